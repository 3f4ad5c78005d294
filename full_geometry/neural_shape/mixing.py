"""Light that has forgotten where it entered: what an object holds as a whole, where it is thin and reflects inside.

The chance that light which was scattered leaves without another event is exactly, by reciprocity, the mean over the
surface of what enters and is scattered, over the mean chord c = 4 V/A:

    1 - q = <F_t P> / (sigma_t c eta²).

If every event forgets the one before and fills the volume evenly, orders two and more are

    S_mixed = F_t(w_o) P_o F_t(w_i) P_i M,    M = a² q/(1 - a q) / (4 pi V sigma_t eta²).

It holds in what is thin and flat or rugged; in a smooth ball it is up to twice too much, as light that entered does not
reach what is held near the surface. M is divided by 1 + (sigma_t' c)², as light of thick objects leaves near to where
it entered.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from full_geometry.first_event import first_event
from full_geometry.subject import Subject, refract_in
from halfspace_sss.physics.medium import Medium
from halfspace_sss.rendering.transport.plane import number
from halfspace_sss.tracing.walk import generator, pass_seed

__all__ = ["Mixed", "mean_chord", "mixed"]

POINTS, SEED, REFLECTIONS = 2**15, 31, 64
LEAST_ESCAPE = 1e-6


class Mixed(NamedTuple):
    """Of a channel: M, 1/(scene unit)²; the mean chord in transport mean free paths; q."""

    M: float
    chord: float
    q: float


def mean_chord(subject: Subject) -> float:
    """4 V/A, V from the mean of x.n over random points of the surface; <= 0 where it is open or inside out."""
    at = subject.random_points(generator(_mitsuba(), POINTS, pass_seed(SEED)))
    x, n = (np.array(v, dtype=float) for v in (at.p, at.n))
    x -= x.mean(axis=1, keepdims=True)
    return float(4 / 3 * (x * n).sum(axis=0).mean())


def mixed(subject: Subject) -> list[Mixed]:
    """What each channel mixes; M is 0 where there is no scattering or no volume."""
    at = subject.random_points(generator(_mitsuba(), POINTS, pass_seed(SEED)))
    entering, P = refract_in(at, number(subject.eta))[1], first_event(subject, at, True, REFLECTIONS).P
    chord = max(mean_chord(subject), 0.0)
    return [_of(subject, m, chord, float(np.mean((entering * P[c]).numpy()))) for c, m in enumerate(subject.media)]


def _of(subject: Subject, m: Medium, chord: float, scattered: float) -> Mixed:
    events, a = float(m.sigma_t) * chord * m.eta**2, float(m.albedo)
    reduced = float(m.sigma_t_prime) * chord
    if not events > 0:
        return Mixed(0.0, reduced, 0.0)
    q = 1 - min(max(scattered / events, LEAST_ESCAPE), 1.0)
    M = a * a * q / (1 - a * q) / (math.pi * subject.found.area * events)  # 4 V = c A
    return Mixed(M / (1 + reduced**2), reduced, q)


def _mitsuba() -> object:
    import mitsuba

    return mitsuba
