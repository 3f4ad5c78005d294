"""One image from two of the same scene, by walks and by a model, with weights that know nothing of the pixel."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from halfspace_sss.rendering.scenes.reference_store import Reference

__all__ = ["combined"]

TILE = 8  # pixels


def combined(walks: Reference, model: Reference) -> Reference:
    """s walks + (1 - s) model, with the share s = V_model / (V_walks + V_model) that has the smallest variance.

    V is the sum of the variances of the mean over pixels and colours. As a pixel that happens to be bright has a large
    variance too, weights from the pixels themselves would darken the image: the image is cut into tiles like a
    chessboard, and the white ones take s from the black ones and the other way round. With fewer than two passes of
    one of them, or where neither varies, s is the share of the samples. The bias of the model does not count.

    Args:
        walks, model: of the same scene and sensor. What `model` is about is kept; `about["combined"]` tells the rest.
    """
    share = np.zeros(model.mean.shape[:2])
    white = _white(*share.shape)
    for to, of in ((white, ~white), (~white, white)):
        share[to] = _share(walks, model, of)
    s = share[..., None]
    about = {
        "share_of_walks": float(share.mean()),
        "walks": _told(walks),
        "model": _told(model),
    }
    mean = s * walks.mean + (1 - s) * model.mean
    variance = s**2 * walks.variance + (1 - s) ** 2 * model.variance
    return replace(
        model, mean=mean, variance=variance,
        passes=walks.passes + model.passes, spp=walks.spp + model.spp, seconds=walks.seconds + model.seconds,
        about={**model.about, "combined": about},
    )  # fmt: skip


def _white(height: int, width: int) -> np.ndarray:
    tile = max(min(TILE, height // 2, width // 2), 1)
    y, x = np.indices((height, width)) // tile
    return (x + y) % 2 == 0


def _share(walks: Reference, model: Reference, of: np.ndarray) -> float:
    by_walks, by_model = (float(image.variance[of][..., :3].sum()) for image in (walks, model))
    if min(walks.passes, model.passes) < 2 or not by_walks + by_model > 0:
        return walks.spp / (walks.spp + model.spp)
    return by_model / (by_walks + by_model)


def _told(image: Reference) -> dict[str, float | int | None]:
    error = image.relative_error
    return {
        "spp": image.spp,
        "passes": image.passes,
        "seconds": image.seconds,
        "relative_error": error if np.isfinite(error) else None,
    }
