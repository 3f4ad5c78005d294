"""`hide_emitters` and alpha are those of Mitsuba's path tracer."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any

import mitsuba as mi
import numpy as np
import pytest

pytestmark = pytest.mark.usefixtures("rgb")

INTEGRATORS = {"walk": {"type": "translucent_walk"}, "sampled": {"type": "bssrdf", "light": "sampled"},
               "gathered": {"type": "bssrdf", "light": "gathered"}}  # fmt: skip


def _lamps() -> dict[str, Any]:
    """Two before a wall, one behind the other."""
    wall = {"type": "rectangle", "to_world": mi.ScalarTransform4f().translate([0, 0, -4]).scale(10),
            "bsdf": {"type": "diffuse"}}  # fmt: skip
    places = {"a": [1.5, 1.5, 1.5], "b": [1.9, 1.9, 0.6]}
    lamps = {name: {"type": "sphere", "center": at, "radius": 0.4, "emitter": {"type": "area", "radiance": 20.0}}
             for name, at in places.items()}  # fmt: skip
    return {"wall": wall, **lamps}


LIGHTS: dict[str, Callable[[], dict[str, Any]]] = {
    "lamps": _lamps,
    "lamps before a sky": lambda: {**_lamps(), "wall": {"type": "constant", "radiance": 0.5}},
}  # fmt: skip


def _image(integrator: dict[str, Any], lights: dict[str, Any], hide: bool, spp: int) -> np.ndarray:
    wax = {"type": "translucent", "sigma_t": "8", "albedo": "0.9", "eta": 1.4, "model": "better_dipole"}
    film = {"type": "hdrfilm", "width": 24, "height": 24, "rfilter": {"type": "box"}, "pixel_format": "rgba"}
    look = mi.ScalarTransform4f().look_at([0, 0, 5], [0, 0, 0], [0, 1, 0])
    bsdf = wax if integrator["type"] != "path" else {"type": "diffuse"}
    scene = mi.load_dict({"type": "scene", "integrator": {**integrator, "hide_emitters": hide}, **lights,
                          "ball": {"type": "sphere", "radius": 0.4, "bsdf": bsdf},
                          "cam": {"type": "perspective", "fov": 70, "to_world": look, "film": film}})  # fmt: skip
    return np.array(mi.render(scene, spp=spp, seed=1))


@cache
def _known(lights: str, hide: bool) -> np.ndarray:
    return _image({"type": "path"}, LIGHTS[lights](), hide, 256)


CASES = [  # gathering takes longest: the emitters of one light are hidden
    pytest.param(kind, lights, hide, id=f"{kind}-{lights}-{'hidden' if hide else 'shown'}")
    for kind in INTEGRATORS
    for lights in LIGHTS
    for hide in (True, False)
    if kind != "gathered" or (lights, hide) == ("lamps", True)
]


@pytest.mark.parametrize(("kind", "lights", "hide"), CASES)
def test_hidden_emitters_and_alpha_are_those_of_the_path_tracer_of_mitsuba(kind: str, lights: str, hide: bool) -> None:
    known = _known(lights, hide)
    found = _image(INTEGRATORS[kind], LIGHTS[lights](), hide, 64)
    assert np.abs(found[:, :, 3] - known[:, :, 3]).max() < 0.35  # samples at edges
    assert np.abs(found[:, :, 3] - known[:, :, 3]).mean() < 0.01
    y, x = np.mgrid[:24, :24] - 11.5
    away = np.hypot(x, y) > 3.5  # from the ball, whose surface differs
    dark = found[away][:, :3].mean(axis=1) < 0.2 * known[away][:, :3].mean(axis=1)
    assert dark.mean() < 0.01
    assert found[away][:, :3].mean() == pytest.approx(known[away][:, :3].mean(), rel=0.1, abs=1e-3)
    lamp = found[2:5, 18:21, :3].mean()  # of the first lamp, in the corner above
    assert lamp == pytest.approx(known[2:5, 18:21, :3].mean(), rel=0.35, abs=1e-3)
