"""A translucent object: its geometry and medium, and, once it is to be rendered, how its light is modelled.

Checks come first: which shapes of a scene are translucent, what lies inside them, where cameras and media may not be.
"""

from __future__ import annotations

import abc
import functools
import math
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np

from full_geometry.geometry import mesh
from full_geometry.geometry.instances import (
    InstanceProposals,
    InstanceScene,
    InstanceTable,
    InstanceTransform,
    InstanceTransport,
    shapes_of,
    shown_groups,
)
from full_geometry.geometry.points import (
    AreaPoints,
    MediumAt,
    ObjectAlbedo,
    Proposals,
    SurfacePoint,
    Transport,
    area_points,
    cosine_direction,
    opaque,
    surface_point,
)
from full_geometry.geometry.shape import Geometry, analyse_shape, geometry_of, is_instance, name_of, scene_of
from full_geometry.geometry.snapshot import Snapshot
from full_geometry.objects.inclusions import Inclusion, find_inclusions, place_of
from full_geometry.settings import MM_PER_UNIT, Capabilities, check_variant
from full_geometry.surface.medium_derivatives import MediumDerivatives
from full_geometry.surface.spectral import MediumByWavelength
from full_geometry.surface.textured import TexturedMedium
from full_geometry.surface.translucent import MediumSpec, check_boundary
from full_geometry.surface.varying import VaryingMedium, equivalent
from full_geometry.surface.wrapped import Wrapping, surface_of, wrapping_of
from halfspace_sss import measure
from halfspace_sss.checks import check_interval
from halfspace_sss.physics import single_scattering
from halfspace_sss.physics.medium import DIFFUSE_LIMIT, Medium
from halfspace_sss.registry import bssrdf


@dataclass(frozen=True, eq=False)
class Inclusions:
    """The inclusions of one object, for a transport that takes them.
    `found`: shapes that neither emit nor reach out of the object, those inside each other too. `scene`: a scene that
    holds these only. `specs`: the `MediumSpec` of each, 1/(scene unit); None of a surface that is not translucent.
    `surfaces`: of each the BSDF as it is."""

    found: list[Inclusion]
    scene: mi.Scene
    specs: list[MediumSpec | None]
    surfaces: list[Snapshot]

    @classmethod
    def of(cls, result: list[Inclusion], world: mi.Scene, mm_per_unit: float) -> Inclusions:
        """Make a scene of inclusions of the scene `world`."""
        shapes = [inclusion.node for inclusion in result]
        surfaces = [surface_of(shape) for shape in shapes]
        below = [surface and surface.spec for surface in surfaces]
        specs = [spec and replace(spec, medium=spec.medium.scaled(mm_per_unit)) for spec in below]
        return cls(result, scene_of(shapes, world), specs, [Snapshot(shape.bsdf()) for shape in shapes])

    @property
    def shapes(self) -> list[mi.Shape]:
        """The shapes, in the order of the scene."""
        return [inclusion.node for inclusion in self.found]

    def is_current(self) -> bool:
        """Whether the surfaces still are as they were."""
        return all(Snapshot(shape.bsdf()) == state for shape, state in zip(self.shapes, self.surfaces))

    def check_held(self) -> None:
        """ValueError if gradients are enabled for a parameter of them: a transport knows no other."""
        for inclusion in self.found:
            for key, value in mi.traverse(inclusion.node).items():
                if dr.grad_enabled(value):
                    raise ValueError(f"{key} of {inclusion.name} inside an object must not have gradients enabled")

    def reach(self, o: mi.Point3f, d: mi.Vector3f, length: mi.Float, active: mi.Bool) -> tuple[mi.Float, mi.Bool]:
        """How far a way of some length leads before it meets one of them, and whether it does."""
        hit = self.scene.ray_intersect_preliminary(mi.Ray3f(mi.Ray3f(o, d), length), False, active)
        met = hit.is_valid()
        return dr.select(met, hit.t, length), met


