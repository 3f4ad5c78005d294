"""Points of a surface with a direction, the query of the half-space for a pair of them, and transports between them."""

from __future__ import annotations

from typing import Any, NamedTuple, Protocol

import drjit as dr
import mitsuba as mi

__all__ = [
    "CosineProposals",
    "ObjectAlbedo",
    "EntrySample",
    "Frame",
    "ObjectModel",
    "Proposals",
    "SurfacePoint",
    "Transport",
    "channel_mean",
    "cosine_above",
    "cosine_density",
    "lift",
    "lifted",
    "local_frame",
    "mirrored",
    "number",
    "opposed",
    "place",
    "plane_query",
    "separation",
    "sided",
    "turned",
]


class SurfacePoint(NamedTuple):
    """A point of a surface and a direction outside, which points away from it: an exit with w_o or an entry with w_i.

    Args:
        p: position.
        n: outward geometric normal.
        n_out: outward shading normal, as w sees it: see `lifted`.
        w: direction.
        sign: that turns geometric normals of the shape outwards.
    """

    p: mi.Point3f
    n: mi.Normal3f
    n_out: mi.Normal3f
    w: mi.Vector3f
    sign: mi.Float | float = 1.0

    @property
    def mu(self) -> mi.Float:
        """The cosine of w to the shading normal; 0 below the surface."""
        return dr.select(dr.dot(self.w, self.n) > 0, dr.maximum(dr.dot(self.w, self.n_out), 0), 0)

    def gather(self, k: mi.UInt32) -> SurfacePoint:
        """The points of the lanes k."""
        return SurfacePoint(*(v if isinstance(v, float) else dr.gather(type(v), v, k) for v in self))


class Frame(NamedTuple):
    """Tangents and normal at a point; `t` follows x_i -> x_o."""

    t: Any
    b: Any
    n: Any

    def azimuth(self, w: mi.Vector3f) -> Any:
        """Azimuth of w about the normal from t, radians."""

        return dr.atan2(dr.dot(w, self.b), dr.dot(w, self.t))

    def direction(self, mu: mi.Float, phi: mi.Float) -> Any:
        """The unit vector with cosine mu and azimuth phi."""

        sine, (s, c) = dr.safe_sqrt((1 - mu) * (1 + mu)), dr.sincos(phi)
        return self.t * (sine * c) + self.b * (sine * s) + self.n * mu


def number(value: float) -> Any:
    """A number of a scene as data of a kernel, which then serves other materials and sizes too."""

    return dr.opaque(mi.Float, float(value))


def channel_mean(value: Any) -> Any:
    """Mean over the channels of a colour.

    By `drjit.mean` the number of lanes is part of a kernel, which is then compiled anew for every size of an image.
    """
    return dr.sum(value) / len(value)


def place(p: mi.Point3f, n: mi.Normal3f) -> Any:
    """A point with its geometric normal, from which rays start clear of the surface."""

    found = dr.zeros(mi.Interaction3f)
    found.p, found.n = mi.Point3f(p), mi.Normal3f(n)
    return found


def local_frame(n: mi.Normal3f, d: mi.Vector3f) -> Frame:
    """The frame of normal n whose first axis is d = x_o - x_i without its normal part; any axis where that is 0."""

    flat = d - n * dr.dot(n, d)
    length2 = dr.squared_norm(flat)
    spare, _ = mi.coordinate_system(n)
    t = dr.select(length2 > 1e-12 * dr.squared_norm(d), flat * dr.rsqrt(dr.maximum(length2, 1e-30)), spare)
    t = dr.normalize(t - n * dr.dot(n, t))
    return Frame(t, dr.cross(n, t), n)


