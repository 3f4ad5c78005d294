"""Which objects can be learnt; the others are refused in a sentence before anything is traced."""

from __future__ import annotations

from typing import Any

from halfspace_sss.rendering.surface.object import Object
from halfspace_sss.rendering.surface.sharing import name_of

__all__ = ["check_geometry", "check_surface", "object_of"]


def check_geometry(found: Object) -> None:
    """ValueError if the faces of an object do not all point to the same side: one sign stands for all of them."""
    if found.signs is not None:
        raise ValueError(
            f"normals of {found.name} must all point to the same side to be learnt, got pieces that disagree"
        )


def check_surface(name: str, surface: Any) -> None:
    """ValueError if the `translucent` surface of an object has what cannot be learnt."""
    import mitsuba as mi

    if surface.boundary.flags() & int(mi.BSDFFlags.Smooth):
        raise ValueError(f"the boundary of {name!r} must be smooth to be learnt, got a rough one")


def object_of(scene: Any, name: str | None) -> Any:
    """The translucent shape called `name` in a scene, or the only one.

    Raises:
        ValueError: there is none, there are several and none is named, or it cannot be learnt.
    """
    known = {s.id(): s for s in scene.shapes() if hasattr(s.bsdf(), "inside")}
    instances = [s.id() for s in scene.shapes() if "nstance" in s.class_name()]
    if name in instances or (name is None and instances and not known):
        raise ValueError(f"object must not be an instance to be learnt, got {name or instances[0]!r}")
    if name is None and len(known) == 1:
        name = next(iter(known))
    if name not in known:
        names = ", ".join(id or name_of(shape) for id, shape in known.items())
        raise ValueError(f"object must be one of {names or 'none'}, got {name!r}")
    check_surface(name, known[name].bsdf())
    return known[name]
