"""Images of figures: shots of a scene with what they differ by from a reference."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from full_geometry.trade.image_differences import FLOOR, check_image, flip_ldr, luminance, relative_mse, srgb


def stops_of(reference: np.ndarray, mask: np.ndarray) -> float:
    """Stops, to a tenth, at which the 97th percentile of the pixels of a mask comes to 1."""
    return float(np.round(-np.log2(np.percentile(reference[mask], 97)), 1))


def noise_of(image: np.ndarray, variance: np.ndarray, mask: np.ndarray) -> float:
    """Root mean square of the standard error of the pixels of a mask, over that of the image."""
    return float(np.sqrt(variance[mask].sum() / np.sum(image[mask] ** 2)))


FLIP, RELATIVE_MSE = "FLIP", "relMSE"


@dataclass(frozen=True)
class Shot:
    """One image of a scene.

    Args:
        label: of the model or method.
        image: linear radiance (H, W, 3); None where there is none to be shown.
        numbers: column of a table -> number or text.
        flip: FLIP map (H, W) in [0, 1]; None for a reference.
        difference: signed relative difference of luminance (H, W), > 0 where brighter; None for a reference.
        why: what stands in the place of an image that is not there.
    """

    label: str
    image: np.ndarray | None
    numbers: Mapping[str, float | str] = field(default_factory=dict)
    flip: np.ndarray | None = None
    difference: np.ndarray | None = None
    why: str = ""

    def __post_init__(self) -> None:
        if self.image is not None:
            check_image(f"image {self.label!r}", self.image)


def absent(label: str, why: str = "not available") -> Shot:
    """The place of an image that does not exist yet, in a grid or a page."""
    return Shot(label, None, why=why)


def compared(
    label: str, image: np.ndarray, reference: np.ndarray, *, exposure: float = 0.0, mask: np.ndarray | None = None,
    numbers: Mapping[str, float | str] | None = None,
) -> Shot:  # fmt: skip
    """An image with its FLIP, its relative squared error and both maps against a reference.

    FLIP is that of the displayed images, `srgb(image, exposure)`. The map of differences is of luminance,
    (Y - Y_ref) / sqrt(Y_ref² + 0.01).

    Args:
        label: of the model or method.
        image, reference: linear radiance (H, W, 3); of the image, what noise has brought below 0 counts as 0.
        exposure: stops, those at which the images are shown.
        mask: (H, W), true for the pixels that count for the means, e.g. those of the object.
        numbers: further columns, e.g. {"time, s": 12.5}; they come after FLIP and relMSE.

    Raises:
        ValueError: the images cannot be compared; see `full_geometry.trade.image_differences`.
    """
    image = np.maximum(image, 0)
    relative = relative_mse(reference, image, mask=mask)
    flip = flip_ldr(srgb(reference, exposure), srgb(image, exposure), mask=mask)
    a, b = luminance(reference), luminance(image)
    results = {FLIP: flip.mean, RELATIVE_MSE: relative.mean, **(numbers or {})}
    return Shot(label, image, results, flip.map, (b - a) / np.sqrt(a * a + FLOOR))
