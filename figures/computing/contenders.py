"""Ways to render a scanned object: Mitsuba's volume path tracer, our own walk, and the models, each ready to render."""

from __future__ import annotations

from typing import Any

import numpy as np

from figures.computing.long_render import long_render
from figures.computing.scenes import SCANS, prepare, scan_scene
from figures.parts.part import Task
from halfspace_sss.neural.symmetric import channels
from halfspace_sss.physics.medium import Medium
from halfspace_sss.rendering.surface.transports import model_names

__all__ = ["ENTRIES", "MODELS", "OF_OBJECTS", "RR_DEPTHS", "VOLUMES", "WALK", "contender", "long_walk", "volume"]

MODELS = ("standard_dipole", "better_dipole", "directional_dipole", "photon_beam_diffusion", "neural")
OF_OBJECTS = tuple(name for name in ("neural_shape", "full_geometry") if name in model_names())
ENTRIES = {"full_geometry": 2}  # of an exit; 1 for the others
WALK = "translucent_walk"
RR_DEPTHS = (5, 64, 200, 1024)
LONG_PASS = 32  # samples per pixel of a pass of the long render
_VOLUME = "volpathmis"


def volume(rr_depth: int) -> str:
    """Name of Mitsuba's volume path tracer with Russian roulette from the given number of vertices on."""
    return f"{_VOLUME} {rr_depth}"


VOLUMES = tuple(volume(rr_depth) for rr_depth in RR_DEPTHS)


def contender(
    method: str, material: str, size: int, lights: str, bare: bool = False, sampler: str = "independent",
    scan: str = "bunny",
) -> Any:  # fmt: skip
    """The Mitsuba scene of an object for a method, or three, one for each channel; `timed.rendered` takes both.

    Mitsuba's media have one phase function for all channels: it is given the channels of others one by one.

    Args:
        method: a name in `VOLUMES`, `WALK`, or a model; `full_geometry` must have been trained.
        material, size, lights, sampler, scan: as in `figures.computing.scenes.scan_scene`.
        bare: whether a model is left without surface reflection and without the single scattering that it lacks.

    Raises:
        ValueError: no such method, material or lights.
    """
    from halfspace_sss import bssrdf, materials
    from halfspace_sss.rendering.scenes.scene_files import PATH_TRACED, load_scene

    description = scan_scene(scan, material, size, lights, sampler=sampler)
    if method in VOLUMES:
        return _volume_scene(description, scan, materials.load(material).medium, int(method.split()[1]))
    if method == WALK:
        return load_scene(description, PATH_TRACED)
    description["integrator"]["entries"] = ENTRIES.get(method, 1)
    if not bare:
        return load_scene(description, method)
    description[scan]["bsdf"]["reflection"] = False
    return load_scene(description, method, bssrdf(method, materials.load(material).medium).orders)


def _volume_scene(description: dict[str, Any], scan: str, medium: Medium, rr_depth: int) -> Any:
    from halfspace_sss.rendering.scenes.mitsuba_scene import with_media

    integrator = {"type": _VOLUME, "max_depth": -1, "rr_depth": rr_depth, "hide_emitters": True}
    mm_per_unit = SCANS[scan].mm_per_unit
    if np.ptp(medium.g) == 0:
        return with_media(description, mm_per_unit, integrator)
    found = []
    for channel in channels(medium):
        values = {key: float(getattr(channel, key)) for key in ("sigma_s", "sigma_a", "g", "eta")}
        one = {**description[scan], "bsdf": {"type": "translucent", **values}}
        found.append(with_media({**description, scan: one}, mm_per_unit, integrator))
    return tuple(found)


def long_walk(task: Task) -> dict[str, Any]:
    """A long image by our walk, in passes that survive an interruption: what the other images are compared with.

    The parameters of the task are material, size, lights, spp, seed and, unless it is the bunny, scan.
    """
    prepare()
    p = task.params
    each = min(max(p["spp"] // 8, 1), LONG_PASS)
    passes = max(p["spp"] // each, 2)
    scene = contender(WALK, p["material"], p["size"], p["lights"], scan=p.get("scan", "bunny"))
    return long_render(task, scene, each, passes)
