"""Images of figures: exposure and sRGB encoding, FLIP and relative squared error, denoising, shots.

Everything is checked here before the evaluator of FLIP is called, because it ends the whole process on bad input.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from halfspace_sss.backend import BackendError
from halfspace_sss.checks import check_finite, check_interval

LARGEST = 1e12  # radiance; squares of it, as tone mapping takes them, still fit float32


def srgb(image: np.ndarray, exposure: float = 0.0) -> np.ndarray:
    """A linear image as a display shows it: times 2^exposure, clipped to [0, 1], encoded by the sRGB curve.

    Args:
        image: linear radiance, any shape, finite and >= 0.
        exposure: stops.

    Raises:
        ValueError: exposure is not finite.
    """
    check_finite("exposure", exposure)
    x = np.clip(np.asarray(image, dtype=np.float32) * np.float32(2.0**exposure), 0.0, 1.0)
    return np.where(x <= 0.0031308, 12.92 * x, 1.055 * np.maximum(x, 1e-9) ** (1 / 2.4) - 0.055).astype(np.float32)


def stops_of(reference: np.ndarray, mask: np.ndarray) -> float:
    """Stops, to a tenth, at which the 97th percentile of the pixels of a mask comes to 1."""
    return float(np.round(-np.log2(np.percentile(reference[mask], 97)), 1))


def noise_of(image: np.ndarray, variance: np.ndarray, mask: np.ndarray) -> float:
    """Root mean square of the standard error of the pixels of a mask, over that of the image."""
    return float(np.sqrt(variance[mask].sum() / np.sum(image[mask] ** 2)))


def luminance(image: np.ndarray) -> np.ndarray:
    """Luminance (H, W) of a linear image (H, W, 3) with the primaries of sRGB."""
    return np.asarray(image, dtype=np.float64) @ np.array([0.2126, 0.7152, 0.0722])


def check_image(name: str, image: np.ndarray, largest: float = LARGEST) -> np.ndarray:
    """The image as contiguous float32 of shape (H, W, 3).

    Raises:
        ValueError: the shape is another, a value is not finite, below 0 or above `largest`.
    """
    try:
        pixels = np.asarray(image, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{name} must be an array of numbers, got {type(image).__name__}") from error
    if pixels.ndim != 3 or pixels.shape[2] != 3 or 0 in pixels.shape:
        raise ValueError(f"{name} must have the shape (height, width, 3), got {pixels.shape}")
    bad = ~((pixels >= 0) & (pixels <= largest))
    if bad.any():
        y, x, channel = (int(k) for k in np.argwhere(bad)[0])
        raise ValueError(
            f"{name} must be finite and in [0, {largest:g}], got {float(pixels[y, x, channel])!r} "
            f"at row {y}, column {x}, channel {channel} ({int(bad.sum())} such values)"
        )
    return np.ascontiguousarray(pixels, dtype=np.float32)


PIXELS_PER_DEGREE = 67.0206  # FLIP's own: a 0.69 m wide display of 3840 pixels seen from 0.7 m
SMALLEST_SIDE = 4  # pixels


class Difference(NamedTuple):
    """Map (H, W) of a difference, its mean over the pixels that count, and the settings it was taken with."""

    map: np.ndarray
    mean: float
    settings: dict[str, Any]


def flip_ldr(
    reference: np.ndarray, test: np.ndarray, *, mask: np.ndarray | None = None,
    pixels_per_degree: float = PIXELS_PER_DEGREE,
) -> Difference:  # fmt: skip
    """FLIP between two images as displayed: what an observer sees when flipping between them, 0 to 1.

    Args:
        reference, test: sRGB-encoded images (H, W, 3) in [0, 1], as `figures.computing.images.srgb` makes them.
        mask: (H, W), true where a pixel counts for the mean; the map covers all.
        pixels_per_degree: of visual angle; the default is FLIP's.

    Raises:
        ValueError: shape, size or range is wrong; names the argument and the pixel.

    Source: Andersson et al., FLIP: A Difference Evaluator for Alternating Images, HPG 2020.
    """
    reference, test, inside = _checked(reference, test, mask, largest=1.0)
    check_interval("pixels_per_degree", pixels_per_degree, 1.0, 1e4)
    import flip_evaluator

    parameters = {"ppd": float(pixels_per_degree)}
    error, _, used = flip_evaluator.evaluate(
        reference, test, "LDR", applyMagma=False, computeMeanError=False, parameters=parameters
    )
    shown = np.clip(error[..., 0], 0.0, 1.0)
    return Difference(shown, float(shown[inside].mean(dtype=np.float64)), {"ppd": used["ppd"]})


def relative_mse(
    reference: np.ndarray, test: np.ndarray, *, mask: np.ndarray | None = None, floor: float = 0.01
) -> Difference:
    """Relative squared error (test - reference)² / (reference² + floor) of linear images, mean of the channels.

    Args:
        reference, test: linear radiance (H, W, 3), finite and >= 0.
        mask: (H, W), true where a pixel counts for the mean; the map covers all.
        floor: squared radiance, > 0; keeps black pixels from deciding the mean.

    Raises:
        ValueError: an argument is out of range.
    """
    reference, test, inside = _checked(reference, test, mask)
    check_interval("floor", floor, 1e-12, 1e12)
    a, b = reference.astype(np.float64), test.astype(np.float64)
    error = ((b - a) ** 2 / (a * a + floor)).mean(axis=2)
    return Difference(error, float(error[inside].mean()), {"floor": float(floor)})


def _checked(
    reference: np.ndarray, test: np.ndarray, mask: np.ndarray | None, **bounds: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    a, b = check_image("reference", reference, **bounds), check_image("test", test, **bounds)
    if a.shape != b.shape:
        raise ValueError(f"test must have the shape of reference {a.shape}, got {b.shape}")
    if min(a.shape[:2]) < SMALLEST_SIDE:
        raise ValueError(f"reference must be at least {SMALLEST_SIDE} pixels wide and high, got {a.shape}")
    return a, b, _checked_mask(mask, a.shape[:2])


def _checked_mask(mask: np.ndarray | None, shape: tuple[int, ...]) -> np.ndarray:
    inside = np.ones(shape, dtype=bool) if mask is None else np.asarray(mask)
    if inside.dtype != bool or inside.shape != shape:
        raise ValueError(f"mask must be true or false in the shape {shape}, got {inside.dtype} in {inside.shape}")
    if not inside.any():
        raise ValueError("mask must be true for at least one pixel, got none")
    return inside


GUIDE_SPP = 64


def check_denoiser() -> Any:
    """The package `mitsuba_oidn`; BackendError with what to install where there is none."""
    try:
        import mitsuba_oidn
    except ImportError as error:
        raise BackendError('denoising needs mitsuba-oidn: pip install "halfspace-sss[figures]"') from error
    return mitsuba_oidn


def cover(scene: Any, spp: int = GUIDE_SPP) -> np.ndarray:
    """Share of each pixel that objects cover, (H, W), float32."""
    return _cover(_aovs(scene, "n:sh_normal", spp, 0))


def guides(scene: Any, spp: int = GUIDE_SPP, sensor: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Mean albedo of each pixel (H, W, 3) and mean shading normal (H, W, 3), both float32.

    The albedo of translucent objects is their directional albedo. Where there is none at all, as of mirrors and glass,
    it is the cover of the pixel, as Open Image Denoise asks.
    """
    both = _aovs(scene, "albedo:albedo,n:sh_normal", spp, sensor)
    albedo, normal = np.clip(both[..., :3], 0, 1), both[..., 3:6]
    return np.where(albedo.any(axis=2, keepdims=True), albedo, _cover(normal)[..., None]), np.clip(normal, -1, 1)


