"""Denoised renders: their error by halves of the samples, targets, files."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytestmark = pytest.mark.usefixtures("rgb")
mi = pytest.importorskip("mitsuba")


def _blurred(image: np.ndarray) -> np.ndarray:
    """A denoiser with a bias: means over 5 x 5 pixels, and 2 % too bright."""
    sums = sum(np.roll(image[..., :3], (j, k), (0, 1)) for j in range(-2, 3) for k in range(-2, 3))
    return 1.02 * sums / 25


def _passes(truth: np.ndarray, sizes: list[int], noise: float, seed: int) -> Any:
    from full_geometry.scenes.reference_store import Reference

    rng, found = np.random.default_rng(seed), Reference.empty(truth.shape, {}, halves=True)
    for spp in sizes:
        found = found.add(truth * rng.gamma(spp / noise**2, noise**2 / spp, truth.shape), spp, 1.0)
    return found


@pytest.mark.parametrize("noise", [0.5, 4.0])
def test_the_error_that_is_told_has_the_bias_of_the_denoiser_and_its_noise(noise: float) -> None:
    from full_geometry.scenes.reference import cross_denoised

    x, y = np.meshgrid(np.linspace(0, 6, 64), np.linspace(0, 6, 64))
    truth = np.repeat((1.2 + np.sin(x) * np.cos(2 * y))[..., None], 3, axis=2)
    errors, told, standard = [], [], []
    for seed in range(8):
        clean = cross_denoised(_passes(truth, [1, 1, 1, 1, 2, 2, 4, 4], noise, seed), _blurred)
        errors.append(np.sqrt(np.square(clean.image - truth).sum() / np.square(truth).sum()))
        told.append(clean.error)
        standard.append(clean.standard_error)
    assert np.mean(errors) > 0.02
    assert np.mean(told) == pytest.approx(np.mean(errors), abs=4 * np.mean(standard) / np.sqrt(8), rel=0.02)
    assert np.std(np.array(told) - errors) < 2 * np.mean(standard)


def _scene() -> dict:
    film = {"type": "hdrfilm", "width": 24, "height": 24, "rfilter": {"type": "box"}, "pixel_format": "rgb"}
    return {
        "type": "scene", "integrator": {"type": "path"},
        "sensor": {"type": "perspective", "film": film, "to_world": mi.ScalarTransform4f().translate([0, 0, -4])},
        "ball": {"type": "sphere", "bsdf": {"type": "diffuse"}}, "lamp": {"type": "point", "position": [3, 3, -3]},
        "sky": {"type": "constant", "radiance": 0.2},
    }  # fmt: skip


def test_a_denoiser_leaves_little_grain_of_sampled_walks_under_an_even_sky() -> None:
    pytest.importorskip("mitsuba_oidn")
    from full_geometry.trade.denoising import Denoiser

    # ---- a smooth ball of white albedo, whose pixels differ by noise alone about its middle
    size = 96
    film = {"type": "hdrfilm", "width": size, "height": size, "rfilter": {"type": "box"}, "pixel_format": "rgb"}
    medium = {"sigma_t": "12, 16, 16", "albedo": "0.9973, 0.9993, 0.9978", "g": 0.0, "eta": 1.0}
    to_world = mi.ScalarTransform4f().look_at([0, 0, -4.5], [0, 0, 0], [0, 1, 0])
    scene = mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "translucent_walk"},
            "sky": {"type": "constant"},
            "sensor": {"type": "perspective", "fov": 30, "film": film, "to_world": to_world},
            "ball": {"type": "sphere", "bsdf": {"type": "translucent", **medium}},
        }  # fmt: skip
    )
    image = np.array(mi.render(scene, spp=16, seed=1))
    y, x = np.indices((size, size)) - size / 2 + 0.5
    middle = np.hypot(x, y) < 0.3 * size

    # the network of half the time leaves 0.4 of it
    raw, left = (each[middle].std(axis=0).mean() for each in (image, Denoiser(scene)(image)))
    assert left < 0.25 * raw


def test_halves_of_a_run_in_two_parts_are_those_of_a_run_in_one(tmp_path: Path) -> None:
    from full_geometry.scenes import reference

    how = {"denoise": _blurred, "spp_per_pass": 2}
    reference.render(_scene(), tmp_path / "parts.exr", spp=6, **how)
    parts = reference.render(_scene(), tmp_path / "parts.exr", spp=14, **how)
    whole = reference.render(_scene(), tmp_path / "whole.exr", spp=14, **how)
    assert (parts.half_spp, parts.spp) == (whole.half_spp, whole.spp) == (8, 14)
    np.testing.assert_array_equal(parts.half, whole.half)
    plain = reference.render(_scene(), tmp_path / "plain.exr", spp=14, spp_per_pass=2)
    np.testing.assert_array_equal(plain.mean, whole.mean)
    with pytest.raises(ValueError, match="must hold the halves of a denoised render to go on with it, got none"):
        reference.render(_scene(), tmp_path / "plain.exr", spp=20, **how)


def test_a_run_stops_at_the_error_of_its_denoised_image(tmp_path: Path) -> None:
    from full_geometry.scenes import reference
    from full_geometry.scenes.reference import cross_denoised

    def none(image: np.ndarray) -> np.ndarray:
        return image[..., :3]

    # what is not denoised at all has the error of its noise
    found = reference.render(_scene(), tmp_path / "a.exr", target_error=0.02, spp=4096, denoise=none)
    assert found.spp < 4096 and found.error <= 0.02
    clean = cross_denoised(found, none)
    assert np.square(clean.image - found.mean).sum() < 0.1 * found.variance.sum()
    assert clean.error == pytest.approx(found.relative_error, rel=0.3)


def test_a_denoiser_that_is_worse_than_the_noise_gives_way() -> None:
    from full_geometry.scenes.reference import cross_denoised

    truth = np.indices((64, 64)).sum(axis=0)[..., None] % 2 + np.array([0.5, 0.4, 0.3])
    found = _passes(truth, [4] * 16, 0.2, 0)
    off = [np.sqrt(np.square(x - truth).mean()) for x in (cross_denoised(found, _blurred).image, found.mean)]
    assert off[0] < 1.1 * off[1]


def test_a_denoised_image_is_black_beside_an_object_that_stands_before_nothing() -> None:
    from full_geometry.scenes.reference import cross_denoised
    from full_geometry.scenes.reference_store import Reference
    from full_geometry.trade.denoising import Denoiser, cover

    pytest.importorskip("mitsuba_oidn")
    scene = mi.load_dict({key: value for key, value in _scene().items() if key != "sky"})
    found = Reference.empty((24, 24, 3), {}, halves=True)
    for seed in range(4):
        found = found.add(np.array(mi.render(scene, spp=1, seed=seed)), 1, 0.0)
    beside, clean = cover(scene) == 0, cross_denoised(found, Denoiser(scene)).image
    assert beside.sum() > 100
    assert (clean[beside] == found.mean[beside]).all()
    assert clean[12, 12].min() > 0


def test_guides_of_a_view_out_of_focus_lose_their_noise() -> None:
    from full_geometry.trade.denoising import guides, without_noise

    pytest.importorskip("mitsuba_oidn")
    tiles = {"type": "checkerboard", "to_uv": mi.ScalarTransform4f().scale([20, 20, 1])}
    scene = mi.load_dict(
        {
            "type": "scene",
            "sensor": {
                "type": "thinlens",
                "aperture_radius": 0.4,
                "focus_distance": 3.0,
                "to_world": mi.ScalarTransform4f().look_at([0, 0, 6], [0, 0, 0], [0, 1, 0]),
                "film": {"type": "hdrfilm", "width": 96, "height": 96, "rfilter": {"type": "box"}},
            },
            "wall": {
                "type": "rectangle",
                "to_world": mi.ScalarTransform4f().scale(5),
                "bsdf": {"type": "diffuse", "reflectance": tiles},
            },
        }
    )
    noisy, exact = guides(scene, spp=16)[0], guides(scene, spp=1024)[0]
    clean = without_noise("albedo", noisy)
    assert np.square(clean - exact).mean() < 0.5 * np.square(noisy - exact).mean()


def test_pixels_far_from_surfaces_do_not_change_what_is_denoised() -> None:
    from full_geometry.trade.denoising import MARGIN, Denoiser

    pytest.importorskip("mitsuba_oidn")
    side, at = 192, 96
    film = {"type": "hdrfilm", "width": side, "height": side, "rfilter": {"type": "box"}, "pixel_format": "rgb"}
    scene = _scene()
    scene["sensor"] = {**scene["sensor"], "film": film, "fov": 60.0}
    denoise = Denoiser(mi.load_dict(scene))
    image = np.random.default_rng(1).random((side, side, 3)).astype(np.float32)
    lamp = image.copy()
    lamp[0, 0] = 1e4
    first, second = denoise(image), denoise(lamp)
    assert MARGIN < at and np.array_equal(first[at, at], second[at, at])
    assert second[0, 0, 0] == np.float32(1e4) and not np.array_equal(first[at, at], image[at, at])
