"""One object with its medium, ready for walks inside it: geometry, coefficients of each channel, smooth boundary."""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from halfspace_sss.physics.medium import Medium
from halfspace_sss.rendering.object.body import check_empty, check_size
from halfspace_sss.rendering.object.points import AreaPoints, SurfacePoint, cosine_above, lifted, number, turned
from halfspace_sss.rendering.object.shape import Geometry, name_of, survey
from halfspace_sss.rendering.object.translucent import Inside, is_translucent, smooth_boundary
from halfspace_sss.rendering.object.varying import VaryingMedium, equivalent, grid_values
from halfspace_sss.rendering.scenes.scene_files import millimetres
from halfspace_sss.rendering.walk.media import WalkMedia

LEAST_RATIO = 1e-3  # in logarithms of what varies


@dataclass(frozen=True, eq=False)
class Subject:
    """One translucent object on its own.

    Args:
        object: its geometry.
        media: scalar medium of each channel of the variant, 1/(scene unit).
        boundary: its smooth dielectric.
        points: uniform points of its surface.
        varying: how its medium varies in space, 1/(scene unit); `media` are then a homogeneous equivalent.
    """

    object: Geometry
    media: tuple[Medium, ...]
    boundary: Any
    points: AreaPoints
    varying: VaryingMedium | None = None

    @classmethod
    def of(cls, shape: Any, medium: Medium, mm_per_unit: float = 1.0) -> Subject:
        """The object of a Mitsuba shape filled with a medium.

        Args:
            shape: closed, no instance; its own BSDF does not count.
            medium: 1/mm, scalar or with one value for each channel of the variant.
            mm_per_unit: length of a scene unit, mm.

        Raises:
            ValueError: the medium has other channels than the variant, mm_per_unit is not a finite number > 0, or the
                shape is an instance.
        """
        return cls.surveyed(survey(shape), _in_scene_units(medium, mm_per_unit))

    @classmethod
    def surveyed(
        cls, object: Geometry, media: tuple[Medium, ...], varying: VaryingMedium | None = None, mm_per_unit: float = 1.0
    ) -> Subject:
        """The object of a known geometry and the scalar medium of each channel, 1/(scene unit).

        Args:
            object: geometry.
            media: of each channel; of a medium that varies the homogeneous equivalent.
            varying: how the medium varies, 1/mm.
            mm_per_unit: length of a scene unit, mm.

        Raises:
            ValueError: its normals point to both sides.
        """
        _check_geometry(object)
        boundary = smooth_boundary(media[0].eta)
        if varying is not None:
            varying = replace(varying, factor=varying.factor * mm_per_unit)
        return cls(object, media, boundary, AreaPoints(object.shape), varying)

    @classmethod
    def given(
        cls, shape: Any, medium: Medium | None, mm_per_unit: float | None = None, name: str | None = None
    ) -> Subject:
        """The object of a shape and a medium, or the one called `name` in a scene.

        Args:
            shape: a Mitsuba shape or scene.
            medium: 1/mm; of a scene it is that of the object's `translucent` surface.
            mm_per_unit: length of a scene unit, mm; by default what the integrator of a scene says, and 1 for a shape.
            name: id of the object; may be left out where there is one.

        Raises:
            ValueError: a scene has no such object, or one that cannot be learnt; a medium is missing; or as `of`.
        """
        if not isinstance(shape, mi.Scene):
            return cls.of(shape, medium, 1.0 if mm_per_unit is None else mm_per_unit)
        object = survey(_object_of(shape, name))
        check_empty(shape, [object], "learning")
        unit = millimetres(shape) if mm_per_unit is None else mm_per_unit
        inside = equivalent(object.shape.bsdf().inside, object)
        subject = cls.surveyed(object, _in_scene_units(inside.medium, unit), inside.varying, unit)
        check_size(subject.object, [float(m.sigma_t) for m in subject.media], unit)
        return subject

    def as_trained(self, medium: dict[str, Any]) -> Subject:
        """The same with the homogeneous equivalent of training, see `Identity`; itself where the medium is homogeneous.

        Another equivalent, over the random points that the object has where it stands now, would be another S_0.
        """
        if self.varying is None or len(medium["albedo"]) != len(self.media):
            return self
        known = zip(medium["albedo"], medium["size_in_mfp"], medium["g"])
        length = math.sqrt(self.object.area)
        media = tuple(Medium.from_albedo(albedo, size / length, g, self.eta) for albedo, size, g in known)
        return replace(self, media=media)

    @property
    def eta(self) -> float:
        """Relative index."""
        return self.media[0].eta

    @functools.cached_property
    def sigma_t(self) -> Any:
        """Extinction of each channel, 1/(scene unit), as data of kernels: one kernel serves all media."""
        return mi.Spectrum([number(m.sigma_t) for m in self.media])

    @functools.cached_property
    def walk_media(self) -> WalkMedia:
        """What walks inside it need to know."""
        medium = self.media[0]
        if len(self.media) > 1:
            values = {key: np.array([getattr(m, key) for m in self.media]) for key in ("sigma_s", "sigma_a", "g")}
            medium = Medium(**values, eta=self.eta)
        inside = Inside("medium", medium, "", "total", True, self.varying)
        return WalkMedia([self.object], [inside], self.object.scene, [self.boundary], 1.0)

    @functools.cached_property
    def _local_channels(self) -> tuple[int, int]:
        """Channels in which extinction and albedo vary in space."""
        volumes = (None, None) if self.varying is None else (self.varying.density, self.varying.albedo_volume)
        n_t, n_albedo = (0 if volume is None else grid_values(volume).shape[-1] for volume in volumes)
        return n_t, n_albedo

    @property
    def n_local(self) -> int:
        """Number of what `local` gives."""
        return sum(self._local_channels)

    def local(self, p: Any) -> tuple[Any, ...]:
        """What varies, at the point p: log of sigma_t over its mean, and half the log of 1 - albedo."""
        if self.varying is None:
            return ()
        n_t, n_albedo = self._local_channels
        sigma_t, sigma_s = self.walk_media.heterogeneous.coefficients(mi.UInt32(0), p)
        ratio, albedo = sigma_t / self.sigma_t, sigma_s / dr.maximum(sigma_t, 1e-20)
        return (
            *(dr.log(ratio[c] + LEAST_RATIO) for c in range(n_t)),
            *(0.5 * dr.log(1 - albedo[c] + LEAST_RATIO) for c in range(n_albedo)),
        )

    def random_points(self, rng: Any) -> SurfacePoint:
        """Points uniform over the area, directions by the cosine to the shading normal, one for each lane of rng."""
        at = self.random_places(rng)
        return surface_point(at.p, at.n, at.n_out, cosine_direction(at.n_out, at.n, rng))

    def random_places(self, rng: Any) -> SurfacePoint:
        """Points uniform over the area, seen along geometric normals: `n_out` is the interpolated one itself."""
        u_face, u = rng.next_float32(), mi.Point2f(rng.next_float32(), rng.next_float32())
        at = self.points.sample(u_face, u, True)
        n = at.n * self.object.sign
        return surface_point(at.p, n, turned(at.n_shading, at.n) * self.object.sign, n)

    def mean_free_paths(self) -> np.ndarray:
        """sigma_t sqrt(area) of each channel: the size of the object in mean free paths."""
        return np.array([float(m.sigma_t) for m in self.media]) * math.sqrt(self.object.area)


