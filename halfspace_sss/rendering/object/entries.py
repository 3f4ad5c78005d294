"""Where light enters a mesh: one of several candidates, the hits of a probe ray and points uniform over the area.

A probe ray follows the normal of the exit with probability 0.8, each tangent with 0.1, at a distance drawn from the
radial density p of the models; all hits on the object count. Their density at x is D(x) = sum over axes p_a |n(x).a|
p(r_a(x)) l_a(x), r_a the distance of x from x_o across the axis (King, Kulla, Conty and Fajardo 2013), l_a the
probability that the probe is long enough: most reach no further along the axis than a mean distance and 4 r_a, beyond
which another axis finds x more often, and the others through the whole object. With m points uniform over the area A
beside it c(x) = D(x) + m/A candidates are expected per area (balance heuristic); one is taken with a probability
proportional to h = p(|x - x_o|)/c and has the weight (sum of all h)/p(|x - x_o|) (resampled importance sampling,
Talbot, Cline and Egbert 2005). The m points are a lattice shifted at random: each is uniform, all are spread out.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np

from halfspace_sss.rendering.object.points import EntrySample, SurfacePoint, number, turned
from halfspace_sss.rendering.object.shape import Geometry

__all__ = ["AreaPoints", "Point", "PositionSampler", "RadialTable"]

MOST_HITS = 64
NORMAL_SHARE = 0.8
LONG_SHARE = 0.05  # of the probes go through the whole object, for what lies straight behind the exit
REACH = 4.0  # length of the others to either side, over their distance from the exit,
LEAST_REACH = 1e-3  # and of the size of the object, for the roughness of a mesh and rounding,
NEAR = 1.0  # and of mean distances, for what lies across a gap or a thin limb
ALONE, MOST_POINTS = 8, 15  # points over the area without probes, and with one
LATTICE = 0.7548776662466927, 0.5698402909980532  # of two dimensions (Roberts 2018)


@dataclass(frozen=True, eq=False)
class PositionSampler:
    """Points of entry of one object.

    Args:
        geometry: of the object.
        table: radial density about the exit.
        points: uniform points of the object.
        area_share: share s of the candidates that are uniform over the area: s/(1 - s) of them, rounded up, beside a
            probe; with 1 there are no probes.
    """

    geometry: Geometry
    table: RadialTable
    points: AreaPoints
    area_share: float

    @property
    def area_points(self) -> int:
        """Number of candidates that are uniform over the area."""
        s = self.area_share
        return ALONE if s == 1 else min(math.ceil(s / (1 - s) - 1e-6), MOST_POINTS)

    @property
    def probes(self) -> int:
        """Number of probes."""
        return int(self.area_share < 1)

    def _side(self, out: SurfacePoint, prim_index: mi.UInt32, active: mi.Bool) -> Any:
        """What turns the normal of a face outwards: of a sheet, to the side of the exit."""
        return self.geometry.side(prim_index, active) if self.geometry.closed else out.sign

    def density(self, p: mi.Point3f, n: mi.Normal3f, out: SurfacePoint, axes: tuple[mi.Vector3f, ...]) -> Any:
        """Density of candidates over the surface at p with normal n, for each that is drawn, 1/(scene unit)²."""
        return self._candidates(p, n, out, axes) * number(1 / (self.probes + self.area_points))

    def _candidates(self, p: mi.Point3f, n: mi.Normal3f, out: SurfacePoint, axes: tuple[mi.Vector3f, ...]) -> Any:
        """c = D + m/A, 1/(scene unit)²."""
        uniform = number(self.area_points / self.geometry.area if self.area_points else 0.0)
        if not self.probes:
            return uniform
        d, total = p - out.p, 0.0
        for axis, share in zip(axes, (NORMAL_SHARE, 0.5 * (1 - NORMAL_SHARE), 0.5 * (1 - NORMAL_SHARE))):
            along = dr.dot(d, axis)
            across = dr.norm(d - axis * along)
            reached = dr.select(dr.abs(along) <= self._reach(across), 1.0, LONG_SHARE)
            total += share * reached * dr.abs(dr.dot(n, axis)) * self.table.pdf(across)
        return total + uniform

    def sample(self, out: SurfacePoint, prim_index: mi.UInt32, sampler: mi.Sampler, active: mi.Bool) -> EntrySample:
        """A point of entry for light that leaves at `out` on the face `prim_index`."""
        axes = (out.n_out, *mi.coordinate_system(out.n_out))
        piece = self.geometry.piece(prim_index, active)
        u_axis, u_length, u_face, u_choice = (sampler.next_1d() for _ in range(4))
        u = sampler.next_2d()
        kept = _Kept(u_choice, mi.Float(0), *_nowhere())
        if self.probes:
            kept = self._hits(self._probe(out, axes, u_axis, u_length, u), out, axes, piece, kept, active)
        if self.area_points:
            kept = self._uniform(out, axes, piece, u_face, u, kept, active)
        total, p = kept.total, self.table.pdf(dr.norm(kept.p - out.p))
        weight = dr.select(total > 0, total / dr.maximum(p, 1e-30), 0)
        return EntrySample(kept.p, turned(kept.n, kept.n_out), kept.n_out, weight, kept.face)

    def _reach(self, across: mi.Float) -> Any:
        return REACH * across + number(LEAST_REACH * self.geometry.size + NEAR * self.table.mean)

    def _probe(
        self, out: SurfacePoint, axes: tuple[mi.Vector3f, ...], u_axis: mi.Float, u_length: mi.Float, u: mi.Point2f
    ) -> Any:
        n, s, t = axes
        to_n, to_s = u_axis < NORMAL_SHARE, u_axis < 0.5 * (1 + NORMAL_SHARE)
        along = dr.select(to_n, n, dr.select(to_s, s, t))
        first = dr.select(to_n, s, dr.select(to_s, t, n))
        second = dr.select(to_n, t, dr.select(to_s, n, s))
        sin_phi, cos_phi = dr.sincos(2 * dr.pi * u.y)
        r = self.table.sample(u.x)
        reach = dr.select(u_length < LONG_SHARE, number(1.01 * self.geometry.size), self._reach(r))
        start = out.p + (first * cos_phi + second * sin_phi) * r - along * reach
        ray = mi.Ray3f(mi.Point3f(start), mi.Vector3f(along))
        ray.maxt = 2 * reach
        return ray

    def _offer(
        self, kept: _Kept, at: tuple, out: SurfacePoint, axes: tuple[mi.Vector3f, ...], active: mi.Bool
    ) -> _Kept:
        """Take a candidate (point, normal, outward shading normal, face) instead with the probability h / sum of h."""
        p, n, n_out, face = at
        c = self._candidates(p, n, out, axes)
        hope = dr.select(active & (c > 0), self.table.pdf(dr.norm(p - out.p)) / dr.maximum(c, 1e-30), 0)
        total = kept.total + hope
        share = dr.select(total > 0, hope / total, 0)
        take = (kept.u < share) & (hope > 0)
        u = dr.select(take, kept.u / dr.maximum(share, 1e-20), (kept.u - share) / dr.maximum(1 - share, 1e-7))
        found = (dr.select(take, a, b) for a, b in zip((p, n, n_out, face), kept[2:]))
        return _Kept(dr.clip(u, 0, 1), total, *found)

    def _hits(
        self,
        ray: mi.Ray3f,
        out: SurfacePoint,
        axes: tuple[mi.Vector3f, ...],
        piece: mi.UInt32,
        kept: _Kept,
        active: mi.Bool,
    ) -> _Kept:
        """All hits of a probe as candidates."""

        def step(ray: mi.Ray3f, left: Any, kept: tuple, active: mi.Bool) -> tuple:
            si = self.geometry.scene.ray_intersect(ray, _FLAGS(), False, active)
            active &= si.is_valid() & (left > 0)
            same = self.geometry.piece(si.prim_index, active) == piece
            side = self._side(out, si.prim_index, active & same)
            at = (si.p, si.n, turned(si.sh_frame.n, si.n) * side, si.prim_index)
            kept = self._offer(_Kept(*kept), at, out, axes, active & same)
            onward = si.spawn_ray(ray.d)
            onward.maxt = ray.maxt - si.t
            return dr.select(active, onward, ray), left - 1, tuple(kept), active

        state = (ray, mi.UInt32(MOST_HITS), tuple(kept), mi.Bool(active))
        return _Kept(*dr.while_loop(state, lambda *state: state[-1], step, label="probe")[2])

    def _uniform(
        self,
        out: SurfacePoint,
        axes: tuple[mi.Vector3f, ...],
        piece: mi.UInt32,
        u_face: mi.Float,
        u: mi.Point2f,
        kept: _Kept,
        active: mi.Bool,
    ) -> _Kept:
        """Points over the area as candidates."""
        m, inverse = number(float(self.area_points)), number(1 / self.area_points)

        def step(k: Any, kept: tuple) -> tuple:
            v = mi.Point2f(*(_wrapped(x + k * ratio) for x, ratio in zip((u.x, u.y), LATTICE)))
            at = self.points.sample(_wrapped(u_face + k * inverse), v, active)
            same = self.geometry.piece(at.prim_index, active) == piece
            side = self._side(out, at.prim_index, active & same)
            point = (at.p, at.n, turned(at.n_shading, at.n) * side, at.prim_index)
            return k + 1, tuple(self._offer(_Kept(*kept), point, out, axes, active & same))

        state = (mi.Float(0), tuple(kept))
        return _Kept(*dr.while_loop(state, lambda k, kept: active & (k < m), step, label="area points")[1])


class _Kept(NamedTuple):
    """The candidate that is kept: uniform number left, sum of h so far, point, normals, face."""

    u: Any
    total: Any
    p: Any
    n: Any
    n_out: Any
    face: Any


def _wrapped(u: mi.Float) -> mi.Float:
    """u modulo one, below one."""
    return dr.minimum(u - dr.floor(u), 1 - 2**-24)


def _FLAGS() -> int:
    return mi.RayFlags.Minimal | mi.RayFlags.ShadingFrame


def _nowhere() -> tuple:
    return mi.Point3f(0), mi.Normal3f(0, 0, 1), mi.Normal3f(0, 0, 1), mi.UInt32(0)


# --------------------------------------------------------------------------------------------------
# Points uniform over the area of an object, with its geometric and its shading normal.


class Point(NamedTuple):
    """Position, geometric normal, shading normal (as the shape has them) and face of a point."""

    p: Any
    n: Any
    n_shading: Any
    prim_index: Any


class AreaPoints:
    """Uniform points of a shape; for a mesh by its faces, as Mitsuba gives one of the two normals only.

    Args:
        shape: the Mitsuba shape.
    """

    def __init__(self, shape: mi.Shape) -> None:
        self.shape = shape
        self.faces = self.centre = None
        parameters = mi.traverse(shape)
        if shape.class_name() == "Sphere":  # Mitsuba's normals of sampled points are wrong where it is mirrored
            self.centre = np.array(parameters["to_world"].matrix, dtype=np.float64).reshape(4, 4)[:3, 3]
        if "faces" in parameters:
            faces = np.array(parameters["faces"]).reshape(-1, 3)
            a, b, c = np.array(parameters["vertex_positions"]).reshape(-1, 3)[faces].transpose(1, 0, 2)
            areas = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)
            self.faces = mi.DiscreteDistribution(mi.Float(areas.astype(np.float32)))

    def sample(self, u_face: mi.Float, u: mi.Point2f, active: mi.Bool) -> Point:
        """A point for uniform numbers u_face and the pair u."""
        if self.faces is None:
            ps = self.shape.sample_position(0.0, u, active)
            n = ps.n if self.centre is None else self._radial(ps.p)
            return Point(ps.p, n, n, mi.UInt32(0))
        return self.on_face(self.faces.sample(u_face, active), u, active)

    def _radial(self, p: mi.Point3f) -> Any:
        n = dr.normalize(p - mi.Point3f(*(number(c) for c in self.centre)))
        return mi.Normal3f(-n if self.shape.has_flipped_normals() else n)

    def on_face(self, face: mi.UInt32, u: mi.Point2f, active: mi.Bool = True) -> Point:
        """A uniform point of a face of a mesh."""
        index = self.shape.face_indices(face, active)
        corners = [self.shape.vertex_position(i, active) for i in (index.x, index.y, index.z)]
        b = mi.warp.square_to_uniform_triangle(u)
        weights = (1 - b.x - b.y, b.x, b.y)
        n = dr.normalize(dr.cross(corners[1] - corners[0], corners[2] - corners[0]))
        n = -n if self.shape.has_flipped_normals() else n
        n_shading = n
        if self.shape.has_vertex_normals():
            normals = [self.shape.vertex_normal(i, active) for i in (index.x, index.y, index.z)]
            n_shading = dr.normalize(sum(w * v for w, v in zip(weights, normals)))
        p = sum(w * c for w, c in zip(weights, corners))
        return Point(mi.Point3f(p), mi.Normal3f(n), mi.Normal3f(n_shading), face)


# --------------------------------------------------------------------------------------------------
# A radial density about the exit for rendering: one table for all channels of a model, covering the whole object.


N_CELLS = 512
FLOOR = 1e-3  # share of the probability that is spread evenly over log r, so that no point is out of reach
SHORTEST = 1e-4  # mean free paths of the densest channel; the first cell reaches from 0 to there


class RadialTable:
    """Mixture over the channels of the models' `pdf_position`, piecewise constant in r over cells even in log r.

    Args:
        models: one scalar model per channel, in scene units.
        reach: largest distance, scene units.
    """

    def __init__(self, models: list[Any], reach: float) -> None:
        densest = max(float(m.medium.sigma_t) for m in models)
        r_min = min(SHORTEST / densest, 1e-3 * reach)
        edges = np.concatenate([[0.0], np.geomspace(r_min, reach, N_CELLS)])
        middle = np.concatenate([[0.5 * r_min], np.sqrt(edges[1:-1] * edges[2:])])
        density = sum(np.asarray(m.pdf_position(middle, 0.0, 0.9)) for m in models)
        mass = density * middle * np.diff(edges)
        mass /= max(mass.sum(), 1e-300)
        probability = (1 - FLOOR) * mass + FLOOR / N_CELLS
        probability /= probability.sum()
        self.r_min, self.reach = r_min, reach
        self.per_log = (N_CELLS - 1) / math.log(reach / r_min)
        self.mean = float(np.sum(probability * middle))
        self._numpy = (np.cumsum(probability), probability, edges, probability / (2 * math.pi * np.diff(edges)))
        self._lanes: dict[str, Any] = {}

    def _arrays(self) -> tuple[Any, ...]:
        if mi.variant() not in self._lanes:
            numbers = (number(v) for v in (self.r_min, self.per_log, self.reach))
            self._lanes[mi.variant()] = (*(mi.Float(v.astype(np.float32)) for v in self._numpy), *numbers)
            dr.eval(self._lanes[mi.variant()])
        return self._lanes[mi.variant()]

    def sample(self, u: mi.Float) -> Any:
        """Distance r for uniform u in [0, 1)."""
        cdf, probability, edges, *_ = self._arrays()
        k = dr.binary_search(0, N_CELLS - 1, lambda i: dr.gather(mi.Float, cdf, i) <= u)
        share = 1 - (dr.gather(mi.Float, cdf, k) - u) / dr.gather(mi.Float, probability, k)
        low, high = dr.gather(mi.Float, edges, k), dr.gather(mi.Float, edges, k + 1)
        return dr.lerp(low, high, dr.clip(share, 0, 1))

    def pdf(self, r: mi.Float) -> Any:
        """Density over the plane at distance r, 1/(scene unit)²; 0 beyond the reach."""
        *_, times_r, r_min, per_log, reach = self._arrays()
        steps = dr.log(dr.maximum(r, r_min) / r_min) * per_log
        k = dr.select(r < r_min, 0, dr.minimum(mi.UInt32(steps) + 1, N_CELLS - 1))
        density = dr.gather(mi.Float, times_r, k) / dr.maximum(r, 1e-3 * r_min)
        return dr.select(r < reach, density, 0)
