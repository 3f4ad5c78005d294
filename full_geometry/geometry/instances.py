"""Shapes that stand in a scene at many places: the instances of a `shapegroup`.

A ray that meets an instance knows the shape of the group, `si.shape`, and the instance, `si.instance`. So each shape at
each of its places is a thing of its own, with the number

    first(si.shape) + rank(si.instance),

rank the place of an instance among those of its group, 0 of what stands in the scene itself. Tables are by these
numbers; what is known of a shape alone is known once, in the frame of its group.
"""

from __future__ import annotations

import functools
import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np

from full_geometry.geometry.points import EntrySample, ObjectAlbedo, Proposals, SurfacePoint, TransportAround
from full_geometry.geometry.rounding import EPSILON, OF_WAY, bound_of, bounds, box_ends, place_bound, ray_to
from full_geometry.geometry.shape import (
    by_pointer,
    completed,
    groups_of,
    is_instance,
    looked_up,
    matrix_of,
    pointer_numbers,
    scene_of,
)


@dataclass(frozen=True, eq=False)
class Group:
    """A group that instances show.
    `instances`: of it, at least one. `to_world`: array (n, 4, 4), of each instance."""

    shapes: list[mi.Shape]
    instances: list[mi.Shape]
    to_world: np.ndarray

    @functools.cached_property
    def longest(self) -> float:
        """The largest stretch of a length in an instance, a factor."""
        return float(np.linalg.norm(self.to_world[:, :3, :3], ord=2, axis=(1, 2)).max())

    @functools.cached_property
    def scale(self) -> float:
        """Length in an instance over that in the group, mean of the logarithm."""
        return float(np.exp(np.log(np.abs(np.linalg.det(self.to_world[:, :3, :3]))).mean() / 3))

    @functools.cached_property
    def stretch(self) -> float:
        """The largest difference of a length in an instance from that in the group, relative."""
        return float(np.abs(np.linalg.svd(self.to_world[:, :3, :3], compute_uv=False) - 1).max())

    @functools.cached_property
    def rounding(self) -> np.ndarray:
        """A bound for each instance of how far rounding puts points off its surfaces, scene units."""
        return np.max([_rounding(shape, self.to_world) for shape in self.shapes], axis=0)


def shown_groups(scene: mi.Scene) -> list[Group]:
    """The groups that instances in a scene show."""
    of_name: dict[str, list[mi.Shape]] = {}
    for shape in scene.shapes():
        if is_instance(shape):  # which tells its group in words alone
            name = re.search(r'ShapeGroup\[\s*name = "(.*)",\n', str(shape))[1]
            of_name.setdefault(name, []).append(shape)
    results = []
    for group in groups_of(scene) if of_name else ():
        instances = of_name.get(group.id(), [])
        shapes = [n for n in mi.traverse(group).hierarchy if isinstance(n, mi.Shape) and n is not group]
        matrices = [matrix_of(mi.traverse(each)["to_world"]) for each in instances]
        results += [Group(shapes, instances, np.stack(matrices))] if instances else []
    return results


def shapes_of(scene: mi.Scene, groups: Sequence[Group]) -> list[mi.Shape]:
    """All shapes of a scene but instances, each once: those of the scene itself, then those of the groups it shows."""
    own = [shape for shape in scene.shapes() if not is_instance(shape)]
    return [*own, *(shape for group in groups for shape in group.shapes)]


