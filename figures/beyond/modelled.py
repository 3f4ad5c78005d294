"""Modelled objects under an even sky or one small light, as methods of rendering are compared on them."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from figures.beyond.objects import VIEWS
from figures.computing.contenders import WALK, long_passes, ready
from figures.computing.learnt import object_parts
from figures.computing.scenes import prepare
from figures.modelling.objects import tissue
from figures.parts.part import Task, unmodelled
from halfspace_sss.checks import check_choice
from halfspace_sss.provenance import check_folder

__all__ = ["MODELLED", "long_modelled", "modelled_contender", "modelled_scene"]

MODELLED = ("candle", "mandarin")
LIGHTS = ("small light", "even sky")
LAMP, LAMP_RADIUS = (-67.0, 46.0, -45.0), 8.0  # from what is looked at, mm: behind it, as with the bunny
GLOW = (90.0, 84.0, 75.0)


def modelled_scene(
    name: str, resolution: int, size: int, lights: str, folder: Path, sampler: str = "independent", seed: int = 0
) -> dict[str, Any]:
    """A modelled object on its own, as a dict for `scene_files.load_scene`, under its name.

    Args:
        name: a name in `modelling.objects.OBJECTS`.
        resolution, seed: of its surface.
        size: pixels of the square image.
        lights: "even sky", radiance 1 from everywhere, or "small light": of the candle its flame, else a lamp.
        folder: for its files.
        sampler: Mitsuba's plugin of random numbers.

    Raises:
        ValueError: no such object or lights.
    """
    import mitsuba as mi

    check_choice("lights", lights, LIGHTS)
    shown, view = object_parts(name, resolution, check_folder(folder), seed), VIEWS[name]
    to_world = mi.ScalarTransform4f().look_at(list(view.origin), list(view.target), [0, 1, 0])
    film = {"type": "hdrfilm", "width": size, "height": size, "rfilter": {"type": "box"}}
    if lights == "even sky":
        shown = {name: shown[name], "sky": {"type": "constant", "radiance": 1.0}}
    elif "flame" not in shown:
        centre = [a + b for a, b in zip(view.target, LAMP)]
        glow = {"type": "area", "radiance": {"type": "rgb", "value": list(GLOW)}}
        shown["lamp"] = {"type": "sphere", "center": centre, "radius": LAMP_RADIUS, "emitter": glow}
    return {
        "type": "scene",
        "integrator": {"type": "bssrdf", "hide_emitters": True},
        "sensor": {"type": "perspective", "fov": view.fov, "to_world": to_world, "film": film,
                   "sampler": {"type": sampler}},
        **shown,
    }  # fmt: skip


def modelled_contender(method: str, p: Mapping[str, Any], folder: Path, sampler: str = "independent") -> Any:
    """The scene of a modelled object for a method, see `contenders.ready`.

    Args:
        method: of rendering.
        p: "object", "resolution", "size" and "lights" of `modelled_scene`.
        folder: for its files.
        sampler: Mitsuba's plugin of random numbers.
    """
    found = modelled_scene(p["object"], p["resolution"], p["size"], p["lights"], folder, sampler)
    return ready(method, found, p["object"], tissue("candle wax").medium)  # all tissues scatter isotropically


@unmodelled
def long_modelled(task: Task) -> dict[str, Any]:
    """A long image by our walk, for the parameters of `modelled_contender` and "spp" and "seed"."""
    prepare()
    return long_passes(task, modelled_contender(WALK, task.params, task.folder))
