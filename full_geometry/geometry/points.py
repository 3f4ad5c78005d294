"""Points of a surface with a direction, the query of the half-space for a pair of them, and transports between them.

`PositionSampler` draws where light enters a mesh: one of several candidates, the hits of a probe ray and points uniform
over the area.

A probe ray follows the normal of the exit with probability 0.8, each tangent with 0.1, at a distance drawn from the
radial density p of the models; all hits on the object count. Their density at x is D(x) = sum over axes p_a |n(x).a|
p(r_a(x)) l_a(x), r_a the distance of x from x_o across the axis (King, Kulla, Conty and Fajardo 2013), l_a the
probability that the probe is long enough: most reach no further along the axis than a mean distance and 4 r_a, beyond
which another axis finds x more often, and the others through the whole object. With m points uniform over the area A
beside it c(x) = D(x) + m/A candidates are expected per area (balance heuristic); one is taken with a probability
proportional to h = p(|x - x_o|)/c and has the weight (sum of all h)/p(|x - x_o|) (resampled importance sampling,
Talbot, Cline and Egbert 2005). The m points are a lattice shifted at random: each is uniform, all are spread out.
Where faces are known to differ in brightness b, of mean 1 over the area, the points have the density b/A and h = b p/c.
"""

from __future__ import annotations

import math
from copy import copy
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol
from weakref import WeakKeyDictionary

import drjit as dr
import mitsuba as mi
import numpy as np

from full_geometry.geometry import mesh
from full_geometry.geometry.rounding import ray_from
from full_geometry.geometry.shape import Geometry
from halfspace_sss.arrays import aligned
from halfspace_sss.interface.model import BSSRDF


@dataclass
class MediumAt:
    """The medium at a point of a surface, per channel, for the whole way of light from there; 1/(scene unit).
    `albedo`: of single scattering. `sigma_t`: extinction. `face`: number of the face there. `g`, `wavelengths`: mean
    cosine and wavelengths in nm, under spectral variants."""

    albedo: mi.Spectrum
    sigma_t: mi.Spectrum
    face: mi.UInt32
    g: mi.Spectrum | tuple[()] = ()
    wavelengths: mi.Spectrum | tuple[()] = ()


class SurfacePoint(NamedTuple):
    """A point of a surface and a direction outside, which points away from it: an exit with w_o or an entry with w_i.

    Args:
        p: position.
        n: outward geometric normal.
        n_out: outward shading normal, as w sees it: see `lifted`.
        w: direction.
        sign: that turns geometric normals of the shape outwards.
        medium: at the point, of objects with textures or spectra.
    """

    p: mi.Point3f
    n: mi.Normal3f
    n_out: mi.Normal3f
    w: mi.Vector3f
    sign: mi.Float | float = 1.0
    medium: MediumAt | tuple[()] = ()

    @property
    def mu(self) -> mi.Float:
        """The cosine of w to the shading normal; 0 below the surface."""
        return dr.select(dr.dot(self.w, self.n) > 0, dr.maximum(dr.dot(self.w, self.n_out), 0), 0)

    def gather(self, k: mi.UInt32) -> SurfacePoint:
        return SurfacePoint(*(v if isinstance(v, (float, tuple)) else dr.gather(type(v), v, k) for v in self))


def evaluate(*values: Any) -> None:
    """Evaluate arrays together, and those of named tuples, which `dr.eval` passes over."""
    ahead, found = list(values), []
    while ahead:
        value = ahead.pop()
        if isinstance(value, (tuple, list)):
            ahead += value
        else:
            found.append(value)
    dr.eval(found)


def surface_point(p: mi.Point3f, n: mi.Normal3f, n_out: mi.Normal3f, w: mi.Vector3f) -> SurfacePoint:
    """A point of the surface with the shading normal that w sees.
    `p`: position. `n`, `n_out`: outward geometric and shading normal. `w`: direction outside."""
    return SurfacePoint(mi.Point3f(p), mi.Normal3f(n), lifted(n_out, n, w), mi.Vector3f(w))


