"""Derivatives of images by walks: they add up to differences of images, and agree in both directions."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

mi = pytest.importorskip("mitsuba")
import drjit as dr  # noqa: E402

from full_geometry.walk import scores  # noqa: E402

pytestmark = pytest.mark.usefixtures("rgb")

LIGHTS = {
    "sky": {"type": "constant"},
    "point": {"type": "point", "position": [30, 20, 40], "intensity": 3000.0},
    "lamp": {"type": "sphere", "center": [30, 20, 40], "radius": 3.0, "emitter": {"type": "area", "radiance": 90.0}},
}
MEDIA = {
    "sky": {"albedo": "0.9,0.8,0.5", "sigma_t": "0.3,0.2,0.4", "g": 0.9, "eta": 1.3},
    "point": {"albedo": "0.95,0.9,0.8", "sigma_t": "1.0,0.5,0.8", "eta": 1.4},
    "lamp": {"albedo": "0.95,0.9,0.8", "sigma_t": "0.4,0.2,0.3", "g": 0.3, "eta": 1.0},
    "rough": {"albedo": "0.95,0.9,0.8", "sigma_t": "0.4,0.2,0.3", "g": 0.6, "eta": 1.4,
              "b": {"type": "roughdielectric", "int_ior": 1.4, "ext_ior": 1.0, "alpha": 0.3}},
}  # fmt: skip
LIGHTS["rough"] = LIGHTS["lamp"]
TWO = np.array([[[0.95, 0.85, 0.5], [0.8, 0.7, 0.45]]], np.float32)
WIDEST_Z = 4.0
RUNS = 6


def _bitmap(texels: np.ndarray, **more: Any) -> dict[str, Any]:
    return {"type": "bitmap", "bitmap": mi.Bitmap(texels), "raw": True, **more}


def _scene(light: str, n: int = 8, **surface: Any) -> mi.Scene:
    """A cube or a ball that fills the view; a unit is 1.2 mm."""
    film = {"type": "hdrfilm", "width": n, "height": n, "rfilter": {"type": "box"}, "component_format": "float32"}
    view = mi.ScalarTransform4f().look_at([0, 0, 50], [0, 0, 0], [0, 1, 0])
    cube = {"type": "cube", "to_world": mi.ScalarTransform4f().scale(4).rotate([1, 1, 0], 30)}
    shape = cube if light == "sky" else {"type": "sphere", "radius": 6.0}
    return mi.load_dict({
        "type": "scene", "integrator": {"type": "translucent_walk", "mm_per_unit": 1.2, "light": "sampled"},
        "light": LIGHTS[light],
        "sensor": {"type": "perspective", "fov": 12.0, "to_world": view, "film": film},
        "object": {**shape, "bsdf": {"type": "translucent", **MEDIA[light], **surface}},
    })  # fmt: skip


def _put(scene: mi.Scene, name: str, value: np.ndarray, followed: bool = False) -> tuple[Any, mi.Spectrum]:
    parameters = mi.traverse(scene)
    value = mi.Spectrum(value.tolist()) if value.ndim == 1 else mi.TensorXf(np.ascontiguousarray(value, np.float32))
    if followed:
        dr.enable_grad(value)
    parameters[f"object.bsdf.{name}"] = value
    parameters.update()
    return parameters, value


def _slope(scene: mi.Scene, name: str, at: np.ndarray, seed: int, spp: int) -> np.ndarray:
    """Derivative of the mean of each channel of the image by that of the parameter."""
    parameters, value = _put(scene, name, at, True)
    dr.backward(dr.sum(mi.render(scene, parameters, spp=spp, seed=seed), axis=None) / 64)
    return np.array(dr.grad(value)).reshape(at.shape)


def _mean(scene: mi.Scene, name: str, at: np.ndarray, seed: int, spp: int) -> np.ndarray:
    _put(scene, name, at)
    return np.array(mi.render(scene, spp=spp, seed=seed)).mean(axis=(0, 1))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("light", "key", "change", "spp", "known_to"),
    [("sky", "sigma_t", 0.2, 192, 0.02), ("point", "albedo", -0.2, 48, 0.1),
     ("point", "g", -0.6, 48, 0.25), ("lamp", "sigma_t", 0.2, 96, 0.1),
     ("rough", "albedo", -0.2, 48, 0.1), ("rough", "g", -0.3, 96, 0.3),
     ("sky", "albedo.data", np.array([[[-0.3], [-0.1]]]), 96, 0.03)],
)  # fmt: skip
def test_derivatives_by_the_medium_add_up_to_the_difference_of_images(
    light: str, key: str, change: float | np.ndarray, spp: int, known_to: float
) -> None:
    scene = _scene(light, **({"albedo": _bitmap(TWO, filter_type="nearest")} if "data" in key else {}))
    start = np.array(mi.traverse(scene)[f"object.bsdf.{key}"])
    start = np.ravel(start) if start.shape[-1] == 1 else start
    nodes, weights = np.polynomial.legendre.leggauss(3)
    found, expected = [], []
    for run in range(RUNS):
        at = [start + change * (x + 1) / 2 for x in nodes]
        slopes = [_slope(scene, key, x, 10 * run + k, spp) for k, x in enumerate(at)]
        mean = (change * np.tensordot(weights / 2, np.array(slopes), 1)).reshape(-1, 3)
        found.append(mean.sum(axis=0))
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


# ---- Textures ------------------------------------------------------------------------------------------------------


def _plates(painted: str | None, name: str = "albedo") -> mi.Scene:
    """Three plates between which paths go to and fro; one coefficient shown by texels or vertices, or constant."""
    value = np.array([float(x) for x in MEDIA["sky"][name].split(",")])
    texture = _bitmap(np.tile(value, (2, 2, 1)).astype(np.float32))
    if painted == "vertex_color":
        texture = {"type": "mesh_attribute", "name": "vertex_color"}
    surface = {"type": "translucent", **MEDIA["sky"], "g": 0.3, **({name: texture} if painted else {})}
    at, things = mi.ScalarTransform4f(), {}
    for k in range(3):
        place = at.translate([0, 0, 1.4 * k]).rotate([0, 1, 0], 4 * k).scale([3, 3, 0.5])
        things[f"plate{k}"] = {"type": "cube", "to_world": place, "bsdf": surface}
    view = at.look_at([0, 5, 50], [0, 0, 0], [0, 1, 0])
    film = {"type": "hdrfilm", "width": 4, "height": 4, "rfilter": {"type": "box"}, "component_format": "float32"}
    things = {key: mi.load_dict(thing) for key, thing in things.items()}
    for thing in things.values() if painted == "vertex_color" else ():
        thing.add_attribute("vertex_color", 3, np.tile(value, thing.vertex_count()).astype(np.float32).tolist())
    return mi.load_dict({
        "type": "scene", "light": LIGHTS["sky"],
        "integrator": {"type": "translucent_walk", "mm_per_unit": 1.2, "rr_depth": 100, "light": "sampled"},
         "sensor": {"type": "perspective", "fov": 9.0, "to_world": view, "film": film}, **things,
    })  # fmt: skip


def _gradients(scene: mi.Scene, endings: tuple[str, ...], seed: int = 3, spp: int = 256) -> np.ndarray:
    """Derivatives of the sum of the image by the numbers of all parameters of each name, summed by channel."""
    parameters = mi.traverse(scene)
    keys = [[key for key in parameters.keys() if key.endswith(ending)] for ending in endings]
    for key in sum(keys, []):
        value = type(parameters[key])(dr.detach(parameters[key]))
        dr.enable_grad(value)
        parameters[key] = value
    parameters.update()
    scene.integrator().render_backward(scene, parameters, dr.ones(mi.TensorXf, (4, 4, 3)), 0, seed, spp)
    slopes = [[np.reshape(dr.grad(parameters[key]), (-1, 3)).sum(axis=0) for key in each] for each in keys]
    return np.array([np.sum(each, axis=0) for each in slopes])


@pytest.mark.slow
def test_derivatives_by_vertices_add_up_to_those_by_a_constant(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of the same paths: kernels differ by rounding, by which few paths take another way."""
    monkeypatch.setattr(scores, "SLOTS", 8)
    constant = _gradients(_plates(None, "sigma_t"), (".sigma_t", ".albedo", ".g"))
    painted = _gradients(_plates("vertex_color", "sigma_t"), (".vertex_color", ".albedo", ".g"))
    assert painted == pytest.approx(constant, rel=2e-3)


def test_of_more_stays_than_there_are_slots_one_stands_for_the_rest(monkeypatch: pytest.MonkeyPatch) -> None:
    found = {}
    for slots in (4, 1):
        monkeypatch.setattr(scores, "SLOTS", slots)
        scene = _plates("data")
        found[slots] = np.array([_gradients(scene, (".data",), seed, 64)[0] for seed in range(8)])
    change = found[1] - found[4]
    error = change.std(axis=0, ddof=1) / np.sqrt(len(change))
    assert (error > 0).all() and (np.abs(change.mean(axis=0)) < WIDEST_Z * error).all()
    assert (error < 0.02 * found[4].mean(axis=0)).all()


def test_derivatives_by_other_textures_are_refused_by_name() -> None:
    scene = _scene("sky", 4)
    parameters = mi.traverse(scene)
    dr.enable_grad(parameters["object.vertex_positions"])
    with pytest.raises(ValueError, match="object.vertex_positions must not have gradients enabled"):
        scene.integrator().render_backward(scene, parameters, dr.ones(mi.TensorXf, (4, 4, 3)), 0, 0, 1)
