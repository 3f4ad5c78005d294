"""What the walk inside objects knows of them: coefficients, boundary and geometry, by the number of the object."""

from __future__ import annotations

import contextlib
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from types import ModuleType
from typing import NamedTuple
from weakref import WeakKeyDictionary

import drjit as dr
import mitsuba as mi
import numpy as np

from full_geometry.geometry.instances import (
    Group,
    InstanceScene,
    InstanceTable,
    bounds_of,
    corners,
    ends_of,
    shapes_of,
    shown_groups,
)
from full_geometry.geometry.points import lift
from full_geometry.geometry.rounding import clear
from full_geometry.geometry.shape import Geometry, analyse_shape, check_together, name_of, pointer_numbers, scene_of
from full_geometry.geometry.snapshot import Snapshot
from full_geometry.objects.inclusions import Inclusion, check_sensors, find_inclusions, refracts
from full_geometry.objects.objects import TranslucentObject, translucent_shapes
from full_geometry.objects.small_emitters import is_delta
from full_geometry.settings import MM_PER_UNIT, NO_OBJECT
from full_geometry.surface.sheets import check_sheets
from full_geometry.surface.translucent import DIELECTRICS, MediumSpec, is_rough, is_smooth_boundary, smooth_boundary
from full_geometry.surface.varying import VaryingMedium, eval_volume
from full_geometry.surface.wrapped import Wrapping, surface_of, wrapping_of
from full_geometry.walk.emission import unmasked_surface
from full_geometry.walk.priorities import Priorities
from halfspace_sss.checks import check_interval
from halfspace_sss.physics.medium import Medium

# ---- Shapes, media and lights inside objects ------------------------------------------------------------------------
#
# Indices are relative, as Mitsuba's path tracers take them: int_ior / ext_ior of a `dielectric` inside, and eta of an
# object inside another, are those of its inside over what is around it. A bubble in wax of eta 1.4 is a `dielectric`
# with int_ior 1 and ext_ior 1.4. What refracts displaces the medium around it; what passes light straight (`null`,
# `mask`, `thindielectric`) stands in it.


MOST_LOST = 0.5  # of the rays that enter an object do not leave it: what is more open has no inside


@dataclass(frozen=True, eq=False)
class InclusionTable:
    """What lies inside the objects of a scene.

    Args:
        scene: a Mitsuba scene that holds the objects, and the shapes inside or partly inside them.
        instance_table: numbers of these shapes and of their instances.
        tables: by these numbers, the number of the object `around` a shape or -1, and whether it `displaces` that; by
            the number of an object, whether it stands `alone`, neither in another nor around anything, and whether it
            is `enclosed` by another and overlaps nothing.
        lights: the delta lights in the medium of an object, and its number.
        glass: geometry of the shapes that refract in them, of those that hold or overlap such glass, and of glass
            about objects, which their light passes.
        priorities: of what overlaps, and of glass outside; None where there is neither.
        surfaces: snapshots of the BSDFs of glass with priorities.
        outer: the glass outside.
    """

    scene: mi.Scene
    instance_table: InstanceTable
    tables: dict[str, mi.Int32 | mi.Bool]
    lights: list[tuple[mi.Emitter, int]]
    glass: list[Geometry]
    priorities: Priorities | None = None
    surfaces: Sequence[Snapshot] = ()
    outer: Sequence[Geometry] = ()

    @classmethod
    def of(cls, scene: mi.Scene, objects: list[Geometry]) -> InclusionTable | None:
        """What lies inside, and glass outside; None where there is neither.
        ValueError if something inside that refracts is not closed, objects count some orders only, or as of
        `Priorities.of`."""
        outer = _glass_outside(scene, objects)
        try:
            return cls._of(scene, objects, outer)
        except ValueError:  # of glass that can be no member: light by way of it is left to chance
            if not outer:
                raise
        return cls._of(scene, objects, [])

    @classmethod
    def _of(cls, scene: mi.Scene, objects: list[Geometry], outer: list[Geometry]) -> InclusionTable | None:
        """The same with these pieces of glass outside."""
        result = find_inclusions(scene, [*objects, *outer])
        if not result and not outer:
            return None
        # ---- what displaces the medium around it holds things of its own: these are looked for again
        groups, glass = shown_groups(scene), list(outer)
        own = InstanceTable([obj.shape for obj in objects], groups)
        _check([inclusion for inclusion in result if inclusion.object < len(own)], objects, own)
        while more := [s for s in _shapes(result) if _displaces(s) and not any(s is piece.shape for piece in glass)]:
            glass += [analyse_shape(shape, scene) for shape in more]
            for piece in glass:
                if not piece.closed:
                    raise ValueError(f"refracting inclusions of an object must be closed, got the shape {piece.name}")
            result = find_inclusions(scene, [*objects, *glass])

        # ---- number shapes inside after the objects, each at all its places
        holders = InstanceTable([obj.shape for obj in (*objects, *glass)], groups)
        inside = [inclusion for inclusion in result if inclusion.object < len(own)]
        things = [thing for thing in _shapes(inside) if not any(thing is shape for shape in own.shapes)]
        instance_table = InstanceTable([*own.shapes, *things], groups)
        first = {id(shape): int(number) for shape, number in zip(instance_table.shapes, instance_table.first)}

        # ---- what is around each: the smallest holder comes last and stays
        around, lights, result = np.full(len(instance_table), -1), {}, _largest_first(result, holders)
        outside = range(len(own), len(own) + len(outer))  # of glass the first, each at one place
        priorities = Priorities.of(scene, result, holders, objects, groups, outside)
        holding, held = np.zeros(len(own), dtype=bool), np.zeros(len(instance_table), dtype=bool)
        for inclusion in result:
            number = inclusion.object if inclusion.object < len(own) else -1
            if isinstance(inclusion.node, mi.Emitter):
                lights[id(inclusion.node)] = inclusion.node, number
            elif id(inclusion.node) in first:
                place = first[id(inclusion.node)] + inclusion.rank
                around[place], held[place] = number, held[place] or number >= 0
            holding[[number] if number >= 0 else []] = True

        # ---- tables of the kernel
        displaces = [_displaces(shape) for shape in instance_table.shapes]
        alone, enclosed = ~holding & ~held[: len(own)], held[: len(own)].copy()
        if priorities is not None:
            members = [k for k in priorities.members() if k < len(own)]
            alone[members] = enclosed[members] = False
        tables = {"around": mi.Int32(around.tolist()), "alone": mi.Bool(alone.tolist())}
        tables["enclosed"] = mi.Bool(enclosed.tolist())
        tables["displaces"] = mi.Bool([displaces[kind] for kind in instance_table.kind])
        dr.make_opaque(tables)
        lights = [(light, k) for light, k in lights.values() if is_delta(light) and k >= 0]
        surfaces = [] if priorities is None else [Snapshot(piece.shape.bsdf()) for piece in glass]
        return cls(instance_table.scene(scene), instance_table, tables, lights, glass, priorities, surfaces, outer)

    def is_current(self, scene: mi.Scene) -> bool:
        """Whether glass still has the index and roughness that boundaries were made of, and no camera inside."""
        try:
            check_sensors(scene, list(self.outer))
        except ValueError:
            return False
        return all(Snapshot(piece.shape.bsdf()) == was for piece, was in zip(self.glass, self.surfaces))

    @property
    def shines(self) -> bool:
        """Whether there are lamps among these."""
        return bool(self.lights) or any(shape.is_emitter() for shape in self.instance_table.shapes)

    def around(self, si: mi.SurfaceInteraction3f) -> mi.Int32:
        """The number of the object around what a ray has met, or -1."""
        return self._met("around", si, -1)

    def displaces(self, si: mi.SurfaceInteraction3f) -> mi.Bool:
        """Whether that, which is no translucent object, displaces the medium around it."""
        return self._met("displaces", si, False)

    def _met(self, key: str, si: mi.SurfaceInteraction3f, otherwise: int | bool) -> mi.Int32 | mi.Bool:
        number, table = self.instance_table.number(si), self.tables[key]
        return dr.select(number >= 0, dr.gather(type(table), table, dr.maximum(number, 0)), otherwise)


