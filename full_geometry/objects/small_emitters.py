"""Emitters that look small, which paths connect with or sample: lamps, delta lights and suns of the environment.

No ray meets a delta light (point, spot, projector, directional). Where emitter sampling cannot reach one either, as
behind a refracting boundary, its light E d(w - w_l) is spread over a cone of solid angle Ω about the direction w_l to
it (path space regularization, Kaplanyan and Dachsbacher 2013),

    L(w) = E / Ω where the angle between w and w_l is below a radius, else 0,

while visibility is that of the light itself. The irradiance stays what it is; the angle of incidence is blurred by the
radius, which changes what an object makes of it by the order of the square of the radius.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from typing import NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np

from full_geometry.geometry.rounding import before, blocked, bound_of, box_ends
from full_geometry.geometry.shape import by_pointer, check_stretch, looked_up, pointer_numbers
from full_geometry.objects.inclusions import check_lamps
from full_geometry.surface.wrapped import surface_of

# ---- Suns of an environment map -------------------------------------------------------------------------------------
#
# A path that meets the environment by chance finds a sun of solid angle Ω, which brings the share e of all light, with
# the probability Ω / 4 pi only, and so with the relative variance e² 4 pi / Ω. Where that is large, a cone is sampled.

SAMPLES = 160  # squared
MOST = 8  # suns
RADII = np.radians(0.15 * 1.3 ** np.arange(16))  # of cones, up to 7.7 degrees
HALO = 0.05  # radiance of the ring about a sun, to twice its radius, over that of the sun: a cone that has it all
MARGIN = 1.3  # of the radius, for what few samples do not show of the rim
LOOKED_AT = (450.0, 520.0, 580.0, 640.0)  # nm, under spectral variants
LEAST_VARIANCE = 1.0  # that chance would have, of the square of the mean: below, a region is left to chance


class Sun(NamedTuple):
    """A cone of directions."""

    direction: tuple[float, float, float]
    radius: float  # half of its opening angle, radians


def suns_of(environment: mi.Emitter) -> list[Sun]:
    """Suns of an environment emitter, brightest first."""
    d, L, energy = _light(environment)
    suns, left = [], np.ones(len(L), dtype=bool)
    while len(suns) < MOST and left.any():
        sun = _about(np.argmax(np.where(left, L, -1)), d, energy * left, energy.sum())
        if sun is None:
            break
        suns.append(sun)
        left &= _angles(d, np.array(sun.direction)) > 2 * sun.radius
    return suns


def _light(environment: mi.Emitter) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Directions (n, 3) that the environment draws, its radiance there, and their part of its light."""
    k = dr.arange(mi.UInt32, SAMPLES**2)
    u = mi.Point2f(k % SAMPLES + 0.5, k // SAMPLES + 0.5) / SAMPLES
    at = dr.zeros(mi.Interaction3f, SAMPLES**2)
    if mi.is_spectral:
        at.wavelengths = mi.Spectrum(*LOOKED_AT)
    ds, weight = environment.sample_direction(at, u)
    dr.eval(ds.d, ds.pdf, weight)  # at once, by one kernel
    energy = np.array(mi.Spectrum(weight) + dr.zeros(mi.Float, SAMPLES**2), dtype=float).max(axis=0)
    energy = np.where(np.isfinite(energy), energy, 0)
    return np.array(ds.d, dtype=float).T, energy * np.array(ds.pdf), energy


def _angles(d: np.ndarray, c: np.ndarray) -> np.ndarray:
    return 2 * np.arcsin(np.clip(0.5 * np.linalg.norm(d - c, axis=1), 0, 1))


def _about(k: int, d: np.ndarray, energy: np.ndarray, total: float) -> Sun | None:
    """The smallest cone about direction k that holds a region brighter than its ring, if it is worth sampling."""
    if not total > 0:
        return None
    c = d[k]
    for radius in RADII:
        within = _angles(d, c) < radius
        mean = energy[within] @ d[within]
        c = mean / np.linalg.norm(mean) if mean.any() else c
        angle = _angles(d, c)
        held, ring = energy[angle < radius].sum(), energy[(angle >= radius) & (angle < 2 * radius)].sum()
        if ring / 3 < HALO * held:
            share, solid = held / total, 2 * np.pi * (1 - np.cos(radius))
            worth = share**2 * 4 * np.pi / solid > LEAST_VARIANCE
            return Sun(tuple(map(float, c)), float(MARGIN * radius)) if worth else None
    return None


# ---- Small emitters --------------------------------------------------------------------------------------------------

LARGEST = 0.5  # radius of an emitter over its distance
NARROW = 0.01  # radius of the cone of a delta light that directions are sampled about, radians
WIDE = 0.05  # and of one that is left to chance
LEAST_BALL, DARK_BALL = 2e-3, 2.4e-4  # radians, below which the cone about a sphere is rounded by 1 %, and is none


@dataclass(frozen=True, eq=False)
class SmallEmitters:
    """The emitters of a scene that may look small from an object, each addressed by its number.

    Args:
        emitters: those with a place of their own or a direction: delta lights first.
        n_delta: how many are delta lights.
        suns: cones of the environment; their numbers follow.
        tables: by number: a point of the emitter or the direction to it (`x`, `y`, `z`), whether it is `distant`, the
            `radius` of the sphere about it or the angle of its cone, and its `rounding`; `pointer`, what Dr.Jit's
            registry calls each emitter; and from that number to its place, `index`.
    """

    scene: mi.Scene
    emitters: list[mi.Emitter]
    n_delta: int
    suns: list[Sun]
    tables: dict[str, mi.Float | mi.UInt32 | mi.Int32 | mi.Bool]

    @classmethod
    def of(cls, scene: mi.Scene) -> SmallEmitters | None:
        """Find the small emitters of a scene; None if there are none.
        ValueError as in `check_emitters`."""
        check_emitters(scene)
        emitters = sorted((e for e in scene.emitters() if _has_place(e)), key=lambda e: not is_delta(e))
        sky = scene.environment()
        suns = [] if sky is None or "Constant" in sky.class_name() else suns_of(sky)
        if not (emitters or suns):
            return None
        rows = [_place(emitter) for emitter in emitters] + [(*sun.direction, True, sun.radius) for sun in suns]
        x, y, z, distant, radius = zip(*rows)
        pointers = [mi.EmitterPtr(emitter) for emitter in emitters]
        shapes = [*(emitter.get_shape() for emitter in emitters), *(None for _ in suns)]
        tables = {
            "rounding": mi.Float([0.0 if shape is None else bound_of(shape) for shape in shapes]),
            "x": mi.Float(x), "y": mi.Float(y), "z": mi.Float(z), "distant": mi.Bool(distant),
            "radius": mi.Float(radius), "pointer": mi.UInt32(pointer_numbers(pointers) or [0]),
            "index": by_pointer(pointers, np.arange(len(pointers)), -1),
        }  # fmt: skip
        dr.make_opaque(tables)
        return cls(scene, emitters, sum(map(is_delta, emitters)), suns, tables)

    def __len__(self) -> int:
        return len(self.emitters) + len(self.suns)

    @property
    def some_met(self) -> bool:
        """Whether rays can meet one."""
        return len(self) > self.n_delta

    def _row(self, key: str, k: mi.UInt32) -> mi.Float | mi.UInt32 | mi.Int32 | mi.Bool:
        return dr.gather(type(self.tables[key]), self.tables[key], k)

    def _centre(self, k: mi.UInt32) -> mi.Vector3f:
        return mi.Vector3f(*(self._row(axis, k) for axis in "xyz"))

    def distant(self, k: mi.UInt32) -> mi.Bool:
        """Whether emitter k is infinitely far."""
        return self._row("distant", k)

    def direction(self, k: mi.UInt32, p: mi.Point3f) -> tuple[mi.Vector3f, mi.Bool]:
        """w_0 from p to emitter k, and whether the emitter looks small from there."""
        centre, distant = self._centre(k), self.distant(k)
        way = dr.select(distant, centre, centre - mi.Vector3f(p))
        size = dr.norm(way)
        small = distant | (self._row("radius", k) < LARGEST * size)
        return way / dr.maximum(size, 1e-20), small

    def some_small(self, p: mi.Point3f) -> bool:
        """Whether an emitter looks small from one of the points p."""
        k = dr.arange(mi.UInt32, dr.width(p) * len(self))
        return bool(dr.any(self.direction(k % len(self), dr.gather(mi.Point3f, p, k // len(self)))[1]))

    def rounding(self, k: mi.UInt32) -> mi.Float:
        """A bound of how far from the surface of emitter k rounding puts points; 0 of one without."""
        return self._row("rounding", k)

    def point(self, k: mi.UInt32, p: mi.Point3f, far: mi.Float | float) -> mi.Point3f:
        """A point of emitter k; as far as said from p where that is distant."""
        centre = self._centre(k)
        return mi.Point3f(dr.select(self.distant(k), p + centre * far, centre))

    def angle2(self, k: mi.UInt32, p: mi.Point3f) -> mi.Float:
        """Square of the angle under which the radius of emitter k is seen from p."""
        seen = dr.square(self._row("radius", k)) / dr.squared_norm(self._centre(k) - mi.Vector3f(p))
        if self.suns:
            seen = dr.select(self.distant(k), dr.square(self._row("radius", k)), seen)
        return dr.select(mi.UInt32(k) < self.n_delta, NARROW**2, seen) if self.n_delta else seen

    def index_of(self, emitter: mi.EmitterPtr, w: mi.Vector3f) -> mi.Int32:
        """The number of an emitter that a ray along w meets, or -1."""
        k = looked_up(self.tables["index"], emitter, -1)
        sky = emitter.is_environment() if self.suns else None
        for number in range(len(self.emitters), len(self)):
            sun = dr.opaque(mi.UInt32, number)
            inside = sky & (k < 0) & _within(w, self._centre(sun), self._row("radius", sun))
            k = dr.select(inside, mi.Int32(sun), k)
        return k

    def sample(self, k: mi.UInt32, at: mi.Interaction3f, u: mi.Point2f) -> tuple[mi.Vector3f, mi.Float, mi.Spectrum]:
        """A direction from `at` to emitter k, its distance, and light over the density of the direction; 0 if none."""
        d, distance, light = mi.Vector3f(0, 0, 1), mi.Float(0), mi.Spectrum(0)
        n = len(self.emitters)
        if n:
            emitter = self._emitter(dr.minimum(k, n - 1) if self.suns else k)
            ds, weight = emitter.sample_direction(at, u, mi.UInt32(k) < n if self.suns else True)
            d, distance, light = ds.d, ds.dist, dr.select(ds.pdf > 0, weight, 0)
        if self.suns:
            axis, radius, sun = self._centre(k), self._row("radius", k), mi.UInt32(k) >= n
            x = u.x * 2 * dr.square(dr.sin(0.5 * radius))  # 1 - cos
            sine, (sin_phi, cos_phi) = dr.safe_sqrt(x * (2 - x)), dr.sincos(2 * dr.pi * u.y)
            way = mi.Frame3f(axis).to_world(mi.Vector3f(sine * cos_phi, sine * sin_phi, 1 - x))
            si = dr.zeros(mi.SurfaceInteraction3f)
            si.wi, si.wavelengths = -way, at.wavelengths
            L = self.scene.environment().eval(si, sun) * _solid_angle(radius)
            d, light = dr.select(sun, way, d), dr.select(sun, L, light)
        return d, distance, light

    def pdf(
        self, k: mi.UInt32, at: mi.Interaction3f, w: mi.Vector3f, met: mi.SurfaceInteraction3f, active: mi.Bool
    ) -> mi.Float:
        """Density of w by `sample`, 1/sr, where the ray along w meets `met`; 0 of a delta light."""
        n, density = len(self.emitters), mi.Float(0)
        if self.some_met and n > self.n_delta:
            there = active & met.is_valid() & (mi.UInt32(k) >= self.n_delta) & (mi.UInt32(k) < n)
            there &= self.index_of(met.emitter(self.scene, there), w) == mi.Int32(k)
            emitter = self._emitter(dr.minimum(k, n - 1) if self.suns else k)
            density = dr.select(there, emitter.pdf_direction(at, mi.DirectionSample3f(self.scene, met, at), there), 0)
        if self.suns:
            radius = self._row("radius", k)
            sun = (mi.UInt32(k) >= n) & _within(w, self._centre(k), radius)
            density = dr.select(sun, 1 / _solid_angle(radius), density)
        return density

    def _emitter(self, k: mi.UInt32) -> mi.Emitter | mi.EmitterPtr:
        if len(self.emitters) == 1:
            return self.emitters[0]
        return dr.reinterpret_array(mi.EmitterPtr, self._row("pointer", k))

    def along(self, k: mi.UInt32, ray: mi.Ray3f, si: mi.SurfaceInteraction3f, active: mi.Bool) -> mi.Spectrum:
        """Radiance of emitter k along a ray that meets `si`; of a delta light, spread over its narrow cone."""
        L = mi.Spectrum(0)
        if self.some_met:
            emitter = si.emitter(self.scene, active)
            met = active & (self.index_of(emitter, ray.d) == mi.Int32(k))
            L = dr.select(met, emitter.eval(si, met), 0)
        if self.n_delta:
            delta = active & (mi.UInt32(k) < self.n_delta)
            L = L + self.spread(k, ray, mi.Float(NARROW), delta)
        return L

    def spread(self, k: mi.UInt32, ray: mi.Ray3f, radius: mi.Float, active: mi.Bool) -> mi.Spectrum:
        """Radiance of delta light k along a ray, spread over a cone of the given radius, where nothing is before it."""
        emitter = self._emitter(dr.minimum(k, self.n_delta - 1))
        return spread(self.scene, emitter, ray, radius, active)


def spread(scene: mi.Scene, emitter: mi.EmitterPtr, ray: mi.Ray3f, radius: mi.Float, active: mi.Bool) -> mi.Spectrum:
    """E / Ω of a delta light, for a ray whose angle with the direction to it is below the radius of Ω."""
    at = dr.zeros(mi.Interaction3f)
    at.p, at.wavelengths = ray.o, ray.wavelengths
    ds, E = emitter.sample_direction(at, mi.Point2f(0.5), active)
    seen = active & (ds.pdf > 0) & _within(ray.d, ds.d, radius) & (dr.max(E) > 0)
    shadow = mi.Ray3f(ray.o, ds.d)
    shadow.maxt = ds.dist - before(ds.p, ds.dist)
    seen &= ~blocked(scene, shadow, seen)
    return dr.select(seen, E / _solid_angle(radius), 0)


def is_delta(emitter: mi.Emitter) -> bool:
    """Whether no ray can meet an emitter, though it can be sampled."""
    return bool(emitter.flags() & int(mi.EmitterFlags.Delta)) and emitter.get_shape() is None


def check_emitters(scene: mi.Scene) -> None:
    """Refuse emitters that do not work, and warn of those that no path from a camera finds; the others learn how far
    the scene reaches, which Mitsuba tells them when it is loaded, not when shapes have moved.
    ValueError for an emitter that Mitsuba's own path tracers cannot evaluate either, for light that is not finite, an
    environment that is stretched, or as of `check_lamps`."""
    check_lamps(scene)
    for emitter in scene.emitters():
        _check_finite(emitter)
        _warn_of_rounding(scene, emitter)
        emitter.set_scene(scene)  # shadow rays to an infinite one end where it was told that the scene ends
        parameters = mi.traverse(emitter)
        if emitter.is_environment() and "to_world" in parameters:  # else what is sampled is not what rays meet
            check_stretch(f"emitter {emitter.id()!r}", parameters["to_world"])
        kind = emitter.class_name()
        if kind.startswith("TimedSunsky"):
            raise ValueError(
                "emitters must work in symbolic loops, got timed_sunsky, which fails in Mitsuba too: use sunsky"
            )
        if emitter.flags() & int(mi.EmitterFlags.Delta) and not is_delta(emitter):
            message = f"light of a {kind} is left out: it can neither be sampled nor met, as by path tracers of Mitsuba"
            warnings.warn(message, stacklevel=2)


def _warn_of_rounding(scene: mi.Scene, emitter: mi.Emitter) -> None:
    """Warn of a spherical lamp that looks so small from an object that 1 - cos of its cone is rounded."""
    ball = emitter.get_shape()
    if ball is None or ball.class_name() != "Sphere":
        return
    low, high = box_ends(ball.bbox())
    centre, radius = 0.5 * (low + high), 0.5 * (high - low).max()
    for shape in filter(surface_of, scene.shapes()):
        farthest = np.linalg.norm(np.abs(box_ends(shape.bbox()) - centre).max(axis=0))
        angle = float(radius / farthest)
        if angle < LEAST_BALL:
            told = "its light is lost" if angle < DARK_BALL else "its light is up to 7 % off"
            warnings.warn(
                f"the spherical lamp {ball.id()!r} should be seen under {LEAST_BALL:g} radians at least, got "
                f"{angle:.2g} from object {shape.id()!r}: {told} by rounding in Mitsuba; a point light keeps it",
                stacklevel=3,
            )


def check_sampled(scene: mi.Scene) -> None:
    """ValueError if an emitter is never sampled: orders 0 and 1 beside models have its light by that alone."""
    for emitter in scene.emitters():
        if not emitter.sampling_weight() > 0:
            raise ValueError(
                f"sampling_weight must be > 0 for bssrdf, got {emitter.sampling_weight():g} of emitter "
                f"{emitter.id()!r}: translucent_walk and corrected light take it"
            )


def _check_finite(emitter: mi.Emitter) -> None:
    parameters = mi.traverse(emitter)
    for key in parameters.keys():
        value = parameters[key]
        if not (dr.is_array_v(value) and dr.is_float_v(value)) or dr.is_matrix_v(value):
            continue
        flat = dr.detach(value.array if dr.is_tensor_v(value) else dr.ravel(value))
        if dr.all(dr.isfinite(flat)):
            continue
        wrong = np.flatnonzero(~np.isfinite(np.array(flat)))
        where = ""
        if dr.is_tensor_v(value):
            row, column = np.unravel_index(wrong[0], value.shape)[:2]
            repeated = int(emitter.is_environment())  # columns before the first
            where = f", the first in row {row}, column {column - repeated}"
        raise ValueError(
            f"light of emitter {emitter.id()!r} must be finite, got NaN or infinity in {len(wrong)} of "
            f"{dr.width(flat)} values of its {key}{where}"
        )


def _has_place(emitter: mi.Emitter) -> bool:
    """Whether an emitter is neither the environment nor out of reach nor the surface of a translucent object."""
    shape = emitter.get_shape()
    met = not emitter.flags() & int(mi.EmitterFlags.Delta)
    return not emitter.is_environment() and (shape is None or (met and not surface_of(shape)))


def _place(emitter: mi.Emitter) -> tuple[float, float, float, bool, float]:
    """A point of an emitter or the direction to it, whether it is distant, and the radius of the sphere about it."""
    shape, at = emitter.get_shape(), dr.zeros(mi.Interaction3f)
    if shape is not None:
        box = shape.bbox()
        extents, ball = np.array(box.extents()), shape.class_name() == "Sphere"
        centre, radius = box.center(), 0.5 * float(extents.max() if ball else np.linalg.norm(extents))
        return (*np.ravel(np.array(centre)).tolist(), False, radius)
    ds, _ = emitter.sample_direction(at, mi.Point2f(0.5))
    far = bool(mi.has_flag(emitter.flags(), mi.EmitterFlags.Infinite))
    return (*np.ravel(np.array(ds.d if far else ds.p)).tolist(), far, 0.0)


def _within(d: mi.Vector3f, axis: mi.Vector3f, radius: mi.Float | float) -> mi.Bool:
    """Whether the angle of two directions is below a radius; by their distance, which float32 keeps."""
    return dr.squared_norm(d - axis) < dr.square(2 * dr.sin(0.5 * mi.Float(radius)))


def _solid_angle(radius: mi.Float) -> mi.Float:
    return 4 * dr.pi * dr.square(dr.sin(0.5 * radius))