def separation(p_i: mi.Point3f, n_i: mi.Normal3f, p_o: mi.Point3f, n_o: mi.Normal3f, geometry: str) -> Any:
    """Distance r of the half-space query, in scene units.

    "distance" takes |d|, d = x_o - x_i. "tangent" takes sqrt(d² - c (d.n)²), n along n_i + n_o and c = max(n_i.n_o, 0):
    the length of d in the common tangent plane where the normals are parallel, |d| where they are at right angles or
    turn away from each other, as on the two sides of something thin.
    """

    d = p_o - p_i
    if geometry == "distance":
        return dr.norm(d)
    middle = n_i + n_o
    along = dr.square(dr.dot(d, middle)) / dr.maximum(dr.squared_norm(middle), 1e-12)
    return dr.sqrt(dr.maximum(dr.squared_norm(d) - dr.maximum(dr.dot(n_i, n_o), 0) * along, 0))


def plane_query(at: SurfacePoint, out: SurfacePoint, geometry: str) -> tuple[mi.Float, ...]:
    """(r, mu_i, phi_i, mu_o, phi_o) of the half-space for light that enters at `at` and leaves at `out`.

    r as in `separation`; each direction is taken against the normal of its own point, its azimuth from x_i -> x_o
    projected there. Cosines below the horizon come out as 0, at which every model is 0.
    """

    d = out.p - at.p
    frame_i, frame_o = local_frame(at.n_out, d), local_frame(out.n_out, d)
    mu_i, mu_o = (dr.clip(dr.dot(point.w, point.n_out), 0, 1) for point in (at, out))
    r = separation(at.p, at.n_out, out.p, out.n_out, geometry)
    return r, mu_i, frame_i.azimuth(at.w), mu_o, frame_o.azimuth(out.w)


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


def turned(n_shading: mi.Normal3f, n: mi.Normal3f) -> Any:
    """The shading normal on the side of the geometric one: vertex normals need not agree with the winding of a face."""

    return dr.select(dr.dot(n_shading, n) < 0, -n_shading, n_shading)


def lifted(m: mi.Normal3f, n: mi.Normal3f, w: mi.Vector3f) -> Any:
    """The interpolated normal m that w sees, on the side of w that the geometric normal n is on."""
    c = dr.dot(m, w)
    return mi.Normal3f(dr.select(c * dr.dot(n, w) < 0, m - 2 * c * w, m))


def lift(si: mi.SurfaceInteraction3f, w: mi.Vector3f, active: mi.Bool = True) -> Any:
    """The interaction with the frame that w sees, a direction in the world that becomes its `wi`."""
    c = dr.dot(si.sh_frame.n, w)
    below = active & (c * dr.dot(si.n, w) < 0)
    frame = mi.Frame3f(dr.select(below, si.sh_frame.n - 2 * c * w, si.sh_frame.n))
    si.sh_frame = dr.select(below, frame, si.sh_frame)
    si.wi = dr.select(below, frame.to_local(w), si.wi)
    return si


def opposed(w: mi.Vector3f, n: mi.Normal3f) -> Any:
    """w, or -w where that is the one above the surface of the normal n."""
    return dr.select(dr.dot(w, n) < 0, -w, w)


def mirrored(w: mi.Vector3f, n: mi.Normal3f) -> Any:
    """w, mirrored at the surface of the normal n where it is below."""
    return w - n * (2 * dr.minimum(dr.dot(w, n), 0))


def sided(si: mi.SurfaceInteraction3f, wo: mi.Vector3f) -> tuple[Any, Any]:
    """A direction of a boundary in the world, on the side of the surface that it has in the frame; if it was turned."""
    d = si.to_world(wo)
    side = dr.select(wo.z > 0, 1.0, -1.0)
    n = si.n * side
    wrong = dr.dot(d, n) < 0
    reflects = wo.z * mi.Frame3f.cos_theta(si.wi) > 0
    return mi.Vector3f(dr.select(wrong, dr.select(reflects, mirrored(d, n), -d), d)), wrong & reflects


def cosine_above(m: mi.Normal3f, n: mi.Normal3f, u: mi.Point2f) -> tuple[Any, Any]:
    """A direction above the surface by the cosine to m, for a pair of uniforms, and its density |m.w| / pi."""
    w = opposed(mi.Frame3f(m).to_world(mi.warp.square_to_cosine_hemisphere(u)), n)
    return mi.Vector3f(w), cosine_density(m, n, w)