class Holes(NamedTuple):
    """The shapes of an `InclusionTable`, with the sides of their surfaces.
    `shapes`: by their place in the table. `side`: by number, 1 where geometric normals point outwards, -1 where they
    point inwards, 0 of what is not closed and has the medium on both sides."""

    shapes: list[Geometry]
    side: mi.Float


def _shapes(result: list[Inclusion]) -> list[mi.Shape]:
    return list({id(c.node): c.node for c in result if isinstance(c.node, mi.Shape)}.values())


def _displaces(shape: mi.Shape) -> bool:
    return not surface_of(shape) and refracts(shape)


def _glass_outside(scene: mi.Scene, objects: list[Geometry]) -> list[Geometry]:
    """Closed dielectrics outside of objects and about one, with neither a lamp nor a camera inside.

    They are about an object where their box holds its own, as that of a bell jar does.
    """
    # ---- boxes of objects, those of instances where they stand
    own, results = InstanceTable([obj.shape for obj in objects], shown_groups(scene)), []
    ends = [ends_of(corners(shape.bbox(), own.to_world(kind))) for kind, shape in enumerate(own.shapes)]
    low, high = (np.concatenate(rows) for rows in zip(*ends)) if ends else (np.zeros((0, 3)),) * 2

    # ---- dielectrics about them
    for shape in scene.shapes():
        box = shape.bbox()
        about = ((low > np.array(box.min)) & (high < np.array(box.max))).all(axis=1).any()
        if not about or shape.bsdf().class_name() not in DIELECTRICS:
            continue
        with warnings.catch_warnings(), contextlib.suppress(ValueError):  # of a sheet, or a camera inside
            warnings.simplefilter("ignore")
            piece = analyse_shape(shape, scene)
            check_sensors(scene, [piece])
            inside = [inclusion.node for inclusion in find_inclusions(scene, [piece])]
            if piece.closed and not any(isinstance(node, mi.Emitter) or node.is_emitter() for node in inside):
                results.append(piece)
    held = {id(inclusion.node) for inclusion in find_inclusions(scene, objects)} if results else set()
    return [piece for piece in results if id(piece.shape) not in held]


def _largest_first(result: list[Inclusion], holders: InstanceTable) -> list[Inclusion]:
    """Sorted by the size of what is around, the smallest last."""
    boxes = [ends_of(corners(shape.bbox(), holders.to_world(k))) for k, shape in enumerate(holders.shapes)]
    sizes = np.concatenate([np.linalg.norm(high - low, axis=1) for low, high in boxes])
    return sorted(result, key=lambda inclusion: -sizes[inclusion.object])


def _check(result: list[Inclusion], objects: list[Geometry], instance_table: InstanceTable) -> None:
    # what refracts is in objects without textures whose orders all count
    for inclusion in result:
        holder = objects[instance_table.kind[inclusion.object]]
        surfaces = [surface_of(holder.shape)]
        if isinstance(inclusion.node, mi.Shape):
            translucent = bool(surface_of(inclusion.node))
            if surfaces[0].spec.textured is not None and (translucent or _displaces(inclusion.node)):
                raise ValueError(
                    f"an object with textures must hold nothing that refracts, got {inclusion.name} in {holder.name}"
                )
            surfaces += [surface_of(inclusion.node)] if translucent else []
        for surface in surfaces:
            if surface.spec.orders != "total":
                raise ValueError(
                    f"orders must be 'total' of objects with something inside, got {surface.spec.orders!r} where "
                    f"{inclusion.name} lies inside object {holder.name}"
                )


