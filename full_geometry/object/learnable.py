"""Objects that can be learnt: one with a medium, or one of a scene, closed and with a smooth boundary."""

from __future__ import annotations

import math
from typing import Any

import mitsuba as mi

from halfspace_sss.physics.medium import Medium
from halfspace_sss.rendering.object.body import TranslucentObject, check_empty, check_size
from halfspace_sss.rendering.object.shape import Geometry, name_of, survey
from halfspace_sss.rendering.object.translucent import is_translucent
from halfspace_sss.rendering.object.varying import equivalent
from halfspace_sss.rendering.scenes.scene_files import millimetres


def object_of(
    shape: Any, medium: Medium | None = None, mm_per_unit: float | None = None, name: str | None = None
) -> TranslucentObject:
    """The object of a shape filled with a medium, or the one called `name` in a scene.

    Args:
        shape: a Mitsuba shape, closed and no instance, whose own BSDF does not count; or a scene.
        medium: 1/mm, scalar or with one value for each channel of the variant; of a scene it is that of the object's
            `translucent` surface.
        mm_per_unit: length of a scene unit, mm; by default what the integrator of a scene says, and 1 for a shape.
        name: id of the object; may be left out where there is one.

    Raises:
        ValueError: a scene has no such object, or one that cannot be learnt: its boundary is rough, its normals point
            to both sides, it is an instance or has something inside. The medium is missing or has other channels than
            the variant, or mm_per_unit is not a finite number > 0.
    """
    if not isinstance(shape, mi.Scene):
        geometry = survey(shape)
        media = _in_scene_units(medium, 1.0 if mm_per_unit is None else mm_per_unit)
        check_geometry(geometry)
        return TranslucentObject(geometry, media)
    geometry = survey(_object_of(shape, name))
    check_empty(shape, [geometry], "learning")
    unit = millimetres(shape) if mm_per_unit is None else mm_per_unit
    inside = equivalent(geometry.shape.bsdf().inside, geometry)
    media = _in_scene_units(inside.medium, unit)
    check_geometry(geometry)
    check_size(geometry, [float(m.sigma_t) for m in media], unit)
    return TranslucentObject(geometry, media, None if inside.varying is None else inside.varying.scaled(unit))


def _in_scene_units(medium: Medium | None, mm_per_unit: float) -> tuple[Medium, ...]:
    """The scalar medium of each channel, 1/(scene unit)."""
    if not (math.isfinite(mm_per_unit) and mm_per_unit > 0):
        raise ValueError(f"mm_per_unit must be finite and > 0, got {mm_per_unit!r}")
    if not isinstance(medium, Medium):
        raise ValueError(f"medium must be a Medium, got {type(medium).__name__}")
    n = len(mi.Spectrum(0))
    if medium.n_channels not in (None, n):
        raise ValueError(f"medium must have {n} channels under {mi.variant()}, got {medium.n_channels}")
    scaled = medium.scaled(mm_per_unit)
    return tuple(scaled if medium.n_channels is None else scaled.channel(k) for k in range(n))


def check_geometry(geometry: Geometry) -> None:
    """ValueError if the faces of an object do not all point to the same side: one sign stands for all of them."""
    if geometry.signs is not None:
        raise ValueError(
            f"normals of {geometry.name} must all point to the same side to be learnt, got pieces that disagree"
        )


def check_surface(name: str, surface: Any) -> None:
    """ValueError if the `translucent` surface of an object has what cannot be learnt."""
    if surface.boundary.flags() & int(mi.BSDFFlags.Smooth):
        raise ValueError(f"the boundary of {name!r} must be smooth to be learnt, got a rough one")


def _object_of(scene: Any, name: str | None) -> Any:
    """The translucent shape called `name` in a scene, or the only one.

    Raises:
        ValueError: there is none, there are several and none is named, or it cannot be learnt.
    """
    known = {s.id(): s for s in scene.shapes() if is_translucent(s.bsdf())}
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
