"""From linear radiance to what a display shows: exposure in stops, sRGB encoding, colours of maps."""

from __future__ import annotations

import numpy as np

from halfspace_sss.checks import check_finite

__all__ = ["LARGEST", "check_image", "luminance", "noise_of", "srgb", "stops_of"]

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
