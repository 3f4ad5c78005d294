"""Ways to render the bunny: Mitsuba's volume path tracer, our own walk, and the models, each ready to render."""

from __future__ import annotations

from typing import Any

from figures.scenes import MM_PER_UNIT, bunny_scene
from figures.style import look

__all__ = ["MODELS", "RR_DEPTHS", "VOLUMES", "WALK", "contender", "label", "volume"]

MODELS = ("standard_dipole", "better_dipole", "directional_dipole", "photon_beam_diffusion", "neural")
WALK = "translucent_walk"
RR_DEPTHS = (5, 64, 200, 1024)
_VOLUME = "volpathmis"


def volume(rr_depth: int) -> str:
    """Name of Mitsuba's volume path tracer with Russian roulette from the given number of vertices on."""
    return f"{_VOLUME} {rr_depth}"


VOLUMES = tuple(volume(rr_depth) for rr_depth in RR_DEPTHS)


def contender(method: str, material: str, size: int, lights: str, bare: bool = False) -> Any:
    """The Mitsuba scene of the bunny for a method.

    Args:
        method: a name in `VOLUMES`, `WALK`, or a model of the library.
        material, size, lights: as in `figures.scenes.bunny_scene`.
        bare: whether a model is left without surface reflection and without the single scattering that it lacks.

    Raises:
        ValueError: no such method, material or lights.
    """
    from halfspace_sss import bssrdf, materials
    from halfspace_sss.rendering.mitsuba_scene import with_media
    from halfspace_sss.rendering.scene_files import PATH_TRACED, load_scene

    description = bunny_scene(material, size, lights)
    if method in VOLUMES:
        integrator = {"type": _VOLUME, "max_depth": -1, "rr_depth": int(method.split()[1]), "hide_emitters": True}
        return with_media(description, MM_PER_UNIT, integrator)
    if method == WALK:
        return load_scene(description, PATH_TRACED)
    if not bare:
        return load_scene(description, method)
    description["bunny"]["bsdf"]["reflection"] = False
    return load_scene(description, method, bssrdf(method, materials.load(material).medium).orders)


def label(method: str) -> str:
    """The name of a method as people read it."""
    if method in VOLUMES:
        return f"Mitsuba {_VOLUME}, roulette from {method.split()[1]}"
    if method == WALK:
        return "Our walk"
    return "Neural half-space" if method == "neural" else look(method).label