def _check_mixes(
    wrappings: list[Wrapping], objects: list[Geometry], instance_table: InstanceTable, inner: InclusionTable | None
) -> None:
    """ValueError if a mask or blend is on an object inside another, or with something inside."""
    alone = np.ones(len(instance_table), dtype=bool) if inner is None else np.array(inner.tables["alone"])
    for kind, (around, obj) in enumerate(zip(wrappings, objects)):
        if around.mixes and not alone[instance_table.numbers(kind)].all():
            raise ValueError(
                f"an object with a mask or blendbsdf must be in no other and hold nothing, got object {obj.name}"
            )


# ---- Heterogeneous media -------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class HeterogeneousMedia:
    """The media of all objects, where at least one varies.

    Args:
        densities: volume of each object, or None, see `VaryingMedium`.
        albedos: likewise.
        factor: table with one column per channel, 1/(scene unit).
        albedo: likewise, without a unit.
        majorants: likewise, 1/(scene unit).
    """

    densities: list[mi.Volume | None]
    albedos: list[mi.Volume | None]
    factor: list[mi.Float]
    albedo: list[mi.Float]
    majorants: list[mi.Float]

    @classmethod
    def of(cls, specs: list[MediumSpec], objects: list[Geometry], mm_per_unit: float) -> HeterogeneousMedia:
        """The media of objects with these specs."""
        varying = [inside.varying or _homogeneous(inside.medium) for inside in specs]
        media = [each.placed(obj, mm_per_unit) for each, obj in zip(varying, objects)]
        tables = [per_channel([getattr(m, key) for m in media], 1.0) for key in ("factor", "albedo", "majorant")]
        dr.make_opaque(tables)
        return cls([m.density for m in media], [m.albedo_volume for m in media], *tables)

    def majorant(self, k: mi.Int32) -> mi.Spectrum:
        """The majorant of object k, 1/(scene unit)."""
        return _row(self.majorants, k)

    def sigma_t(self, k: mi.Int32, p: mi.Point3f) -> mi.Spectrum:
        """Extinction of object k at the point p, 1/(scene unit)."""
        return _row(self.factor, k) * _eval(self.densities, k, p)

    def coefficients(self, k: mi.Int32, p: mi.Point3f) -> tuple[mi.Spectrum, mi.Spectrum]:
        """sigma_t and sigma_s of object k at the point p, 1/(scene unit)."""
        sigma_t = self.sigma_t(k, p)
        return sigma_t, sigma_t * _row(self.albedo, k) * _eval(self.albedos, k, p)

    def transmittance(self, k: mi.Int32, ray: mi.Ray3f, distance: mi.Float, rng: mi.PCG32) -> mi.Spectrum:
        """An unbiased estimate of exp(-∫ sigma_t) over a distance along a ray inside object k: ratio tracking.
        Collisions are drawn by the largest majorant M of the channels; each is null, with the weight 1 - sigma_t,c / M
        (Novak, Selle and Jarosz 2014)."""
        # the first collision, t = -ln(1 - u) / M
        M = dr.max(self.majorant(k))
        o, d = mi.Point3f(ray.o), mi.Vector3f(ray.d)
        T = dr.full(mi.Spectrum, 1, dr.width(o))
        t = -dr.log(1 - rng.next_float32()) / M

        def collide(t: mi.Float, T: mi.Spectrum, rng: mi.PCG32) -> tuple:
            # T *= 1 - sigma_t / M at the collision, then the next one
            T = T * dr.maximum(1 - self.sigma_t(k, dr.fma(d, t, o)) / M, 0)
            return t - dr.log(1 - rng.next_float32()) / M, T, rng

        def going(t: mi.Float, T: mi.Spectrum, rng: mi.PCG32) -> mi.Bool:
            return (t < distance) & (dr.max(T) > 0)

        return dr.while_loop((t, T, rng), going, collide, label="ratio tracking")[1]


def per_channel(rows: list[float | np.ndarray], scale: float) -> list[mi.Float]:
    """A table with one column per channel from a number, or one per channel, of each object."""
    # (objects, channels), as one array for each channel
    n = len(mi.Spectrum(0))
    values = np.array([np.broadcast_to(row, n) for row in rows], dtype=float) * scale
    return [mi.Float(values[:, c].tolist()) for c in range(n)] if len(rows) else []


def sent_back(lib: ModuleType, albedo: Number, g: Number) -> Number:
    """About the light that a half-space sends back, for NumPy or Dr.Jit.
    (1 - s) (1 - 0.139 s) / (1 + 1.17 s), s² = (1 - a) / (1 - a g) for the albedo a (van de Hulst 1980)."""
    s = lib.sqrt((1 - albedo) / lib.maximum(1 - albedo * g, 1e-6))
    return lib.maximum((1 - s) * (1 - 0.139 * s) / (1 + 1.17 * s), 1e-6)


def _shares(medium: Medium) -> np.ndarray:
    """Probability of each channel of a walk: a part evenly, the rest by the light that a half-space sends back."""
    R = sent_back(np, np.atleast_1d(medium.albedo).astype(float), medium.g)
    return EVENLY / len(R) + (1 - EVENLY) * R / R.sum()


def _homogeneous(medium: Medium) -> VaryingMedium:
    return VaryingMedium(None, np.atleast_1d(medium.sigma_t), None, np.atleast_1d(medium.albedo))


def _row(table: list[mi.Float], k: mi.Int32) -> mi.Spectrum:
    return mi.Spectrum([dr.gather(mi.Float, column, k) for column in table])


def _eval(volumes: list[mi.Volume | None], k: mi.Int32, p: mi.Point3f) -> mi.Spectrum:
    """The value of the volume of object k, 1 where it has none; Mitsuba's volumes cannot be called by pointers."""
    if len(volumes) == 1:
        return eval_volume(volumes[0], p)
    # one branch for each object
    value = mi.Spectrum(1)
    for number, volume in enumerate(volumes):
        if volume is not None:
            here = k == number
            value = dr.select(here, eval_volume(volume, p, here), value)
    return value


Number = "mi.Spectrum | np.ndarray"
_FEWEST = {"total": 0, "multiple": 2, "single": 1}
_MOST = {"total": 2**31 - 1, "multiple": 2**31 - 1, "single": 1}