class InstanceTable:
    """Numbers of shapes and of their instances in a scene, for look-ups in tables of kernels.
    `shapes`: each once. `groups`: of each, of those that are `shown`, or None for what stands in the scene itself.
    `first`: array (shapes + 1,), the number of the first thing of each shape, then that of all things."""

    def __init__(self, shapes: list[mi.Shape], shown: Sequence[Group]) -> None:
        self.shapes = shapes
        self.groups = [next((g for g in shown if any(s is shape for s in g.shapes)), None) for shape in shapes]
        self.first = np.cumsum([0, *(1 if g is None else len(g.instances) for g in self.groups)])

    def __len__(self) -> int:
        return int(self.first[-1])

    @property
    def repeated(self) -> bool:
        """Whether a shape stands in a group."""
        return any(group is not None for group in self.groups)

    @functools.cached_property
    def kind(self) -> np.ndarray:
        """Array (things,), the place of the shape of each in the list."""
        return np.repeat(np.arange(len(self.shapes)), np.diff(self.first))

    def numbers(self, kind: int) -> range:
        """The numbers of a shape and its instances."""
        return range(int(self.first[kind]), int(self.first[kind + 1]))

    def to_world(self, kind: int) -> np.ndarray:
        """Array (n, 4, 4), of the things of a shape."""
        group = self.groups[kind]
        return np.eye(4)[None] if group is None else group.to_world

    def scene(self, world: mi.Scene | None = None) -> mi.Scene:
        """A scene that holds them, with all else that is in their groups."""
        own = [shape for shape, group in zip(self.shapes, self.groups) if group is None]
        shown = list({id(group): group for group in self.groups if group is not None}.values())
        return scene_of([*own, *(instance for group in shown for instance in group.instances)], world)

    @functools.cached_property
    def rounding(self) -> np.ndarray:
        """A bound for each number of how far rounding puts points off its surface, scene units."""
        return np.concatenate([_rounding(shape, self.to_world(kind)) for kind, shape in enumerate(self.shapes)])

    @functools.cached_property
    def tables(self) -> dict[str, mi.Int32 | mi.UInt32]:
        """Tables by pointers of Dr.Jit's registry: the `first` number of a shape or -1, the `rank` of an instance."""
        ranks = {id(g): np.arange(len(g.instances)) for g in self.groups if g is not None}
        shown = {id(g): g.instances for g in self.groups if g is not None}
        instances = [mi.ShapePtr(each) for group in shown.values() for each in group]
        rank = np.concatenate([*ranks.values(), np.zeros(0, dtype=int)])
        tables = {"first": by_pointer([mi.ShapePtr(s) for s in self.shapes], self.first[:-1], -1)}
        tables |= {"rank": by_pointer(instances, rank, 0)} if instances else {}
        dr.make_opaque(tables)
        return tables

    def number(self, si: mi.SurfaceInteraction3f, active: mi.Bool | bool = True) -> mi.Int32:
        """The number of the thing that a ray has met, -1 for anything else."""
        first = looked_up(self.tables["first"], si.shape, -1, active)
        if "rank" not in self.tables:
            return first
        rank = looked_up(self.tables["rank"], si.instance, 0, active & (first >= 0))
        return first + rank


def _rounding(shape: mi.Shape, to_world: np.ndarray) -> np.ndarray:
    """A bound under each transformation of how far rounding puts points off a shape."""
    there = bounds(shape, *ends_of(corners(shape.bbox(), to_world)))
    return np.maximum(there, bound_of(shape) * np.linalg.norm(to_world[:, :3, :3], ord=2, axis=(1, 2)))


def corners(box: mi.ScalarBoundingBox3f, to_world: np.ndarray) -> np.ndarray:
    """The corners of a box under each of the transformations (n, 4, 4), shape (n, 3, 8)."""
    points = np.stack(np.meshgrid(*box_ends(box).T, indexing="ij")).reshape(3, 8)
    return to_world[:, :3, :3] @ points + to_world[:, :3, 3:]


