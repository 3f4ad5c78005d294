"""Light that has forgotten where it entered: what an object holds as a whole, where it is thin and reflects inside.

The chance that light which was scattered leaves without another event is exactly, by reciprocity, the mean over the
surface of what enters and is scattered, over the mean chord c = 4 V/A:

    1 - q = <F_t P> / (sigma_t c eta²).

q_d of it before the boundary, by the same with eta = 1. Light of two events that met the boundary between them, and
light of three events and more, if after the second it forgets where it is, as in the reduced medium (sigma_t', a',
g = 0), of which <F_t P'> is scattered, k = <F_t P'>/<F_t P>, is spread evenly:

    S_mixed = F_t(w_o) P_o F_t(w_i) P_i M,
    M = [a² (q - q_d)/sigma_t + a q k² a'² q'/(1 - a' q')/sigma_t'] / (4 pi V eta²).

It holds in what is thin and flat or rugged; in a smooth ball it is up to twice too much, as light that entered does not
reach what is held near the surface. M is divided by 1 + (sigma_t' c)², as light of thick objects leaves near where it
entered. m_2 = a²/(4 pi eta)² is that of light of two events, see `backbone`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from full_geometry.first_event import first_event
from full_geometry.subject import Subject, refract_in
from halfspace_sss.physics.medium import Medium
from halfspace_sss.rendering.transport.plane import number
from halfspace_sss.tracing.walk import generator, pass_seed

__all__ = ["Mixed", "mean_chord", "mixed"]

POINTS, SEED = 2**15, 31
LEAST_ESCAPE = 1e-6


class Mixed(NamedTuple):
    """Of a channel: M, 1/(scene unit)²; m_2; the mean chord in transport mean free paths; q, q', q_d and k."""

    M: float
    m_2: float
    chord: float
    q: float
    q_reduced: float
    q_direct: float
    k: float


def mean_chord(subject: Subject) -> float:
    """4 V/A, V from the mean of x.n over random points of the surface; <= 0 where it is open or inside out."""
    at = subject.random_points(generator(_mitsuba(), POINTS, pass_seed(SEED)))
    x, n = (np.array(v, dtype=float) for v in (at.p, at.n))
    x -= x.mean(axis=1, keepdims=True)
    return float(4 / 3 * (x * n).sum(axis=0).mean())


def mixed(subject: Subject) -> list[Mixed]:
    """What each channel mixes; M and m_2 are 0 where there is no scattering or no volume."""
    at = subject.random_points(generator(_mitsuba(), POINTS, pass_seed(SEED)))
    entering, chord = refract_in(at, number(subject.eta))[1], max(mean_chord(subject), 0.0)
    kinds = [subject.media, *(tuple(map(kind, subject.media)) for kind in (_reduced, _unbounded))]
    P = [first_event(replace(subject, media=media), at).P for media in kinds]
    through = [entering, entering, 1.0]
    scattered = [[float(np.mean((F_t * p).numpy())) for p in each] for F_t, each in zip(through, P)]
    return [_of(subject, media, parts, chord) for media, parts in zip(zip(*kinds), zip(*scattered))]


def _reduced(m: Medium) -> Medium:
    return Medium(float(m.sigma_s) * (1 - float(m.g)), float(m.sigma_a), 0.0, m.eta)


def _unbounded(m: Medium) -> Medium:
    return Medium(m.sigma_s, m.sigma_a, m.g, 1.0)


def _of(subject: Subject, media: Sequence[Medium], scattered: Sequence[float], chord: float) -> Mixed:
    m, reduced, _ = media
    thickness, a = float(reduced.sigma_t) * chord, float(m.albedo)
    if not (thickness > 0 and a > 0 and scattered[0] > 0):
        return Mixed(0.0, 0.0, thickness, 0.0, 0.0, 0.0, 1.0)
    q, q_reduced, q_direct = (_stays(medium, chord, part) for medium, part in zip(media, scattered))
    a_reduced, k, thin = float(reduced.albedo), scattered[1] / scattered[0], 1 / (1 + thickness**2)
    M = a**2 * max(q - q_direct, 0.0) / float(m.sigma_t)
    M += a * q * k**2 * a_reduced**2 * q_reduced / (1 - a_reduced * q_reduced) / float(reduced.sigma_t)
    M /= math.pi * subject.found.area * chord * m.eta**2  # 4 V = c A
    return Mixed(M * thin, (a / (4 * math.pi * m.eta)) ** 2, thickness, q, q_reduced, q_direct, k)


def _stays(m: Medium, chord: float, scattered: float) -> float:
    """q of a medium."""
    escapes = scattered / (float(m.sigma_t) * chord * m.eta**2)
    return 1 - min(max(escapes, LEAST_ESCAPE), 1.0)


def _mitsuba() -> object:
    import mitsuba

    return mitsuba