def with_inclusions(scene: mi.Scene, objects: list[Geometry], mm_per_unit: float, what: str) -> list[Geometry]:
    """The objects of a scene that lie in no other, each with its `inclusions`.
    `scene`, `objects`: as of `find_inclusions`. `mm_per_unit`: length of a scene unit, mm. `what`: sees neither lamps
    inside objects, nor what lies partly inside. ValueError names such a thing and the object."""
    result = find_inclusions(scene, objects)
    kinds = InstanceTable([obj.shape for obj in objects], shown_groups(scene)).kind
    for inclusion in result:
        holder = objects[kinds[inclusion.object]]
        lamp = isinstance(inclusion.node, mi.Emitter) or inclusion.node.is_emitter()
        moves = holder.group or (inclusion.shown and any(obj.shape is inclusion.node for obj in objects))
        if lamp or moves or not inclusion.whole:
            refuse(inclusion, holder, what)
    held = [[inclusion for inclusion in result if kinds[inclusion.object] == k] for k in range(len(objects))]
    return [
        replace(obj, inclusions=Inclusions.of(inside, scene, mm_per_unit)) if inside else obj
        for obj, inside in zip(objects, held)
        if not any(obj.shape is inclusion.node for inclusion in result)
    ]


def refuse(result: Inclusion, holder: Geometry, what: str) -> None:
    """ValueError that names what lies inside an object, or partly inside, which `what` does not see."""
    raise ValueError(
        f"objects must be empty for {what}, got {result.name} {'' if result.whole else 'partly '}inside "
        f"object {holder.name}: the integrator translucent_walk traces it"
    )


def refuse_instances(scene: mi.Scene, shapes: list[mi.Shape], what: str) -> None:
    """ValueError that names a shape which instances show, if `what` does not see them."""
    for shape in shapes:
        if not any(shape is each for each in scene.shapes()):
            raise ValueError(
                f"objects must be no instances for {what}, got the shape {name_of(shape)} in a shapegroup: the "
                "integrator translucent_walk traces it"
            )


def refuse_textures(name: str, what: str) -> None:
    """ValueError that names an object whose medium has textures, which `what` does not take."""
    raise ValueError(
        f"object {name} must be without textures for {what}: translucent_walk, full_geometry and models of the "
        "half-space take them"
    )


def outermost(scene: mi.Scene) -> list[mi.Shape]:
    """The translucent shapes of a scene, and of the groups that instances in it show, that lie in no other."""
    groups, shapes = shown_groups(scene), translucent_shapes(scene)
    own = [shape for shape in scene.shapes() if surface_of(shape) or is_instance(shape)]
    holders = [a for a in shapes if groups or any(a.bbox().contains(b.bbox()) for b in own if b is not a)]
    result = find_inclusions(scene, [analyse_shape(shape, scene, groups) for shape in holders])
    return [shape for shape in shapes if not any(shape is inclusion.node for inclusion in result)]


def places_of(scene: mi.Scene) -> list[Snapshot | list[float] | None]:
    """Snapshots of shapes, those of groups too, and places of lamps of a scene, which show a move."""
    shapes = [node for node in mi.traverse(scene).hierarchy if isinstance(node, mi.Shape)]
    lamps = [place_of(emitter) for emitter in scene.emitters()]
    return [*map(geometry_of, shapes), *(None if place is None else place.tolist() for place in lamps)]


def translucent_shapes(scene: mi.Scene) -> list[mi.Shape]:
    """The shapes whose surface is `translucent`: of the scene, and of the groups that instances in it show.
    ValueError if the scene has media of Mitsuba; or as of `wrapping_of`."""
    shapes = shapes_of(scene, shown_groups(scene))
    _check_media(scene, shapes)
    return [shape for shape in shapes if surface_of(shape)]


def _check_media(scene: mi.Scene, shapes: list[mi.Shape]) -> None:
    """ValueError if light would be scattered outside of the objects, or by a second medium in one."""
    results = [
        (side, shape)
        for shape in shapes
        for side, medium in (("interior", shape.interior_medium()), ("exterior", shape.exterior_medium()))
        if medium is not None
    ]
    for side, shape in results:
        if surface_of(shape):
            raise ValueError(
                f"a translucent object must be without {side}, as its surface states the medium, got the {side} "
                f"of {shape.id()!r}"
            )
    if results:
        side, shape = results[0]
        raise ValueError(f"the scene must be without media of Mitsuba, such as fog, got the {side} of {shape.id()!r}")
    for place in (*scene.sensors(), *scene.emitters()):
        if place.get_medium() is not None:
            raise ValueError(f"the scene must be without media of Mitsuba, such as fog, got one around {place.id()!r}")


_MODELS = "models of their light"
SMALL, LARGE = 1.0, 5e3  # mean free paths across an object, beyond which the units of the scene are doubted


