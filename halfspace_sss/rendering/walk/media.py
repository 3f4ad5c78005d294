"""What the walk inside objects knows of them: coefficients, boundary and geometry, by the number of the object."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np

from halfspace_sss.rendering.surface.horizon import lift
from halfspace_sss.rendering.surface.object import Object, survey
from halfspace_sss.rendering.surface.placement import translucent_shapes
from halfspace_sss.rendering.surface.sharing import check_together, scene_of
from halfspace_sss.rendering.walk.grids import Grids, per_channel
from halfspace_sss.rendering.walk.inner import Inner

__all__ = ["Coefficients", "WalkMedia", "by_pointer", "pointer_numbers"]

_FEWEST = {"total": 0, "multiple": 2, "single": 1}
_MOST = {"total": 2**31 - 1, "multiple": 2**31 - 1, "single": 1}


class Coefficients(NamedTuple):
    """Of the medium at a point in each lane: 1/(scene unit) and mean cosine, one value per channel."""

    sigma_t: mi.Spectrum
    sigma_s: mi.Spectrum
    g: mi.Spectrum
    majorant: mi.Spectrum  # at least sigma_t, everywhere in the object; sigma_t where the medium is homogeneous
    mean_t: mi.Spectrum  # sigma_t, or its mean where that varies


@dataclass(frozen=True, eq=False)
class WalkMedia:
    """The translucent objects of a scene, each addressed by its number.

    Args:
        objects: geometry of each.
        insides: the `Inside` of each.
        scene: a Mitsuba scene that holds these objects only.
        boundaries: dielectric BSDF of each.
        mm_per_unit: length of a scene unit, mm.
        inner: what lies inside the objects, if anything does.
    """

    objects: list[Object]
    insides: list[Any]
    scene: Any
    boundaries: list[Any]
    mm_per_unit: float
    inner: Inner | None = None

    def __post_init__(self) -> None:
        media = [inside.medium for inside in self.insides]
        tables = {}
        for key in ("sigma_t", "sigma_s", "g"):
            scale = 1.0 if key == "g" else self.mm_per_unit
            tables[key] = per_channel([getattr(m, key) for m in media], scale)
        tables["eta"] = mi.Float([m.eta for m in media])
        sides = [[obj.sign] if obj.signs is None else np.array(obj.signs).tolist() for obj in self.objects]
        tables["side"] = mi.Float(sum(sides, []))
        tables["first"] = mi.UInt32(np.cumsum([0, *map(len, sides)])[:-1].tolist())
        tables["step"] = mi.UInt32([int(len(side) > 1) for side in sides])
        tables["fewest"] = mi.UInt32([_FEWEST[inside.orders] for inside in self.insides])
        tables["most"] = mi.UInt32([_MOST[inside.orders] for inside in self.insides])
        tables["rounding"] = mi.Float([obj.rounding for obj in self.objects])
        tables["reflects"] = mi.Bool([inside.reflection for inside in self.insides])
        tables["rough"] = mi.Bool([is_rough(b) for b in self.boundaries])
        tables["boundary"] = pointer_numbers([mi.BSDFPtr(b) for b in self.boundaries])
        tables["shape"] = by_pointer([mi.ShapePtr(obj.shape) for obj in self.objects])
        dr.make_opaque(tables)  # one kernel for all media
        object.__setattr__(self, "tables", tables)
        object.__setattr__(self, "box", _bounds(self.scene))
        varies = any(inside.varying is not None for inside in self.insides)
        object.__setattr__(self, "grids", Grids.of(self.insides, self.mm_per_unit) if varies else None)

    def is_current(self) -> bool:
        """Whether the objects still have the shapes and the media that this was made of."""
        pairs = zip(self.objects, self.insides)
        return all(inside is obj.shape.bsdf().inside and obj.is_current() for obj, inside in pairs)

    @property
    def same_g(self) -> bool:
        """Whether g of every medium is the same in all channels."""
        return all(np.ptp(inside.medium.g) == 0 for inside in self.insides)

    @property
    def any_rough(self) -> bool:
        """Whether a boundary is rough, so that emitters can be sampled through it."""
        return any(is_rough(b) for b in self.boundaries)

    @property
    def needed(self) -> Any:
        """What boundaries have to know of a point that a walk meets: derivatives of positions where one is rough."""
        few = mi.RayFlags.Minimal | mi.RayFlags.ShadingFrame | mi.RayFlags.UV
        return mi.RayFlags.All if self.any_rough else few

    @property
    def all_rough(self) -> bool:
        """Whether no boundary is smooth."""
        return all(is_rough(b) for b in self.boundaries)

    def connects(self, k: Any) -> Any:
        """Whether emitters can be connected to events in object k through its boundary: smooth, and nothing inside."""
        smooth = ~self.row("rough", k)
        if self.inner is None:
            return smooth
        return smooth & dr.gather(mi.Bool, self.inner.tables["alone"], self._place(k))

    def row(self, key: str, k: Any) -> Any:
        """An entry of a table for object k."""
        table = self.tables[key]
        return dr.gather(type(table), table, self._place(k))

    def _place(self, k: Any) -> Any:
        """Of object k in tables: the same in all lanes, which is faster, where there is one object."""
        return mi.UInt32(0) if len(self.objects) == 1 else k

    def counts(self, k: Any, order: Any) -> Any:
        """Whether a walk that leaves object k after so many events counts."""
        return (order >= self.row("fewest", k)) & (order <= self.row("most", k))

    @property
    def varies(self) -> bool:
        """Whether a medium varies in space, so that collisions may be null."""
        return self.grids is not None

    def spectrum(self, key: str, k: Any) -> Any:
        """An entry of a table with one column per channel."""
        return mi.Spectrum([dr.gather(mi.Float, column, self._place(k)) for column in self.tables[key]])

    def coefficients(self, k: Any, p: Any) -> Coefficients:
        """Of object k at the point p."""
        mean, g = self.spectrum("sigma_t", k), self.spectrum("g", k)
        if self.grids is None:
            return Coefficients(mean, self.spectrum("sigma_s", k), g, mean, mean)
        sigma_t, sigma_s = self.grids.coefficients(k, p)
        return Coefficients(sigma_t, sigma_s, g, self.grids.majorant(k), mean)

    def transmittance(self, k: Any, ray: Any, distance: Any, rng: Any) -> Any:
        """exp(-∫ sigma_t) over a distance along a ray inside object k; by ratio tracking where a medium varies."""
        if self.grids is None:
            return dr.exp(-self.spectrum("sigma_t", k) * distance)
        return self.grids.transmittance(k, ray, distance, rng)

    def index_of(self, shape: Any, active: Any = True) -> Any:
        """The number of the object that a shape is, or -1."""
        pointer = dr.reinterpret_array(mi.UInt32, shape)
        table = self.tables["shape"]
        known = active & (pointer < dr.width(table))
        return dr.select(known, dr.gather(mi.Int32, table, pointer, known), -1)

    def met(self, shape: Any, k: Any) -> Any:
        """The number of the object whose boundary, the given shape, a ray inside object k has met."""
        return k if len(self.objects) == 1 else self.index_of(shape)

    def boundary(self, k: Any) -> Any:
        """The dielectric of object k: one BSDF, or a pointer in each lane."""
        if len(self.boundaries) == 1:
            return self.boundaries[0]
        return dr.reinterpret_array(mi.BSDFPtr, dr.gather(mi.UInt32, self.tables["boundary"], k))

    def side(self, k: Any, prim_index: Any) -> Any:
        """1 where the geometric normal of a face of object k points outwards, -1 where it points inwards."""
        if all(obj.signs is None for obj in self.objects):
            return self.row("side", k)
        table = self.tables["side"]  # by face, not by object
        index = self.row("first", k) + prim_index * self.row("step", k)
        return dr.gather(mi.Float, table, dr.minimum(index, dr.width(table) - 1))

    def clear(self, k: Any, n: Any, d: Any) -> Any:
        """Length along d after which a ray from the surface of object k is clear of it; n is the normal there.

        Mitsuba moves the origin along the normal instead, which lays the walk deeper: at 1000 mean free paths from the
        origin of the scene it took 8 % of the single and 1 to 6 % of the multiple scattering away.
        """
        return self.row("rounding", k) / dr.maximum(dr.abs(dr.dot(n, d)), 0.1)

    def depart(self, k: Any, si: Any, d: Any, inside: Any) -> tuple[Any, Any]:
        """Where a ray along d from the surface of object k begins, and the length that it skips if it runs inside."""
        skip = self.clear(dr.maximum(mi.Int32(k), 0), si.n, d)
        return dr.select(inside, si.p, si.spawn_ray(d).o), dr.select(inside, skip, 0)

    @property
    def interpolates(self) -> bool:
        """Whether normals of an object are not those of its surface."""
        return any(obj.shape.is_mesh() and obj.shape.has_vertex_normals() for obj in self.objects)

    def seen(self, si: Any, k: Any, direction: Any) -> Any:
        """The interaction as a ray along `direction` sees it: normals outwards, none on the other side of the ray."""
        si = self.face_outwards(si, k, direction)
        return lift(si, -direction, k >= 0) if self.interpolates else si

    def face_outwards(self, si: Any, k: Any, direction: Any) -> Any:
        """The interaction with its normals turned to the outside of object k; `direction` is that of the ray."""
        if all(obj.upright for obj in self.objects):
            return si
        n = dr.select(k >= 0, si.n * self.side(dr.maximum(k, 0), si.prim_index), si.n)
        flip = (k >= 0) & (dr.dot(si.sh_frame.n, n) < 0)
        si.n, n = n, si.sh_frame.n
        si.sh_frame = dr.select(flip, mi.Frame3f(-n), si.sh_frame)
        si.wi = si.to_local(-direction)
        return si

    @classmethod
    def of(cls, scene: Any, mm_per_unit: float) -> WalkMedia:
        """The objects of a scene whose surface is `translucent`.

        Raises:
            ValueError: mm_per_unit is not a finite number > 0, an object is an instance, or as `Inner.of`.
        """
        if not (np.isfinite(mm_per_unit) and mm_per_unit > 0):
            raise ValueError(f"mm_per_unit must be finite and > 0, got {mm_per_unit!r}")
        shapes = translucent_shapes(scene)
        inner, objects = scene_of(shapes, scene), [survey(shape, scene) for shape in shapes]
        found = Inner.of(scene, objects)
        check_together(scene, [inner, *([found.scene] if found else []), *(obj.scene for obj in objects)])
        surfaces = [shape.bsdf() for shape in shapes]
        return cls(
            objects,
            [surface.inside for surface in surfaces],
            inner,
            [surface.boundary for surface in surfaces],
            float(mm_per_unit),
            found,
        )


def _bounds(scene: Any) -> Any:
    """The bounding box, a little larger; what is outside has leaked through the boundary by rounding."""
    box = scene.bbox()
    if not box.valid():
        return box
    margin = 1e-3 * (box.max - box.min)
    return mi.BoundingBox3f(mi.Point3f(box.min - margin), mi.Point3f(box.max + margin))


def is_rough(boundary: Any) -> bool:
    """Whether a boundary scatters into a solid angle."""
    return bool(boundary.flags() & int(mi.BSDFFlags.Smooth))


def pointer_numbers(pointers: list[Any]) -> Any:
    """What Dr.Jit's registry calls each."""
    return mi.UInt32([int(dr.reinterpret_array(mi.UInt32, pointer)[0]) for pointer in pointers])


def by_pointer(pointers: list[Any]) -> Any:
    """Table from the number of a pointer in Dr.Jit's registry to its place in the list, -1 for others."""
    ids = np.array(pointer_numbers(pointers), dtype=int).tolist()
    table = np.full(max(ids, default=0) + 1, -1, dtype=np.int32)
    for k, number in enumerate(ids):
        table[number] = k
    return mi.Int32(table.tolist())  # lists, not NumPy arrays: memory in any alignment would need kernels of its own
