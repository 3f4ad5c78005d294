"""A scene that was edited again and again renders as one that was given its last values before its first image."""

from __future__ import annotations

import gc
from collections.abc import Callable, Collection, Iterator
from typing import Any

import numpy as np
import pytest

pytestmark = pytest.mark.usefixtures("quiet_rgb", "little_light")

mi = pytest.importorskip("mitsuba")

EDITS = 8
FEW = (  # of gathered light, which takes seconds each: of a medium, an instance, a sky, vertices, a lamp
    "point.position", "block.bsdf.sigma_t", "shown.to_world", "sky.data", "block.vertex_positions in place",
    "point.position",
)  # fmt: skip
SURFACE = {"type": "translucent", "sigma_s": "2,2.5,3", "sigma_a": 0.1, "g": 0.3, "eta": 1.4, "model": "better_dipole"}
INTEGRATORS = {
    "gathered": {"type": "bssrdf", "light": "gathered"},
    "sampled": {"type": "bssrdf", "light": "sampled"},
    "walk": {"type": "translucent_walk"},
}


def _at(*where: float, scale: float = 1.0) -> mi.ScalarTransform4f:
    return mi.ScalarTransform4f().translate(where).scale(scale)


def _looking(*origin: float) -> mi.ScalarTransform4f:
    return mi.ScalarTransform4f().look_at(origin, [0, 0, 0], [0, 1, 0])


def _grey(value: float) -> dict:
    """Another for each thing: Mitsuba makes one of equal ones."""
    return {"type": "diffuse", "reflectance": value}


def _sky(column: int) -> np.ndarray:
    texels = np.full((8, 16, 3), 0.1, dtype=np.float32)
    texels[3, column] = 5.0
    return texels


def _things() -> dict[str, dict]:
    """Two objects on a floor, one of them a mesh, a tile in a group, and local lamps of every kind."""
    return {
        "ball": {"type": "sphere", "radius": 1.0, "to_world": _at(-1.2, 0, 0), "bsdf": SURFACE},
        "block": {"type": "cube", "to_world": _at(1.2, 0, 0, scale=0.7), "bsdf": {**SURFACE, "sigma_s": 4.0}},
        "floor": {"type": "rectangle", "to_world": _at(0, 0, -2, scale=5.0), "bsdf": _grey(0.4)},
        "group": {"type": "shapegroup", "tile": {"type": "rectangle", "bsdf": _grey(0.6)}},
        "shown": {"type": "instance", "to_world": _at(0, 2.5, -1), "group": {"type": "ref", "id": "group"}},
        "globe": {"type": "sphere", "to_world": _at(2, 3, 4, scale=0.5), "emitter": {"type": "area", "radiance": 9.0}},
        "box": {"type": "cube", "to_world": _at(-3, 2, 3, scale=0.3), "emitter": {"type": "area", "radiance": 9.0}},
        "point": {"type": "point", "position": [3, -3, 3], "intensity": 9.0},
        "spot": {"type": "spot", "to_world": _looking(-3, -3, 4), "cutoff_angle": 30.0, "intensity": 20.0},
        "slide": {"type": "projector", "to_world": _looking(0, 4, 4), "irradiance": 20.0},
        "sun": {"type": "directional", "direction": [1, 0, -1], "irradiance": 0.5},
    }


SKIES: dict[str, Callable[[], dict]] = {
    "envmap": lambda: {"type": "envmap", "bitmap": mi.Bitmap(_sky(3))},
    "constant": lambda: {"type": "constant", "radiance": 0.3},
    "sunsky": lambda: {"type": "sunsky", "sun_direction": [0.6, 0, 0.8], "sky_scale": 0.02, "sun_scale": 0.001},
}


def _moved(by: float) -> Callable[[Any, np.random.Generator], Any]:
    return lambda old, rng: mi.Transform4f().translate(mi.Vector3f(rng.uniform(-by, by, 3).tolist())) @ old


def _times(low: float, high: float) -> Callable[[Any, np.random.Generator], Any]:
    return lambda old, rng: type(old)(old * float(rng.uniform(low, high)))


def _shifted(old: mi.Float, rng: np.random.Generator) -> mi.Float:
    """Vertices, all by the same."""
    return mi.Float((np.array(old).reshape(-1, 3) + rng.uniform(-0.3, 0.3, 3)).ravel().astype(np.float32))


def _in_place(old: mi.Float, rng: np.random.Generator) -> mi.Float:
    """Vertices by a view of NumPy, which writes into what Dr.Jit holds already."""
    view = old.numpy()
    view *= rng.uniform(0.85, 1.0)
    return mi.Float(view)