def refract_in(at: SurfacePoint, eta: mi.Float | float) -> tuple[mi.Vector3f, mi.Float, mi.Bool]:
    """Direction inside of light that is seen along w, Fresnel transmittance, and whether it goes inwards at all.
    mu' = sqrt(1 - (1 - mu²)/eta²), d = -w/eta + n (mu/eta - mu')."""
    mu = dr.dot(at.w, at.n_out)
    inner = 1 - (1 - mu * mu) / (eta * eta)
    d = at.n_out * (mu / eta - dr.safe_sqrt(inner)) - at.w / eta
    F = mi.fresnel(dr.maximum(mu, 0), eta)[0]
    valid = (mu > 0) & (inner > 0) & (dr.dot(at.w, at.n) > 0) & (dr.dot(d, at.n) < 0)
    return mi.Vector3f(dr.normalize(d)), dr.select(valid, 1 - F, 0), valid


class Frame(NamedTuple):
    """Tangents and normal at a point; `t` follows x_i -> x_o."""

    t: mi.Vector3f
    b: mi.Vector3f
    n: mi.Normal3f

    def azimuth(self, w: mi.Vector3f) -> mi.Float:
        """Azimuth of w about the normal from t, radians."""
        return dr.atan2(dr.dot(w, self.b), dr.dot(w, self.t))

    def direction(self, mu: mi.Float, phi: mi.Float) -> mi.Vector3f:
        """The unit vector with cosine mu and azimuth phi."""
        sine, (s, c) = dr.safe_sqrt((1 - mu) * (1 + mu)), dr.sincos(phi)
        return self.t * (sine * c) + self.b * (sine * s) + self.n * mu


def opaque(value: float) -> mi.Float:
    """A number of a scene as data of a kernel, which then serves other materials and sizes too."""
    return dr.opaque(mi.Float, float(value))


def lane_numbers(n: int) -> mi.UInt32:
    """Numbers 0 to n - 1 that gather from arrays of any length by one kernel: plain ones have another for length n."""
    return dr.arange(mi.UInt32, n) + dr.opaque(mi.UInt32, 0)


def floats(values: np.ndarray) -> mi.Float:
    """`aligned` numbers in single precision."""
    return aligned(mi.Float, values)


def of_rows(kind: type, rows: np.ndarray) -> mi.Vector3f | mi.Spectrum:
    """A vector or colour of n lanes from an array (n, size): its parts are arrays, so that n is in no kernel."""
    return kind(*map(floats, rows.T))


def channel_mean(value: mi.Spectrum) -> mi.Float:
    """Mean over the channels of a colour.

    With `drjit.mean` the number of lanes is part of a kernel, which is then compiled anew for every size of an image.
    """
    return dr.sum(value) / len(value)


def place(p: mi.Point3f, n: mi.Normal3f, medium: MediumAt | tuple[()] = ()) -> mi.Interaction3f:
    """A point with its geometric normal.
    Under spectral variants with the wavelengths of a `medium`: emitters are asked for those."""
    result = dr.zeros(mi.Interaction3f)
    result.p, result.n = mi.Point3f(p), mi.Normal3f(n)
    if mi.is_spectral and medium:
        result.wavelengths = medium.wavelengths
    return result


def local_frame(n: mi.Normal3f, d: mi.Vector3f) -> Frame:
    """The frame of normal n whose first axis is d = x_o - x_i without its normal part; any axis where that is 0."""
    flat = d - n * dr.dot(n, d)
    length2 = dr.squared_norm(flat)
    spare, _ = mi.coordinate_system(n)
    t = dr.select(length2 > 1e-12 * dr.squared_norm(d), flat * dr.rsqrt(dr.maximum(length2, 1e-30)), spare)
    t = dr.normalize(t - n * dr.dot(n, t))
    return Frame(t, dr.cross(n, t), n)


