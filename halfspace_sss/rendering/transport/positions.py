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

from halfspace_sss.rendering.surface.object import Object, turned
from halfspace_sss.rendering.transport.area_points import AreaPoints
from halfspace_sss.rendering.transport.plane import Exit, number
from halfspace_sss.rendering.transport.protocols import Entry
from halfspace_sss.rendering.transport.radial_table import RadialTable

__all__ = ["PositionSampler"]

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
        found: the object.
        table: radial density about the exit.
        points: uniform points of the object.
        area_share: share s of the candidates that are uniform over the area: s/(1 - s) of them, rounded up, beside a
            probe; with 1 there are no probes.
    """

    found: Object
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

    def _side(self, out: Exit, prim_index: Any, active: Any) -> Any:
        """What turns the normal of a face outwards: of a sheet, to the side of the exit."""
        return self.found.side(prim_index, active) if self.found.closed else out.sign

    def density(self, p: Any, n: Any, out: Exit, axes: Any) -> Any:
        """Density of candidates over the surface at p with normal n, for each that is drawn, 1/(scene unit)²."""
        return self._candidates(p, n, out, axes) * number(1 / (self.probes + self.area_points))

    def _candidates(self, p: Any, n: Any, out: Exit, axes: Any) -> Any:
        """c = D + m/A, 1/(scene unit)²."""
        uniform = number(self.area_points / self.found.area if self.area_points else 0.0)
        if not self.probes:
            return uniform
        d, total = p - out.p, 0.0
        for axis, share in zip(axes, (NORMAL_SHARE, 0.5 * (1 - NORMAL_SHARE), 0.5 * (1 - NORMAL_SHARE))):
            along = dr.dot(d, axis)
            across = dr.norm(d - axis * along)
            reached = dr.select(dr.abs(along) <= self._reach(across), 1.0, LONG_SHARE)
            total += share * reached * dr.abs(dr.dot(n, axis)) * self.table.pdf(across)
        return total + uniform

    def sample(self, out: Exit, prim_index: Any, sampler: Any, active: Any) -> Entry:
        """A point of entry for light that leaves at `out` on the face `prim_index`."""
        axes = (out.n, *mi.coordinate_system(out.n))
        piece = self.found.piece(prim_index, active)
        u_axis, u_length, u_face, u_choice = (sampler.next_1d() for _ in range(4))
        u = sampler.next_2d()
        kept = _Kept(u_choice, mi.Float(0), *_nowhere())
        if self.probes:
            kept = self._hits(self._probe(out, axes, u_axis, u_length, u), out, axes, piece, kept, active)
        if self.area_points:
            kept = self._uniform(out, axes, piece, u_face, u, kept, active)
        total, p = kept.total, self.table.pdf(dr.norm(kept.p - out.p))
        weight = dr.select(total > 0, total / dr.maximum(p, 1e-30), 0)
        return Entry(kept.p, kept.n, kept.n_out, weight, kept.face)

    def _reach(self, across: Any) -> Any:
        return REACH * across + number(LEAST_REACH * self.found.size + NEAR * self.table.mean)

    def _probe(self, out: Exit, axes: Any, u_axis: Any, u_length: Any, u: Any) -> Any:
        n, s, t = axes
        to_n, to_s = u_axis < NORMAL_SHARE, u_axis < 0.5 * (1 + NORMAL_SHARE)
        along = dr.select(to_n, n, dr.select(to_s, s, t))
        first = dr.select(to_n, s, dr.select(to_s, t, n))
        second = dr.select(to_n, t, dr.select(to_s, n, s))
        sin_phi, cos_phi = dr.sincos(2 * dr.pi * u.y)
        r = self.table.sample(u.x)
        reach = dr.select(u_length < LONG_SHARE, number(1.01 * self.found.size), self._reach(r))
        start = out.p + (first * cos_phi + second * sin_phi) * r - along * reach
        ray = mi.Ray3f(mi.Point3f(start), mi.Vector3f(along))
        ray.maxt = 2 * reach
        return ray

    def _offer(self, kept: _Kept, at: tuple, out: Exit, axes: Any, active: Any) -> _Kept:
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

    def _hits(self, ray: Any, out: Exit, axes: Any, piece: Any, kept: _Kept, active: Any) -> _Kept:
        """All hits of a probe as candidates."""

        def step(ray: Any, left: Any, kept: tuple, active: Any) -> tuple:
            si = self.found.scene.ray_intersect(ray, _FLAGS(), False, active)
            active &= si.is_valid() & (left > 0)
            same = self.found.piece(si.prim_index, active) == piece
            side = self._side(out, si.prim_index, active & same)
            at = (si.p, si.n, turned(si.sh_frame.n, si.n) * side, si.prim_index)
            kept = self._offer(_Kept(*kept), at, out, axes, active & same)
            onward = si.spawn_ray(ray.d)
            onward.maxt = ray.maxt - si.t
            return dr.select(active, onward, ray), left - 1, tuple(kept), active

        state = (ray, mi.UInt32(MOST_HITS), tuple(kept), mi.Bool(active))
        return _Kept(*dr.while_loop(state, lambda *state: state[-1], step, label="probe")[2])

    def _uniform(self, out: Exit, axes: Any, piece: Any, u_face: Any, u: Any, kept: _Kept, active: Any) -> _Kept:
        """Points over the area as candidates."""
        m, inverse = number(float(self.area_points)), number(1 / self.area_points)

        def step(k: Any, kept: tuple) -> tuple:
            v = mi.Point2f(*(_wrapped(x + k * ratio) for x, ratio in zip((u.x, u.y), LATTICE)))
            at = self.points.sample(_wrapped(u_face + k * inverse), v, active)
            same = self.found.piece(at.prim_index, active) == piece
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


def _wrapped(u: Any) -> Any:
    """u modulo one, below one."""
    return dr.minimum(u - dr.floor(u), 1 - 2**-24)


def _FLAGS() -> int:
    return mi.RayFlags.Minimal | mi.RayFlags.ShadingFrame


def _nowhere() -> tuple:
    return mi.Point3f(0), mi.Normal3f(0, 0, 1), mi.Normal3f(0, 0, 1), mi.UInt32(0)