class Coefficients(NamedTuple):
    """Coefficients of the medium at a point in each lane: 1/(scene unit) and mean cosine, one value per channel."""

    sigma_t: mi.Spectrum
    sigma_s: mi.Spectrum
    g: mi.Spectrum
    majorant: mi.Spectrum  # at least sigma_t, everywhere in the object; sigma_t where the medium is homogeneous
    mean_t: mi.Spectrum  # sigma_t, or its mean where that varies


@dataclass
class Place:
    """A point of a surface, as textures ask for it."""

    p: mi.Point3f
    uv: mi.Point2f
    face: mi.UInt32

    @classmethod
    def unknown(cls, lanes: int) -> Place:
        """No point."""
        return cls(dr.zeros(mi.Point3f, lanes), dr.zeros(mi.Point2f, lanes), dr.zeros(mi.UInt32, lanes))

    def on(self, shape: mi.Shape) -> mi.SurfaceInteraction3f:
        """What textures of a shape are looked up by."""
        si = dr.zeros(mi.SurfaceInteraction3f, dr.width(self.face))
        si.p, si.uv, si.prim_index, si.shape = self.p, self.uv, self.face, mi.ShapePtr(shape)
        return si


@dataclass
class WalkMedium:
    """What a walk carries: of textures and spectra the medium where it enters, for its whole way; 1/(scene unit)."""

    sigma_t: mi.Spectrum
    sigma_s: mi.Spectrum
    g: mi.Spectrum | tuple[()] = ()  # where it differs by wavelength
    wavelengths: mi.Spectrum | tuple[()] = ()  # of its light, nm, under spectral variants
    place: Place | tuple[()] = ()  # where it entered, if media have textures


def ray_of(o: mi.Point3f, d: mi.Vector3f, medium: WalkMedium | tuple[()]) -> mi.Ray3f:
    """A ray with the wavelengths of a walk that carries `medium`."""
    return mi.Ray3f(o, d, 0, medium.wavelengths) if mi.is_spectral else mi.Ray3f(o, d)


def interaction_of(p: mi.Point3f, medium: WalkMedium | tuple[()]) -> mi.Interaction3f:
    """A point that emitters are seen from, with the wavelengths of a walk that carries `medium`."""
    at = dr.zeros(mi.Interaction3f)
    at.p = mi.Point3f(p)
    if mi.is_spectral:
        at.wavelengths = medium.wavelengths
    return at


EVENLY = 0.5  # part of the probability of a channel