def plane_query(at: SurfacePoint, out: SurfacePoint) -> tuple[mi.Float, ...]:
    """(r, mu_i, phi_i, mu_o, phi_o) of the half-space for light that enters at `at` and leaves at `out`.
    r = |x_o - x_i| in scene units; each direction is taken against the normal of its own point, its azimuth from
    x_i -> x_o projected there. Cosines below the horizon come out as 0, at which every model is 0."""
    d = out.p - at.p
    frame_i, frame_o = local_frame(at.n_out, d), local_frame(out.n_out, d)
    mu_i, mu_o = (dr.clip(dr.dot(point.w, point.n_out), 0, 1) for point in (at, out))
    return dr.norm(d), mu_i, frame_i.azimuth(at.w), mu_o, frame_o.azimuth(out.w)


# --------------------------------------------------------------------------------------------------
# Directions above a surface but below the horizon of its interpolated normal, so that light there is not lost.
#
# With the geometric normal n and the interpolated one m, a direction w with (m.w)(n.w) < 0 sees the normal
#
#     m' = m - 2 (m.w) w,    |m'| = 1,    m'.w = -m.w,
#
# which is bent just so far that w is as high above its horizon as it was below. What is drawn about m and refracted to
# below the surface leaves along -w instead: as w runs over those directions, -w runs over the ones that m does not
# reach, with the same |m.w|. So every direction above the surface counts once, and
#
#     ∫_{n.w > 0} f(|m.w|) dw = ∫_{m.w > 0} f(m.w) dw    for every f.
#
# What is reflected to below the surface is reflected once more, at the surface.


def turned(n_shading: mi.Normal3f, n: mi.Normal3f) -> mi.Normal3f:
    """The shading normal on the side of the geometric one: vertex normals need not agree with the winding of a face."""
    return dr.select(dr.dot(n_shading, n) < 0, -n_shading, n_shading)


def lifted(m: mi.Normal3f, n: mi.Normal3f, w: mi.Vector3f) -> mi.Normal3f:
    """The interpolated normal m that w sees, on the side of w that the geometric normal n is on."""
    c = dr.dot(m, w)
    return mi.Normal3f(dr.select(c * dr.dot(n, w) < 0, m - 2 * c * w, m))


def lift(si: mi.SurfaceInteraction3f, w: mi.Vector3f, active: mi.Bool = True) -> mi.SurfaceInteraction3f:
    """The interaction with the frame that w sees, a direction in the world that becomes its `wi`."""
    c = dr.dot(si.sh_frame.n, w)
    below = active & (c * dr.dot(si.n, w) < 0)
    n = dr.select(below, si.sh_frame.n - 2 * c * w, si.sh_frame.n)
    s = dr.normalize(si.sh_frame.s - n * dr.dot(n, si.sh_frame.s))  # rough boundaries are told apart by their axes
    frame = mi.Frame3f(s, dr.cross(n, s), n)
    si.sh_frame = dr.select(below, frame, si.sh_frame)
    si.wi = dr.select(below, frame.to_local(w), si.wi)
    return si


def opposed(w: mi.Vector3f, n: mi.Normal3f) -> mi.Vector3f:
    """w, or -w where that is the one above the surface of the normal n."""
    return dr.select(dr.dot(w, n) < 0, -w, w)


def mirrored(w: mi.Vector3f, n: mi.Normal3f) -> mi.Vector3f:
    """w, mirrored at the surface of the normal n where it is below."""
    return w - n * (2 * dr.minimum(dr.dot(w, n), 0))


def sided(si: mi.SurfaceInteraction3f, wo: mi.Vector3f) -> tuple[mi.Vector3f, mi.Bool]:
    """A direction of a boundary in the world, on the side of the surface that it has in the frame; if it was turned."""
    d = si.to_world(wo)
    side = dr.select(wo.z > 0, 1.0, -1.0)
    n = si.n * side
    wrong = dr.dot(d, n) < 0
    reflects = wo.z * mi.Frame3f.cos_theta(si.wi) > 0
    return mi.Vector3f(dr.select(wrong, dr.select(reflects, mirrored(d, n), -d), d)), wrong & reflects


