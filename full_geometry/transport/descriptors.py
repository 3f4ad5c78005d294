"""Inputs of the network of all shapes for a pair of points, free of place, turn and scale.

Light that is mixed in what is thin, lines between two points, what rays measure around an end, and the descriptors.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np

from full_geometry.geometry.points import SurfacePoint, floats, local_frame, opaque, refract_in
from full_geometry.objects.objects import TranslucentObject
from full_geometry.transport.features import FirstEvent, first_event
from halfspace_sss.neural.network import medium_features
from halfspace_sss.physics.backbone import length_scale
from halfspace_sss.physics.medium import Medium
from halfspace_sss.tracing.walk import generator, pass_seed

# ----------------------------------------------------------------------------------------------------
# Light that has forgotten where it entered: what an object holds as a whole, where it is thin and reflects inside.
# The chance that light which was scattered leaves without another event is exactly, by reciprocity, the mean over the
# surface of what enters and is scattered, over the mean chord c = 4 V/A:
#
#     1 - q = <F_t P> / (sigma_t c eta²).
#
# q_d of it before the boundary, by the same with eta = 1. Light of two events that met the boundary between them, and
# light of three events and more, if after the second it forgets where it is, as in the reduced medium (sigma_t', a',
# g = 0), of which <F_t P'> is scattered, k = <F_t P'>/<F_t P>, is spread evenly:
#
#     S_mixed = F_t(w_o) P_o F_t(w_i) P_i M,
#     M = [a² (q - q_d)/sigma_t + a q k² a'² q'/(1 - a' q')/sigma_t'] / (4 pi V eta²).
#
# It holds in what is thin and flat or rugged; in a smooth ball it is up to twice too much, as light that entered does
# not reach what is held near the surface. M is divided by 1 + (sigma_t' c)², as light of thick objects leaves near
# where it entered. m_2 = a²/(4 pi eta)² is that of light of two events, see `Backbone`.

POINTS, SEED = 2**15, 31
LEAST_ESCAPE = 1e-6


class Mixed(NamedTuple):
    """Those of a channel: M, 1/(scene unit)²; m_2; the mean chord in transport mean free paths; q, q', q_d and k."""

    M: float
    m_2: float
    chord: float
    q: float
    q_reduced: float
    q_direct: float
    k: float


def mean_chord(obj: TranslucentObject) -> float:
    """4 V/A, V from the mean of x.n over random points of the surface; <= 0 where it is open or inside out."""
    at = obj.random_points(generator(mi, POINTS, pass_seed(SEED)))
    x, n = (np.array(v, dtype=float) for v in (at.p, at.n))
    x -= x.mean(axis=1, keepdims=True)
    return float(4 / 3 * (x * n).sum(axis=0).mean())


def mixed(obj: TranslucentObject) -> list[Mixed]:
    """What each channel mixes; M and m_2 are 0 where there is no scattering or no volume."""
    at = obj.random_points(generator(mi, POINTS, pass_seed(SEED)))
    entering, chord = refract_in(at, obj.eta)[1], max(mean_chord(obj), 0.0)
    isotropic = tuple(Medium(float(m.sigma_s) * (1 - float(m.g)), float(m.sigma_a), 0.0, m.eta) for m in obj.media)
    kinds = [obj.media, isotropic, tuple(Medium(m.sigma_s, m.sigma_a, m.g, 1.0) for m in obj.media)]
    P = [first_event(replace(obj, media=media), at).P for media in kinds]
    through = [entering, entering, 1.0]
    scattered = [[float(np.mean((F_t * p).numpy())) for p in each] for F_t, each in zip(through, P)]
    return [_of(obj, media, parts, chord) for media, parts in zip(zip(*kinds), zip(*scattered))]


