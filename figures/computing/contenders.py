"""Ways to render the bunny: Mitsuba's volume path tracer, our own walk, and the models, each ready to render."""

from __future__ import annotations

from typing import Any

import numpy as np

from figures.computing.scenes import MM_PER_UNIT, bunny_scene, prepare
from figures.parts.part import Task
from halfspace_sss.neural.symmetric import channels
from halfspace_sss.physics.medium import Medium
from halfspace_sss.provenance import check_folder

__all__ = ["MODELS", "RR_DEPTHS", "VOLUMES", "WALK", "contender", "long_walk", "volume"]

MODELS = ("standard_dipole", "better_dipole", "directional_dipole", "photon_beam_diffusion", "neural")
WALK = "translucent_walk"
RR_DEPTHS = (5, 64, 200, 1024)
LONG_PASS = 32  # samples per pixel of a pass of the long render
_VOLUME = "volpathmis"


def volume(rr_depth: int) -> str:
    """Name of Mitsuba's volume path tracer with Russian roulette from the given number of vertices on."""
    return f"{_VOLUME} {rr_depth}"


VOLUMES = tuple(volume(rr_depth) for rr_depth in RR_DEPTHS)


def contender(
    method: str, material: str, size: int, lights: str, bare: bool = False, sampler: str = "independent"
) -> Any:
    """The Mitsuba scene of the bunny for a method, or three, one for each channel; `timed.rendered` takes both.

    Mitsuba's media have one phase function for all channels: it is given the channels of others one by one.

    Args:
        method: a name in `VOLUMES`, `WALK`, or a model of the library.
        material, size, lights, sampler: as in `figures.computing.scenes.bunny_scene`.
        bare: whether a model is left without surface reflection and without the single scattering that it lacks.

    Raises:
        ValueError: no such method, material or lights.
    """
    from halfspace_sss import bssrdf, materials
    from halfspace_sss.rendering.scenes.scene_files import PATH_TRACED, load_scene

    description = bunny_scene(material, size, lights, sampler=sampler)
    if method in VOLUMES:
        return _volume_scene(description, materials.load(material).medium, int(method.split()[1]))
    if method == WALK:
        return load_scene(description, PATH_TRACED)
    if not bare:
        return load_scene(description, method)
    description["bunny"]["bsdf"]["reflection"] = False
    return load_scene(description, method, bssrdf(method, materials.load(material).medium).orders)


def _volume_scene(description: dict[str, Any], medium: Medium, rr_depth: int) -> Any:
    from halfspace_sss.rendering.scenes.mitsuba_scene import with_media

    integrator = {"type": _VOLUME, "max_depth": -1, "rr_depth": rr_depth, "hide_emitters": True}
    if np.ptp(medium.g) == 0:
        return with_media(description, MM_PER_UNIT, integrator)
    found = []
    for one in channels(medium):
        values = {key: float(getattr(one, key)) for key in ("sigma_s", "sigma_a", "g", "eta")}
        bunny = {**description["bunny"], "bsdf": {"type": "translucent", **values}}
        found.append(with_media({**description, "bunny": bunny}, MM_PER_UNIT, integrator))
    return tuple(found)


def long_walk(task: Task) -> dict[str, Any]:
    """A long image by our walk, in passes that survive an interruption: what the other images are compared with.

    The parameters of the task are material, size, lights, spp and seed.
    """
    from halfspace_sss.rendering.scenes import reference

    prepare()
    p = task.params
    each = min(max(p["spp"] // 8, 1), LONG_PASS)
    passes = max(p["spp"] // each, 2)
    found = reference.render(
        contender(WALK, p["material"], p["size"], p["lights"]), check_folder(task.folder) / "passes.exr",
        spp_per_pass=each, seed=p["seed"], passes=passes, progress=lambda now: task.progress(now.passes, passes),
    )  # fmt: skip
    image, variance = (v[..., :3].astype(np.float32) for v in (found.mean, found.variance))
    return {"image": image, "variance": variance, "seconds": found.seconds, "spp": found.spp}
