"""Derivatives of images by walks: they add up to differences of images, and agree in both directions."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

mi = pytest.importorskip("mitsuba")
import drjit as dr  # noqa: E402

pytestmark = pytest.mark.usefixtures("rgb")

LIGHTS = {
    "sky": {"type": "constant"},
    "point": {"type": "point", "position": [30, 20, 40], "intensity": 3000.0},
}
MEDIA = {
    "sky": {"albedo": "0.9,0.8,0.5", "sigma_t": "0.3,0.2,0.4", "g": 0.9, "eta": 1.3},
    "point": {"albedo": "0.95,0.9,0.8", "sigma_t": "1.0,0.5,0.8", "eta": 1.4},
}
WIDEST_Z = 4.0
RUNS = 6


def _scene(light: str, n: int = 8, **surface: Any) -> mi.Scene:
    """A cube or a ball that fills the view; a unit is 1.2 mm."""
    film = {"type": "hdrfilm", "width": n, "height": n, "rfilter": {"type": "box"}, "component_format": "float32"}
    view = mi.ScalarTransform4f().look_at([0, 0, 50], [0, 0, 0], [0, 1, 0])
    cube = {"type": "cube", "to_world": mi.ScalarTransform4f().scale(4).rotate([1, 1, 0], 30)}
    shape = cube if light == "sky" else {"type": "sphere", "radius": 6.0}
    return mi.load_dict({
        "type": "scene", "integrator": {"type": "translucent_walk", "mm_per_unit": 1.2}, "light": LIGHTS[light],
        "sensor": {"type": "perspective", "fov": 12.0, "to_world": view, "film": film},
        "object": {**shape, "bsdf": {"type": "translucent", **MEDIA[light], **surface}},
    })  # fmt: skip


def _put(scene: mi.Scene, name: str, value: np.ndarray, followed: bool = False) -> tuple[Any, mi.Spectrum]:
    parameters, value = mi.traverse(scene), mi.Spectrum(value.tolist())
    if followed:
        dr.enable_grad(value)
    parameters[f"object.bsdf.{name}"] = value
    parameters.update()
    return parameters, value


def _slope(scene: mi.Scene, name: str, at: np.ndarray, seed: int, spp: int) -> np.ndarray:
    """Derivative of the mean of each channel of the image by that of the parameter."""
    parameters, value = _put(scene, name, at, True)
    dr.backward(dr.sum(mi.render(scene, parameters, spp=spp, seed=seed), axis=None) / 64)
    return np.ravel(np.array(dr.grad(value)))


def _mean(scene: mi.Scene, name: str, at: np.ndarray, seed: int, spp: int) -> np.ndarray:
    _put(scene, name, at)
    return np.array(mi.render(scene, spp=spp, seed=seed)).mean(axis=(0, 1))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("light", "key", "change", "spp", "known_to"),
    [("sky", "albedo", -0.3, 96, 0.02), ("sky", "sigma_t", 0.2, 192, 0.02), ("point", "albedo", -0.2, 48, 0.1),
     ("point", "g", -0.6, 48, 0.25)],
)  # fmt: skip
def test_derivatives_by_the_medium_add_up_to_the_difference_of_images(
    light: str, key: str, change: float, spp: int, known_to: float
) -> None:
    scene = _scene(light)
    start = np.ravel(np.array(mi.traverse(scene)[f"object.bsdf.{key}"]))
    nodes, weights = np.polynomial.legendre.leggauss(3)
    found, expected = [], []
    for run in range(RUNS):
        at = [start + change * (x + 1) / 2 for x in nodes]
        slopes = [_slope(scene, key, x, 10 * run + k, spp) for k, x in enumerate(at)]
        found.append(change * (weights / 2) @ np.array(slopes))
        sides = [_mean(scene, key, start + x, 1000 + 10 * run + k, 4 * spp) for k, x in enumerate((0.0, change))]
        expected.append(sides[1] - sides[0])
    found, expected = np.array(found), np.array(expected)
    error = np.sqrt((found.var(axis=0, ddof=1) + expected.var(axis=0, ddof=1)) / RUNS)
    assert (np.abs(found.mean(axis=0) - expected.mean(axis=0)) < WIDEST_Z * error).all()
    assert (error < known_to * np.abs(expected.mean(axis=0))).all()


def test_forward_and_backward_derivatives_of_walks_agree_and_leave_the_image() -> None:
    scene = _scene("point", 4)
    before, found = np.array(mi.render(scene, spp=64, seed=3)), {}
    for name in ("albedo", "sigma_t", "g"):
        at = np.ravel(np.array(mi.traverse(scene)[f"object.bsdf.{name}"]))
        parameters, value = _put(scene, name, at, True)
        image = mi.render(scene, parameters, spp=64, seed=3)
        assert np.array_equal(np.array(image), before)
        dr.backward(dr.sum(image, axis=None))
        found[name] = np.ravel(np.array(dr.grad(value)))
        parameters, value = _put(scene, name, at, True)
        dr.set_grad(value, 1.0)
        image = mi.render(scene, parameters, spp=64, seed=3)
        forward = np.array(dr.forward_to(image)).sum(axis=(0, 1))
        assert forward == pytest.approx(found[name], rel=1e-4, abs=1e-6)
        _put(scene, name, at)
    assert (found["albedo"] > 0).all()


def test_derivatives_by_an_albedo_of_zero_are_refused() -> None:
    scene = _scene("sky", 4, albedo="0.9,0,0.5")
    with pytest.raises((ValueError, RuntimeError)) as caught:
        _slope(scene, "albedo", np.array([0.9, 0.0, 0.5]), 0, 1)
    assert "albedo must be > 0" in str(caught.value) + str(caught.value.__cause__)
