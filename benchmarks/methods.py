"""Methods to render an object: Mitsuba's volume path tracer, our own walk, and the models, each ready to render."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from figures.computing.contenders import WALK
from figures.computing.scans import scan_scene
from figures.parts.part import SceneDict
from halfspace_sss.physics.medium import Medium

if TYPE_CHECKING:
    import mitsuba as mi

RR_DEPTHS = (5, 64, 200, 1024)
_VOLUME = "volpathmis"


def volume(rr_depth: int) -> str:
    """Name of Mitsuba's volume path tracer with Russian roulette from the given number of vertices on."""
    return f"{_VOLUME} {rr_depth}"


VOLUMES = tuple(volume(rr_depth) for rr_depth in RR_DEPTHS)


def contender(method: str, material: str, size: int, lights: str) -> mi.Scene | tuple[mi.Scene, ...]:
    """The scene of the bunny for a method.
    `method`: as in `ready`. `material`, `size`, `lights`: as in `figures.computing.scans.scan_scene`. ValueError if
    there is no such method, material or lights."""
    from halfspace_sss import materials

    return ready(method, scan_scene(material, size, lights), "bunny", materials.load(material).medium)


def ready(method: str, description: SceneDict, name: str, medium: Medium) -> mi.Scene | tuple[mi.Scene, ...]:
    """The Mitsuba scene for a method, or three, one for each channel; `timed.rendered` takes both.

    Mitsuba's media have one phase function for all channels: it is given the channels of others one by one.

    Args:
        method: a name in `VOLUMES`, `WALK`, or a model; `full_geometry` must have been trained.
        description: of the scene, with millimetres of its unit in the integrator; it is changed.
        medium: of the object, 1/mm; of one that varies any with its mean cosine.

    Raises:
        ValueError: no such method.
    """
    from full_geometry.scenes.scene_files import PATH_TRACED, load_scene

    if method in VOLUMES:
        return _volume_scene(description, name, medium, int(method.split()[1]))
    if method == WALK:
        return load_scene(description, PATH_TRACED)
    return load_scene(description, method)


def _volume_scene(description: SceneDict, name: str, medium: Medium, rr_depth: int) -> mi.Scene | tuple[mi.Scene, ...]:
    from benchmarks.mitsuba_media import with_media

    integrator = {"type": _VOLUME, "max_depth": -1, "rr_depth": rr_depth, "hide_emitters": True}
    mm_per_unit = description["integrator"].get("mm_per_unit", 1.0)
    if np.ptp(medium.g) == 0:
        return with_media(description, mm_per_unit, integrator)
    results = []
    for channel in medium.channels():
        values = {key: float(getattr(channel, key)) for key in ("sigma_s", "sigma_a", "g", "eta")}
        one = {**description[name], "bsdf": {"type": "translucent", **values}}
        results.append(with_media({**description, name: one}, mm_per_unit, integrator))
    return tuple(results)
