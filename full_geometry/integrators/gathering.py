"""Light that arrives at the points of an object, gathered once, and what leaves by it.

At each point the mean of the incident radiance, weighted by a(mu) mu, is estimated per channel by emitter sampling and
by directions of the cosine (balance heuristic); what other surfaces send is traced along the latter, by the path loop.
B = T L follows, T the transport matrix (`precomputed.transport_matrix`), and at an exit L_o(x_o, w_o) = a(w_o) B(x_o),
blended between points.
Jensen and Buhler (2002) take two passes so with a dipole; here the second is a sparse matrix that outlives the light.

What is not known: a dependence of the model on the azimuth between light and view; how light varies over directions,
apart from its a(mu)-weighted mean, first moment, and what S along a few directions of it brings in the neighbourhood;
detail of light below the distance of the points (`fine_light` keeps its flux). Its noise is that of the gathering.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np

from full_geometry.geometry.instances import InstanceScene
from full_geometry.geometry.light_points import GOLDEN, SurfacePoints
from full_geometry.geometry.points import SurfacePoint, cosine_above, floats, of_rows, opaque, place, surface_point
from full_geometry.geometry.rounding import blocked, ray_from
from full_geometry.geometry.snapshot import Snapshot, same_objects
from full_geometry.integrators.fine_light import fine_light
from full_geometry.integrators.inner_light import COUNT, UNEVEN, inner_light
from full_geometry.integrators.lighting import EnvironmentMean, Lights
from full_geometry.integrators.surface_paths import trace_paths
from full_geometry.objects.objects import TranslucentObject
from full_geometry.precomputed.inner import Events, InnerLight, has_inner_light
from full_geometry.precomputed.point_pairs import Rays
from full_geometry.precomputed.surface_regression import directional, painted
from full_geometry.precomputed.transport_matrix import (
    SEED,
    Albedo,
    Hemispheres,
    Incident,
    TransportMatrix,
    bent,
    cosine,
    transport_matrix,
)
from full_geometry.settings import Settings
from full_geometry.walk.emission import emitter_pdf, mis_weight, sample_emitter
from full_geometry.walk.media import WalkMedia, sent_back
from halfspace_sss.backend import clock
from halfspace_sss.interrupts import checkpoint
from halfspace_sss.physics.fresnel import F_t

DIRECTIONS = 2**18  # of all points of an object, by emitters, and as many by the cosine
FEWEST, MOST = 24, 1024  # of a point
PART = 1 / 8  # of the samples of a transport matrix
SPREADINGS = 4  # of what other surfaces send,
BRIGHTEST = 1 / 128  # of the points, which share it no matter how bright
FLIGHT = 0.05  # share of flights that are longer than the way on which things inside are looked for
TRACED = 8  # one of so many directions by the cosine is traced further, where it meets a surface


@dataclass(frozen=True, eq=False)
class Gathered:
    """Radiance of orders from two on that leaves an object in the light of a scene.

    Without a transport of the object it is 0, and `factor` that of its reflectance.

    Args:
        object: that the light leaves.
        points: where B is known.
        albedo: a(mu).
        values: B of all points, for each channel the first terms of `directional` in w_o bent by the boundary, or all
            and those of `painted`.
        inner: at events of order 1 inside; None where that order is traced.
        matrix: transport matrix of the model; None without one.
        light: that arrives, less c.
        parts: independent estimates of it.
        c: mean radiance of the environment where alpha is known, else 0, see `lighting.EnvironmentMean`.
        rough: light that a rough boundary lets in by the cosine, in place of F_t; None as models have it.
        within: glass in which the object is, see `walk.priorities`.
    """

    object: TranslucentObject
    points: SurfacePoints
    albedo: Albedo
    values: mi.Float
    inner: InnerLight | None
    matrix: TransportMatrix | None = None
    light: Incident | None = None
    parts: tuple[Incident, ...] = ()
    c: np.ndarray | float = 0.0
    rough: mi.Texture1f | None = None
    within: int = 0

    @property
    def terms(self) -> int:
        """Terms for each channel of a point."""
        return dr.width(self.values) // (len(self.points) * dr.size_v(mi.Spectrum))

    def with_terms(self, terms: int) -> mi.Float:
        """The values, with zeros for further terms."""
        if terms == self.terms:
            return self.values
        rows = np.array(self.values).reshape(-1, self.terms)
        return floats(np.pad(rows, ((0, 0), (0, terms - self.terms))))

    def radiance(self, out: SurfacePoint, active: mi.Bool) -> mi.Spectrum:
        """L_o of an exit; 0 below the horizon."""
        B = _blended(self.points, self.values, self.terms, out, self.albedo.eta, active, self.reflectance(out))
        return dr.select(active & (dr.dot(out.w, out.n_out) > 0), self.factor(out, active) * B, 0)

    def factor(self, out: SurfacePoint, active: mi.Bool) -> mi.Spectrum:
        """L_o / B of an exit: a(w_o) R^e, or alpha in the channels where the model knows its directional albedo."""
        a = self._smooth_factor(out, active)
        if self.rough is None:
            return a
        mu = dr.maximum(dr.dot(out.w, out.n_out), 0)
        return a * (self.rough.eval(mi.Float(mu))[0] / dr.maximum(F_t(mu, opaque(self.albedo.eta)), 1e-6))

    def _smooth_factor(self, out: SurfacePoint, active: mi.Bool) -> mi.Spectrum:
        mu = dr.maximum(dr.dot(out.w, out.n_out), 0)
        if self.object.transport is None:
            return self.albedo(mu) * self.reflectance(out)
        paint = None if self.object.textured is None else self.object.transport.paint(out)
        a = self.albedo(mu, paint)
        if paint is not None:
            a *= paint ** mi.Spectrum([opaque(v) for v in self.matrix.e])
        alpha = self.object.transport.alpha
        if alpha is None:
            return a
        known = alpha.known[1]
        return known * alpha(out, active)[1] + (1 - known) * a

    def reflectance(self, out: SurfacePoint) -> mi.Spectrum:
        """Reflectance of a half-space of the medium at an exit where textures tell it, else 1."""
        if not out.medium:
            return mi.Spectrum(1)
        return sent_back(dr, out.medium.albedo, mi.Spectrum([opaque(m.g) for m in self.object.media]))

    @cached_property
    def error(self) -> float:
        """Standard error of B by the gathering of light, over its mean; NaN where that is not in parts."""
        # sqrt(mean variance of the parts / their number) over the mean of B
        found = np.stack([self.matrix.mean(part) + self.c for part in self.parts])
        spread = found.var(axis=0, ddof=1).mean() if len(found) > 1 else np.nan
        return float(np.sqrt(spread / len(found)) / max(float(found.mean()), 1e-30))

    @property
    def told(self) -> str:
        """How many points, and the noise of B."""
        return (
            f"gathered at {len(self.points)} points, {1e-6 * self.matrix.nbytes:.0f} MB: noise of the transport matrix "
            f"{self.matrix.error:.1%} a point, of the light {self.error:.1%}"
        )

    def kept(self, other: Gathered) -> float:
        """The share of the variance of two parts that all samples have."""
        # Var = Var_light + Var_matrix, by one of both exchanged at a time
        B = self.matrix @ self.light
        by_light = ((B - self.matrix @ other.light) ** 2).mean()
        by_matrix = ((B - other.matrix @ self.light) ** 2).mean()
        whole = by_light + by_matrix
        return float((0.5 * by_light + PART * by_matrix) / whole) if whole > 0 else 1.0


def _blended(
    points: SurfacePoints, values: mi.Float, terms: int, out: SurfacePoint, eta: mi.Float | float, active: mi.Bool,
    R: mi.Spectrum, k: mi.Int32 | None = None,
) -> mi.Spectrum:  # fmt: skip
    """max(B.Y(w, R), 0) at an exit, B blended between points of object k, w bent by a boundary of this index."""
    size, w = dr.size_v(mi.Spectrum), bent(out.w, out.n_out, eta)
    B = points.blend(values, terms * size, out.p, out.n, active, k)
    Y = directional(w.x, w.y, w.z, dr.dot(w, out.n_out))
    rows = [B[terms * c : terms * (c + 1)] for c in range(size)]
    return dr.maximum(mi.Spectrum([sum(b * y for b, y in zip(row, [*Y, *painted(r)])) for row, r in zip(rows, R)]), 0)


@dataclass(frozen=True, eq=False)
class OutgoingLight:
    """Light that leaves objects at their surfaces, looked up by walks: a(w_o) max(B.Y(w_o), 0), without reflection.

    Args:
        media: the objects as walks know them.
        lights: of each by its number; None of those that no path enters from outside.
        tables: by the number of an object, whether its light is `known`, the index `eta` of its boundary to what is
            around it, and `within` what glass that is.
        points: of all of them, joined.
        values: B of these, for each channel so many terms.
        terms: of `directional`, and of `painted` where an object has textures.
    """

    media: WalkMedia
    lights: list[Gathered | None]
    tables: dict[str, mi.Bool | mi.Float | mi.UInt32]
    points: SurfacePoints
    values: mi.Float
    terms: int

    @classmethod
    def of(cls, media: WalkMedia, lights: list[Gathered | None]) -> OutgoingLight:
        """The light of objects."""
        some = [light for light in lights if light is not None]
        terms = max(light.terms for light in some)
        none = replace(some[0].points, h=1.0, first=dr.zeros(mi.UInt32, int(some[0].points.cells.prod()) + 1))
        points = SurfacePoints.joined([none if light is None else light.points for light in lights])
        values = dr.concat([(light or some[0]).with_terms(terms) for light in lights])
        tables = {
            "known": mi.Bool([light is not None for light in lights]),
            "eta": mi.Float([(light or some[0]).albedo.eta for light in lights]),
            "within": mi.UInt32([light.within if light else 0 for light in lights]),
        }
        dr.make_opaque(values, tables)
        return cls(media, lights, tables, points, values, terms)

    def radiance(
        self, si: mi.SurfaceInteraction3f, k: mi.Int32, w: mi.Vector3f, within: mi.UInt32 | tuple[()], active: mi.Bool
    ) -> tuple[mi.Bool, mi.Spectrum]:
        """Whether light that leaves object k is known, and that along w from a point with normals outwards.
        `within`: the glass that is around the point."""
        place = self.media.place_of(k)
        row = dr.gather(dict, self.tables, place)
        active = active & row["known"] & ((within == row["within"]) if len(within) else True)
        active = way_in_is_clear(self.media, si, k, w, row["eta"], active)
        out, a, R = surface_point(si.p, si.n, si.sh_frame.n, w), mi.Spectrum(0), mi.Spectrum(1)
        # a(w) and R of each object, with the medium that textures have here
        for kind in range(len(self.media.objects)):
            light = next((self.lights[k] for k in self.media.instance_table.numbers(kind) if self.lights[k]), None)
            if light is not None:
                here, at = active & self.media.has_shape(k, kind), out._replace(medium=light.object.medium_at(si))
                a, R = dr.select(here, light.factor(at, here), a), dr.select(here, light.reflectance(at), R)
        B = _blended(self.points, self.values, self.terms, out, row["eta"], active, R, place)
        return active, dr.select(active & (dr.dot(w, out.n_out) > 0), a * B, 0)


def way_in_is_clear(
    media: WalkMedia, si: mi.SurfaceInteraction3f, k: mi.Int32, w: mi.Vector3f, eta: mi.Float, active: mi.Bool
) -> mi.Bool:
    """Whether the straight way in of what leaves object k along w meets nothing inside, as far as a flight gets.
    Things inside have edges there, which no smooth function of directions follows.
    `eta`: index of the boundary to what is around the object, such as glass."""
    if media.inner is None:
        return active
    d = -bent(w, dr.select(dr.dot(si.n, w) > 0, si.n, -si.n), eta)
    o, off = media.depart(si, d, mi.Bool(True))
    ray = mi.Ray3f(o + off, d)
    ray.maxt = -math.log(FLIGHT) / dr.min(media.spectrum("sigma_t", k))
    hit = media.scene.ray_intersect_preliminary(ray, coherent=False, active=active)
    met = media.instance_scene.interaction(hit, ray, media.needed)
    return active & (~hit.is_valid() | (media.met(met, k) == k))


class Gathering:
    """Gathered light of the objects of a scene, kept until something in the scene changes.

    Args:
        part: 0 for all samples; others are independent of each other, with a share `PART` of the samples of a
            transport matrix and half the light.
        seed: of what is drawn.

    Attributes:
        seconds: by `clock`, of the transport matrices and of the light, as they were last found.
    """

    def __init__(self, part: int = 0, seed: int = 0) -> None:
        self._part, self._seed, self.seconds = part, seed, (0.0, 0.0)
        self._objects: list[TranslucentObject] = []
        self._matrices: list[TransportMatrix | None] = []
        self._events: list[Events | None] = []
        self._light: Snapshot | None = None
        self._parts = 0
        self._found: list[TranslucentObject] = []

    def of(
        self, scene: mi.Scene, objects: list[TranslucentObject], settings: Settings, quick: bool = False
    ) -> list[TranslucentObject]:
        """The objects, each with what leaves it in place of its transport.
        `quick`: whether half of the light is enough where it is not known, as for a first look.

        Raises:
            ValueError: an object is open or has no known area, or light that arrives is not finite.
        """
        if not same_objects(objects, self._objects):
            # what outlives the light: transport matrices, and places of events inside
            spread = [spreads(obj) for obj in objects]
            for obj, one in zip(objects, spread):
                if one:
                    _check(obj, settings.light)
            started = clock()
            share = PART if self._part else 1.0
            seed = SEED + self._part + 10 * self._seed
            made = [transport_matrix(obj, share, seed) if one else None for obj, one in zip(objects, spread)]
            inner = [bool(one and not self._part and has_inner_light(obj)) for obj, one in zip(objects, spread)]
            self._events = [Events.of(obj, COUNT) if one else None for obj, one in zip(objects, inner)]
            self._matrices, self._objects, self._light = made, objects, None
            self.seconds = (clock() - started, 0.0)
        state, parts = light_state(scene), 1 if self._part or quick else 2
        if state != self._light or parts > self._parts:
            # the light, in two parts that tell its noise
            checkpoint()
            started = clock()
            seed = 1000 * self._part + 10_000 * self._seed
            ways = list(zip(self._matrices, self._events))
            self._found = _lit(scene, objects, ways, settings, seed, parts)
            self._light, self._parts, self.seconds = state, parts, (self.seconds[0], clock() - started)
        return self._found

    def kept(self, other: Gathering, k: int) -> float:
        """The share of the variance of parts of an object's light that gathering with all samples has.

        Args:
            other: another part of the same scene.
            k: number of the object.
        """
        one = self._found[k].gathered
        return 1.0 if one is None else one.kept(other._found[k].gathered)

    def told(self) -> list[str]:
        """A line for each object: points, memory, and noise."""
        results = [obj.gathered for obj in self._found if obj.gathered is not None]
        return [f"light of object {g.object.geometry.name} {g.told}" for g in results]


def spreads(obj: TranslucentObject) -> bool:
    """Whether light leaves elsewhere than it entered, by orders that a transport has, of an object at one place."""
    return obj.transport is not None and not obj.transport.is_delta and not obj.repeated


def _check(obj: TranslucentObject, light: str) -> None:
    # points have one side, and their number comes from the area; maps bend normals between them, which walks correct
    result = obj.geometry
    if not result.closed or not result.area > 0:
        lacks = "is not closed" if not result.closed else f"is a {result.shape.class_name()} without known area"
        raise ValueError(f"light must be sampled for object {result.name}, which {lacks}, got {light}")
    if obj.wrapping.bend is not None and light != "corrected":
        raise ValueError(
            f"light must be sampled for object {result.name}, which has a normal or bump map, got gathered"
        )


def light_state(scene: mi.Scene) -> Snapshot:
    """What tells whether anything that sends, blocks or scatters light has changed."""
    return Snapshot(scene, without=(mi.Scene, mi.Integrator, mi.Sensor, mi.Film, mi.Sampler))


def _lit(
    scene: mi.Scene, objects: list[TranslucentObject], ways: list[tuple[TransportMatrix | None, Events | None]],
    settings: Settings, seed: int, parts: int,
) -> list[TranslucentObject]:  # fmt: skip
    """The objects, those with a transport matrix by what leaves them; what they send each other is sampled."""
    # the light of one object does not wait for what is gathered of the others
    found = list(objects)
    for k, (obj, (T, events)) in enumerate(zip(objects, ways)):
        if T is not None:
            g = _leaving(scene, objects, k, (T, events), settings, seed, parts)
            found[k] = replace(obj, transport=None, proposals=None, gathered=g)
    return found


def _leaving(
    scene: mi.Scene, objects: list[TranslucentObject], k: int, of: tuple[TransportMatrix, Events | None],
    settings: Settings, seed: int, parts: int,
) -> Gathered:  # fmt: skip
    """B of object k, by light in parts whose differences tell the noise, and light inside."""
    # ---- L at the points, in parts, and the light of emitters by ray
    obj, (T, events) = objects[k], of
    fine = fine_light(scene, objects[0].instance_scene, obj, T)
    left_out = () if fine is None else fine.emitters
    found, rays = _incident(scene, objects, (T, obj.geometry.clearance, left_out), settings, 2 * k + seed, parts)
    lights, others = zip(*found)
    if not all(np.isfinite(light.mean).all() for light in lights):
        raise ValueError(f"light at object {obj.geometry.name} must be finite, got NaN or infinity")

    # ---- J at events inside, with what other surfaces send to the points
    inner = None
    if events is not None:
        seen = floats(np.mean(others, axis=0))
        inner = inner_light(scene, objects, k, settings, events, (T.points, seen), 1 if parts == 1 else UNEVEN)

    # ---- B = T (L - c) + c, c the mean of the environment where alpha is known
    mean = EnvironmentMean.of(scene, Lights.of(scene), [obj])
    c = np.zeros(len(T.trusted)) if mean is None else T.trusted * np.ravel(np.array(mean.mean))
    lights = tuple(replace(light, mean=light.mean - c.astype(np.float32)) for light in lights)
    light = Incident.mean_of(lights)
    B = T @ light
    B[:, :, 0] += c
    if fine is not None:
        B += fine.leaving(T, scaled=obj.textured is None)

    # ---- what S along directions of light has beyond T; averages over the neighbourhood would cross edges of textures
    if obj.textured is None:
        direct = np.maximum(rays.whole / T.around.whole - c, 0)
        B += T.beyond(direct.astype(np.float32), rays)

    # ---- four numbers for each channel of a point, as data of a kernel
    values = floats(B)
    return Gathered(
        object=obj,
        points=T.points,
        albedo=T.albedo,
        values=values,
        inner=inner,
        matrix=T,
        light=light,
        parts=lights,
        c=c,
    )


def _incident(
    scene: mi.Scene,
    objects: list[TranslucentObject],
    of: tuple[TransportMatrix, mi.Float, Sequence[mi.Emitter]],
    settings: Settings,
    seed: int,
    parts: int,
) -> tuple[list[tuple[Incident, np.ndarray]], Rays]:
    """Incident radiance at all points, and the mean of other surfaces that each sees, in parts; light by ray.

    Parts are independent estimates by as many directions each, of one launch. Rays have the light of emitters alone.
    `of` are the matrix, how far rounding puts points off the surface, and emitters that are left out.
    """
    T, e, left_out = of
    # ---- n directions for each point and part; lanes of kernels that serve other numbers of points too
    count, rows = len(T.points), len(T.points) * parts
    n = int(np.clip(DIRECTIONS // (2 * count), FEWEST, MOST)) // TRACED * TRACED
    lane, each, few, all_few = dr.arange(mi.UInt32, rows * n), *_numbers(n, n // TRACED, rows * (n // TRACED))

    # ---- direction s of row j: those that are traced further come first, as lanes that wait cost as much
    traced, rest = lane < all_few, lane - all_few
    i = rest % (each - few)
    s = dr.select(traced, lane % few * TRACED, i + i // (TRACED - 1) + 1)
    j = dr.select(traced, lane // few, rest // (each - few))

    # ---- light by emitters and by the cosine, with MIS weights, and what other surfaces send along the latter
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(100 + seed, dr.width(lane))
    point = j % _numbers(count)[0]
    at = GatheringPoint(*(dr.gather(type(v), v, point) for v in (T.points.p, T.points.n, T.points.n_out)), e)
    u, v = (_stratified(sampler, j, s, each) for _ in range(2))
    aimed, w_e = by_emitters(scene, objects[0].instance_scene, T.albedo, at, u, left_out=left_out)
    met, more, a, w_c, on = by_cosine((scene, objects, settings), T.albedo, at, v, traced, sampler)

    # ---- Σ L and Σ L (bent w - middle) over the directions of each row
    around = T.around
    centre = dr.gather(mi.Vector3f, of_rows(mi.Vector3f, around.middle), point)
    d_e, d_c = (bent(w, at.n_out, T.albedo.eta) - centre for w in (w_e, w_c))
    values = [aimed + met, *(aimed * d_e[i] + met * d_c[i] for i in range(3))]
    values += [TRACED * more, *(TRACED * more * d_c[i] for i in range(3)), TRACED * dr.select(on, a, 0)]
    values = [mi.Spectrum(v) + dr.zeros(mi.Float, rows * n) for v in values]
    each_light = [mi.Spectrum(v) + dr.zeros(mi.Float, rows * n) for v in (aimed, met)]
    w_e += dr.zeros(mi.Float, rows * n)  # without an emitter it has one lane
    dr.eval(values, each_light, w_e, w_c)

    # ---- the lane of direction s of row j, and sums over the directions of each row
    def lane_of(j: mi.UInt32, s: mi.UInt32) -> mi.UInt32:
        return dr.select(s % TRACED == 0, j * few + s // TRACED, all_few + j * (each - few) + s - s // TRACED - 1)

    order = lane_of(lane // each, lane % each)
    sums = [dr.block_sum(dr.gather(mi.Float, v, order), n) for value in values for v in value]
    dr.eval(sums)
    found = np.stack([np.array(v, dtype=float) for v in sums], axis=1).reshape(rows, len(values), -1) / n

    # ---- rays of each point: directions of emitters, then of the cosine, of all parts
    number, total = dr.arange(mi.UInt32, 2 * rows * n), _numbers(parts * n)[0]
    part, point = number % total // each, number // (2 * total)
    at = lane_of(part * _numbers(count)[0] + point, number % each)
    aimed_at = number // total % 2 == 0
    w, light = (
        dr.select(aimed_at, *(dr.gather(type(v), v, at) for v in both))
        for both in ((w_e, w_c), map(mi.Spectrum, each_light))
    )
    rays = Rays.of(w, light / mi.Float(total), found[:, 0].reshape(parts, count, -1).mean(axis=0))
    return [_of_part(T.points, around, found[k * count : (k + 1) * count]) for k in range(parts)], rays


def _of_part(points: SurfacePoints, around: Hemispheres, found: np.ndarray) -> tuple[Incident, np.ndarray]:
    """Incident radiance, and the mean of other surfaces.

    Args:
        points: where.
        around: their hemispheres.
        found: (points, 9, channels), with the weight a(mu) mu: light of emitters, and times directions about their
            middle; what other surfaces send, and times these; 1 where they are.
    """
    # what few directions bring is averaged over the neighbourhood
    direct, sent, seen = found[:, 0], found[:, 4], found[:, 8]
    steady = _steadied(sent)
    spread = _spread(points, steady * sent)
    first = found[:, 1:4] + _spread(points, steady[:, None] * found[:, 5:8])

    # ∫ a mu L / ∫ a mu, and the first moment likewise
    parts = ((direct + spread) / around.whole, np.moveaxis(first, 1, 2) / around.whole[:, :, None])
    others = spread / np.maximum(_spread(points, seen), 1e-30)
    return Incident(*(part.astype(np.float32) for part in parts)), others


def _steadied(sent: np.ndarray) -> np.ndarray:
    """Factors of what other surfaces send to points, (points, channels), by which the brightest share that of the next.

    Of mirrored lamps a few points may hold half of all light; what is cut goes to all points by what they have.
    """
    # min(sent, quantile), scaled to the same sum
    most = np.quantile(sent, 1 - BRIGHTEST, axis=0)
    kept = np.where(most > 0, np.minimum(sent, most), sent)
    whole = sent.sum(axis=0) / np.maximum(kept.sum(axis=0), 1e-30)
    return np.where(sent > 0, kept / np.maximum(sent, 1e-30), 1) * whole


def _spread(points: SurfacePoints, values: np.ndarray) -> np.ndarray:
    """What a few traced directions bring, over the neighbourhood: it varies slowly, and was most of the noise."""
    for _ in range(SPREADINGS):
        values = points.smoothed(values)
    return values


class GatheringPoint(NamedTuple):
    """Position, outward geometric and shading normal, and how far rounding puts the position from the surface."""

    p: mi.Point3f
    n: mi.Normal3f
    n_out: mi.Normal3f
    e: mi.Float


def _numbers(*values: int) -> list[mi.UInt32]:
    return [dr.opaque(mi.UInt32, value) for value in values]


def _stratified(sampler: mi.Sampler, j: mi.UInt32, s: mi.UInt32, n: mi.UInt32) -> mi.Point2f:
    """Pairs of uniforms for n directions of each point, a lattice shifted for each point."""
    # direction s of n: (s / n, s golden), shifted by two random numbers of the point, modulo 1
    shift = dr.gather(mi.Point2f, sampler.next_2d(), j * n)
    x = mi.Point2f(mi.Float(s) / mi.Float(n) + shift.x, dr.fma(mi.Float(s), GOLDEN, shift.y))
    return x - dr.floor(x)


def _weight(albedo: Albedo, at: GatheringPoint, w: mi.Vector3f) -> tuple[mi.Spectrum, mi.Float]:
    """a(mu) mu over the density mu / pi of the cosine, and that density."""
    mu = cosine(w, at.n, at.n_out)
    return albedo(mu) * dr.pi, mu * dr.inv_pi


def by_emitters(
    scene: mi.Scene,
    instance_scene: InstanceScene,
    albedo: Albedo,
    at: GatheringPoint,
    u: mi.Point2f,
    c: mi.Spectrum | float = 0.0,
    left_out: Sequence[mi.Emitter] = (),
) -> tuple[mi.Spectrum, mi.Vector3f]:
    """Light of sampled emitters less c, and its direction: a mu (L - c) V / p_e with its MIS weight."""
    # w by emitters, and what is between
    here = place(at.p, at.n)
    ds, light = sample_emitter(scene, here, u, mi.Bool(True))
    a, pdf = _weight(albedo, at, ds.d)
    above = (ds.pdf > 0) & (pdf > 0)
    for emitter in left_out:
        above &= ds.emitter != mi.EmitterPtr(emitter)
    light = dr.select(blocked(scene, instance_scene.ray_to_emitter(here, ds, at.e), above), 0, light)

    # a mu / p_e times L V - c, times p_e / (p_e + p_mu)
    light -= dr.select(ds.emitter.is_environment(), c / dr.maximum(ds.pdf, 1e-30), 0)
    share = dr.select(ds.delta, 1, mis_weight(ds.pdf, pdf))
    return dr.select(above, a * pdf * light * share, 0), ds.d


def by_cosine(
    scenery: tuple[mi.Scene, list[TranslucentObject], Settings], albedo: Albedo, at: GatheringPoint, u: mi.Point2f,
    traced: mi.Bool, sampler: mi.Sampler,
) -> tuple[mi.Spectrum, mi.Spectrum, mi.Spectrum, mi.Vector3f, mi.Bool]:  # fmt: skip
    """Light along directions of the cosine: of emitters that they meet, and of other surfaces along some.

    Args:
        scenery: the scene, its objects and settings.
        albedo: a(mu).
        at: points.
        u: uniform numbers of the directions.
        traced: directions along which what other surfaces send is traced.
        sampler: of these paths.

    Returns:
        Light of emitters, of other surfaces, a, the direction w, and where w meets another surface that is traced.
    """
    # the path loop goes on from the surface, where emission has been counted
    scene, objects, settings = scenery
    met, a, w, ray, si = met_by_cosine(scene, objects[0].instance_scene, albedo, at, u)
    depth = max(settings.max_depth - 1, -1) or 1
    hidden = replace(settings, hide_emitters=True, light="sampled", layers=False, max_depth=depth)
    on = si.is_valid() & traced
    parts, *_ = trace_paths(scene, objects, hidden, sampler, ray, on, scattered=True)
    return met, dr.select(on, a * (parts[0] + parts[1]), 0), a, w, on


def met_by_cosine(
    scene: mi.Scene,
    instance_scene: InstanceScene,
    albedo: Albedo,
    at: GatheringPoint,
    u: mi.Point2f,
    c: mi.Spectrum | float = 0.0,
) -> tuple[mi.Spectrum, mi.Spectrum, mi.Vector3f, mi.Ray3f, mi.SurfaceInteraction3f]:
    """Light of emitters along a direction of the cosine, less c; a, the direction, its ray, and what that meets."""
    # w of density p_mu = mu / pi, so that a mu / p_mu = pi a
    w, _ = cosine_above(at.n_out, at.n, u)
    a, pdf = _weight(albedo, at, w)
    here = place(at.p, at.n)
    ray = ray_from(here, w, at.e)
    si = instance_scene.intersect(scene, ray, mi.RayFlags.All, True)
    emitter = si.emitter(scene)
    shines = emitter != None  # noqa: E711
    density, _ = emitter_pdf(scene, here, si, shines)

    # pi a (L - c) p_mu / (p_mu + p_e)
    L = emitter.eval(si, shines) - dr.select(emitter.is_environment(), c, 0)
    met = dr.select(shines, mis_weight(pdf, density) * L, 0)
    return a * met, a, w, ray, si
