"""Inclusions, that is shapes, parts of shapes and lamps inside the objects of a scene; cameras may not be there.

Shapes and objects may be instances. Copies of a shape and of an object whose boxes meet are looked at in pairs, in the
frames of both, many pairs in a launch. In one group they are looked at once for all instances.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np

from full_geometry.geometry.instances import InstanceTable, corners, ends_of, shapes_of, shown_groups
from full_geometry.geometry.points import floats
from full_geometry.geometry.rounding import bound_of
from full_geometry.geometry.shape import Geometry, is_inside, meet_alone, name_of, ray_of_arrays, scene_of, ways_into
from full_geometry.surface.sheets import is_sheet
from full_geometry.surface.wrapped import surface_of

STARTS = 64  # rays of each sensor that are looked at
LOOKS = 512  # rays that look for parts of a shape in an object
OVERLAP_LOOKS = 2**15  # that look for coplanar parts of shapes that overlap, of all pairs
DEEP = 1e-3  # of the size of an object: what reaches less deep stands at its surface
CLOSE = 4.0  # bounds of rounding: surfaces that are so close are one to rays
MOST_TOUCHING, SHARE_TOUCHING = 4, 5e-4  # points on one surface that are on the other by chance, where both cross
REFRACTS = int(mi.BSDFFlags.DeltaTransmission) | int(mi.BSDFFlags.GlossyTransmission)
PAIRS = 512  # in a launch
DEPTHS = 32  # points of each of several pairs, whose depth is measured
EACH = -1  # number of an instance that stands for all of its group


@dataclass(frozen=True, eq=False)
class Inclusion:
    """A shape or a lamp inside an object.

    Args:
        node: a shape, or an emitter that has none.
        name: what messages call it.
        object: the number of the object, see `instances.InstanceTable`.
        whole: whether all of it lies inside.
        rank: the number of its instance in the group, if it is shown by one.
        shown: whether it is.
    """

    node: mi.Object
    name: str
    object: int
    whole: bool
    rank: int = 0
    shown: bool = False


def find_inclusions(scene: mi.Scene, objects: list[Geometry]) -> list[Inclusion]:
    """Find what lies inside each closed object of a scene: shapes with a part deeper than `DEEP`, and lamps.
    What shines or lets light through counts from the depth on that rays tell. ValueError if the surface of such a shape
    lies on that of an object, so that rays do not tell which comes first; or it is a thin wall."""
    groups, results = shown_groups(scene), []
    holders = InstanceTable([obj.shape for obj in objects], groups)
    things = InstanceTable(shapes_of(scene, groups), groups)
    for a, shape in enumerate(things.shapes):
        alone, group = None, things.groups[a]
        for b, holder in enumerate(objects):
            pairs = _meeting(things, a, holders, b)
            if not len(pairs.i):
                continue
            alone = alone or scene_of([shape], scene)
            if _tells(shape):
                _check_apart(pairs, (shape, alone), holder)
            held = _held(pairs, alone, holder)
            partly = [ij[:2] for ij in held if not ij[2]]
            if partly and _tells(shape):
                rows = [k for k, ij in enumerate(zip(pairs.i.tolist(), pairs.j.tolist())) if ij in partly]
                _check_apart(pairs.some(rows), (shape, alone), holder, max(OVERLAP_LOOKS // len(rows), LOOKS))
            if held and is_sheet(shape.bsdf()):
                raise ValueError(
                    f"a surface with a thickness must be outside of objects, got {name_of(shape)} inside {holder.name}"
                )
            for i, j, whole in held:
                for k in range(len(group.instances)) if i == EACH else (i,):
                    name = name_of(shape if group is None else group.instances[k])
                    number = int(holders.first[b]) + (k if i == EACH else j)
                    results.append(Inclusion(shape, f"the shape {name}", number, whole, k, group is not None))
    for emitter in scene.emitters():
        place = place_of(emitter)
        for b, holder in enumerate(objects if place is not None else ()):
            inside = is_inside(holder, _into(holders.to_world(b), place[:, None]))
            name, first = f"the emitter {emitter.id()!r}", int(holders.first[b])
            results += [Inclusion(emitter, name, first + j, True) for j in np.flatnonzero(inside).tolist()]
    return results


class _Pairs(NamedTuple):
    """Copies i of a shape and j of an object whose boxes meet.
    `i`, `j`: arrays (n,). `thing`, `holder`: arrays (n, 4, 4), their places. `low`, `high`: arrays (n, 3), the box that
    they share. `deep`: array (n,), the depth from which on a shape lies inside, scene units."""

    i: np.ndarray
    j: np.ndarray
    thing: np.ndarray
    holder: np.ndarray
    low: np.ndarray
    high: np.ndarray
    deep: np.ndarray

    def some(self, kept: np.ndarray | slice) -> _Pairs:
        return _Pairs(*(value[kept] for value in self))


_NONE = _Pairs(*(np.zeros(0, dtype=int),) * 2, *(np.zeros((0, 4, 4)),) * 2, *(np.zeros((0, 3)),) * 2, np.zeros(0))


def _meeting(things: InstanceTable, a: int, holders: InstanceTable, b: int) -> _Pairs:
    """Copies of a shape and of an object, not the same, that share a box which reaches deep, or touches if it tells."""
    same, one = things.shapes[a] is holders.shapes[b], np.eye(4)[None]
    together = things.groups[a] is not None and things.groups[a] is holders.groups[b]
    looks = [(one, one, EACH)] if together and not same else []
    looks += [(things.to_world(a), holders.to_world(b), 0)] if together or not same else []
    results = [_NONE]
    for thing, holder, number in looks:
        a_low, a_high = ends_of(corners(things.shapes[a].bbox(), thing))
        b_low, b_high = ends_of(corners(holders.shapes[b].bbox(), holder))
        deep = DEEP * np.linalg.norm(b_high - b_low, axis=1)
        e = [each.rounding[each.numbers(number)] for each, number in ((things, a), (holders, b))]
        tells = _tells(things.shapes[a])
        for i in range(len(thing)):
            close = CLOSE * (e[0][i] + e[1][: len(holder)])
            margin = (-close if tells else deep)[:, None]
            low, high = np.maximum(a_low[i], b_low + margin), np.minimum(a_high[i], b_high - margin)
            j = np.flatnonzero((low <= high).all(axis=1))
            j = j[j != i] if together and number != EACH else j
            n = np.full(len(j), i)
            depth = (close if tells else deep)[j]
            results.append(_Pairs(n + number, j + number, thing[n], holder[j], low[j], high[j], depth))
    return _Pairs(*map(np.concatenate, zip(*results)))


def _held(pairs: _Pairs, alone: mi.Scene, holder: Geometry) -> list[tuple[int, int, bool]]:
    """Which copies of a shape, in the scene `alone`, lie in which of an object, and whether wholly."""
    results = []
    for start in range(0, len(pairs.i) if holder.closed else 0, PAIRS):
        part = pairs.some(slice(start, start + PAIRS))
        part = part.some(_reach_deep(part, alone, holder))
        if len(part.i):
            results += zip(part.i.tolist(), part.j.tolist(), _whole(part, alone, holder).tolist())
    return results


def _into(to_world: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Points (3, n) of the world in each of the frames (m, 4, 4): shape (3, m n)."""
    inverse = np.linalg.inv(to_world)
    return np.moveaxis(inverse[:, :3, :3] @ points + inverse[:, :3, 3:], 0, 1).reshape(3, -1)


