"""Differences between images: their order, their masks, and that bad input is refused while the process lives on."""

from __future__ import annotations

import subprocess
import sys
from typing import Any

import flip_evaluator
import numpy as np
import pytest

from figures.computing.images import TONE_CURVES, exposure_range, flip_hdr, flip_ldr, relative_mse, srgb

METRICS = [flip_ldr, flip_hdr, relative_mse]


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
    for metric, kind in ((flip_ldr, "LDR"), (flip_hdr, "HDR")):
        error, mean, _ = flip_evaluator.evaluate(a, b, kind, applyMagma=False)
        found = metric(a, b)
        np.testing.assert_allclose(found.map, error[..., 0], atol=2e-4)
        assert found.mean == pytest.approx(mean, abs=1e-4)


@pytest.mark.parametrize("tone_mapper", TONE_CURVES)
def test_exposures_without_a_mask_are_those_of_the_evaluator(tone_mapper: str) -> None:
    image = 3 * _picture()
    *_, used = flip_evaluator.evaluate(image, image, "HDR", applyMagma=False, parameters={"tonemapper": tone_mapper})
    expected = (used["startExposure"], used["stopExposure"])
    assert exposure_range(image, tone_mapper=tone_mapper) == pytest.approx(expected, abs=1e-3)
    assert flip_hdr(image, image, tone_mapper=tone_mapper).settings["numExposures"] == used["numExposures"]


def test_a_black_background_does_not_stretch_the_exposures_of_the_mask() -> None:
    image, inside = np.zeros((40, 40, 3)), np.zeros((40, 40), dtype=bool)
    inside[10:20, 10:20] = True
    image[inside] = 0.5
    assert exposure_range(image)[1] > 20
    low, high = exposure_range(image, inside)
    assert low == pytest.approx(high)


def test_flip_of_linear_images_does_not_depend_on_their_scale() -> None:
    a, b = _picture(), _noisy(_picture(), 0.1)
    assert flip_hdr(100 * a, 100 * b).mean == pytest.approx(flip_hdr(a, b).mean, rel=1e-3)


def test_seen_from_farther_away_noise_is_a_smaller_difference() -> None:
    a, b = _picture(), _noisy(_picture(), 0.1)
    near, far = (flip_ldr(a, b, pixels_per_degree=ppd).mean for ppd in (20, 150))
    assert far < near


def test_relative_error_is_its_formula() -> None:
    a, b = np.full((4, 4, 3), 2.0), np.full((4, 4, 3), 2.5)
    assert relative_mse(a, b).mean == pytest.approx(0.25 / 4.01)
    assert relative_mse(a, b, floor=1.0).mean == pytest.approx(0.25 / 5)


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
        (flip_ldr, (_GOOD, _GOOD), {"pixels_per_degree": 0}, "pixels_per_degree must be a number in"),
        (flip_hdr, (_GOOD, _GOOD * np.inf), {}, "test must be finite"),
        (flip_hdr, (0 * _GOOD, _GOOD), {}, "reference must have a luminance above"),
        (flip_hdr, (_GOOD, _GOOD), {"exposures": (3, -2)}, "exposures must ascend"),
        (flip_hdr, (_GOOD, _GOOD), {"exposures": 3}, "exposures must be a first and a last"),
        (flip_hdr, (_GOOD, _GOOD), {"exposures": (0, 99)}, r"exposures\[1\] must be a number in \[-40, 40\]"),
        (flip_hdr, (_GOOD, _GOOD), {"n_exposures": 1}, "n_exposures must be a whole number >= 2"),
        (flip_hdr, (_GOOD, _GOOD), {"tone_mapper": "filmic"}, "tone_mapper must be one of aces, hable, reinhard"),
        (relative_mse, (_GOOD, _GOOD), {"floor": 0}, "floor must be a number in"),
    ],
)  # fmt: skip
def test_bad_input_is_refused(metric: Any, arguments: tuple, options: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        metric(*arguments, **options)


def test_what_ends_the_process_in_the_evaluator_is_only_a_refusal_here() -> None:
    code = (
        "import numpy as np; from {module} import {name} as f; a = np.zeros((8, 8, 3), np.float32)\n"
        "try: f(a, a + 1{more})\n"
        "except ValueError: pass\n"
        "print('alive')"
    )
    ended = code.format(module="flip_evaluator", name="evaluate", more=", 'HDR'")
    refused = code.format(module="figures.computing.images", name="flip_hdr", more="")
    runs = [subprocess.run([sys.executable, "-c", c], capture_output=True, text=True) for c in (ended, refused)]
    assert "alive" not in runs[0].stdout
    assert runs[1].stdout == "alive\n", runs[1].stderr


@pytest.mark.parametrize("value", [1e6, 1e12])
def test_a_firefly_is_one_bad_pixel_and_not_a_bad_map(value: float) -> None:
    image = _picture()
    test = image.copy()
    test[10, 10] = value
    found = flip_hdr(image, test)
    assert np.isfinite(found.map).all() and found.map.argmax() == 10 * 40 + 10 and found.map[30, 35] == 0


def test_black_images_are_compared_where_exposures_are_given() -> None:
    assert flip_hdr(0 * _GOOD, _GOOD, exposures=(0, 2)).mean > 0.5