def cosine_density(m: mi.Normal3f, n: mi.Normal3f, w: mi.Vector3f) -> Any:
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
    """

    p: mi.Point3f
    n: mi.Normal3f
    n_out: mi.Normal3f
    weight: mi.Float
    face: mi.UInt32

    def facing(self, w: mi.Vector3f) -> SurfacePoint:
        """The entry with light from w, with the shading normal that w sees."""
        return SurfacePoint(self.p, self.n, lifted(self.n_out, self.n, w), w)


class Proposals(Protocol):
    """Where light that leaves at an exit may have entered."""

    def prepare(self, out: SurfacePoint, prepared: Any, active: mi.Bool) -> Any:
        """What is done once for all entries of an exit; `prepared` is what the transport has made of it."""

    def sample(
        self, out: SurfacePoint, prim_index: mi.UInt32, prepared: Any, sampler: mi.Sampler, active: mi.Bool
    ) -> EntrySample:
        """A point of entry; its weight is the inverse of the density of such points over the surface, (scene unit)²."""

    def sample_direction(self, entry: EntrySample, out: SurfacePoint, u: mi.Point2f) -> tuple[Any, Any]:
        """A direction w_i that points away from the surface at the entry, for a pair of uniforms, and its density.

        The density is over solid angle, 1/sr.
        """

    def pdf_direction(self, entry: EntrySample, out: SurfacePoint, w_i: mi.Vector3f) -> Any:
        """The density of `sample_direction`, 1/sr; 0 below the surface."""


class CosineProposals(Proposals, Protocol):
    """Proposals whose directions are by the cosine to the interpolated normal, above the surface."""

    def sample_direction(self, entry: EntrySample, out: SurfacePoint, u: mi.Point2f) -> tuple[Any, Any]:
        return cosine_above(entry.n_out, entry.n, u)

    def pdf_direction(self, entry: EntrySample, out: SurfacePoint, w_i: mi.Vector3f) -> Any:
        return cosine_density(entry.n_out, entry.n, w_i)


class ObjectAlbedo(Protocol):
    """The directional albedo of an object under uniform illumination, alpha = ∫ S mu_i dw_i dA_i.

    Attributes:
        known: two spectra, 1 in the channels where it may stand for even light: of orders below two, and of S.
    """

    known: tuple[mi.Spectrum, mi.Spectrum]

    def __call__(self, at: SurfacePoint, active: mi.Bool) -> tuple[mi.Spectrum, mi.Spectrum]:
        """Of orders below two and of S at an exit, per channel; 0 where it is not known."""


class Transport(Protocol):
    """S of one object, for any exit and entry.

    Attributes:
        orders: "multiple" (two or more scattering events) or "total".
        checksums: of what it has learnt, which are part of a render's identity; empty where nothing is.
        alpha: its directional albedo, the control variate of an even sky; None where it is not known.
        is_delta: whether light leaves where it enters, so that S has no value for two points.
    """

    orders: str
    checksums: tuple[str, ...]
    alpha: ObjectAlbedo | None
    is_delta: bool

    def prepare(self, at: SurfacePoint, active: mi.Bool = True) -> Any:
        """What is done once for all entries of an exit, handed to `S` as it is."""

    def S(self, exit: Any, at: SurfacePoint, active: mi.Bool = True) -> mi.Spectrum:
        """S(x_i, w_i; x_o, w_o) per channel, 1/((scene unit)² sr); 0 below the horizons.

        Args:
            exit: from `prepare`.
            at: entry, with w_i.
            active: mask of lanes.
        """


class ObjectModel(NamedTuple):
    """What renders an object inside: a transport, the proposals that suit it, and how many entries an exit draws."""

    transport: Transport | None
    proposals: Proposals | None
    entries: int = 1