def _of(obj: TranslucentObject, media: Sequence[Medium], scattered: Sequence[float], chord: float) -> Mixed:
    m, reduced, _ = media
    thickness, a = float(reduced.sigma_t) * chord, float(m.albedo)
    if not (thickness > 0 and a > 0 and scattered[0] > 0):
        return Mixed(0.0, 0.0, thickness, 0.0, 0.0, 0.0, 1.0)
    q, q_reduced, q_direct = (_stays(medium, chord, part) for medium, part in zip(media, scattered))
    a_reduced, k, thin = float(reduced.albedo), scattered[1] / scattered[0], 1 / (1 + thickness**2)
    M = a**2 * max(q - q_direct, 0.0) / float(m.sigma_t)
    M += a * q * k**2 * a_reduced**2 * q_reduced / (1 - a_reduced * q_reduced) / float(reduced.sigma_t)
    M /= math.pi * obj.geometry.area * chord * m.eta**2  # 4 V = c A
    return Mixed(M * thin, (a / (4 * math.pi * m.eta)) ** 2, thickness, q, q_reduced, q_direct, k)


def _stays(m: Medium, chord: float, scattered: float) -> float:
    """q of a medium."""
    escapes = scattered / (float(m.sigma_t) * chord * m.eta**2)
    return 1 - min(max(escapes, LEAST_ESCAPE), 1.0)


# ---- Lines between two points, and where light would go if the surface between them were a plane ---

LEAST_R = 1e-9
LEAST_PHASE = 1e-4


class Segment(NamedTuple):
    """From one point to another: direction, length."""

    d: mi.Vector3f
    length: mi.Float

    @classmethod
    def between(cls, a: mi.Point3f, b: mi.Point3f) -> Segment:
        way = b - a
        length = dr.norm(way)
        return cls(way / dr.maximum(length, LEAST_R), length)

    @property
    def back(self) -> Segment:
        return Segment(-self.d, self.length)


def on_a_plane(
    n_o: mi.Normal3f, inner_o: mi.Vector3f, n_i: mi.Normal3f, inner_i: mi.Vector3f, line: Segment
) -> tuple[mi.Vector3f, mi.Vector3f]:
    """The refracted directions as on a plane, x along the line between the points, z along the normals.
    There both y lie a mean free path along them."""

    def inside(n: mi.Normal3f, along: mi.Vector3f) -> mi.Vector3f:
        flat = mi.Vector3f(line.d - n * dr.dot(n, line.d))
        spare = mi.coordinate_system(n)[0]
        t = dr.normalize(dr.select(dr.squared_norm(flat) > 1e-12, flat, spare))
        return mi.Vector3f(dr.dot(along, t), dr.dot(along, dr.cross(n, t)), dr.dot(along, n))

    return inside(n_o, inner_o), inside(n_i, inner_i)


def phases(g: float, d_o: mi.Vector3f, d_i: mi.Vector3f, d: mi.Vector3f) -> mi.Float:
    """Both phase functions of light that goes along d from one end to the other, times (4 pi)²."""
    a, b = opaque(1 + g * g), opaque(2 * g)
    c_o, c_i = dr.dot(d_o, d), -dr.dot(d_i, d)
    base = dr.maximum(a - b * c_o, LEAST_PHASE) * dr.maximum(a - b * c_i, LEAST_PHASE)
    return opaque((1 - g * g) ** 2) / (base * dr.sqrt(base))


# ----------------------------------------------------------------------------------------------------
# What a point inside an object sees of its surface: rays in fixed directions, against what they would see on a plane.
# From y, the mean place of the first event, at the depth z below x, the way d_j to the surface is measured along N
# directions omega_j, uniform in solid angle and turned with n and w, so that they follow the object when it is moved.
# For lengths l_k, a mean free path and multiples of a transport mean free path, with c_j the chance 1 - exp(-d_j/l_k)
# that something happens on the way, and c'_j that on the way z/(omega_j.n) to a plane (1 downwards),
#
#     L_k = log[(mean_j c_j + e)/(mean_j c'_j + e)] / 2,
#     V_k = mean_j omega_j c'_j / (mean_j c'_j + e) - the same of c.
#
# Both are 0 on a half-space, and tell thin from thinner however thin it is. A mesh is looked at by rays only, so its
# resolution does not count.