def _in_scene_units(medium: Medium, mm_per_unit: float) -> tuple[Medium, ...]:
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


def cosine_direction(n_out: Any, n: Any, rng: Any) -> Any:
    """A direction by the cosine to the shading normal, above the surface, see `object.points`."""
    return cosine_above(n_out, n, mi.Point2f(rng.next_float32(), rng.next_float32()))[0]


def surface_point(p: Any, n: Any, n_out: Any, w: Any) -> SurfacePoint:
    """A point of the surface with the shading normal that w sees.

    Args:
        p: position.
        n, n_out: outward geometric and shading normal.
        w: direction outside.
    """
    return SurfacePoint(mi.Point3f(p), mi.Normal3f(n), lifted(n_out, n, w), mi.Vector3f(w))


def refract_in(at: SurfacePoint, eta: Any) -> tuple[Any, Any, Any]:
    """Direction inside of light that is seen along w, Fresnel transmittance, and whether it goes inwards at all.

    mu' = sqrt(1 - (1 - mu²)/eta²), d = -w/eta + n (mu/eta - mu').
    """
    mu = dr.dot(at.w, at.n_out)
    inner = 1 - (1 - mu * mu) / (eta * eta)
    d = at.n_out * (mu / eta - dr.safe_sqrt(inner)) - at.w / eta
    F = mi.fresnel(dr.maximum(mu, 0), eta)[0]
    valid = (mu > 0) & (inner > 0) & (dr.dot(at.w, at.n) > 0) & (dr.dot(d, at.n) < 0)
    return mi.Vector3f(dr.normalize(d)), dr.select(valid, 1 - F, 0), valid


def _check_geometry(object: Geometry) -> None:
    """ValueError if the faces of an object do not all point to the same side: one sign stands for all of them."""
    if object.signs is not None:
        raise ValueError(
            f"normals of {object.name} must all point to the same side to be learnt, got pieces that disagree"
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