def _aovs(scene: Any, aovs: str, spp: int, sensor: int) -> np.ndarray:
    import mitsuba as mi

    integrator = mi.load_dict({"type": "aov", "aovs": aovs})
    return np.array(mi.render(scene, integrator=integrator, sensor=sensor, spp=spp, seed=7), dtype=np.float32)


def _cover(normal: np.ndarray) -> np.ndarray:
    return np.clip(np.linalg.norm(normal[..., :3], axis=2), 0, 1)


def denoised(image: np.ndarray, albedo: np.ndarray, normal: np.ndarray) -> tuple[np.ndarray, float]:
    """The image without its noise, float32, and the seconds it took.

    Args:
        image: linear radiance (H, W, 3).
        albedo, normal: as `guides` makes them.

    Raises:
        ValueError: the image is not finite or below 0, or the sizes differ.
        BackendError: the denoiser is not installed.
    """
    oidn, pixels = check_denoiser(), check_image("image", image)
    for name, guide in (("albedo", albedo), ("normal", normal)):
        if np.shape(guide) != pixels.shape:
            raise ValueError(f"{name} must have the shape of the image {pixels.shape}, got {np.shape(guide)}")
    albedo, normal = (np.ascontiguousarray(guide, dtype=np.float32) for guide in (albedo, normal))
    started = time.perf_counter()
    result = oidn.denoise(pixels, albedo=albedo, normal=normal, hdr=True)
    return np.maximum(np.asarray(result), 0.0), time.perf_counter() - started


WHITE = 0.9  # encoded luminance of the bright end
BRIGHT = 99.0  # percentile that comes out there


def mean_flip(reference: np.ndarray, test: np.ndarray) -> float:
    """Mean LDR-FLIP of two images, both exposed so that the bright end of the reference is nearly white."""
    level = float(np.percentile(luminance(reference), BRIGHT))
    exposure = float(np.log2(WHITE / level)) if level > 0 else 0.0
    return flip_ldr(srgb(reference, exposure), srgb(test, exposure)).mean


FLIP, RELATIVE_MSE = "FLIP", "relMSE"
FLOOR = 0.01  # squared radiance, as in the relative error


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
        ValueError: the images cannot be compared; see `figures.computing.images`.
    """
    image = np.maximum(image, 0)
    relative = relative_mse(reference, image, mask=mask, floor=FLOOR)
    flip = flip_ldr(srgb(reference, exposure), srgb(image, exposure), mask=mask)
    a, b = luminance(reference), luminance(image)
    results = {FLIP: flip.mean, RELATIVE_MSE: relative.mean, **(numbers or {})}
    return Shot(label, image, results, flip.map, (b - a) / np.sqrt(a * a + FLOOR))