RAYS = 8
LENGTHS = (2.0, 8.0, 32.0)  # transport mean free paths
N_LENGTHS = 1 + len(LENGTHS)
LEAST_CHANCE = 1e-4  # e
FAR = 1e30


class RaySurroundings(NamedTuple):
    """L and V for each length, and the depth z in scene units."""

    L: list[mi.Float]
    V: list[mi.Vector3f]
    depth: mi.Float


def directions(n: int = RAYS) -> np.ndarray:
    """n directions over the sphere, uniform in solid angle, (3, n)."""
    k = np.arange(n)
    z, phi = 1 - 2 * (k + 0.5) / n, math.pi * (3 - math.sqrt(5)) * k + 0.3
    s = np.sqrt(1 - z * z)
    return np.stack([s * np.cos(phi), s * np.sin(phi), z])


def look(obj: TranslucentObject, at: SurfacePoint, event: FirstEvent, active: mi.Bool = True) -> list[RaySurroundings]:
    """Surroundings of the first events of each channel; channels of the same extinction share them.
    `at`: points of its surface, with the directions outside that light goes along. `event`: their first events."""
    known: dict[tuple[float, float], RaySurroundings] = {}
    for m, y in zip(obj.media, event.ys):
        key = float(m.sigma_t), float(m.sigma_t_prime)
        if key not in known:
            known[key] = _from(obj, at, y, key, active)
    return [known[float(m.sigma_t), float(m.sigma_t_prime)] for m in obj.media]


def _from(
    obj: TranslucentObject, at: SurfacePoint, y: mi.Point3f, extinctions: tuple[float, float], active: mi.Bool
) -> RaySurroundings:
    """Surroundings of the points y below the points of a surface, for sigma_t and sigma_t'."""
    tables = [floats(row) for row in directions()]
    sigma_t, sigma_t_prime = extinctions
    decays = [opaque(v) for v in (sigma_t, *(sigma_t_prime / length for length in LENGTHS))]
    t, b, n = local_frame(at.n_out, at.w)
    depth = dr.maximum(dr.dot(at.p - y, n), 0)

    def step(j: mi.UInt32, *sums: list) -> tuple:
        u, v, w = (dr.gather(mi.Float, table, j) for table in tables)
        d = mi.Vector3f(t * u + b * v + n * w)
        hit = obj.geometry.scene.ray_intersect_preliminary(mi.Ray3f(y, d), False, active)
        ways = dr.select(hit.is_valid(), hit.t, FAR), dr.select(w > 0, depth / dr.maximum(w, 1e-6), FAR)
        c, c_plane = ([1 - dr.exp(-way * decay) for decay in decays] for way in ways)
        new = c, c_plane, [d * v for v in c], [d * v for v in c_plane]
        return j + 1, *([a + b for a, b in zip(old, added)] for old, added in zip(sums, new))

    state = (mi.UInt32(0), *([kind(0) for _ in decays] for kind in (mi.Float, mi.Float, mi.Vector3f, mi.Vector3f)))
    _, *sums = dr.while_loop(state, lambda j, *_: j < RAYS, step, label="surroundings")
    C, C_plane, M, M_plane = ([v / RAYS for v in each] for each in sums)
    L = [0.5 * dr.log((a + LEAST_CHANCE) / (b + LEAST_CHANCE)) for a, b in zip(C, C_plane)]
    V = [m_p / (b + LEAST_CHANCE) - m / (a + LEAST_CHANCE) for a, b, m, m_p in zip(C, C_plane, M, M_plane)]
    return RaySurroundings(L, V, depth)


