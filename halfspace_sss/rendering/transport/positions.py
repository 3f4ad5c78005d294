"""Where light enters a mesh: probe rays about the exit, points uniform over the area, or both, with their densities.

A probe ray follows the normal of the exit with probability 0.8, each tangent with 0.1, at a distance drawn from the
radial density of the models; all hits on the object count, and one is chosen in proportion to what it may bring. The
density of hits at x is D(x) = sum over axes p_a |n(x).a| p(r_a(x)) l_a(x), r_a the distance of x from x_o across the
axis (King, Kulla, Conty and Fajardo 2013), l_a the probability that the probe is long enough: most reach no further
along the axis than 4 r_a, beyond which another axis finds x more often, and the others through the whole object. With
points uniform over the area A, a share s of the samples, the density is (1 - s) D(x) + s/A (balance heuristic).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from halfspace_sss.rendering.surface.object import Object, turned
from halfspace_sss.rendering.transport.area_points import AreaPoints
from halfspace_sss.rendering.transport.plane import Exit, number
from halfspace_sss.rendering.transport.protocols import Entry
from halfspace_sss.rendering.transport.radial_table import RadialTable

__all__ = ["PositionSampler"]

MOST_HITS = 64
NORMAL_SHARE = 0.8
LONG_SHARE = 0.05  # of the probes go through the whole object, for what lies straight behind the exit
REACH = 4.0  # length of the others to either side, over their distance from the exit
LEAST_REACH = 1e-3  # of the size of the object, for the roughness of a mesh and rounding


@dataclass(frozen=True, eq=False)
class PositionSampler:
    """Points of entry of one object.

    Args:
        found: the object.
        table: radial density about the exit.
        points: uniform points of the object.
        area_share: share of the samples that are uniform over the area, in [0, 1].
    """

    found: Object
    table: RadialTable
    points: AreaPoints
    area_share: float

    def density(self, p: Any, n: Any, out: Exit, axes: Any) -> Any:
        """Density of samples (of all hits of a probe) over the surface at p with normal n, 1/(scene unit)²."""
        import drjit as dr

        s = self.area_share
        if s == 1:
            return number(1 / self.found.area)
        d = p - out.p
        total = 0.0
        for axis, share in zip(axes, (NORMAL_SHARE, 0.5 * (1 - NORMAL_SHARE), 0.5 * (1 - NORMAL_SHARE))):
            along = dr.dot(d, axis)
            across = dr.norm(d - axis * along)
            reached = dr.select(dr.abs(along) <= self._reach(across), 1.0, LONG_SHARE)
            total += share * reached * dr.abs(dr.dot(n, axis)) * self.table.pdf(across)
        return number(1 - s) * total + number(s / self.found.area if s else 0.0)

    def sample(self, out: Exit, prim_index: Any, sampler: Any, active: Any) -> Entry:
        """A point of entry for light that leaves at `out` on the face `prim_index`."""
        import drjit as dr
        import mitsuba as mi

        axes = (out.n, *mi.coordinate_system(out.n))
        piece = self.found.piece(prim_index, active)
        u_choice, u_axis, u_length, u_hit = (sampler.next_1d() for _ in range(4))
        u = sampler.next_2d()
        by_area = active & (u_choice < number(self.area_share))
        entry = _nowhere()
        if self.area_share < 1:
            ray = self._probe(out, axes, u_axis, u_length, u)
            entry = self._hits(ray, out, axes, piece, u_hit, active & ~by_area)
        if self.area_share > 0:
            uniform = self._uniform(out, axes, piece, u_hit, u, by_area)
            entry = Entry(*(dr.select(by_area, a, b) for a, b in zip(uniform, entry)))
        return entry

    def _reach(self, across: Any) -> Any:
        return REACH * across + number(LEAST_REACH * self.found.size)

    def _probe(self, out: Exit, axes: Any, u_axis: Any, u_length: Any, u: Any) -> Any:
        import drjit as dr
        import mitsuba as mi

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

    def _hits(self, ray: Any, out: Exit, axes: Any, piece: Any, u: Any, active: Any) -> Entry:
        """One hit of a ray among all, chosen with probability proportional to p(|x - x_o|)/D(x)."""
        import drjit as dr
        import mitsuba as mi

        def step(ray: Any, u: Any, left: Any, total: Any, entry: tuple, active: Any) -> tuple:
            si = self.found.scene.ray_intersect(ray, _FLAGS(), False, active)
            active &= si.is_valid() & (left > 0)
            density = self.density(si.p, si.n, out, axes)
            hope = self.table.pdf(dr.norm(si.p - out.p)) / density
            same = self.found.piece(si.prim_index, active) == piece
            hope = dr.select(active & same & (density > 0), hope, 0)
            total += hope
            share = dr.select(total > 0, hope / total, 0)
            take = (u < share) & (hope > 0)
            u = dr.clip(dr.select(take, u / dr.maximum(share, 1e-20), (u - share) / dr.maximum(1 - share, 1e-7)), 0, 1)
            found = (
                si.p,
                si.n,
                turned(si.sh_frame.n, si.n) * out.sign,
                1 / (density * dr.maximum(hope, 1e-30)),
                si.prim_index,
            )
            entry = tuple(dr.select(take, a, b) for a, b in zip(found, entry))
            onward = si.spawn_ray(ray.d)
            onward.maxt = ray.maxt - si.t
            return dr.select(active, onward, ray), u, left - 1, total, entry, active

        state = (ray, u, mi.UInt32(MOST_HITS), mi.Float(0), tuple(_nowhere()), mi.Bool(active))
        *_, total, entry, _ = dr.while_loop(state, lambda *state: state[-1], step, label="probe")
        p, n, n_out, weight, face = entry
        return Entry(p, n, n_out, dr.select(total > 0, weight * total, 0), face)

    def _uniform(self, out: Exit, axes: Any, piece: Any, u_face: Any, u: Any, active: Any) -> Entry:
        import drjit as dr

        at = self.points.sample(u_face, u, active)
        same = self.found.piece(at.prim_index, active) == piece
        weight = dr.select(active & same, 1 / self.density(at.p, at.n, out, axes), 0)
        return Entry(at.p, at.n, turned(at.n_shading, at.n) * out.sign, weight, at.prim_index)


def _FLAGS() -> int:
    import mitsuba as mi

    return mi.RayFlags.Minimal | mi.RayFlags.ShadingFrame


def _nowhere() -> Entry:
    import mitsuba as mi

    return Entry(mi.Point3f(0), mi.Normal3f(0, 0, 1), mi.Normal3f(0, 0, 1), mi.Float(0), mi.UInt32(0))
