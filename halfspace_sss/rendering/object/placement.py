"""Which shapes of a scene are translucent, what lies inside them, and where cameras and media may not be."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from halfspace_sss.rendering.object.shape import Geometry, geometry_of, is_inside, name_of, rays_into, scene_of
from halfspace_sss.rendering.object.translucent import is_translucent

__all__ = ["Content", "check_empty", "check_sensors", "contents", "places_of", "translucent_shapes"]

STARTS = 64  # rays of each sensor that are looked at
LOOKS = 512  # rays that look for parts of a shape in an object
DEEP = 1e-3  # of the size of an object: what reaches less deep stands at its surface


@dataclass(frozen=True, eq=False)
class Content:
    """What lies inside an object.

    Args:
        thing: a shape, or an emitter that has none.
        name: what messages call it.
        object: the number of the object.
        whole: whether all of it lies inside.
    """

    thing: Any
    name: str
    object: int
    whole: bool


def contents(scene: mi.Scene, objects: list[Geometry]) -> list[Content]:
    """What lies inside each closed object of a scene: of every shape a part that is deeper than `DEEP`, and lamps."""
    found = []
    for shape in scene.shapes():
        alone = None
        for k, holder in enumerate(objects):
            shared = _shared(shape, holder)
            if holder.shape is shape or shared is None:
                continue
            alone = alone or scene_of([shape], scene)
            if _deep(holder, _points_on(alone, shared)).any():
                found.append(Content(shape, f"the shape {name_of(shape)}", k, _holds(holder, shape, alone)))
    for emitter in scene.emitters():
        place = _place(emitter)
        for k, holder in enumerate(objects):
            if place is not None and is_inside(holder, place[:, None]).all():
                found.append(Content(emitter, f"the emitter {emitter.id()!r}", k, True))
    return found


def check_empty(scene: mi.Scene, objects: list[Geometry], what: str) -> None:
    """Refuse objects with something inside, for `what` does not see it.

    Raises:
        ValueError: names what lies in which object, or partly in it.
    """
    for found in contents(scene, objects)[:1]:
        raise ValueError(
            f"objects must be empty for {what}, got {found.name} {'' if found.whole else 'partly '}inside "
            f"object {objects[found.object].name}: the integrator translucent_walk traces it"
        )


def places_of(scene: mi.Scene) -> tuple[list, list]:
    """What tells whether shapes or lamps of a scene have been moved; what is kept so that no number is reused."""
    found = [geometry_of(shape) for shape in scene.shapes()]
    lamps = [_place(emitter) for emitter in scene.emitters()]
    places = [None if place is None else place.tolist() for place in lamps]
    return [*(key for key, _ in found), *places], [kept for _, kept in found]


def _shared(shape: mi.Shape, holder: Geometry) -> Any:
    """The box that a shape shares with an object; None if it reaches less deep."""

    (a, b), (c, d), deep = _corners(shape.bbox()), _corners(holder.scene.bbox()), DEEP * holder.size
    low, high = np.maximum(a, c + deep), np.minimum(b, d - deep)
    return mi.ScalarBoundingBox3f(low.tolist(), high.tolist()) if (low <= high).all() else None


def _corners(box: mi.ScalarBoundingBox3f) -> tuple[np.ndarray, np.ndarray]:
    return tuple(np.ravel(np.array(corner, dtype=float)) for corner in (box.min, box.max))


def _points_on(alone: mi.Scene, box: mi.ScalarBoundingBox3f) -> np.ndarray:
    """Points in a box, of the shape in a scene of its own: shape (3, n).

    Points that rays into the box meet first, and points by area, without which wires are missed.
    """
    si = alone.ray_intersect(rays_into(box, LOOKS))
    p = np.concatenate([np.array(si.p)[:, np.array(si.is_valid())], _points_by_area(alone)], axis=1)
    low, high = _corners(box)
    slack = DEEP * np.linalg.norm(high - low)  # of flat boxes
    low, high = low - slack, high + slack
    return p[:, (p.T >= low).all(axis=1) & (p.T <= high).all(axis=1)]


def _points_by_area(alone: mi.Scene) -> np.ndarray:
    """Points drawn by area, shape (3, n); none of shapes that cannot be drawn from, such as curves and instances."""

    u = np.random.default_rng(19).random((2, LOOKS)).astype(np.float32)
    points = []
    for shape in alone.shapes():
        try:
            drawn = shape.sample_position(0.0, mi.Point2f(u))
        except (RuntimeError, NotImplementedError):
            continue
        points.append(np.array(drawn.p).reshape(3, -1))
    return np.concatenate(points or [np.zeros((3, 0))], axis=1)


def _deep(holder: Geometry, points: np.ndarray) -> np.ndarray:
    """Which points lie inside an object, and deep."""

    inside = np.flatnonzero(is_inside(holder, points)) if points.shape[1] else np.zeros(0, dtype=int)
    if not len(inside):
        return np.zeros(0, dtype=bool)
    along = np.random.default_rng(17).standard_normal((3, 128))
    along /= np.linalg.norm(along, axis=0)
    start, ends = np.repeat(points[:, inside], 128, axis=1), np.tile(along, len(inside))
    hit = holder.scene.ray_intersect_preliminary(mi.Ray3f(mi.Point3f(start), mi.Vector3f(ends)))
    return np.array(hit.t).reshape(-1, 128).min(axis=1) > DEEP * holder.size


def _holds(holder: Geometry, shape: mi.Shape, alone: mi.Scene) -> bool:
    """Whether all of a shape lies inside an object."""
    (a, b), (c, d) = _corners(shape.bbox()), _corners(holder.scene.bbox())
    return bool((a >= c).all() and (b <= d).all() and is_inside(holder, _points_on(alone, alone.bbox())).all())


def _place(emitter: mi.Emitter) -> np.ndarray | None:
    """Where an emitter without a shape is; None where it is nowhere or has a shape."""

    far = emitter.flags() & int(mi.EmitterFlags.Infinite)
    if far or emitter.is_environment() or emitter.get_shape() is not None:
        return None
    ds, _ = emitter.sample_direction(dr.zeros(mi.Interaction3f), mi.Point2f(0.5))
    return np.ravel(np.array(ds.p))


def translucent_shapes(scene: mi.Scene) -> list[Any]:
    """The shapes whose surface is `translucent`.

    Raises:
        ValueError: such a surface is inside of another BSDF, which would show its reflection only, or its shape belongs
            to a shape group, whose instances are several objects; or the scene has media of Mitsuba.
    """

    shapes = scene.shapes()
    for node in mi.traverse(scene).hierarchy:
        if isinstance(node, mi.Shape) and node not in shapes and _inside(node.bsdf()):
            raise ValueError(
                f"a translucent object must stand in the scene itself, got {node.id()!r} in a shapegroup: "
                "give each instance a shape of its own"
            )
    for shape in shapes:
        bsdf = shape.bsdf()
        if _inside(bsdf) and not is_translucent(bsdf):
            raise ValueError(
                f"a translucent surface must stand alone, got one inside the {bsdf.class_name()} of {shape.id()!r}"
            )
    _check_media(scene)
    return [shape for shape in shapes if is_translucent(shape.bsdf())]


def _check_media(scene: mi.Scene) -> None:
    """ValueError if light would be scattered outside of the objects, or by a second medium in one."""
    found = [
        (side, shape)
        for shape in scene.shapes()
        for side, medium in (("interior", shape.interior_medium()), ("exterior", shape.exterior_medium()))
        if medium is not None
    ]
    for side, shape in found:
        if is_translucent(shape.bsdf()):
            raise ValueError(
                f"a translucent object must be without {side}, as its surface says what is inside, got the {side} "
                f"of {shape.id()!r}"
            )
    if found:
        side, shape = found[0]
        raise ValueError(f"the scene must be without media of Mitsuba, such as fog, got the {side} of {shape.id()!r}")
    for place in (*scene.sensors(), *scene.emitters()):
        if place.get_medium() is not None:
            raise ValueError(f"the scene must be without media of Mitsuba, such as fog, got one around {place.id()!r}")


def check_sensors(scene: mi.Scene, objects: list[Geometry]) -> None:
    """Refuse sensors inside of objects, of any kind: they may have several places, or a surface.

    Raises:
        ValueError: rays of a sensor begin inside an object, whose id is named.
    """
    for sensor in scene.sensors():
        for found in objects:
            if is_inside(found, _starts(sensor, found.size)).any():
                raise ValueError(f"the camera must be outside of every object, got it inside {found.name}")


def _starts(sensor: mi.Sensor, size: float) -> np.ndarray:
    """Shape (3, n); off a surface that the rays leave by a little of the size of an object."""

    u = np.random.default_rng(13).random((5, STARTS)).astype(np.float32)
    numbers = [mi.Float(row.tolist()) for row in u]
    # not sample_ray, which some sensors lack
    ray, _ = sensor.sample_ray_differential(0.0, numbers[0], mi.Point2f(*numbers[1:3]), mi.Point2f(*numbers[3:]))
    return np.array(mi.Point3f(ray.o + ray.d * (1e-4 * size))).reshape(3, -1)


def _inside(bsdf: mi.BSDF | None) -> bool:
    """Whether a BSDF is `translucent` or has such a one in it."""

    return bsdf is not None and any(is_translucent(node) for node in mi.traverse(bsdf).hierarchy)