def _points_in(alone: mi.Scene, pairs: _Pairs) -> tuple[np.ndarray, np.ndarray]:
    """Points in the boxes of pairs, of the shape in a scene of its own: numbers of the pairs, and shape (3, n).
    Points that rays into the box meet first, and points by area, without which wires are missed."""
    n, inverse = len(pairs.i), np.linalg.inv(pairs.thing)
    start, along = ways_into(pairs.low, pairs.high, LOOKS)
    start, along = inverse[:, :3, :3] @ start + inverse[:, :3, 3:], inverse[:, :3, :3] @ along
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    o, d = (np.moveaxis(v, 0, 1).reshape(3, -1) for v in (start, along))
    si = meet_alone(alone, ray_of_arrays(o, d), mi.RayFlags.Minimal)
    met = np.moveaxis(np.where(si.is_valid(), np.array(si.p, dtype=float), 0).reshape(3, n, -1), 0, 1)
    drawn = np.broadcast_to(points := _points_by_area(alone), (n, *points.shape))
    points = pairs.thing[:, :3, :3] @ np.concatenate([met, drawn], axis=2) + pairs.thing[:, :3, 3:]
    valid = np.concatenate([np.array(si.is_valid()).reshape(n, -1), np.ones((n, drawn.shape[2]), dtype=bool)], axis=1)
    slack = DEEP * np.linalg.norm(pairs.high - pairs.low, axis=1)[:, None]  # of flat boxes
    low, high = (pairs.low - slack)[:, :, None], (pairs.high + slack)[:, :, None]
    k, q = np.nonzero(valid & (points >= low).all(axis=1) & (points <= high).all(axis=1))
    return k, points[k, :, q].T