def ends_of(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The least and the largest coordinates of sets of points (n, 3, m), shapes (n, 3)."""
    return points.min(axis=2), points.max(axis=2)


class InstanceTransform(NamedTuple):
    """The transformation M of the instance that each lane has met; the identity where it has met none.

        p = M p',    n = M^-T n' / |M^-T n'|,    dp = M dp',    dn = (1 - n n^T) M^-T dn' / |M^-T n'|.

    Args:
        to_world, to_object: columns of M and of its inverse.
        rounding: see `Group.rounding`.
    """

    to_world: list[mi.Vector3f]
    to_object: list[mi.Vector3f]
    rounding: mi.Float

    def point_to_object(self, p: mi.Point3f) -> mi.Point3f:
        """A point in the frame of the group."""
        return mi.Point3f(_map(self.to_object, p) + self.to_object[3])

    def normal_to_object(self, n: mi.Normal3f) -> mi.Normal3f:
        """A normal in the frame of the group."""
        return dr.normalize(_transposed(self.to_world, n))

    def vector_to_world(self, v: mi.Vector3f) -> mi.Vector3f:
        """A vector along the surface in the scene."""
        return mi.Vector3f(_map(self.to_world, v))

    def ray_to_object(self, ray: mi.Ray3f) -> mi.Ray3f:
        """A ray in the frame of the group, at the same distances."""
        local = mi.Ray3f(ray)
        local.o, local.d = self.point_to_object(ray.o), mi.Vector3f(_map(self.to_object, ray.d))
        return local

    def surface_point_to_object(self, at: SurfacePoint) -> SurfacePoint:
        """A `points.SurfacePoint` in the frame of the group."""
        w = mi.Vector3f(dr.normalize(_map(self.to_object, at.w)))
        return at._replace(
            p=self.point_to_object(at.p), n=self.normal_to_object(at.n), n_out=self.normal_to_object(at.n_out), w=w
        )

    def entry_to_world(self, entry: EntrySample) -> EntrySample:
        """A `points.EntrySample` of the frame of the group in the scene: dA = |det M| |M^-T n'| dA'."""
        n, n_out = (_transposed(self.to_object, each) for each in (entry.n, entry.n_out))
        x, y, z, shift = self.to_world
        area = dr.abs(dr.dot(x, dr.cross(y, z))) * dr.norm(n)
        return entry._replace(
            p=mi.Point3f(_map(self.to_world, entry.p) + shift), n=dr.normalize(n), n_out=dr.normalize(n_out),
            weight=entry.weight * area,
        )  # fmt: skip

    def interaction_to_world(self, si: mi.SurfaceInteraction3f, flags: int) -> mi.SurfaceInteraction3f:
        """An interaction of the frame of the group in the scene; `shape.completed` adds the rest."""
        M, inverse = self.to_world, self.to_object
        si.p = mi.Point3f(_map(M, si.p) + M[3])
        si.n, si.dp_du, si.dp_dv = dr.normalize(_transposed(inverse, si.n)), _map(M, si.dp_du), _map(M, si.dp_dv)
        if flags & mi.RayFlags.ShadingFrame:
            n = _transposed(inverse, si.sh_frame.n)
            scale = dr.rcp(dr.norm(n))
            n *= scale
            si.dn_du, si.dn_dv = (
                (v := _transposed(inverse, each) * scale) - n * dr.dot(n, v) for each in (si.dn_du, si.dn_dv)
            )
            si.sh_frame.n = n
        return si


@dataclass(eq=False)
class InstanceScene:
    """Intersects rays with a scene, or a scene of some of its shapes, whose instances are data of kernels.

    Mitsuba has a function for every instance in each kernel, which takes 30 ms to compile and, at 1000 of them, 10 s to
    record again. Here there is one for every shape, and instances are data, see `InstanceTransform`.

    Args:
        shapes: that rays may meet, where there are instances.
        tables: by what Dr.Jit's registry calls a shape its place in the list, `kind`, and an instance its `row`, 0 of
            what is none; by row the columns of M and of its inverse, `rounding`, and the `first` kind of the group; by
            kind the `pointer`.
        bounds: by what Dr.Jit's registry calls a shape of the scene, how far from it rounding puts points.
        lamps: likewise, by what it calls an emitter.
    """

    shapes: list[mi.Shape]
    tables: dict[str, mi.Float | mi.Int32 | mi.UInt32 | list[mi.Vector3f]]
    bounds: mi.Float | None = None
    lamps: mi.Float | None = None

    @classmethod
    def of(cls, scene: mi.Scene, shown: Sequence[Group]) -> InstanceScene:
        """Make the tables of a scene whose instances show these groups."""
        result = cls.of_shapes(shapes_of(scene, shown), shown) if shown else cls([], {})
        result.measure(scene, shown)
        return result

    @classmethod
    def of_shapes(cls, shapes: list[mi.Shape], shown: Sequence[Group] = ()) -> InstanceScene:
        """Make the tables of shapes, those of groups last."""
        instances = [mi.ShapePtr(each) for group in shown for each in group.instances]
        M = np.concatenate([np.eye(4)[None], *(group.to_world for group in shown)])
        pointers = [mi.ShapePtr(each) for each in shapes]
        sizes = [len(shapes) - sum(len(group.shapes) for group in shown), *(len(group.shapes) for group in shown)]
        first = np.repeat(np.cumsum([0, *sizes])[:-1], [1, *(len(group.instances) for group in shown)])
        tables = {"kind": by_pointer(pointers, np.arange(len(shapes)), 0), "first": mi.Int32(first.tolist())}
        tables["pointer"] = mi.UInt32(pointer_numbers(pointers))
        tables["row"] = by_pointer(instances, 1 + np.arange(len(instances)), 0)
        for key, matrices in (("to_world", M), ("to_object", np.linalg.inv(M))):
            tables[key] = [mi.Float(matrices[:, :3, k].ravel().tolist()) for k in range(4)]
        tables["rounding"] = mi.Float([0.0, *(v for group in shown for v in group.rounding.tolist())])
        dr.make_opaque(tables)
        return cls(shapes, tables, bounds_of([*shapes, *(i for group in shown for i in group.instances)], shown))

    def measure(self, scene: mi.Scene, shown: Sequence[Group] = ()) -> None:
        """Take the bounds of a scene whose instances show these groups; anew once shapes have moved."""
        self.bounds, self.lamps = bounds_of(scene.shapes(), shown), lamps_of(scene)

    def rounding(self, si: mi.SurfaceInteraction3f) -> mi.Float:
        """A bound of how far from the surface that a ray has met rounding has put `si.p`."""
        more = place_bound(si.p) + OF_WAY * EPSILON * dr.select(si.is_valid(), si.t, 0)
        if self.bounds is None:
            return more
        pointer = si.shape
        if self.shapes:
            pointer = dr.select(si.instance != None, si.instance, pointer)  # noqa: E711
        number = dr.reinterpret_array(mi.UInt32, pointer)
        known = number < dr.width(self.bounds)
        return dr.gather(mi.Float, self.bounds, number, known) + more

    def rounding_of(self, emitter: mi.EmitterPtr) -> mi.Float:
        """A bound of how far from the surface of an emitter rounding puts points; 0 of one without."""
        if self.lamps is None:
            return mi.Float(0)
        number = dr.reinterpret_array(mi.UInt32, emitter)
        return dr.gather(mi.Float, self.lamps, number, number < dr.width(self.lamps))

    def ray_to_emitter(self, at: mi.Interaction3f, ds: mi.DirectionSample3f, e: mi.Float) -> mi.Ray3f:
        """A ray from a point of a surface, at most e off that by rounding, to a sampled one of an emitter."""
        return ray_to(at, ds.p, e, self.rounding_of(ds.emitter))

    def intersect(
        self, scene: mi.Scene, ray: mi.Ray3f, flags: int, coherent: bool = False, active: mi.Bool | bool = True
    ) -> mi.SurfaceInteraction3f:
        """Intersect a ray with a scene of the shapes, as `mi.Scene.ray_intersect`."""
        if not self.shapes:
            return scene.ray_intersect(ray, flags, coherent, active)
        hit = scene.ray_intersect_preliminary(ray, coherent, active=active)
        return self.interaction(hit, ray, flags, active)

    def interaction(
        self, hit: mi.PreliminaryIntersection3f, ray: mi.Ray3f, flags: int, active: mi.Bool | bool = True
    ) -> mi.SurfaceInteraction3f:
        """The interaction of an intersection that is known."""
        if not self.shapes:
            return hit.compute_surface_interaction(ray, flags, active)
        active = active & hit.is_valid()
        row = looked_up(self.tables["row"], hit.instance, 0, active)
        transform = self._transform(row, active)
        local = transform.ray_to_object(ray)
        # on a CPU a hit knows the number of a shape in its group instead of the shape
        in_group = dr.gather(mi.Int32, self.tables["first"], row, active) + mi.Int32(hit.shape_index)
        own = looked_up(self.tables["kind"], hit.shape, 0, active)
        kind = dr.select(active & (hit.shape == None), in_group, own)  # noqa: E711
        calls = [functools.partial(_interaction, shape, flags) for shape in self.shapes]
        si = dr.switch(mi.UInt32(kind), calls, hit, local, active) if len(calls) > 1 else calls[0](hit, local, active)
        si.shape = dr.reinterpret_array(mi.ShapePtr, dr.gather(mi.UInt32, self.tables["pointer"], kind, active))
        si.instance = hit.instance
        return completed(transform.interaction_to_world(si, flags), hit, ray, flags, active)

    def transform(self, si: mi.SurfaceInteraction3f) -> InstanceTransform:
        """The transformation of the instance that a ray has met."""
        return self._transform(looked_up(self.tables["row"], si.instance, 0), True)

    def _transform(self, row: mi.Int32, active: mi.Bool | bool) -> InstanceTransform:
        M, inverse = (self._columns(key, row, active) for key in ("to_world", "to_object"))
        return InstanceTransform(M, inverse, dr.gather(mi.Float, self.tables["rounding"], row, active))

    def _columns(self, key: str, row: mi.Int32, active: mi.Bool) -> list[mi.Vector3f]:
        return [dr.gather(mi.Vector3f, column, row, active) for column in self.tables[key]]


def bounds_of(shapes: Sequence[mi.Shape], shown: Sequence[Group] = ()) -> mi.Float | None:
    """Table from what Dr.Jit's registry calls a shape to how far from it rounding puts points; None without shapes."""
    if not len(shapes):
        return None
    known = {id(shape): bound_of(shape) for shape in shapes}
    for group in shown:
        known |= {id(each): e for each, e in zip(group.instances, group.rounding)}
    result = by_pointer([mi.ShapePtr(shape) for shape in shapes], [known[id(shape)] for shape in shapes], 0.0)
    dr.make_opaque(result)
    return result


def lamps_of(scene: mi.Scene) -> mi.Float | None:
    """Table from what Dr.Jit's registry calls an emitter to how far from its surface rounding puts points."""
    emitters = scene.emitters()
    if not len(emitters):
        return None
    values = [0.0 if e.get_shape() is None else bound_of(e.get_shape()) for e in emitters]
    result = by_pointer([mi.EmitterPtr(emitter) for emitter in emitters], values, 0.0)
    dr.make_opaque(result)
    return result


def _map(columns: list[mi.Vector3f], v: mi.Vector3f) -> mi.Vector3f:
    return columns[0] * v.x + columns[1] * v.y + columns[2] * v.z


def _transposed(columns: list[mi.Vector3f], v: mi.Vector3f) -> mi.Normal3f:
    return mi.Normal3f(*(dr.dot(column, v) for column in columns[:3]))


def _interaction(
    shape: mi.Shape, flags: int, hit: mi.PreliminaryIntersection3f, ray: mi.Ray3f, active: mi.Bool
) -> mi.SurfaceInteraction3f:
    return shape.compute_surface_interaction(ray, hit, flags, active)


# --------------------------------------------------------------------------------------------------
# Transports and proposals of a shape in a group, for the instance that is met: the same for all.


@dataclass(frozen=True, eq=False)
class InstanceProposals:
    """`Proposals` of a shape in a group: positions are drawn in the frame of the group, directions in the scene.
    `proposals`: `points.Proposals` of the shape."""

    proposals: Proposals
    transform: InstanceTransform

    def prepare(self, out: SurfacePoint, prepared: Any, active: mi.Bool) -> Any:
        return self.proposals.prepare(self.transform.surface_point_to_object(out), prepared, active)

    def sample(
        self, out: SurfacePoint, prim_index: mi.UInt32, prepared: Any, sampler: mi.Sampler, active: mi.Bool
    ) -> EntrySample:
        return self.transform.entry_to_world(
            self.proposals.sample(self.transform.surface_point_to_object(out), prim_index, prepared, sampler, active)
        )

    def sample_direction(self, entry: EntrySample, out: SurfacePoint, u: mi.Point2f) -> tuple[mi.Vector3f, mi.Float]:
        """Draw a direction as the proposals do: they need the normals of both ends alone."""
        return self.proposals.sample_direction(entry, out, u)

    def pdf_direction(self, entry: EntrySample, out: SurfacePoint, w_i: mi.Vector3f) -> mi.Float:
        return self.proposals.pdf_direction(entry, out, w_i)


@dataclass(frozen=True, eq=False)
class InstanceTransport(TransportAround):
    """S of a learnt object in the frame of the group, which an instance moves, turns or mirrors."""

    transform: InstanceTransform

    @property
    def alpha(self) -> InstanceAlbedo | None:
        return None if self.transport.alpha is None else InstanceAlbedo(self.transport.alpha, self.transform)

    def prepare(self, at: SurfacePoint, active: mi.Bool = True) -> Any:
        return self.transport.prepare(self.transform.surface_point_to_object(at), active)

    def S(self, exit: Any, at: SurfacePoint, active: mi.Bool = True) -> mi.Spectrum:
        return self.transport.S(exit, self.transform.surface_point_to_object(at), active)


@dataclass(frozen=True, eq=False)
class InstanceAlbedo:
    """`points.ObjectAlbedo` of a learnt object in the frame of the group."""

    alpha: ObjectAlbedo
    transform: InstanceTransform

    @property
    def known(self) -> tuple[mi.Spectrum, mi.Spectrum]:
        return self.alpha.known

    def __call__(self, at: SurfacePoint, active: mi.Bool) -> tuple[mi.Spectrum, mi.Spectrum]:
        return self.alpha(self.transform.surface_point_to_object(at), active)