def cosine_above(m: mi.Normal3f, n: mi.Normal3f, u: mi.Point2f) -> tuple[mi.Vector3f, mi.Float]:
    """A direction above the surface by the cosine to m, for a pair of uniforms, and its density |m.w| / pi."""
    w = opposed(mi.Frame3f(m).to_world(mi.warp.square_to_cosine_hemisphere(u)), n)
    return mi.Vector3f(w), cosine_density(m, n, w)


def cosine_direction(n_out: mi.Normal3f, n: mi.Normal3f, rng: mi.PCG32) -> mi.Vector3f:
    """A direction of `cosine_above` for numbers of a generator."""
    return cosine_above(n_out, n, mi.Point2f(rng.next_float32(), rng.next_float32()))[0]


def cosine_density(m: mi.Normal3f, n: mi.Normal3f, w: mi.Vector3f) -> mi.Float:
    """The density of `cosine_above`, 1/sr; 0 below the surface."""
    return dr.select(dr.dot(w, n) > 0, dr.abs(dr.dot(w, m)) * dr.inv_pi, 0)


# --------------------------------------------------------------------------------------------------
# The two words the path loop knows of a model: where light may enter for an exit, and what it is worth there.
#
# A *proposal* draws an entry and the direction that light comes from, with densities; a *transport* gives S for an exit
# and an entry. A half-space model laid onto the surface is one transport, a network that knows the object another.


class EntrySample(NamedTuple):
    """A sampled point of entry, whose direction is still to be drawn.

    Args:
        p: position.
        n, n_out: outward geometric and shading normal.
        weight: 1/density over the area, (scene unit)²; 0 where none was found.
        face: its number.
        medium: as of a `SurfacePoint`.
    """

    p: mi.Point3f
    n: mi.Normal3f
    n_out: mi.Normal3f
    weight: mi.Float
    face: mi.UInt32
    medium: MediumAt | tuple[()] = ()

    def gather(self, k: mi.UInt32) -> EntrySample:
        return EntrySample(*(v if isinstance(v, tuple) else dr.gather(type(v), v, k) for v in self))

    def facing(self, w: mi.Vector3f) -> SurfacePoint:
        """The entry with light from w, with the shading normal that w sees."""
        return SurfacePoint(self.p, self.n, lifted(self.n_out, self.n, w), w, medium=self.medium)


class Proposals(Protocol):
    """Where light that leaves at an exit may have entered."""

    def lit(self, brightness: np.ndarray) -> Proposals:
        """Proposals that draw more entries where light is bright, positive numbers of the faces of a mesh."""
        return self

    def prepare(self, out: SurfacePoint, prepared: Any, active: mi.Bool) -> Any:
        """Prepare an exit once for all its entries, if need be; `prepared` comes from `Transport.prepare`."""

    def sample(
        self, out: SurfacePoint, prim_index: mi.UInt32, prepared: Any, sampler: mi.Sampler, active: mi.Bool
    ) -> EntrySample:
        """A point of entry; its weight is the inverse of the density of such points over the surface, (scene unit)²."""

    def sample_direction(self, entry: EntrySample, out: SurfacePoint, u: mi.Point2f) -> tuple[mi.Vector3f, mi.Float]:
        """A direction w_i that points away from the surface at the entry, for a pair of uniforms, and its density.
        The density is over solid angle, 1/sr."""

    def pdf_direction(self, entry: EntrySample, out: SurfacePoint, w_i: mi.Vector3f) -> mi.Float:
        """The density of `sample_direction`, 1/sr; 0 below the surface."""


class CosineProposals(Proposals, Protocol):
    """Proposals whose directions are by the cosine to the interpolated normal, above the surface."""

    def sample_direction(self, entry: EntrySample, out: SurfacePoint, u: mi.Point2f) -> tuple[mi.Vector3f, mi.Float]:
        return cosine_above(entry.n_out, entry.n, u)

    def pdf_direction(self, entry: EntrySample, out: SurfacePoint, w_i: mi.Vector3f) -> mi.Float:
        return cosine_density(entry.n_out, entry.n, w_i)