@dataclass(frozen=True, eq=False)
class WalkMedia:
    """The translucent objects of a scene, each addressed by its number.

    An object is a shape at one of its places. What is known of all places is listed by shape.

    Args:
        objects: geometry of each shape.
        specs: the `MediumSpec` of each shape.
        scene: a Mitsuba scene that holds these objects, and what is in groups with them.
        boundaries: dielectric BSDF of each shape.
        mm_per_unit: length of a scene unit, mm.
        inner: what lies inside the objects, if anything does.
        wrappings: what is around surfaces, by shape; () where nothing is.
        shown: the groups that the scene shows.
        instance_scene: intersects rays with it, and with scenes of some of its shapes.
    """

    objects: list[Geometry]
    specs: list[MediumSpec]
    scene: mi.Scene
    boundaries: list[mi.BSDF]
    mm_per_unit: float
    inner: InclusionTable | None = None
    wrappings: tuple[Wrapping, ...] = ()
    shown: tuple[Group, ...] = ()
    instance_scene: InstanceScene = InstanceScene([], {})

    def __post_init__(self) -> None:
        # ---- coefficients by the number of an object, 1/(scene unit)
        instance_table = InstanceTable([obj.shape for obj in self.objects], self.shown)
        object.__setattr__(self, "instance_table", instance_table)
        specs, boundaries = ([rows[kind] for kind in instance_table.kind] for rows in (self.specs, self.boundaries))
        media, tables = [inside.medium for inside in specs], {}
        for key in ("sigma_t", "sigma_s", "g"):
            scale = 1.0 if key == "g" else self.mm_per_unit
            tables[key] = per_channel([getattr(m, key) for m in media], scale)
        tables["shares"] = per_channel([_shares(m) for m in media], 1.0)
        tables["eta"] = mi.Float([m.eta for m in media])

        # ---- sides of geometric normals: one per object, or one per face of all shapes
        sides = [[obj.sign] if obj.signs is None else np.array(obj.signs).tolist() for obj in self.objects]
        one_each = all(obj.signs is None for obj in self.objects)
        tables["side"] = mi.Float(sum([sides[kind] for kind in instance_table.kind] if one_each else sides, []))
        tables["first"] = mi.UInt32(np.cumsum([0, *map(len, sides)])[instance_table.kind].tolist())
        tables["step"] = mi.UInt32([int(len(sides[kind]) > 1) for kind in instance_table.kind])

        # ---- orders, and what boundaries are like
        tables["fewest"] = mi.UInt32([_FEWEST[inside.orders] for inside in specs])
        tables["most"] = mi.UInt32([_MOST[inside.orders] for inside in specs])
        tables["rounding"] = mi.Float(instance_table.rounding.tolist())
        tables["textured"] = mi.Bool([inside.textured is not None for inside in specs])
        tables["reflects"] = mi.Bool([inside.reflection for inside in specs])
        tables["rough"] = mi.Bool([is_rough(b) for b in boundaries])
        straight = self._straight()
        tables["straight"] = mi.Bool([straight[kind] for kind in instance_table.kind])
        numbers = pointer_numbers([mi.BSDFPtr(b) for b in self.boundaries])
        tables["boundary"] = mi.UInt32([numbers[kind] for kind in instance_table.kind])
        tables["kind"] = mi.UInt32(instance_table.kind.tolist())

        # ---- as data of a kernel, which then serves all media
        dr.make_opaque(tables)
        object.__setattr__(self, "tables", tables)
        object.__setattr__(self, "any_straight", any(straight))
        object.__setattr__(self, "box", _bounds(self.scene))
        varies = any(inside.varying is not None for inside in specs)
        heterogeneous = HeterogeneousMedia.of(specs, self.objects, self.mm_per_unit) if varies else None
        object.__setattr__(self, "heterogeneous", heterogeneous)

    def is_current(self, scene: mi.Scene) -> bool:
        """Whether objects of a scene still have the shapes and the media that this was made of."""
        pairs = zip(self.objects, self.specs)
        same = all(inside is surface_of(obj.shape).spec and obj.is_current() for obj, inside in pairs)
        return same and (self.inner is None or self.inner.is_current(scene))

    def renewed(self) -> WalkMedia | None:
        """The same shapes with the media that they have now; None if they moved, or hold or are around something."""
        if self.inner is not None or self.wrappings or self.shown or not all(obj.is_current() for obj in self.objects):
            return None
        surfaces = [surface_of(obj.shape) for obj in self.objects]
        for surface, obj in zip(surfaces, self.objects):
            if surface.spec.textured is not None:
                surface.spec.textured.check(obj)
        return replace(self, specs=[each.spec for each in surfaces], boundaries=[each.boundary for each in surfaces])

    def enclosed(self, k: mi.Int32) -> mi.Bool:
        """Whether object k lies inside another and overlaps nothing: light comes to it by way of that alone."""
        return (k < 0) if self.inner is None else dr.gather(mi.Bool, self.inner.tables["enclosed"], k)

    @cached_property
    def nested(self) -> bool:
        """Whether an object lies inside another, and nothing overlaps: light comes to it by way of that."""
        if self.inner is None or self.overlaps:
            return False
        return bool(np.array(self.inner.tables["enclosed"]).any())

    @property
    def outermost(self) -> list[Geometry]:
        """The objects, and the glass about them."""
        return [*self.objects, *(self.inner.outer if self.inner is not None else ())]

    @property
    def holders(self) -> InstanceTable:
        """Numbers of the objects, then of the glass that overlaps them."""
        return self.inner.priorities.instance_table if self.overlaps else self.instance_table

    @property
    def holder_shapes(self) -> list[Geometry]:
        """The shapes of these."""
        return [*self.objects, *(self.inner.glass if self.overlaps else [])]

    @property
    def lit_from_outside(self) -> list[int]:
        """Numbers of the objects and glass at which scattered light may begin."""
        objects = np.flatnonzero(~np.array(self.enclosed(dr.arange(mi.Int32, len(self.instance_table)))))
        glass = [k for k in self.inner.priorities.members() if k >= len(self.instance_table)] if self.overlaps else []
        return [*objects.tolist(), *map(int, glass)]

    @property
    def refracting(self) -> list[mi.Shape]:
        """The objects, and the glass in or over them."""
        inside = [] if self.inner is None else filter(_displaces, self.inner.instance_table.shapes)
        return [*self.holders.shapes, *inside]

    @cached_property
    def holes(self) -> Holes | None:
        """The shapes inside objects, as far as they bound the media around them; None where nothing lies inside.
        ValueError if one has no area, as curves, or faces to both sides, or as of `analyse_shape`."""
        if self.inner is None:
            return None
        table, shapes = self.inner.instance_table, list(self.objects)
        known = {id(each.shape): each for each in self.inner.glass}
        for shape in table.shapes[len(shapes) :]:
            if id(shape) in known:
                shapes.append(known[id(shape)])
                continue
            try:
                shape.surface_area()
            except RuntimeError:  # Mitsuba's, of curves
                raise ValueError(f"a shape must have an area, got {name_of(shape)}") from None
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # a sheet inside an object is no mistake
                shapes.append(analyse_shape(shape, self.scene))
        for each in shapes:
            if each.signs is not None:
                raise ValueError(f"faces must point to one side, got both of {each.name}")
        side = mi.Float([shapes[kind].sign if shapes[kind].closed else 0.0 for kind in table.kind])
        dr.make_opaque(side)
        return Holes(shapes, side)

    @property
    def same_g(self) -> bool:
        """Whether g of every medium is the same in all channels."""
        return all(np.ptp((inside.spectral or inside.medium).g) == 0 for inside in self.specs)

    @property
    def any_rough(self) -> bool:
        """Whether a boundary is rough, so that emitters can be sampled through it."""
        return any(is_rough(b) for b in self.boundaries)

    @property
    def tinted(self) -> bool:
        """Whether a boundary has colours, which its choice between reflection and refraction leaves out."""
        return any(key.startswith("specular_") for b in self.boundaries for key in mi.traverse(b).keys())

    def reflected(self, k: mi.Int32, si: mi.SurfaceInteraction3f) -> mi.Float:
        """F of the smooth boundary of object k at a point, without its colour."""
        return mi.fresnel(mi.Frame3f.cos_theta(si.wi), self.row("eta", k))[0]

    def tint(self, k: mi.Int32, si: mi.SurfaceInteraction3f, reflects: bool) -> mi.Spectrum:
        """The colour that the smooth boundary of object k reflects, or refracts, at a point."""
        if not self.tinted:
            return mi.Spectrum(1)
        # the weight of a choice that is given is its colour
        ctx = mi.BSDFContext(mi.TransportMode.Importance)
        return self.boundary(k).sample(ctx, si, 0.0 if reflects else 1.0, mi.Point2f(0))[1]

    @property
    def needed(self) -> int:
        """What boundaries have to know of a point that a walk meets: derivatives of positions where one is rough."""
        few = mi.RayFlags.Minimal | mi.RayFlags.ShadingFrame | mi.RayFlags.UV
        return mi.RayFlags.All if self.any_rough or self.any_bent else few

    @property
    def any_bent(self) -> bool:
        """Whether a normal or bump map bends the normals of an object."""
        return any(around.bend is not None for around in self.wrappings)

    @property
    def any_refracts(self) -> bool:
        """Whether a boundary is smooth and not straight."""
        return any(not is_rough(b) and not straight for b, straight in zip(self.boundaries, self._straight()))

    @property
    def overlaps(self) -> bool:
        """Whether walks have to know what is around them, see `walk.priorities`."""
        return self.inner is not None and self.inner.priorities is not None

    def connects(self, k: mi.Int32) -> mi.Bool:
        """Whether connections go through the boundary of object k: smooth, refracting, and nothing inside."""
        return self._alone(~self.row("rough", k) & ~self.row("straight", k), k)

    def scatters_at(self, k: mi.Int32) -> mi.Bool:
        """Whether the boundary of object k is rough, and nothing inside."""
        return self._alone(self.row("rough", k), k)

    def straight(self, k: mi.Int32) -> mi.Bool:
        """Whether light goes straight through the boundary of object k: of index 1, and nothing inside."""
        return self._alone(self.row("straight", k), k)

    def _alone(self, able: mi.Bool, k: mi.Int32) -> mi.Bool:
        return able if self.inner is None else able & dr.gather(mi.Bool, self.inner.tables["alone"], self.place_of(k))

    def _straight(self) -> list[bool]:
        """By shape, whether its boundary is smooth, of index 1, and everywhere."""
        mixes = [around.mixes for around in self.wrappings] or [False] * len(self.specs)
        rows = zip(self.specs, self.boundaries, mixes)
        return [inside.medium.eta == 1 and is_smooth_boundary(b) and not mixed for inside, b, mixed in rows]

    def row(self, key: str, k: mi.Int32) -> mi.Float | mi.UInt32 | mi.Bool:
        """An entry of a table for object k."""
        table = self.tables[key]
        return dr.gather(type(table), table, self.place_of(k))

    def place_of(self, k: mi.Int32) -> mi.UInt32 | mi.Int32:
        """The place of object k in tables: the same in all lanes, which is faster, where there is one object."""
        return mi.UInt32(0) if len(self.instance_table) == 1 else k

    def has_shape(self, k: mi.Int32, kind: int) -> mi.Bool:
        """Whether object k, which may be -1, has a shape of the list."""
        if not self.instance_table.repeated:
            return k == kind
        return (k >= 0) & (dr.gather(mi.UInt32, self.tables["kind"], dr.maximum(k, 0)) == kind)

    def counts(self, k: mi.Int32, order: mi.UInt32) -> mi.Bool:
        """Whether a walk that leaves object k after so many events counts."""
        return (order >= self.row("fewest", k)) & (order <= self.row("most", k))

    @property
    def varies(self) -> bool:
        """Whether a medium varies in space, so that collisions may be null."""
        return self.heterogeneous is not None

    def shares(self, k: mi.Int32) -> mi.Spectrum:
        """Probability of each channel of a path that begins at object k; even where they are wavelengths of a walk."""
        n = len(mi.Spectrum(0))
        return mi.Spectrum(1 / n) if mi.is_spectral or not self.objects else self.spectrum("shares", k)

    def spectrum(self, key: str, k: mi.Int32) -> mi.Spectrum:
        """An entry of a table with one column per channel."""
        return mi.Spectrum([dr.gather(mi.Float, column, self.place_of(k)) for column in self.tables[key]])

    @property
    def carried(self) -> bool:
        """Whether walks carry their medium: what they took of textures, or of spectra at their wavelengths."""
        return mi.is_spectral or self.textured

    @property
    def textured(self) -> bool:
        """Whether a medium has textures, so that walks carry the place where they took it."""
        return any(inside.textured is not None for inside in self.specs)

    def fetch(self, k: mi.Int32, si: mi.SurfaceInteraction3f, active: mi.Bool = True) -> WalkMedium | tuple[()]:
        """What a walk takes that enters object k at a point of its surface: the medium there; () if none is carried."""
        if not self.carried:
            return ()
        # of the object, or by what its textures or spectra are at the point
        sigma_t, sigma_s, g = (self.spectrum(key, k) for key in ("sigma_t", "sigma_s", "g"))
        for number, inside in enumerate(self.specs):
            here = active & self.has_shape(k, number)
            if inside.textured is not None:
                at = inside.textured.scaled(self.mm_per_unit).at(si, here)
                sigma_t = dr.select(here, at.sigma_t, sigma_t)
                sigma_s = dr.select(here, at.albedo * at.sigma_t, sigma_s)
            elif inside.spectral is not None:
                at = inside.spectral.scaled(self.mm_per_unit).at(si.wavelengths)
                sigma_t, sigma_s, g = (dr.select(here, a, b) for a, b in zip(at, (sigma_t, sigma_s, g)))
        g, wavelengths = () if self.same_g else g, si.wavelengths if mi.is_spectral else ()
        place = Place(mi.Point3f(si.p), mi.Point2f(si.uv), mi.UInt32(si.prim_index)) if self.textured else ()
        return WalkMedium(sigma_t, sigma_s, g if mi.is_spectral else (), wavelengths, place)

    def unknown(self, lanes: int, wavelengths: mi.Spectrum | tuple[()] = ()) -> WalkMedium | tuple[()]:
        """What a walk carries before it has entered anything."""
        if not self.carried:
            return ()
        g = dr.full(mi.Spectrum, 0, lanes) if mi.is_spectral and not self.same_g else ()
        place = Place.unknown(lanes) if self.textured else ()
        return WalkMedium(*(dr.full(mi.Spectrum, 1, lanes) for _ in range(2)), g, wavelengths, place)

    def coefficients(self, k: mi.Int32, p: mi.Point3f, medium: WalkMedium | tuple[()] = ()) -> Coefficients:
        """Coefficients of object k at the point p, for a walk that took `medium` from `fetch`."""
        # homogeneous: of the walk where it carries a medium, else of the object
        mean, g = self.spectrum("sigma_t", k), self.spectrum("g", k)
        if self.heterogeneous is None:
            if medium:
                return Coefficients(
                    medium.sigma_t, medium.sigma_s, medium.g if len(medium.g) else g, medium.sigma_t, medium.sigma_t
                )
            return Coefficients(mean, self.spectrum("sigma_s", k), g, mean, mean)

        # heterogeneous: sigma_t(p), sigma_s(p) and the majorant, but for objects with textures
        sigma_t, sigma_s = self.heterogeneous.coefficients(k, p)
        result = Coefficients(sigma_t, sigma_s, g, self.heterogeneous.majorant(k), mean)
        if not medium:
            return result
        own = Coefficients(medium.sigma_t, medium.sigma_s, g, medium.sigma_t, medium.sigma_t)
        textured = self.row("textured", k)
        return Coefficients(*(dr.select(textured, a, b) for a, b in zip(own, result)))

    def transmittance(
        self, k: mi.Int32, ray: mi.Ray3f, distance: mi.Float, rng: mi.PCG32, medium: WalkMedium | tuple[()] = ()
    ) -> mi.Spectrum:
        """exp(-∫ sigma_t) over a distance along a ray inside object k; by ratio tracking where a medium varies."""
        # exp(-sigma_t d) of a homogeneous medium
        own = dr.exp(-(medium.sigma_t if medium else self.spectrum("sigma_t", k)) * distance)
        if self.heterogeneous is None:
            return own
        result = self.heterogeneous.transmittance(k, ray, distance, rng)
        return dr.select(self.row("textured", k), own, result) if medium else result

    def index_of(self, si: mi.SurfaceInteraction3f, active: mi.Bool | bool = True) -> mi.Int32:
        """The number of the object that a ray has met, or -1."""
        return self.instance_table.number(si, active)

    def met(self, si: mi.SurfaceInteraction3f, k: mi.Int32) -> mi.Int32:
        """The number of the object whose boundary a ray inside object k has met; -1 of what is no object in there."""
        alone = len(self.objects) == 1 and not self.instance_table.repeated and self.inner is None
        return k if alone else self.index_of(si)

    def boundary(self, k: mi.Int32) -> mi.BSDF | mi.BSDFPtr:
        """The dielectric of object k: one BSDF, or a pointer in each lane."""
        if len(self.boundaries) == 1:
            return self.boundaries[0]
        return dr.reinterpret_array(mi.BSDFPtr, dr.gather(mi.UInt32, self.tables["boundary"], k))

    def boundary_pointer(self, k: mi.Int32) -> mi.BSDFPtr:
        """The dielectric of object k as a pointer."""
        boundary = self.boundary(k)
        return boundary if isinstance(boundary, mi.BSDFPtr) else mi.BSDFPtr(boundary)

    def side(self, k: mi.Int32, prim_index: mi.UInt32) -> mi.Float:
        """1 where the geometric normal of a face of object k points outwards, -1 where it points inwards."""
        if all(obj.signs is None for obj in self.objects):
            return self.row("side", k)
        table = self.tables["side"]  # by face, not by object
        index = self.row("first", k) + prim_index * self.row("step", k)
        return dr.gather(mi.Float, table, dr.minimum(index, dr.width(table) - 1))

    def clear(self, k: mi.Int32, n: mi.Normal3f, d: mi.Vector3f) -> mi.Vector3f:
        """From the surface of object k to where a ray along d is clear of it; n is the normal there."""
        return clear(n, d, self.row("rounding", k))

    def behind(self, k: mi.Int32, d: mi.Vector3f) -> mi.Vector3f:
        """From a place in object k to where a ray along d surely meets a boundary that rounding has put it beyond."""
        return d * -self.row("rounding", k)

    def depart(self, si: mi.SurfaceInteraction3f, d: mi.Vector3f, inside: mi.Bool) -> tuple[mi.Point3f, mi.Vector3f]:
        """Where a way along d from a surface begins, and how far from there its ray, if it runs inside.
        A walk that began where its ray begins would lie deeper, so that light that is scattered once were lost."""
        # inside it begins at the surface and its ray `off` from there, outside clear of the surface
        off = clear(si.n, d, self.instance_scene.rounding(si))
        return dr.select(inside, si.p, mi.Point3f(si.p + off)), dr.select(inside, off, 0)

    @property
    def interpolates(self) -> bool:
        """Whether normals of an object are not those of its surface."""
        return self.any_bent or any(obj.shape.is_mesh() and obj.shape.has_vertex_normals() for obj in self.objects)

    def seen(self, si: mi.SurfaceInteraction3f, k: mi.Int32, direction: mi.Vector3f) -> mi.SurfaceInteraction3f:
        """The interaction as a ray along `direction` sees it: normals outwards, none on the other side of the ray."""
        si = self.face_outwards(si, k, direction)
        return lift(si, -direction, k >= 0) if self.interpolates else si

    def face_outwards(
        self, si: mi.SurfaceInteraction3f, k: mi.Int32, direction: mi.Vector3f
    ) -> mi.SurfaceInteraction3f:
        """The interaction with its normals turned to the outside of object k; `direction` is that of the ray."""
        # normal and bump maps, then the side of geometric and shading normal
        for number, around in enumerate(self.wrappings):
            si = around.bent(si, self.has_shape(k, number))
        if all(obj.upright for obj in self.objects) and not self.any_bent:
            return si

        # the geometric normal outwards, the shading frame on the same side, turned about the first axis of a rough
        # boundary, and wi in it
        n = dr.select(k >= 0, si.n * self.side(dr.maximum(k, 0), si.prim_index), si.n)
        flip = (k >= 0) & (dr.dot(si.sh_frame.n, n) < 0)
        si = mi.SurfaceInteraction3f(si)  # that of the caller stays as it is: turned twice it would point inwards
        si.n, frame = n, si.sh_frame
        si.sh_frame = dr.select(flip, mi.Frame3f(frame.s, -frame.t, -frame.n), frame)
        si.wi = si.to_local(-direction)
        return si

    def draw(self, si: mi.SurfaceInteraction3f, d: mi.Vector3f, rng: mi.PCG32) -> tuple[mi.Int32, mi.BSDFPtr]:
        """The number of the object that a ray along d meets from outside, -1 for another surface, and the BSDF of that.
        Masks and blends may show another surface where an object is."""
        # what a mask or blend has drawn is another surface than that of the object
        k, bsdf = self.index_of(si), si.bsdf()
        for number, around in enumerate(self.wrappings):
            if around.mixes:
                here, obj = self.has_shape(k, number), self.objects[number]
                drawn = unmasked_surface(around, obj, si, d, rng.next_float32(), here)
                bsdf = dr.select(here, drawn, bsdf)
                k = dr.select(here & (drawn != mi.BSDFPtr(around.surface)), -1, k)
        return k, bsdf

    @classmethod
    def of(cls, scene: mi.Scene, mm_per_unit: float) -> WalkMedia:
        """The objects of a scene whose surface is `translucent`.
        ValueError if mm_per_unit is out of range, there is no object, one is a sheet, the medium of an instance varies
        in space, or as `InclusionTable.of` and `check_sheets`."""
        check_interval("mm_per_unit", mm_per_unit, *MM_PER_UNIT)
        # ---- the geometry of each shape, and whether its medium can be there
        shapes, shown = translucent_shapes(scene), shown_groups(scene)
        check_sheets(shapes_of(scene, shown), mm_per_unit)
        if not shapes:
            raise ValueError(NO_OBJECT)
        instance_table, objects = InstanceTable(shapes, shown), [analyse_shape(shape, scene) for shape in shapes]
        inner = instance_table.scene(scene)
        for obj, group in zip(objects, instance_table.groups):
            inside = surface_of(obj.shape).spec
            if obj.lost > MOST_LOST:
                raise ValueError(
                    f"an object must have an inside for translucent_walk, got object {obj.name}, which "
                    f"{100 * obj.lost:.3g} % of the rays that enter it do not leave again: use a half-space model"
                )
            if inside.varying is not None and group is not None:
                raise ValueError(f"the medium of an instance must not vary in space, got object {obj.name}")
            if inside.textured is not None:
                inside.textured.check(obj)

        # ---- what lies inside, and what is around the surfaces
        result = InclusionTable.of(scene, objects)
        check_together(scene, [inner, *([result.scene] if result else []), *(obj.scene for obj in objects)])
        wrappings = [wrapping_of(shape) for shape in shapes]
        for around, obj in zip(wrappings, objects):
            around.check(obj)
        _check_mixes(wrappings, objects, instance_table, result)
        surfaces, some = [around.surface for around in wrappings], any(a.bend or a.mixes for a in wrappings)
        return cls(
            objects=objects, specs=[surface.spec for surface in surfaces], scene=inner,
            boundaries=[surface.boundary for surface in surfaces], mm_per_unit=float(mm_per_unit), inner=result,
            wrappings=tuple(wrappings) if some else (), shown=tuple(shown),
            instance_scene=InstanceScene.of(scene, shown),
        )  # fmt: skip