@dataclass(frozen=True, eq=False)
class TranslucentObject:
    """One translucent object; of one that is not rendered geometry and medium alone are known.

    Args:
        media: scalar medium of each channel of the variant, 1/(scene unit).
        varying: how its medium varies in space, 1/(scene unit); `media` are then a homogeneous equivalent.
        textured: likewise over its surface.
        spectral: likewise by wavelength.
        transport: what light that enters elsewhere is worth here; None where no order from two on is asked for.
        proposals: where it may enter; None without a transport.
        entries: how many of them an exit draws.
        low_orders: the orders below two that are traced beside it: (0, 1), (1,) or none.
        expected: what each kind of light is expected to bring.
        derivatives: of its light by its medium.
        capabilities: of its model; None of one that is not rendered.
        gathered: what leaves by orders from two on, in place of a transport, see `integrators.gathering`.
        painted: its shape as it was, whose attributes textures show, if the surface has textures.
        instance_scene: of the scene that it is rendered in.
    """

    geometry: Geometry
    media: tuple[Medium, ...]
    varying: VaryingMedium | None = None
    textured: TexturedMedium | None = None
    spectral: MediumByWavelength | None = None
    transport: Transport | None = None
    proposals: Proposals | None = None
    entries: int = 1
    low_orders: tuple[int, ...] = ()
    expected: Expected | None = None
    derivatives: MediumDerivatives | None = None
    capabilities: Capabilities | None = None
    gathered: Any = None
    painted: Snapshot | None = None
    instance_scene: InstanceScene = InstanceScene([], {})

    @property
    def repeated(self) -> bool:
        """Whether instances show it."""
        return self.geometry.group is not None

    def at(self, transform: InstanceTransform | None) -> TranslucentObject:
        """The object as the instance that a ray has met; itself where it stands in the scene.
        S of the half-space is asked for in the scene, that of a whole object in the frame of the group."""
        if not self.repeated:
            return self
        geometry, transport, proposals = self.geometry.as_instance(transform), self.transport, self.proposals
        if transport is not None and not transport.is_delta:
            proposals = InstanceProposals(proposals, transform)
            if self.is_mixed:
                transport = replace(transport, obj=geometry)
            elif not self.capabilities.of_half_space:
                transport = InstanceTransport(transport, transform)
        return replace(self, geometry=geometry, transport=transport, proposals=proposals)

    @property
    def is_mixed(self) -> bool:
        """Whether half-space models are mixed over its texture or spectrum, see `transport.palette`."""
        varies = self.textured is not None or self.spectral is not None
        return varies and self.capabilities.of_half_space

    @functools.cached_property
    def wrapping(self) -> Wrapping:
        """Its `translucent` surface, and what is around it."""
        return wrapping_of(self.geometry.shape) or Wrapping(self.geometry.shape.bsdf())

    @property
    def surface(self) -> mi.BSDF:
        """Its `translucent` surface; the BSDF of its shape where there is none."""
        return self.wrapping.surface

    @property
    def eta(self) -> mi.Float:
        """Relative index of the media, as data of kernels."""
        return opaque(self.media[0].eta)

    @functools.cached_property
    def sigma_t(self) -> mi.Spectrum:
        """Extinction of each channel, 1/(scene unit), as data of kernels: one kernel serves all media."""
        return mi.Spectrum([opaque(m.sigma_t) for m in self.media])

    def medium_at(self, si: mi.SurfaceInteraction3f) -> MediumAt | tuple[()]:
        """The medium at a point of its surface, where that has textures or spectra; else ()."""
        if self.spectral is not None:
            return self.spectral.at_exit(si)
        return () if self.textured is None else self.textured.at(si)

    def knowing(self, at: SurfacePoint, face: mi.UInt32 | None = None) -> SurfacePoint:
        """A point of its surface with the medium there, where that has textures; a ray finds an unknown face."""
        if self.textured is None:
            return at
        return at._replace(medium=self.textured.at_point(self.geometry, at.p, at.n, face))

    @property
    def points(self) -> AreaPoints:
        """Uniform points of its surface."""
        return area_points(self.geometry)

    def random_places(self, rng: mi.PCG32) -> SurfacePoint:
        """Points uniform over the area, seen along geometric normals: `n_out` is the interpolated one itself."""
        u_face, u = rng.next_float32(), mi.Point2f(rng.next_float32(), rng.next_float32())
        at = self.points.sample(u_face, u, True)
        n, n_out = at.outward(self.geometry.sign)
        return self.knowing(surface_point(at.p, n, n_out, n), mi.UInt32(at.prim_index))

    def random_points(self, rng: mi.PCG32) -> SurfacePoint:
        """Points uniform over the area, directions by the cosine to the shading normal, one for each lane of rng."""
        at = self.random_places(rng)
        w = cosine_direction(at.n_out, at.n, rng)
        return surface_point(at.p, at.n, at.n_out, w)._replace(medium=at.medium)

    def mean_free_paths(self) -> np.ndarray:
        """sigma_t sqrt(area) of each channel: the size of the object in mean free paths."""
        return np.array([float(m.sigma_t) for m in self.media]) * math.sqrt(self.geometry.area)

    @property
    def alpha(self) -> ObjectAlbedo | None:
        """Its directional albedo, where its transport knows one: with the normals that it has without a normal map."""
        return None if self.transport is None or self.wrapping.bend is not None else self.transport.alpha

    @property
    def splits(self) -> bool:
        """Whether light is of both kinds, orders below two and others, of the transport or gathered."""
        return (self.transport is not None or self.gathered is not None) and bool(self.low_orders)

    def prepare_derivatives(self) -> None:
        """Make what derivatives by the medium need, before any loop is recorded.
        ValueError if they are asked for, and the model has none."""
        self.derivatives.prepare(self.transport)
        if self.geometry.inclusions is not None:
            self.geometry.inclusions.check_held()
        if self.textured is None or self.transport is None or self.is_mixed:
            return
        with dr.resume_grad():
            if self.textured.is_followed(self.geometry.shape):
                raise ValueError(
                    f"textures must not have gradients enabled under {self.surface.spec.model!r}, got some of object "
                    f"{self.geometry.name}: models of the half-space have derivatives by them"
                )

    def is_current(self) -> bool:
        """Whether the object still has the shape and the medium that it was made of."""
        textured, shape = self.surface.spec.textured, self.geometry.shape
        same = textured is None or self.painted == Snapshot(shape)
        if textured is not None and self.textured is None:  # its textures are the same everywhere
            with dr.resume_grad():
                same = same and not textured.is_followed(shape)
        return same and self.surface.spec is self.derivatives.spec and self.geometry.is_current()