class ObjectAlbedo(Protocol):
    """The directional albedo of an object under uniform illumination, alpha = ∫ S mu_i dw_i dA_i.
    `known`: two spectra, 1 in the channels where it may stand for uniform light: of orders below two, and of S."""

    known: tuple[mi.Spectrum, mi.Spectrum]

    def __call__(self, at: SurfacePoint, active: mi.Bool) -> tuple[mi.Spectrum, mi.Spectrum]:
        """The directional albedos of orders below two and of S at an exit, per channel; 0 where they are not known."""


class Transport(Protocol):
    """S of one object, for any exit and entry. `orders`: "multiple" (two or more scattering events) or "total".
    `checksums`: of what it has learnt, which are part of a render's identity; empty where nothing is. `alpha`: its
    directional albedo, the control variate of an even sky; None where it is not known. `is_delta`: whether light leaves
    where it enters, so that S has no value for two points."""

    orders: str
    checksums: tuple[str, ...] = ()
    alpha: ObjectAlbedo | None = None
    is_delta: bool = False

    def prepare(self, at: SurfacePoint, active: mi.Bool = True) -> Any:
        """Prepare an exit once for all its entries; the result, by default the exit, is handed to `S`."""
        return at

    def S(self, exit: Any, at: SurfacePoint, active: mi.Bool = True) -> mi.Spectrum:
        """S(x_i, w_i; x_o, w_o) per channel, 1/((scene unit)² sr); 0 below the horizons.
        `exit`: from `prepare`. `at`: entry, with w_i."""

    def paint(self, at: SurfacePoint) -> mi.Spectrum:
        """The reflectance of the half-space of the medium at an exit; only of objects with textures."""


@dataclass(frozen=True, eq=False)
class TransportAround:
    """A transport that wraps another one and takes its properties."""

    transport: Transport
    is_delta = False

    @property
    def orders(self) -> str:
        return self.transport.orders

    @property
    def checksums(self) -> tuple[str, ...]:
        return self.transport.checksums

    @property
    def alpha(self) -> ObjectAlbedo | None:
        return self.transport.alpha