# ----------------------------------------------------------------------------------------------------
# What the network is told of a pair of points: the medium, the pair as on a plane, and how far it is from a plane.
# For a channel with l' = 1/sigma_t' and each end of the pair (exit and entry; d is the direction to the other end, e
# that from y to the other y; L_k and V_k are those of `RaySurroundings`):
#
#     own:     mu, mu', w.d, w.n of the other end, refracted w.e, log of the depth of y in mean free paths;
#              log P, log of the way to y in mean free paths, n.d, n.e, L_k, -V_k.n, V_k.e
#     shared:  log r/l', log of |y_i - y_o|/l' as it would be on a plane, w_o.w_i, r/(r + l'), the refracted w_o.w_i,
#              log of a phase function of g² between the two;
#              1 - n_o.n_i, log of |y_i - y_o| over that of a plane, whether the line y_o y_i leaves the object, the
#              length that it is outside for, l/(l + l'), log of the phase functions at y_o and y_i for light between
#              the two, over those of a plane, within 1/4 and 4, exp(-sigma_t |y_i - y_o|) less that of a plane, and
#              the shares of S_0 that are mixed and scattered twice
#     medium:  nine functions of albedo, g and eta, two of sigma_t' sqrt(area), five of `Mixed`
#
# What stands behind a semicolon, own numbers summed over both ends, is 0 on a plane. All are free of scale, place and
# turn, and exchanged with the ends.

N_LOOK = 3 * N_LENGTHS
CURVED_OWN, CURVED_SHARED = slice(6, 10 + N_LOOK), slice(6, 14)  # which are 0 on a plane
N_OWN, N_SHARED, N_MEDIUM = 10 + N_LOOK, 14, 16
ALONE = [0, 1, 5, 6, 7, *range(10, 10 + 2 * N_LENGTHS)]  # own numbers that do not depend on the other end
LEAST_P, LEAST_LENGTH = 1e-3, 1e-2
MOST_G = 0.85  # of a phase function of g²
MOST_RATIO = 4.0  # of phase functions: what is not bounded runs away outside of what was seen
GRAZES = 0.999  # of the line between two points, from which on nothing is in between


class End(NamedTuple):
    """Exit or entry: its point, its first event, its surroundings, its refracted direction."""

    at: SurfacePoint
    event: FirstEvent
    around: list[RaySurroundings]
    inner: mi.Vector3f


class Pair(NamedTuple):
    """Descriptors of a channel: of both ends, and shared."""

    exit: list[mi.Float]
    entry: list[mi.Float]
    shared: list[mi.Float]


def end(obj: TranslucentObject, at: SurfacePoint, active: mi.Bool = True) -> End:
    """What belongs to one end alone, measured once for all partners."""
    inner = refract_in(at, obj.eta)[0]
    event = first_event(obj, at, active)
    return End(at, event, look(obj, at, event, active), inner)


def medium(obj: TranslucentObject, channel: int, mixed: Mixed) -> np.ndarray:
    """The numbers of the medium of a channel and of the object as a whole, (16,)."""
    m = obj.media[channel]
    albedo, g, eta = (np.float64(v) for v in (m.albedo, m.g, m.eta))
    size = float(m.sigma_t_prime) * math.sqrt(obj.geometry.area)
    of_medium = medium_features(np, albedo, g, eta, length_scale(albedo, g))
    sizes = [1 / (1 + 0.1 * size), 0.2 * math.log1p(size), 0.3 * math.log(mixed.chord + 1e-2)]
    return np.array([*of_medium, *sizes, mixed.q, mixed.q_reduced, mixed.q_direct, mixed.k], dtype=np.float32)


def describe(
    obj: TranslucentObject, exit: End, entry: End, shares: Sequence[Sequence[mi.Float]], active: mi.Bool = True
) -> list[Pair]:
    """The descriptors of pairs for each channel, with the shares of `Backbone`; those of one extinction share rays."""
    line = Segment.between(exit.at.p, entry.at.p)
    clear: dict[float, tuple[mi.Float, mi.Float]] = {}
    pairs = []
    for c, m in enumerate(obj.media):
        key = float(m.sigma_t)
        if key not in clear:
            clear[key] = _clearance(obj, exit.event.ys[c], entry.event.ys[c], active)
        pairs.append(_channel(obj, c, exit, entry, line, clear[key], shares[c]))
    return pairs


