"""Priorities of things that overlap, by Schmidt and Budge, Simple Nested Dielectrics in Ray Traced Images, 2002.

Where closed things that refract overlap, space belongs to that of the largest priority, and boundaries inside it are no
boundaries. A ray knows the things around it as bits of a number, one for each thing of a group, in the order of
priorities: the highest bit is the medium that the ray is in. A boundary is skipped while a higher bit is set.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from full_geometry.geometry.instances import Group, InstanceTable, shapes_of
from full_geometry.geometry.shape import Geometry, name_of, pointer_numbers
from full_geometry.objects.inclusions import Inclusion
from full_geometry.surface.translucent import DIELECTRICS, boundary_of, index_of, with_index
from full_geometry.surface.wrapped import surface_of

OUTSIDE = -1  # of all objects
MOST = 32  # things of a group


class Meeting(NamedTuple):
    """A boundary of a group that a ray has met, and what is behind it.

    Args:
        member: whether it is one.
        passes: whether the ray goes on as if it were none: a higher priority is around it, or rounding has put the ray
            on its other side.
        within: the things around a ray behind it.
        object: the number of the object that such a ray is in, or OUTSIDE.
        bsdf: of the index of the thing over that of what is around it there.
    """

    member: mi.Bool
    passes: mi.Bool
    within: mi.UInt32
    object: mi.Int32
    bsdf: mi.BSDFPtr


@dataclass(frozen=True, eq=False)
class Priorities:
    """The things of a scene that overlap, or have a priority, in groups. `instance_table`: numbers of objects, then of
    glass. `tables`: by these numbers the `bit` of a member, 0 of others, the `first` row of its group and of its
    `boundary`; by row of a group the `object` of a member; by row of a boundary the number of its `bsdf` in the
    registry. `boundaries`: these BSDFs: of a member behind nothing, and behind each of its group."""

    instance_table: InstanceTable
    tables: dict[str, mi.UInt32 | mi.Int32]
    boundaries: list[mi.BSDF]

    @classmethod
    def of(
        cls, scene: mi.Scene, result: list[Inclusion], holders: InstanceTable, objects: list[Geometry],
        groups: list[Group], outer: range,
    ) -> Priorities | None:  # fmt: skip
        """The groups of a scene; None where nothing overlaps, nothing has a priority, and no glass is outside.
        `result`: what lies inside of what, the smallest holder last. `holders`: objects, then glass. `groups`: that
        instances in the scene show. `outer`: the numbers of glass outside.

        Raises:
            ValueError: a group has more than MOST things, an open one, glass that is no dielectric, or a delta light.
        """
        # ---- which members hold or overlap each other
        first = {id(shape): int(number) for shape, number in zip(holders.shapes, holders.first)}
        edges = [(first[id(c.node)] + c.rank, c.object, c.whole) for c in result if id(c.node) in first]
        surfaces = [surface_of(holders.shapes[kind]) for kind in holders.kind]
        own = [surface.spec.priority if surface else None for surface in surfaces]
        n = len(holders)
        ends = np.array([edge[:2] for edge in edges], dtype=int).reshape(-1, 2)
        label = connected_components(coo_array((np.ones(len(ends)), ends.T), shape=(n, n)), directed=False)[1]
        needed = {label[a] for a, b, whole in edges if not whole or own[a] is not None or own[b] is not None}
        needed |= {label[k] for k in outer}
        if not needed:
            return None

        # ---- priority and index: of what lies wholly inside another and has no priority, those are of its holder
        inside = [[b for a, b, whole in edges if whole and a == k] for k in range(n)]
        priority, eta = [0.0] * n, [1.0] * n
        boundaries = [_boundary(holders.shapes[kind]) if label[k] in needed else None
                      for k, kind in enumerate(holders.kind)]  # fmt: skip
        for k in sorted((k for k in range(n) if label[k] in needed), key=lambda k: len(inside[k])):
            follows = own[k] is None and inside[k]
            around = inside[k][-1] if follows else None
            priority[k] = priority[around] if follows else own[k] or 0.0
            eta[k] = index_of(boundaries[k]) * (eta[around] if follows else 1.0)
        listed = {id(shape): place for place, shape in enumerate(shapes_of(scene, groups))}
        order = {k: (priority[k], len(inside[k]), listed[id(holders.shapes[kind])], k)
                 for k, kind in enumerate(holders.kind)}  # fmt: skip
        members = [sorted(np.flatnonzero(label == group).tolist(), key=order.get) for group in sorted(needed)]
        _check(result, holders, members, objects)
        return cls._of(holders, int(holders.first[len(objects)]), members, boundaries, eta)

    @classmethod
    def _of(
        cls, holders: InstanceTable, objects: int, members: list[list[int]], boundaries: list[mi.BSDF], eta: list[float]
    ) -> Priorities:
        rows = {"bit": np.zeros(len(holders), dtype=np.int64), "first": np.zeros(len(holders), dtype=int)}
        rows["boundary"], inside, made = np.zeros(len(holders), dtype=int), [], []
        for group in members:
            for bit, k in enumerate(group):
                rows["bit"][k], rows["first"][k], rows["boundary"][k] = 1 << bit, len(inside), len(made)
                others = (1.0, *(1.0 if j == k else eta[j] for j in group))  # never behind itself
                made += [with_index(boundaries[k], eta[k] / around) for around in others]
            inside += [k if k < objects else OUTSIDE for k in group]
        tables = {key: mi.UInt32(row.tolist()) for key, row in rows.items()}
        tables["object"] = mi.Int32(inside)
        tables["bsdf"] = mi.UInt32(pointer_numbers([mi.BSDFPtr(b) for b in made]))
        dr.make_opaque(tables)
        return cls(holders, tables, made)

    def members(self) -> np.ndarray:
        return np.flatnonzero(np.array(self.tables["bit"]))

    def start(self, k: mi.Int32) -> mi.UInt32:
        """What is around a walk that begins at the surface of object k, which lies in no other."""
        return dr.gather(mi.UInt32, self.tables["bit"], k)

    def boundary(self, k: int) -> mi.BSDF:
        """The boundary of member k to what is outside of all."""
        return self.boundaries[int(self.tables["boundary"][k])]

    def index_within(self, k: int, within: int) -> float:
        """The index of member k over that of what things are around it there."""
        row = int(self.tables["boundary"][k]) + within.bit_length()
        return index_of(self.boundaries[row])

    def bit_of(self, number: mi.Int32, active: mi.Bool | bool = True) -> mi.UInt32:
        """The bit of a thing by its number, which may be -1; 0 of what is no member."""
        return dr.gather(mi.UInt32, self.tables["bit"], dr.maximum(number, 0), active & (number >= 0))

    def meet(self, si: mi.SurfaceInteraction3f, d: mi.Vector3f, within: mi.UInt32) -> Meeting:
        """What a ray along d has met; the normal at `si` is on the outside of objects."""
        number = self.instance_table.number(si, si.is_valid())
        near, bit = dr.maximum(number, 0), self.bit_of(number)
        member = bit != 0

        # ---- bits behind it: set on the way in, cleared on the way out; others on top of it hide it
        others = within & ~bit
        beyond = dr.select(dr.dot(si.n, d) < 0, within | bit, others)
        passes = member & ((others > bit) | (beyond == within))

        # ---- the highest of these, and the boundary to the highest of the others
        first, row = (dr.gather(mi.UInt32, self.tables[key], near, member) for key in ("first", "boundary"))
        k = dr.gather(mi.Int32, self.tables["object"], first + _top(beyond), member & (beyond != 0))
        k = dr.select(beyond != 0, k, OUTSIDE)
        row += dr.select(others != 0, 1 + _top(others), 0)
        bsdf = dr.gather(mi.UInt32, self.tables["bsdf"], row, member & ~passes)
        return Meeting(member, passes, beyond, k, dr.reinterpret_array(mi.BSDFPtr, bsdf))


def _top(bits: mi.UInt32) -> mi.UInt32:
    """The place of the highest bit that is set."""
    return 31 - dr.lzcnt(bits)


def _boundary(shape: mi.Shape) -> mi.BSDF:
    """The boundary of an object, or of glass."""
    surface, bsdf = surface_of(shape), shape.bsdf()
    if surface:
        return surface.boundary
    if bsdf.class_name() not in DIELECTRICS:
        raise ValueError(
            f"what overlaps an object must be a dielectric or roughdielectric, got the {bsdf.class_name()} of the "
            f"shape {name_of(shape)}"
        )
    return boundary_of([bsdf], index_of(bsdf))


def _check(result: list[Inclusion], holders: InstanceTable, members: list[list[int]], objects: list[Geometry]) -> None:
    name = {k: name_of(holders.shapes[holders.kind[k]]) for group in members for k in group}
    for group in members:
        if len(group) > MOST:
            raise ValueError(
                f"at most {MOST} refracting shapes may overlap or hold each other where some have a priority, got "
                f"{len(group)}, the shape {name[group[0]]} among them"
            )
    for kind, obj in enumerate(objects):
        if not obj.closed and not name.keys().isdisjoint(holders.numbers(kind)):
            raise ValueError(f"objects that overlap or have a priority must be closed, got object {obj.name}")
    for inclusion in result:
        if isinstance(inclusion.node, mi.Emitter) and inclusion.object in name:
            raise ValueError(
                f"a delta light must not stand in things that overlap or have a priority, got {inclusion.name} in "
                f"{name[inclusion.object]}"
            )