class KnowsUnit(abc.ABC):
    """An integrator that says how long a unit of its scene is: `bssrdf` and `translucent_walk`.
    They register, as classes of Mitsuba take no second base."""

    mm_per_unit: float


def millimetres(scene: mi.Scene) -> float:
    """Millimetres in a unit of a scene, as its integrator says; 1, with a warning, if that is none of ours."""
    integrator = scene.integrator()
    if isinstance(integrator, KnowsUnit):
        return float(integrator.mm_per_unit)
    warnings.warn(
        "a unit of the scene is taken for 1 mm: mm_per_unit of an integrator bssrdf or translucent_walk changes that",
        stacklevel=3,
    )
    return 1.0


def check_size(geometry: Geometry, sigma_t: Sequence[float], mm_per_unit: float) -> None:
    """Warn of an object whose size in mean free paths speaks of another unit of length.
    `sigma_t`: of each channel, 1/(scene unit). `mm_per_unit`: length of a scene unit, mm."""
    size = geometry.size * (1 if geometry.group is None else geometry.group.scale)
    thickness = [size * value for value in sigma_t]
    thickness = [value for value in thickness if value * DIFFUSE_LIMIT * 1.001 < min(thickness)]  # which has no length
    if min(thickness) < SMALL or max(thickness) > LARGE:
        warnings.warn(
            f"object {geometry.name} is {min(thickness):.3g} to {max(thickness):.3g} mean free paths across, "
            f"{size * mm_per_unit:.3g} mm: check mm_per_unit = {mm_per_unit:g} if that is not meant",
            stacklevel=2,
        )


# --------------------------------------------------------------------------------------------------
# What the kinds of light that leave an object are expected to bring, by which the path loop chooses among them.


class Expected(NamedTuple):
    """Means over channels.
    `single`: reflectance of the half-space at normal incidence by single scattering. `multiple`: by the orders from two
    on. `albedo`: of single scattering, which nearly all leaves something thin."""

    single: float
    multiple: float
    albedo: float


def expected_of(media: Sequence[Medium]) -> Expected:
    """Means over the media of the channels."""
    rows = []
    for m in media:
        multiple = float(measure.reflectance(bssrdf("better_dipole", m), 1.0)) if float(m.sigma_s) > 0 else 0.0
        rows.append((float(single_scattering.reflectance(m, 1.0)), multiple, float(m.albedo)))
    return Expected(*np.mean(rows, axis=0).tolist())


# --------------------------------------------------------------------------------------------------
# One object alone, as it is learnt: of a shape with a medium, or of a scene.


