"""Differences between images: their order, their masks, and that bad input is refused."""

from __future__ import annotations

from typing import Any

import flip_evaluator
import numpy as np
import pytest

from full_geometry.trade.image_differences import flip_ldr, relative_mse, srgb

METRICS = [flip_ldr, relative_mse]


def _picture(height: int = 32, width: int = 40, seed: int = 1) -> np.ndarray:
    """A smooth picture in [0.1, 0.9] that fills its range."""
    y, x = np.mgrid[0:height, 0:width]
    phase = np.random.default_rng(seed).uniform(0, 6, 3)
    return (0.5 + 0.4 * np.sin(x[..., None] / 5 + y[..., None] / 7 + phase)).astype(np.float32)


def _noisy(image: np.ndarray, sigma: float) -> np.ndarray:
    return np.clip(image + sigma * np.random.default_rng(3).standard_normal(image.shape), 0, 1)


@pytest.mark.parametrize("metric", METRICS)
def test_identical_images_have_no_difference(metric: Any) -> None:
    image = _picture()
    found = metric(image, image.copy())
    assert found.mean == 0 and found.map.shape == image.shape[:2] and not found.map.any()


@pytest.mark.parametrize("metric", METRICS)
def test_more_noise_is_a_larger_difference(metric: Any) -> None:
    image = _picture()
    means = [metric(image, _noisy(image, sigma)).mean for sigma in (0.01, 0.05, 0.2)]
    assert 0 < means[0] < means[1] < means[2]


@pytest.mark.parametrize("metric", METRICS)
def test_the_mean_is_that_of_the_map_over_the_mask(metric: Any) -> None:
    image, inside = _picture(), np.zeros((32, 40), dtype=bool)
    test = image.copy()
    test[:, 20:] = 1 - test[:, 20:]
    inside[:, 30:] = True
    changed, all_pixels = metric(image, test, mask=inside), metric(image, test)
    assert changed.mean == pytest.approx(changed.map[inside].mean(), rel=1e-6)
    assert changed.mean > 1.5 * all_pixels.mean
    assert metric(image, test, mask=~inside & (np.arange(40) < 5)).mean < 1e-3


def test_flip_is_what_the_evaluator_gives() -> None:
    a, b = _picture(), _noisy(_picture(), 0.1).astype(np.float32)
    error, mean, _ = flip_evaluator.evaluate(a, b, "LDR", applyMagma=False)
    found = flip_ldr(a, b)
    np.testing.assert_allclose(found.map, error[..., 0], atol=2e-4)
    assert found.mean == pytest.approx(mean, abs=1e-4)


def test_relative_error_is_its_formula() -> None:
    a, b = np.full((4, 4, 3), 2.0), np.full((4, 4, 3), 2.5)
    assert relative_mse(a, b).mean == pytest.approx(0.25 / 4.01)


def test_the_display_curve_is_that_of_srgb() -> None:
    np.testing.assert_allclose(srgb([0, 0.0031308, 0.2140, 1, 7]), [0, 0.04045, 0.5, 1, 1], atol=1e-4)
    np.testing.assert_allclose(srgb([0.25], exposure=2), [1])


_GOOD = np.full((8, 8, 3), 0.5)
_NAN, _NEGATIVE, _BRIGHT = (np.where(np.arange(192).reshape(8, 8, 3) == 100, v, 0.5) for v in (np.nan, -1, 1.5))


@pytest.mark.parametrize(
    ("metric", "arguments", "options", "message"),
    [
        *((m, (_GOOD, _GOOD[:, :6]), {}, r"test must have the shape of reference \(8, 8, 3\)") for m in METRICS),
        *((m, (_GOOD, _NAN), {}, "test must be finite .* got nan at row 4, column 1, channel 1") for m in METRICS),
        *((m, (_NEGATIVE, _GOOD), {}, "reference must be finite and in .* got -1.0") for m in METRICS),
        *((m, (_GOOD[..., 0], _GOOD), {}, r"reference must have the shape \(height, width, 3\)") for m in METRICS),
        *((m, (_GOOD[:3], _GOOD[:3]), {}, "reference must be at least 4 pixels") for m in METRICS),
        *((m, ("a.exr", _GOOD), {}, "reference must be an array of numbers, got str") for m in METRICS),
        *((m, (_GOOD, _GOOD), {"mask": np.zeros((8, 8), bool)}, "mask must be true for at least") for m in METRICS),
        *((m, (_GOOD, _GOOD), {"mask": np.ones((8, 9), bool)}, "mask must be true or false") for m in METRICS),
        (flip_ldr, (_GOOD, _BRIGHT), {}, r"test must be finite and in \[0, 1\], got 1.5"),
    ],
)  # fmt: skip
def test_bad_input_is_refused(metric: Any, arguments: tuple, options: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        metric(*arguments, **options)
