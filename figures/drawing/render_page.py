"""A render as a page that opens by a double click, and without its noise: the entry point "render"."""

from __future__ import annotations

from typing import TYPE_CHECKING

import matplotlib  # noqa: F401  without it there is no page, which must be known before one is drawn
import numpy as np

from figures.drawing.page import page
from figures.drawing.shot import Shot

if TYPE_CHECKING:
    from halfspace_sss.rendering.scenes.picture import Picture

__all__ = ["render"]


def render(picture: Picture) -> dict[str, bytes]:
    """{"html": page}, and with `denoise` {"denoised.exr", "denoised.png"}; on the page both images can be flipped.

    Raises:
        ValueError: the image is not finite or below 0.
        BackendError: the denoiser is not installed.
    """
    image = np.maximum(picture.image, 0.0)  # filters with negative lobes
    shots, files = [Shot("rendered", image, dict(picture.numbers))], {}
    if picture.denoise:
        from figures.computing.denoise import denoised, guides

        clean, seconds = denoised(image, *guides(picture.scene, sensor=picture.sensor))
        shots.append(Shot("denoised", clean, {"denoising, s": f"{seconds:.2g}"}))
        files = {"denoised.exr": picture.exr(clean), "denoised.png": picture.png(clean)}
    text = page(picture.title, {picture.title: shots}, caption=picture.caption, lower_is_better=())
    return {"html": text.encode(), **files}
