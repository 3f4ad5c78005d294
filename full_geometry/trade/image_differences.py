"""How different images are: sRGB encoding, FLIP and relative squared error.

Everything is checked here before the evaluator of FLIP is called, because it ends the whole process on bad input.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from halfspace_sss.checks import check_finite

LARGEST = 1e12  # radiance; squares of it, as tone mapping takes them, still fit float32


def srgb(image: np.ndarray, exposure: float = 0.0) -> np.ndarray:
    """A linear image as a display shows it: times 2^exposure, clipped to [0, 1], encoded by the sRGB curve.
    `image`: linear radiance, any shape, finite and >= 0. `exposure`: stops. ValueError if exposure is not finite."""
    check_finite("exposure", exposure)
    x = np.clip(np.asarray(image, dtype=np.float32) * np.float32(2.0**exposure), 0.0, 1.0)
    return np.where(x <= 0.0031308, 12.92 * x, 1.055 * np.maximum(x, 1e-9) ** (1 / 2.4) - 0.055).astype(np.float32)


def luminance(image: np.ndarray) -> np.ndarray:
    """Luminance (H, W) of a linear image (H, W, 3) with the primaries of sRGB."""
    return np.asarray(image, dtype=np.float64) @ np.array([0.2126, 0.7152, 0.0722])


def check_image(name: str, image: np.ndarray, largest: float = LARGEST) -> np.ndarray:
    """The image as contiguous float32 of shape (H, W, 3).
    ValueError if the shape is another, a value is not finite, below 0 or above `largest`."""
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
FLOOR = 0.01  # squared radiance, which keeps black pixels from deciding a mean


class Difference(NamedTuple):
    """Map (H, W) of a difference, and its mean over the pixels that count."""

    map: np.ndarray
    mean: float


def flip_ldr(reference: np.ndarray, test: np.ndarray, *, mask: np.ndarray | None = None) -> Difference:
    """FLIP between two images as displayed: what an observer sees when flipping between them, 0 to 1.
    `reference`, `test`: sRGB-encoded images (H, W, 3) in [0, 1], as `srgb` makes them. `mask`: (H, W), true where a
    pixel counts for the mean; the map covers all. ValueError if shape, size or range is wrong.

    Source: Andersson et al., FLIP: A Difference Evaluator for Alternating Images, HPG 2020.
    """
    reference, test, inside = _checked(reference, test, mask, largest=1.0)
    import flip_evaluator

    error, _, _ = flip_evaluator.evaluate(
        reference, test, "LDR", applyMagma=False, computeMeanError=False, parameters={"ppd": PIXELS_PER_DEGREE}
    )
    shown = np.clip(error[..., 0], 0.0, 1.0)
    return Difference(shown, float(shown[inside].mean(dtype=np.float64)))


def relative_mse(reference: np.ndarray, test: np.ndarray, *, mask: np.ndarray | None = None) -> Difference:
    """Relative squared error (test - reference)² / (reference² + FLOOR), mean of the channels.
    `reference`, `test`: linear radiance (H, W, 3), finite and >= 0. `mask`: as of `flip_ldr`. ValueError likewise."""
    reference, test, inside = _checked(reference, test, mask)
    a, b = reference.astype(np.float64), test.astype(np.float64)
    error = ((b - a) ** 2 / (a * a + FLOOR)).mean(axis=2)
    return Difference(error, float(error[inside].mean()))


def _checked(
    reference: np.ndarray, test: np.ndarray, mask: np.ndarray | None, **bounds: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    a, b = check_image("reference", reference, **bounds), check_image("test", test, **bounds)
    if a.shape != b.shape:
        raise ValueError(f"test must have the shape of reference {a.shape}, got {b.shape}")
    if min(a.shape[:2]) < SMALLEST_SIDE:
        raise ValueError(f"reference must be at least {SMALLEST_SIDE} pixels wide and high, got {a.shape}")
    shape = a.shape[:2]
    inside = np.ones(shape, dtype=bool) if mask is None else np.asarray(mask)
    if inside.dtype != bool or inside.shape != shape:
        raise ValueError(f"mask must be true or false in the shape {shape}, got {inside.dtype} in {inside.shape}")
    if not inside.any():
        raise ValueError("mask must be true for at least one pixel, got none")
    return a, b, inside
