"""One image from two of the same scene, by walks and by a model: inverse-variance weights, cross-weighted."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from full_geometry.scenes.reference_store import BY_CHANCE, Reference

TILE = 8  # pixels


def combined(walks: Reference, model: Reference) -> Reference:
    """s walks + (1 - s) model, with the share s = V_model / (V_walks + V_model) that has the smallest variance.

    The image is cut into tiles like a chessboard. In each the variances of the mean are summed over pixels and colours,
    and V is the square of the mean of the roots of these sums, so that a single spike, as walks have them that find a
    small light by chance, does not decide alone. As a pixel that happens to be bright has a large variance too, weights
    from the pixels themselves would darken the image. Tiles are cross-weighted: white ones take s from the black ones
    and the other way round, as the two buffers of Rousselle, Knaus and Zwicker (2012) filter each other. Filters
    wider than a box let neighbours at the edges of tiles share samples. With fewer than two passes of one of them, or
    where neither varies, s is the share of the samples. The bias of the model does not count.

    Args:
        walks, model: of the same scene and sensor. What `model` is about is kept; `about["combined"]` tells the rest.
    """
    share = np.zeros(model.mean.shape[:2])
    row, column, tiles = _tiles(*share.shape)
    white = (row + column) % 2 == 0
    for to, of in ((white, ~white), (~white, white)):
        share[to] = _share(walks, model, np.where(of, tiles, -1))
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
        about={**{k: v for k, v in model.about.items() if k != BY_CHANCE}, "combined": about},
    )  # fmt: skip


def _tiles(height: int, width: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Row, column and number of the tile of each pixel."""
    side = max(min(TILE, height // 2, width // 2), 1)
    row, column = np.indices((height, width)) // side
    return row, column, row * (column.max() + 1) + column


def _share(walks: Reference, model: Reference, tiles: np.ndarray) -> float:
    """s from the pixels whose tile is not -1."""
    by_walks, by_model = (_spread(image.variance[..., :3], tiles) ** 2 for image in (walks, model))
    if min(walks.passes, model.passes) < 2 or not by_walks + by_model > 0:
        return walks.spp / (walks.spp + model.spp)
    return by_model / (by_walks + by_model)


def _spread(variance: np.ndarray, tiles: np.ndarray) -> float:
    """Mean over tiles of the root of the sum of variances."""
    inside = tiles >= 0
    sums = np.bincount(tiles[inside], weights=variance[inside].sum(axis=-1))
    counts = np.bincount(tiles[inside])
    return float(np.sqrt(np.maximum(sums[counts > 0], 0)).mean()) if inside.any() else 0.0


def _told(image: Reference) -> dict[str, float | int | None]:
    error = image.relative_error
    return {
        "spp": image.spp,
        "passes": image.passes,
        "seconds": image.seconds,
        "relative_error": error if np.isfinite(error) else None,
    }