class ObjectModel(NamedTuple):
    """The model of an object: a transport, the proposals that suit it, and how many entries an exit draws."""

    transport: Transport | None
    proposals: Proposals | None
    entries: int = 1


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
    """Points of entry of one object. `table`: radial density about the exit. `points`: uniform points of the object.
    `area_share`: share s of the candidates that are uniform over the area: s/(1 - s) of them, rounded up, beside a
    probe; with 1 there are no probes."""

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
        return int(self.area_share < 1)

    def _side(self, out: SurfacePoint, prim_index: mi.UInt32, active: mi.Bool) -> mi.Float:
        """The sign that turns the normal of a face outwards, or that of a sheet to the side of the exit."""
        return self.geometry.side(prim_index, active) if self.geometry.closed else out.sign

    def density(
        self, p: mi.Point3f, n: mi.Normal3f, face: mi.UInt32, out: SurfacePoint, axes: tuple[mi.Vector3f, ...]
    ) -> mi.Float:
        """Density of candidates over the surface at p with normal n, for each that is drawn, 1/(scene unit)²."""
        return self._candidates(p, n, self.points.brightness(face), out, axes) * opaque(
            1 / (self.probes + self.area_points)
        )

    def _candidates(
        self, p: mi.Point3f, n: mi.Normal3f, b: mi.Float, out: SurfacePoint, axes: tuple[mi.Vector3f, ...]
    ) -> mi.Float:
        """c = D + m b/A, 1/(scene unit)²."""
        uniform = b * opaque(self.area_points / self.geometry.area if self.area_points else 0.0)
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
        kept = _Kept(u_choice, mi.Float(0), mi.Point3f(0), mi.Normal3f(0, 0, 1), mi.Normal3f(0, 0, 1), mi.UInt32(0))
        if self.probes:
            kept = self._hits(self._probe(out, axes, u_axis, u_length, u), out, axes, piece, kept, active)
        if self.area_points:
            kept = self._uniform(out, axes, piece, u_face, u, kept, active)
        total, p = kept.total, self.table.pdf(dr.norm(kept.p - out.p)) * self.points.brightness(kept.face)
        weight = dr.select(total > 0, total / dr.maximum(p, 1e-30), 0)
        return EntrySample(kept.p, turned(kept.n, kept.n_out), kept.n_out, weight, kept.face)

    def _reach(self, across: mi.Float) -> mi.Float:
        return REACH * across + opaque(LEAST_REACH * self.geometry.size + NEAR * self.table.mean)

    def _probe(
        self, out: SurfacePoint, axes: tuple[mi.Vector3f, ...], u_axis: mi.Float, u_length: mi.Float, u: mi.Point2f
    ) -> mi.Ray3f:
        n, s, t = axes
        to_n, to_s = u_axis < NORMAL_SHARE, u_axis < 0.5 * (1 + NORMAL_SHARE)
        along = dr.select(to_n, n, dr.select(to_s, s, t))
        first = dr.select(to_n, s, dr.select(to_s, t, n))
        second = dr.select(to_n, t, dr.select(to_s, n, s))
        sin_phi, cos_phi = dr.sincos(2 * dr.pi * u.y)
        r = self.table.sample(u.x)
        reach = dr.select(u_length < LONG_SHARE, opaque(1.01 * self.geometry.size), self._reach(r))
        start = out.p + (first * cos_phi + second * sin_phi) * r - along * reach
        ray = mi.Ray3f(mi.Point3f(start), mi.Vector3f(along))
        ray.maxt = 2 * reach
        return ray

    def _offer(
        self, kept: _Kept, at: tuple, out: SurfacePoint, axes: tuple[mi.Vector3f, ...], active: mi.Bool
    ) -> _Kept:
        """Take a candidate (point, normal, outward shading normal, face) instead with the probability h / sum of h."""
        p, n, n_out, face = at
        b = self.points.brightness(face)
        c = self._candidates(p, n, b, out, axes)  # weight: target b p over density c
        weight = dr.select(active & (c > 0), b * self.table.pdf(dr.norm(p - out.p)) / dr.maximum(c, 1e-30), 0)
        total = kept.total + weight
        share = dr.select(total > 0, weight / total, 0)
        take = (kept.u < share) & (weight > 0)
        u = dr.select(take, kept.u / dr.maximum(share, 1e-20), (kept.u - share) / dr.maximum(1 - share, 1e-7))
        result = (dr.select(take, a, b) for a, b in zip((p, n, n_out, face), kept[2:]))
        return _Kept(dr.clip(u, 0, 1), total, *result)

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

        def step(ray: mi.Ray3f, left: mi.UInt32, kept: tuple, active: mi.Bool) -> tuple:
            si = self.geometry.ray_intersect(ray, mi.RayFlags.Minimal | mi.RayFlags.ShadingFrame, False, active)
            active &= si.is_valid() & (left > 0)
            same = self.geometry.piece(si.prim_index, active) == piece
            side = self._side(out, si.prim_index, active & same)
            at = (si.p, si.n, turned(si.sh_frame.n, si.n) * side, si.prim_index)
            kept = self._offer(_Kept(*kept), at, out, axes, active & same)
            onward = ray_from(si, ray.d, self.geometry.clearance)
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
        m, inverse = opaque(float(self.area_points)), opaque(1 / self.area_points)

        def step(k: mi.UInt32, kept: tuple) -> tuple:
            v = mi.Point2f(*(wrapped(x + k * ratio) for x, ratio in zip((u.x, u.y), LATTICE)))
            at = self.points.sample(wrapped(u_face + k * inverse), v, active)
            same = self.geometry.piece(at.prim_index, active) == piece
            side = self._side(out, at.prim_index, active & same)
            point = (at.p, at.n, turned(at.n_shading, at.n) * side, at.prim_index)
            return k + 1, tuple(self._offer(_Kept(*kept), point, out, axes, active & same))

        state = (mi.Float(0), tuple(kept))
        return _Kept(*dr.while_loop(state, lambda k, kept: active & (k < m), step, label="area points")[1])


