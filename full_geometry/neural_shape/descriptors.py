"""What the network is told of a pair of points: the medium, the pair as on a plane, and how far it is from a plane.

For a channel with l' = 1/sigma_t' and each end of the pair (exit and entry; d is the direction to the other end, e that
from y to the other y; L_k and V_k are those of `surroundings`):

    own:     mu, mu', w.d, w.n of the other end, refracted w.e, log of the depth of y in mean free paths;
             log P, log of the way to y in mean free paths, n.d, n.e, L_k, -V_k.n, V_k.e
    shared:  log r/l', log of |y_i - y_o|/l' as it would be on a plane, w_o.w_i, r/(r + l'), the refracted w_o.w_i,
             log of a phase function of g² between the two;
             1 - n_o.n_i, log of |y_i - y_o| over that of a plane, whether the line y_o y_i leaves the object, the
             length that it is outside for, l/(l + l'), log of the phase functions at y_o and y_i for light between the
             two, over those of a plane, within 1/4 and 4, exp(-sigma_t |y_i - y_o|) less that of a plane, and the
             shares of S_0 that are mixed and scattered twice
    medium:  nine functions of albedo, g and eta, two of sigma_t' sqrt(area), five of what `mixing` says

What stands behind a semicolon, own numbers summed over both ends, is 0 on a plane. All are free of scale, place and
turn, and exchanged with the ends.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from full_geometry.first_event import FirstEvent, first_event
from full_geometry.neural_shape.backbone import phases
from full_geometry.neural_shape.lines import Line, on_a_plane
from full_geometry.neural_shape.mixing import Mixed
from full_geometry.neural_shape.surroundings import N_LENGTHS, Surroundings, look
from full_geometry.subject import Subject, SurfacePoint, refract_in
from halfspace_sss.neural.features import medium_features
from halfspace_sss.physics.backbone import length_scale
from halfspace_sss.rendering.transport.plane import number

__all__ = [
    "ALONE",
    "CURVED_OWN",
    "CURVED_SHARED",
    "N_MEDIUM",
    "N_OWN",
    "N_SHARED",
    "End",
    "Pair",
    "describe",
    "end",
    "medium",
]

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
    around: list[Surroundings]
    inner: Any


class Pair(NamedTuple):
    """Descriptors of a channel: of both ends, and shared."""

    exit: list[Any]
    entry: list[Any]
    shared: list[Any]


def end(subject: Subject, at: SurfacePoint, active: Any = True) -> End:
    """What belongs to one end alone, measured once for all partners."""
    inner = refract_in(at, number(subject.eta))[0]
    event = first_event(subject, at, active)
    return End(at, event, look(subject, at, event, active), inner)


def medium(subject: Subject, channel: int, mixed: Mixed) -> np.ndarray:
    """The numbers of the medium of a channel and of the object as a whole, (16,)."""
    m = subject.media[channel]
    albedo, g, eta = (np.float64(v) for v in (m.albedo, m.g, m.eta))
    size = float(m.sigma_t_prime) * math.sqrt(subject.found.area)
    found = medium_features(np, albedo, g, eta, length_scale(albedo, g))
    sizes = [1 / (1 + 0.1 * size), 0.2 * math.log1p(size), 0.3 * math.log(mixed.chord + 1e-2)]
    return np.array([*found, *sizes, mixed.q, mixed.q_reduced, mixed.q_direct, mixed.k], dtype=np.float32)


def describe(
    subject: Subject, exit: End, entry: End, shares: Sequence[Sequence[Any]], active: Any = True
) -> list[Pair]:
    """The descriptors of pairs for each channel, with the shares of `Backbone`; those of one extinction share rays."""
    line = Line.between(exit.at.p, entry.at.p)
    clear: dict[float, tuple[Any, Any]] = {}
    found = []
    for c, m in enumerate(subject.media):
        key = float(m.sigma_t)
        if key not in clear:
            clear[key] = _clearance(subject, exit.event.ys[c], entry.event.ys[c], active)
        found.append(_channel(subject, c, exit, entry, line, clear[key], shares[c]))
    return found


def _channel(
    subject: Subject, c: int, exit: End, entry: End, line: Line, clear: tuple[Any, Any], shares: Sequence[Any]
) -> Pair:
    import drjit as dr
    import mitsuba as mi

    m = subject.media[c]
    s, t, g = number(float(m.sigma_t_prime)), number(float(m.sigma_t)), float(m.g)
    gap = Line.between(exit.event.ys[c], entry.event.ys[c])
    own_o, own_i = _own(c, t, exit, entry, line, gap), _own(c, t, entry, exit, line.back, gap.back)
    r = line.length * s
    d_o, d_i = on_a_plane(exit.at.n_out, exit.inner, entry.at.n_out, entry.inner, line)
    flat = Line.between(d_o / t, mi.Vector3f(line.length, 0, 0) + d_i / t)
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


def _onward(g: float, exit: End, entry: End) -> Any:
    """0.3 log of a phase function of g², of light that two events turn from one end into the other."""
    import drjit as dr

    g = min(g * abs(g), MOST_G)
    c = -dr.dot(exit.inner, entry.inner)
    return 0.3 * dr.log(number(1 - g * g) / (number(1 + g * g) - number(2 * g) * c))


def _own(c: int, sigma_t: Any, here: End, there: End, line: Line, gap: Line) -> list[Any]:
    import drjit as dr

    at, event, n, around = here.at, here.event, here.at.n_out, here.around[c]
    return [
        dr.dot(at.w, n), -dr.dot(here.inner, n), dr.dot(at.w, line.d), dr.dot(at.w, there.at.n_out),
        dr.dot(here.inner, gap.d), 0.5 * dr.log(around.depth * sigma_t + LEAST_LENGTH),
        0.5 * dr.log((event.P[c] + LEAST_P) / (1 + LEAST_P)),
        0.5 * dr.log((event.lengths[c] * sigma_t + LEAST_LENGTH) / (1 + LEAST_LENGTH)),
        dr.dot(n, line.d), dr.dot(n, gap.d),
        *around.L, *(-dr.dot(v, n) for v in around.V), *(dr.dot(v, gap.d) for v in around.V),
    ]  # fmt: skip


def _clearance(subject: Subject, a: Any, b: Any, active: Any) -> tuple[Any, Any]:
    """Of the line between two points inside: 1 if it leaves the object, else 0; the length that it is outside for."""
    import drjit as dr
    import mitsuba as mi

    line = Line.between(a, b)

    def reach(start: Any, d: Any, needed: Any) -> Any:
        hit = subject.found.scene.ray_intersect_preliminary(mi.Ray3f(start, d), False, needed)
        return dr.select(hit.is_valid() & (hit.t < line.length), hit.t, line.length)

    one = reach(a, line.d, active)
    blocked = one < GRAZES * line.length
    lost = dr.select(blocked, line.length - one - reach(b, -line.d, active & blocked), 0)
    return dr.select(blocked, mi.Float(1), 0), dr.maximum(lost, 0)
