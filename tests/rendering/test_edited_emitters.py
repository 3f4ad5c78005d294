"""A scene whose emitters were edited renders as one loaded so: for every emitter plugin and both integrators."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

pytestmark = pytest.mark.usefixtures("rgb", "little_light")

mi = pytest.importorskip("mitsuba")

from full_geometry.geometry.instances import InstanceScene  # noqa: E402


def _looking(origin: list) -> mi.ScalarTransform4f:
    return mi.ScalarTransform4f().look_at(origin, [0, 0, 0], [0, 1, 0])


def _map(column: int) -> dict:
    """A sky with a hot texel."""
    texels = np.full((16, 32, 3), 0.3, dtype=np.float32)
    texels[4, column] = 200.0
    return {"type": "envmap", "bitmap": mi.Bitmap(texels)}


EMITTERS: dict[str, Callable[[bool], dict]] = {
    "area": lambda b: {"type": "sphere", "center": [0, 0, 0], "radius": 1.0,
                       "to_world": mi.ScalarTransform4f().translate([3, 3, -3] if b else [2, 3, 4]).scale(0.3),
                       "emitter": {"type": "area", "radiance": 20.0 if b else 10.0}},
    "area mesh": lambda b: {"type": "cube",
                            "to_world": mi.ScalarTransform4f().translate([3, 3, -3] if b else [2, 3, 4]).scale(0.3),
                            "emitter": {"type": "area", "radiance": 20.0 if b else 10.0}},
    "point": lambda b: {"type": "point", "position": [3, 3, -3] if b else [2, 3, 4], "intensity": 20.0 if b else 10.0},
    "spot": lambda b: {"type": "spot", "to_world": _looking([3, 3, -3] if b else [2, 3, 4]),
                       "cutoff_angle": 10.0 if b else 30.0, "intensity": 20.0 if b else 10.0},
    "projector": lambda b: {"type": "projector", "to_world": _looking([3, 3, -3] if b else [2, 3, 4]),
                            "irradiance": {"type": "rgb", "value": 20.0 if b else 10.0}},
    "directional": lambda b: {"type": "directional", "to_world": _looking([3, 3, -3] if b else [2, 3, 4]),
                              "irradiance": 2.0 if b else 1.0},
    "constant": lambda b: {"type": "constant", "radiance": 2.0 if b else 1.0},
    "envmap": lambda b: _map(20 if b else 5),
    "sunsky": lambda b: {"type": "sunsky", "sun_direction": [0.6, 0.0, 0.8] if b else [0.0, 0.6, 0.8],
                         "turbidity": 5.0 if b else 3.0},
}  # fmt: skip


def _scene(integrator: str, lights: dict) -> dict:
    surface = {"type": "translucent", "sigma_s": 2.0, "sigma_a": 0.1, "g": 0.3, "eta": 1.4, "model": "better_dipole"}
    film = {"type": "hdrfilm", "width": 4, "height": 4, "rfilter": {"type": "box"}, "component_format": "float32"}
    return {
        "type": "scene",
        "integrator": {"type": integrator},
        "sensor": {"type": "perspective", "fov": 20.0, "to_world": _looking([0, 0, 8]), "film": film},
        "ball": {"type": "sphere", "bsdf": surface},
        **lights,
    }


def _image(scene: mi.Scene) -> np.ndarray:
    return np.array(mi.render(scene, spp=64, seed=1))


WALK, BSSRDF = "translucent_walk", "bssrdf"  # which share the sampling of emitters
SLOW = [pytest.param(kind, (WALK, BSSRDF)[k % 2], marks=pytest.mark.slow)
        for k, kind in enumerate(kind for kind in EMITTERS if kind != "constant")]  # fmt: skip


@pytest.mark.parametrize(("kind", "integrator"), [("constant", WALK), ("constant", BSSRDF), *SLOW])
def test_an_edited_emitter_is_that_of_a_fresh_scene(kind: str, integrator: str) -> None:
    before, after = (mi.load_dict(_scene(integrator, {"lamp": EMITTERS[kind](b)})) for b in (False, True))
    first, wanted = _image(before), _image(after)
    edited, values = mi.traverse(before), mi.traverse(after)
    for key in edited.keys():
        if key.startswith("lamp"):
            edited[key] = values[key]
    edited.update()
    found = _image(before)
    assert np.abs(first - wanted).max() > 0.1 * wanted.max()
    np.testing.assert_allclose(found, wanted, rtol=2e-3, atol=1e-4 * wanted.max())


@pytest.mark.parametrize("integrator", [WALK, BSSRDF])
def test_an_integrator_sees_emitters_that_were_added_and_removed(integrator: str) -> None:
    point, sun = EMITTERS["point"](False), EMITTERS["directional"](True)
    found = mi.load_dict(_scene(integrator, {"point": point}))
    for lights in ({"point": point, "sun": sun}, {"sun": sun}):
        fresh = mi.load_dict(_scene(integrator, lights))
        other = np.array(mi.render(fresh, integrator=found.integrator(), spp=64, seed=1))
        np.testing.assert_allclose(other, _image(fresh), rtol=1e-5)  # light on cells is summed in any order


@pytest.mark.parametrize("integrator", [WALK, BSSRDF])
def test_a_wall_that_moves_beyond_the_scene_blocks_the_sun(integrator: str) -> None:
    """Mitsuba tells a sun how far the scene reaches when it is loaded, and there shadow rays to it would end."""
    at, black = mi.ScalarTransform4f(), {"type": "diffuse", "reflectance": 0.0}
    wall = {"type": "rectangle", "to_world": at.translate([5, 0, 0]), "bsdf": black}
    sun = {"type": "directional", "direction": [0, 0, -1], "irradiance": 1.0}
    scene = mi.load_dict(_scene(integrator, {"wall": wall, "sun": sun}))
    edited = mi.traverse(scene)
    assert _image(scene).max() > 0
    edited["wall.to_world"] = mi.Transform4f(at.translate([0, 0, 100]).scale(50))
    edited.update()
    assert _image(scene).max() == 0


def test_bounds_of_rounding_are_those_of_shapes_where_they_are_now() -> None:
    floor = {"type": "rectangle", "to_world": mi.ScalarTransform4f().translate([0, 0, -1e5]).scale(1e6)}
    scene = mi.load_dict(_scene(BSSRDF, {"floor": floor, "lamp": EMITTERS["area"](False)}))
    (before,) = scene.integrator().prepare(scene)
    edited = mi.traverse(scene)
    edited["floor.to_world"] = mi.Transform4f().translate([0, 0, -2])
    edited["lamp.to_world"] = mi.Transform4f().translate([30, 0, 40])
    edited.update()
    (after,) = scene.integrator().prepare(scene)
    wanted = InstanceScene.of(scene, [])
    assert after is before  # whose matrices and networks stay
    for name in ("bounds", "lamps"):
        np.testing.assert_array_equal(getattr(after.instance_scene, name), getattr(wanted, name))