class _Kept(NamedTuple):
    """The candidate that is kept: uniform number left, sum of h so far, point, normals, face."""

    u: mi.Float
    total: mi.Float
    p: mi.Point3f
    n: mi.Normal3f
    n_out: mi.Normal3f
    face: mi.UInt32


def wrapped(u: mi.Float) -> mi.Float:
    """u modulo one, below one."""
    return dr.minimum(u - dr.floor(u), 1 - 2**-24)


# --------------------------------------------------------------------------------------------------
# Points uniform over the area of an object, with its geometric and its shading normal.


class Point(NamedTuple):
    """Position, geometric normal, shading normal (as the shape has them) and face of a point."""

    p: mi.Point3f
    n: mi.Normal3f
    n_shading: mi.Normal3f
    prim_index: mi.UInt32

    def outward(self, sign: mi.Float | float) -> tuple[mi.Normal3f, mi.Normal3f]:
        """Geometric and shading normal on the outer side, by the sign that turns the former there."""
        return mi.Normal3f(self.n * sign), mi.Normal3f(turned(self.n_shading, self.n) * sign)


class AreaPoints:
    """Uniform points of a shape; for a mesh by its faces, as Mitsuba gives one of the two normals only."""

    def __init__(self, shape: mi.Shape) -> None:
        self.shape = shape
        self.faces: mi.DiscreteDistribution | None = None
        self.centre: np.ndarray | None = None
        self.light: mi.Float | None = None
        self.areas: np.ndarray | None = None
        if shape.class_name() == "Sphere":  # Mitsuba's normals of sampled points are wrong where it is mirrored
            self.centre = np.array(mi.traverse(shape)["to_world"].matrix, dtype=np.float64).reshape(4, 4)[:3, 3]
        if mesh.has_faces(shape):
            a, b, c = mesh.face_corners(shape, np.float32)
            self.areas = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)
            self.faces = mi.DiscreteDistribution(floats(self.areas))

    def lit(self, brightness: np.ndarray) -> AreaPoints:
        """Points of a mesh by the brightness of its faces, positive numbers."""
        result = copy(self)
        brightness = brightness * (self.areas.sum() / (self.areas * brightness).sum())
        result.light = floats(brightness)
        result.faces = mi.DiscreteDistribution(floats(self.areas * brightness))
        return result

    def brightness(self, face: mi.UInt32) -> mi.Float | float:
        """Density of points over that of uniform ones, on a face."""
        return 1.0 if self.light is None else dr.gather(mi.Float, self.light, face)

    def sample(self, u_face: mi.Float, u: mi.Point2f, active: mi.Bool) -> Point:
        """A point for uniform numbers u_face and the pair u."""
        if self.faces is None:
            ps = self.shape.sample_position(0.0, u, active)
            n = ps.n if self.centre is None else self._radial(ps.p)
            return Point(ps.p, n, n, mi.UInt32(0))
        return self.on_face(self.faces.sample(u_face, active), u, active)

    def _radial(self, p: mi.Point3f) -> mi.Normal3f:
        n = dr.normalize(p - mi.Point3f(*(opaque(c) for c in self.centre)))
        return mi.Normal3f(-n if mesh.is_flipped(self.shape) else n)

    def on_face(self, face: mi.UInt32, u: mi.Point2f, active: mi.Bool = True) -> Point:
        """A uniform point of a face of a mesh."""
        vertices = mesh.vertices_of(self.shape, face, active)
        corners = mesh.positions_at(self.shape, vertices, active)
        b = mi.warp.square_to_uniform_triangle(u)
        weights = (1 - b.x - b.y, b.x, b.y)
        n = dr.normalize(dr.cross(corners[1] - corners[0], corners[2] - corners[0]))
        n = -n if mesh.is_flipped(self.shape) else n
        n_shading = n
        if self.shape.has_vertex_normals():
            normals = mesh.normals_at(self.shape, vertices, active)
            n_shading = dr.normalize(sum(w * v for w, v in zip(weights, normals)))
        p = sum(w * c for w, c in zip(weights, corners))
        return Point(mi.Point3f(p), mi.Normal3f(n), mi.Normal3f(n_shading), face)