CHANGES: dict[str, Callable[[Any, np.random.Generator], Any]] = {
    "globe.to_world": _moved(0.8),
    "globe.to_world anew": lambda old, rng: mi.Transform4f().translate([float(rng.uniform(-4, 4)), 3, 3]),
    "globe.emitter.radiance.value": _times(0.5, 2),
    "box.vertex_positions": _shifted,
    "point.position": lambda old, rng: mi.Point3f(old.x, float(rng.uniform(-4, 4)), old.z),
    "point.intensity.value": _times(0.5, 2),
    "spot.to_world": _moved(0.5),
    "spot.intensity.value": _times(0.5, 2),
    "slide.to_world": _moved(0.5),
    "sun.to_world": lambda old, rng: mi.Transform4f().rotate([1, 0, 0], float(rng.uniform(-40, 40))) @ old,
    "sun.irradiance.value": _times(0.5, 2),
    "ball.to_world": _moved(0.1),
    "block.vertex_positions": _shifted,
    "block.vertex_positions in place": _in_place,
    "ball.bsdf.albedo": lambda old, rng: mi.Color3f(old.x, float(rng.uniform(0.5, 0.95)), old.z),
    "block.bsdf.sigma_t": _times(0.7, 1.4),
    "ball.bsdf.g": lambda old, rng: mi.Color3f(float(rng.uniform(0, 0.6))),
    "floor.bsdf.reflectance.value": _times(0.6, 1.3),
    "group.tile.bsdf.reflectance.value": _times(0.6, 1.3),
    "group.tile.to_world": _moved(0.2),
    "shown.to_world": _moved(0.2),
}
OF_SKY = {
    "envmap": {"sky.data": lambda old, rng: mi.TensorXf(_env(int(rng.integers(16)))), "sky.scale": _times(0.5, 2)},
    "constant": {"sky.radiance.value": _times(0.5, 2)},
    "sunsky": {"sky.turbidity": lambda old, rng: mi.Float(float(rng.uniform(2, 8))), "sky.sky_scale": _times(0.5, 2)},
}


def _env(column: int) -> np.ndarray:
    """Texels as `envmap` shows them, the first column twice."""
    texels = _sky(column)
    return np.concatenate([texels, texels[:, :1]], axis=1)


def _scene(way: str, sky: str, things: Collection[str]) -> mi.Scene:
    film = {"type": "hdrfilm", "width": 6, "height": 4, "rfilter": {"type": "box"}, "component_format": "float32"}
    sensor = {"type": "perspective", "fov": 40.0, "to_world": _looking(0, -1, 9), "film": film}
    own = {"integrator": INTEGRATORS[way], "sensor": sensor, "sky": SKIES[sky]()}
    shown = {name: thing for name, thing in _things().items() if name in things}
    return mi.load_dict({"type": "scene", **own, **shown})


def _image(scene: mi.Scene) -> np.ndarray:
    return np.array(mi.render(scene, spp=16, seed=1))


def _edit(scene: mi.Scene, sky: str, edits: list[str], seed: int) -> Iterator[None]:
    """Edit a scene; after each edit comes a pause."""
    rng, edited, changes = np.random.default_rng(seed), mi.traverse(scene), {**CHANGES, **OF_SKY[sky]}
    for edit in edits:
        key = edit.partition(" ")[0]
        edited[key] = changes[edit](edited[key], rng)
        edited.update()
        yield


def _check(load: Callable[[], mi.Scene], sky: str, edits: list[str], seed: int) -> None:
    scene = load()
    found = [_image(scene), *(_image(scene) for _ in _edit(scene, sky, edits, seed))]
    for before, after, edit in zip(found, found[1:], edits):
        assert np.abs(after - before).max() > 1e-4 * after.max(), edit
    for number in {*range(4, len(edits), 4), len(edits)}:  # an edit that is missed leaves the image wrong
        del scene  # kernels call the objects of all scenes that there are: one alone needs no new ones
        gc.collect()
        scene = load()
        for _ in _edit(scene, sky, edits[:number], seed):
            pass
        wanted = _image(scene)
        told = str(edits[:number])
        np.testing.assert_allclose(found[number], wanted, rtol=2e-3, atol=1e-4 * wanted.max(), err_msg=told)


@pytest.mark.slow
@pytest.mark.parametrize(("way", "sky"), [("sampled", "sunsky"), ("walk", "constant")])
def test_each_of_many_random_edits_is_seen(way: str, sky: str) -> None:
    every = [*CHANGES, *OF_SKY[sky]]
    edits = np.random.default_rng(50).permutation(2 * every)[:EDITS].tolist()
    _check(lambda: _scene(way, sky, _things()), sky, edits, 51)


@pytest.mark.slow
def test_gathered_light_sees_an_edit_of_each_kind() -> None:
    things = ["block", "floor", "group", "shown", "point"]
    _check(lambda: _scene("gathered", "envmap", things), "envmap", list(FEW), 51)