def _points_by_area(alone: mi.Scene) -> np.ndarray:
    """Points drawn by area, shape (3, n); none of shapes that cannot be drawn from, such as curves."""
    u = np.random.default_rng(19).random((2, LOOKS)).astype(np.float32)
    points = []
    for shape in alone.shapes():
        try:
            drawn = shape.sample_position(0.0, mi.Point2f(u))
        except (RuntimeError, NotImplementedError):
            continue
        points.append(np.array(drawn.p).reshape(3, -1))
    return np.concatenate(points or [np.zeros((3, 0))], axis=1)


def _reach_deep(pairs: _Pairs, alone: mi.Scene, holder: Geometry) -> np.ndarray:
    """Whether a point of the shape lies inside the object, and deep."""
    k, points = _points_in(alone, pairs)
    to_holder = np.linalg.inv(pairs.holder)[k]
    points = np.einsum("nij,jn->in", to_holder[:, :3, :3], points) + to_holder[:, :3, 3].T
    inside = np.flatnonzero(is_inside(holder, points))
    result = np.zeros(len(pairs.i), dtype=bool)
    if len(pairs.i) > 1:
        inside = inside[np.arange(len(inside)) - np.searchsorted(k[inside], k[inside]) < DEPTHS]
    if len(inside):
        along = np.random.default_rng(17).standard_normal((3, 128))
        along /= np.linalg.norm(along, axis=0)
        start, ends = np.repeat(points[:, inside], 128, axis=1), np.tile(along, len(inside))
        hit = holder.scene.ray_intersect_preliminary(ray_of_arrays(start, ends))
        scale = np.cbrt(np.abs(np.linalg.det(pairs.holder[k[inside], :3, :3])))
        result[k[inside][scale * np.array(hit.t).reshape(-1, 128).min(axis=1) > pairs.deep[k[inside]]]] = True
    return result


def _whole(pairs: _Pairs, alone: mi.Scene, holder: Geometry) -> np.ndarray:
    one, none = np.eye(4)[None], np.zeros(1, dtype=int)
    (a, b), (c, d) = ends_of(corners(alone.bbox(), one)), ends_of(corners(holder.scene.bbox(), one))
    _, points = _points_in(alone, _Pairs(none, none, one, one, a, b, np.zeros(1)))
    relative = np.linalg.inv(pairs.holder) @ pairs.thing
    inside = relative[:, :3, :3] @ points + relative[:, :3, 3:]
    whole = is_inside(holder, np.moveaxis(inside, 0, 1).reshape(3, -1)).reshape(len(pairs.i), -1).all(axis=1)
    boxed = bool((a >= c).all() and (b <= d).all()) or np.abs(relative - one).max(axis=(1, 2)) > 0
    return whole & boxed


def refracts(shape: mi.Shape) -> bool:
    """Whether the surface of a shape lets light through, bent."""
    return bool(shape.bsdf().flags() & REFRACTS)


def _tells(shape: mi.Shape) -> bool:
    """Whether rays have to tell the surface of a shape from that of an object, as light comes from behind it."""
    return shape.is_emitter() or bool(surface_of(shape)) or refracts(shape)


def _check_apart(pairs: _Pairs, of: tuple[mi.Shape, mi.Scene], holder: Geometry, looks: int = LOOKS) -> None:
    """ValueError if a shape, in a scene of its own, and an object share a part of their surfaces, by so many points."""
    shape, alone = of
    for start in range(0, len(pairs.i), PAIRS):
        part = pairs.some(slice(start, start + PAIRS))
        scales = (np.cbrt(np.abs(np.linalg.det(M[:, :3, :3]))) for M in (part.holder, part.thing))
        ways = np.linalg.inv(part.holder) @ part.thing, np.linalg.inv(part.thing) @ part.holder
        both = zip((shape, holder.shape), (holder.scene, alone), ways, scales)
        shared = sum(_shares(*each, part.deep / scale, looks) for *each, scale in both)
        if shared.any():
            raise ValueError(
                f"surfaces must be apart by more than {part.deep[shared.argmax()]:.2g} scene units, outside or inside, "
                f"got the shape {name_of(shape)} on the surface of object {holder.name}"
            )