def object_of(
    shape: mi.Shape | mi.Scene, medium: Medium | None = None, mm_per_unit: float | None = None, name: str | None = None
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
            to both sides, it is an instance or has inside what cannot be learnt. The medium is missing or has other
            channels than the variant, or mm_per_unit is not a finite number > 0.
    """
    check_variant()
    if mi.is_spectral:
        raise ValueError(f"variant must be RGB or mono for an object to be learnt, got {mi.variant()}")
    if not isinstance(shape, mi.Scene):
        geometry = analyse_shape(shape)
        media = _in_scene_units(medium, 1.0 if mm_per_unit is None else mm_per_unit)
        check_geometry(geometry)
        return TranslucentObject(geometry, media)
    unit = millimetres(shape) if mm_per_unit is None else mm_per_unit
    geometry = analyse_shape(_object_of(shape, name), shape, shown_groups(shape))
    (geometry,) = with_inclusions(shape, [geometry], unit, "learning")
    spec = equivalent(surface_of(geometry.shape).spec, geometry)
    media = _in_scene_units(spec.medium, unit)
    check_geometry(geometry)
    check_size(geometry, [float(m.sigma_t) for m in media], unit)
    if spec.textured is not None:
        spec.textured.check(geometry)
        spec = replace(spec, textured=None) if spec.textured.is_even(geometry.shape) else spec
    varying = None if spec.varying is None else spec.varying.placed(geometry, unit)
    textured = None if spec.textured is None else spec.textured.scaled(unit)
    return TranslucentObject(geometry, media, varying, textured)


def _in_scene_units(medium: Medium | None, mm_per_unit: float) -> tuple[Medium, ...]:
    """The scalar medium of each channel, 1/(scene unit)."""
    check_interval("mm_per_unit", mm_per_unit, *MM_PER_UNIT)
    if not isinstance(medium, Medium):
        raise ValueError(f"medium must be a Medium, got {type(medium).__name__}")
    n = len(mi.Spectrum(0))
    if medium.n_channels not in (None, n):
        raise ValueError(f"medium must have {n} channels under {mi.variant()}, got {medium.n_channels}")
    scaled = medium.scaled(mm_per_unit)
    return tuple(scaled if medium.n_channels is None else scaled.channel(k) for k in range(n))


def check_geometry(geometry: Geometry) -> None:
    """ValueError if faces of an object point to both sides, as one sign stands for all; or as `_check_inclusions`."""
    if geometry.signs is not None:
        raise ValueError(
            f"normals of {geometry.name} must all point to the same side to be learnt, got pieces that disagree"
        )
    if geometry.inclusions is not None:
        _check_inclusions(geometry.name, geometry.inclusions)


_DELTAS = int(mi.BSDFFlags.Delta) | int(mi.BSDFFlags.GlossyTransmission)  # of BSDFs inside an object


def _check_inclusions(name: str, inclusions: Inclusions) -> None:
    """ValueError if something inside an object cannot be learnt: light that it mirrors or refracts is a delta in S."""
    for inclusion, spec in zip(inclusions.found, inclusions.specs):
        shape = inclusion.node
        if inclusion.shown:
            raise ValueError(f"inclusions of {name} must be no instances to be learnt, got {inclusion.name}")
        if not (mesh.has_faces(shape) or "to_world" in mi.traverse(shape)):
            raise ValueError(
                f"inclusions of {name} must be meshes or have a transformation to be learnt, got the "
                f"{shape.class_name()} {name_of(shape)}"
            )
        if spec is None and shape.bsdf().flags() & _DELTAS:
            raise ValueError(
                f"inclusions of {name} must be opaque and no mirror, or translucent, to be learnt, as S holds no "
                f"deltas, got the shape {name_of(shape)} with a {shape.bsdf().class_name()}"
            )
        if spec is not None and not spec.is_homogeneous:
            raise ValueError(f"media inside {name} must be homogeneous to be learnt, got {name_of(shape)}")


def _object_of(scene: mi.Scene, name: str | None) -> mi.Shape:
    """The translucent shape called `name` in a scene, or the only one that lies in no other.
    ValueError if there is none, there are several and none is named, or it cannot be learnt."""
    known = {shape.id(): shape for shape in outermost(scene)}
    instances = [s.id() for s in scene.shapes() if is_instance(s)]
    if name in instances or (name is None and instances and not known):
        raise ValueError(f"object must not be an instance to be learnt, got {name or instances[0]!r}")
    if name is None and len(known) == 1:
        name = next(iter(known))
    if name not in known:
        names = ", ".join(id or name_of(shape) for id, shape in known.items())
        raise ValueError(f"object must be one of {names or 'none'}, got {name!r}")
    check_boundary(repr(name), surface_of(known[name]).boundary)
    return known[name]