_OF_OBJECT: WeakKeyDictionary[TranslucentObject, WalkMedia] = WeakKeyDictionary()


def _boundary(eta: float) -> mi.BSDF:
    """That of another object of the index: kernels call every BSDF that there is, and a new one compiles them anew."""
    others = (media.boundaries[0] for media in _OF_OBJECT.values() if media.specs[0].medium.eta == eta)
    known = next(filter(is_smooth_boundary, others), None)
    return smooth_boundary(eta) if known is None else known


def walk_media(obj: TranslucentObject) -> WalkMedia:
    """One object alone, with a smooth boundary and as if it were empty; made once for each."""
    # one medium with a value for each channel, behind a smooth boundary of its index
    result = _OF_OBJECT.get(obj)
    if result is None:
        medium, eta = obj.media[0], obj.media[0].eta
        if len(obj.media) > 1:
            values = {key: np.array([getattr(m, key) for m in obj.media]) for key in ("sigma_s", "sigma_a", "g")}
            medium = Medium(**values, eta=eta)
        inside, geometry = MediumSpec("medium", medium, "", "total", True, obj.varying, obj.textured), obj.geometry
        alone = InstanceScene([], {}, bounds_of([geometry.shape]))
        instance_scene = alone if geometry.group is None else InstanceScene.of_shapes([geometry.shape])
        result = WalkMedia([geometry], [inside], geometry.scene, [_boundary(eta)], 1.0, instance_scene=instance_scene)
        _OF_OBJECT[obj] = result
    return result