_AREA_POINTS: WeakKeyDictionary[Geometry, AreaPoints] = WeakKeyDictionary()


def area_points(geometry: Geometry) -> AreaPoints:
    """Uniform points of an object: made once, as areas of faces wait for all kernels and are summed by NumPy."""
    if geometry not in _AREA_POINTS:
        _AREA_POINTS[geometry] = AreaPoints(geometry.shape)
    return _AREA_POINTS[geometry]


# --------------------------------------------------------------------------------------------------
# A radial density about the exit for rendering: one table for all channels of a model, covering the whole object.


N_CELLS = 512
FLOOR = 1e-3  # share of the probability that is spread evenly over log r, so that no point is out of reach
SHORTEST = 1e-4  # mean free paths of the densest channel; the first cell reaches from 0 to there


class RadialTable:
    """Mixture over the channels of the models' `pdf_position`, piecewise constant in r over cells even in log r.
    `models`: one scalar model per channel, in scene units. `reach`: largest distance, scene units."""

    def __init__(self, models: list[BSSRDF], reach: float) -> None:
        densest = max(float(m.medium.sigma_t) for m in models)
        r_min = min(SHORTEST / densest, 1e-3 * reach)
        edges = np.concatenate([[0.0], np.geomspace(r_min, reach, N_CELLS)])
        middle = np.concatenate([[0.5 * r_min], np.sqrt(edges[1:-1] * edges[2:])])
        density = sum(np.asarray(m.pdf_position(middle, 0.0, 0.9)) for m in models)
        mass = density * middle * np.diff(edges)
        mass /= max(mass.sum(), 1e-300)
        probability = (1 - FLOOR) * mass + FLOOR / N_CELLS
        probability /= probability.sum()
        self.mean = float(np.sum(probability * middle))
        tables = (np.cumsum(probability), probability, edges, probability / (2 * math.pi * np.diff(edges)))
        numbers = (opaque(v) for v in (r_min, (N_CELLS - 1) / math.log(reach / r_min), reach))
        self._arrays = (*map(floats, tables), *numbers)
        dr.eval(self._arrays)

    def sample(self, u: mi.Float) -> mi.Float:
        """Distance r for uniform u in [0, 1)."""
        cdf, probability, edges, *_ = self._arrays
        k = dr.binary_search(0, N_CELLS - 1, lambda i: dr.gather(mi.Float, cdf, i) <= u)
        share = 1 - (dr.gather(mi.Float, cdf, k) - u) / dr.gather(mi.Float, probability, k)
        low, high = dr.gather(mi.Float, edges, k), dr.gather(mi.Float, edges, k + 1)
        return dr.lerp(low, high, dr.clip(share, 0, 1))

    def pdf(self, r: mi.Float) -> mi.Float:
        """Density over the plane at distance r, 1/(scene unit)²; 0 beyond the reach."""
        *_, times_r, r_min, per_log, reach = self._arrays
        steps = dr.log(dr.maximum(r, r_min) / r_min) * per_log
        k = dr.select(r < r_min, 0, dr.minimum(mi.UInt32(steps) + 1, N_CELLS - 1))
        density = dr.gather(mi.Float, times_r, k) / dr.maximum(r, 1e-3 * r_min)
        return dr.select(r < reach, density, 0)