def check_lamps(scene: mi.Scene) -> None:
    """ValueError if lamps lie on each other, as copies do: rays meet one of them, samples of emitters find both."""
    # ---- lamps of the same box, up to rounding
    lamps, alike = [lamp for lamp in map(mi.Emitter.get_shape, scene.emitters()) if lamp is not None], {}
    boxes = np.array([[*lamp.bbox().min, *lamp.bbox().max] for lamp in lamps], dtype=float).reshape(-1, 6)
    sizes = np.linalg.norm(boxes[:, 3:] - boxes[:, :3], axis=1)
    for lamp, box, size in zip(lamps, boxes, sizes):
        alike.setdefault((f"{size:.3g}", *np.round(box / (DEEP * size))), []).append(lamp)

    # ---- of these, whether they share their surfaces
    for one, *others in alike.values():
        for other in others:
            close = np.full(1, CLOSE * bound_of(one))
            if _shares(other, scene_of([one], scene), np.eye(4)[None], close, LOOKS).any():
                raise ValueError(
                    f"lamps must be apart by more than {close[0]:.2g} scene units, got the shape {name_of(other)} on "
                    f"the shape {name_of(one)}"
                )


def _shares(shape: mi.Shape, other: mi.Scene, into: np.ndarray, close: np.ndarray, looks: int) -> np.ndarray:
    """Whether a part of the surface of a shape lies on that of a scene, whose frame each of the matrices leads into."""
    u = np.random.default_rng(19).random((2, looks)).astype(np.float32)
    try:
        drawn = shape.sample_position(0.0, mi.Point2f(u))
    except (RuntimeError, NotImplementedError):  # of shapes that cannot be drawn from
        return np.zeros(len(into), dtype=bool)
    p, n = (np.array(v, dtype=float).reshape(3, -1) for v in (drawn.p, drawn.n))
    p, n = into[:, :3, :3] @ p + into[:, :3, 3:], np.moveaxis(np.linalg.inv(into[:, :3, :3]), 1, 2) @ n
    n /= np.linalg.norm(n, axis=1, keepdims=True)
    o, d = (np.moveaxis(v, 0, 1).reshape(3, -1) for v in (p - n * close[:, None, None], n))
    ray = ray_of_arrays(o, d)
    ray.maxt = floats(np.repeat(2 * close, p.shape[2]))
    si = other.ray_intersect(ray, mi.RayFlags.Minimal, False)
    on = np.array(si.is_valid() & (dr.abs(dr.dot(si.n, ray.d)) > 0.99))
    return on.reshape(len(into), -1).sum(axis=1) > max(MOST_TOUCHING, SHARE_TOUCHING * looks)


def place_of(emitter: mi.Emitter) -> np.ndarray | None:
    """Where an emitter without a shape is; None where it is nowhere or has a shape."""
    far = emitter.flags() & int(mi.EmitterFlags.Infinite)
    if far or emitter.is_environment() or emitter.get_shape() is not None:
        return None
    ds, _ = emitter.sample_direction(dr.zeros(mi.Interaction3f), mi.Point2f(0.5))
    return np.ravel(np.array(ds.p, dtype=float))


def check_sensors(scene: mi.Scene, objects: list[Geometry], sensors: list[mi.Sensor] | None = None) -> None:
    """Refuse sensors inside of objects, of any kind: they may have several places, or a surface.
    `sensors`: those of the scene where None. ValueError if rays of a sensor begin inside an object, whose id is
    named."""
    holders = InstanceTable([obj.shape for obj in objects], shown_groups(scene))
    for sensor in scene.sensors() if sensors is None else sensors:
        o, d = _rays(sensor) if objects else (None, None)
        for b, each in enumerate(objects):
            # off a surface that the rays leave by a little of the size of an object
            if is_inside(each, _into(holders.to_world(b), o + 1e-4 * each.size * d)).any():
                near = _near_clip(sensor, each, holders.to_world(b), o, d)
                raise ValueError(f"the camera must be outside of every object, got it inside {each.name}{near}")


def _near_clip(sensor: mi.Sensor, obj: Geometry, to_world: np.ndarray, o: np.ndarray, d: np.ndarray) -> str:
    """Words on the near_clip of a sensor if rays that began without it, at o - near_clip d, were outside an object."""
    if not isinstance(sensor, mi.ProjectiveCamera):
        return ""
    inside = is_inside(obj, _into(to_world, o - sensor.near_clip() * d)).any()
    return "" if inside else f", where its rays begin by near_clip = {sensor.near_clip():g}"


def _rays(sensor: mi.Sensor) -> tuple[np.ndarray, np.ndarray]:
    """Origins and directions of some rays of a sensor, of shape (3, n)."""
    u = np.random.default_rng(13).random((5, STARTS)).astype(np.float32)
    numbers = [mi.Float(row.tolist()) for row in u]
    # not sample_ray, which some sensors lack
    ray, _ = sensor.sample_ray_differential(0.0, numbers[0], mi.Point2f(*numbers[1:3]), mi.Point2f(*numbers[3:]))
    o, d = (np.array(v, dtype=float).reshape(3, -1) for v in (ray.o, ray.d))
    return o, d