_WITHIN: WeakKeyDictionary[TranslucentObject, WalkMedia] = WeakKeyDictionary()


def media_within(obj: TranslucentObject) -> WalkMedia:
    """The same with all that lies inside it, whose objects follow; made once for each."""
    inclusions = obj.geometry.inclusions
    if inclusions is None:
        return walk_media(obj)
    if obj not in _WITHIN:
        # object 0 is that around all others
        alone, shapes = walk_media(obj), [s for s, inside in zip(inclusions.shapes, inclusions.specs) if inside]
        objects = [obj.geometry, *(analyse_shape(shape) for shape in shapes)]
        inner = InclusionTable.of(scene_of([obj.geometry.shape, *inclusions.shapes]), objects)
        boundaries = [*alone.boundaries, *(surface_of(shape).boundary for shape in shapes)]
        specs = [*alone.specs, *filter(None, inclusions.specs)]
        own = scene_of([obj.geometry.shape, *shapes])
        instance_scene = InstanceScene([], {}, bounds_of([obj.geometry.shape, *inclusions.shapes]))
        _WITHIN[obj] = WalkMedia(objects, specs, own, boundaries, 1.0, inner, instance_scene=instance_scene)
    return _WITHIN[obj]


def _bounds(scene: mi.Scene) -> mi.BoundingBox3f:
    """The bounding box, a little larger; what is outside has leaked through the boundary by rounding."""
    box = scene.bbox()
    if not box.valid():
        return box
    # walks beyond it end
    margin = 1e-3 * (box.max - box.min)
    low, high = mi.Point3f(box.min - margin), mi.Point3f(box.max + margin)
    dr.make_opaque(low, high)
    return mi.BoundingBox3f(low, high)