def _channel(
    obj: TranslucentObject,
    c: int,
    exit: End,
    entry: End,
    line: Segment,
    clear: tuple[mi.Float, mi.Float],
    shares: Sequence[mi.Float],
) -> Pair:
    m = obj.media[c]
    s, t, g = opaque(float(m.sigma_t_prime)), opaque(float(m.sigma_t)), float(m.g)
    gap = Segment.between(exit.event.ys[c], entry.event.ys[c])
    own_o, own_i = _own(c, t, exit, entry, line, gap), _own(c, t, entry, exit, line.back, gap.back)
    r = line.length * s
    d_o, d_i = on_a_plane(exit.at.n_out, exit.inner, entry.at.n_out, entry.inner, line)
    flat = Segment.between(d_o / t, mi.Vector3f(line.length, 0, 0) + d_i / t)
    plane = flat.length * s
    ratio = phases(g, exit.inner, entry.inner, gap.d) / phases(g, d_o, d_i, flat.d)
    blocked, lost = clear
    return Pair(own_o, own_i, [
        0.5 * dr.log(r + LEAST_LENGTH), 0.5 * dr.log(plane + LEAST_LENGTH), dr.dot(exit.at.w, entry.at.w), r / (1 + r),
        dr.dot(exit.inner, entry.inner), _onward(g, exit, entry),
        1 - dr.dot(exit.at.n_out, entry.at.n_out),
        0.5 * dr.log((gap.length * s + LEAST_LENGTH) / (plane + LEAST_LENGTH)), blocked, lost * s / (1 + lost * s),
        0.5 * dr.log(dr.clip(ratio, 1 / MOST_RATIO, MOST_RATIO)), dr.exp(-gap.length * t) - dr.exp(-flat.length * t),
        *shares,
    ])  # fmt: skip


def _onward(g: float, exit: End, entry: End) -> mi.Float:
    """0.3 log of a phase function of g², of light that two events turn from one end into the other."""
    g = min(g * abs(g), MOST_G)
    c = -dr.dot(exit.inner, entry.inner)
    return 0.3 * dr.log(opaque(1 - g * g) / (opaque(1 + g * g) - opaque(2 * g) * c))


def _own(c: int, sigma_t: mi.Float, here: End, there: End, line: Segment, gap: Segment) -> list[mi.Float]:
    at, event, n, around = here.at, here.event, here.at.n_out, here.around[c]
    return [
        dr.dot(at.w, n), -dr.dot(here.inner, n), dr.dot(at.w, line.d), dr.dot(at.w, there.at.n_out),
        dr.dot(here.inner, gap.d), 0.5 * dr.log(around.depth * sigma_t + LEAST_LENGTH),
        0.5 * dr.log((event.P[c] + LEAST_P) / (1 + LEAST_P)),
        0.5 * dr.log((event.lengths[c] * sigma_t + LEAST_LENGTH) / (1 + LEAST_LENGTH)),
        dr.dot(n, line.d), dr.dot(n, gap.d),
        *around.L, *(-dr.dot(v, n) for v in around.V), *(dr.dot(v, gap.d) for v in around.V),
    ]  # fmt: skip


def _clearance(obj: TranslucentObject, a: mi.Point3f, b: mi.Point3f, active: mi.Bool) -> tuple[mi.Float, mi.Float]:
    """Of the line between two points inside: 1 if it leaves the object, else 0; the length that it is outside for."""
    line = Segment.between(a, b)

    def reach(start: mi.Point3f, d: mi.Vector3f, needed: mi.Bool) -> mi.Float:
        hit = obj.geometry.scene.ray_intersect_preliminary(mi.Ray3f(start, d), False, needed)
        return dr.select(hit.is_valid() & (hit.t < line.length), hit.t, line.length)

    one = reach(a, line.d, active)
    blocked = one < GRAZES * line.length
    lost = dr.select(blocked, line.length - one - reach(b, -line.d, active & blocked), 0)
    return dr.select(blocked, mi.Float(1), 0), dr.maximum(lost, 0)
