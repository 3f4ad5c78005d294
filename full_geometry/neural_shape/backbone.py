"""S_0 of the network of all shapes: the half-space, a floor, and what the object as a whole brings where it is thin.

Of light that is scattered twice, between the mean places y of both first events at a distance d,

    S_twice = F_t(w_o) P_o F_t(w_i) P_i m_2 max(v - v', 0),    v = (4 pi)² p_o p_i exp(-sigma_t d)/(d² + e²),

v' the same of a plane, whose light of two events the half-space has; e² a twelfth of the squared ways to both y, as
these are places in the mean; p of |g| <= 0.6, as so are directions. Light of more events is that of `mixing`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from full_geometry.features import Side
from full_geometry.half_space import HalfSpace
from full_geometry.neural_shape.lines import Line, on_a_plane
from full_geometry.neural_shape.mixing import Mixed
from full_geometry.subject import Subject, refract_in
from halfspace_sss.physics.medium import Medium
from halfspace_sss.rendering.transport.plane import number

__all__ = ["MODEL", "Backbone", "phases"]

MODEL = "neural"
FLOOR = 2e-3  # reflectance of what S_0 has everywhere, over that of the half-space
LEAST_LENGTH2 = 1e-6  # squared mean free paths
MOST_G = 0.6
LEAST_PHASE = 1e-4
LEAST_S = 1e-30


class Backbone(HalfSpace):
    """S_0 P_o P_i per channel.

    Args:
        subject: the object.
        mixtures: what each of its channels mixes.
    """

    def __init__(self, subject: Subject, mixtures: Sequence[Mixed]) -> None:
        super().__init__(subject, MODEL, FLOOR)
        self.mixtures = mixtures

    def added(self, exit: Side, entry: Side) -> list[Any]:
        """Per channel the floor, what is mixed and what is scattered twice, over F_t(w_o) P_o F_t(w_i) P_i."""
        everywhere = [number(floor + mixture.M) for floor, mixture in zip(self.floors, self.mixtures)]
        return [G + S for G, S in zip(everywhere, self.twice(exit, entry))]

    def shares(self, S_0: Any, exit: Side, entry: Side) -> list[tuple[Any, Any]]:
        """Per channel the parts of S_0, of this pair, that are mixed and that are scattered twice; 0 on a plane."""
        import drjit as dr

        F_t = self.query(exit.at, entry.at)[1]
        found = []
        for c, (mixture, twice) in enumerate(zip(self.mixtures, self.twice(exit, entry))):
            over = dr.select(
                S_0[c] > LEAST_S, F_t * exit.event.P[c] * entry.event.P[c] / dr.maximum(S_0[c], LEAST_S), 0
            )
            found.append((number(mixture.M) * over, twice * over))
        return found

    def twice(self, exit: Side, entry: Side) -> Any:
        """S_twice/(F_t(w_o) P_o F_t(w_i) P_i) per channel, that of a plane taken off."""
        import drjit as dr
        import mitsuba as mi

        eta = number(self.subject.eta)
        o, i = (refract_in(side.at, eta)[0] for side in (exit, entry))
        line = Line.between(exit.at.p, entry.at.p)
        d_o, d_i = on_a_plane(exit.at.n_out, o, entry.at.n_out, i, line)
        found = []
        for c, (m, mixture) in enumerate(zip(self.subject.media, self.mixtures)):
            t = number(max(float(m.sigma_t), 1e-20))
            ys = exit.event.ys[c], entry.event.ys[c]
            spread = dr.square(exit.event.lengths[c]) + dr.square(entry.event.lengths[c])
            flat = Line.between(d_o / t, mi.Vector3f(line.length, 0, 0) + d_i / t)
            here = _twice(m, o, i, Line.between(*ys), spread)
            plane = _twice(m, d_o, d_i, flat, 2 / dr.square(t))
            found.append(number(mixture.m_2) * dr.maximum(here - plane, 0))
        return mi.Spectrum(found)


def _twice(m: Medium, d_o: Any, d_i: Any, line: Line, spread: Any) -> Any:
    """Both phase functions and the attenuation along a line over its squared length, times (4 pi)²."""
    import drjit as dr

    t = number(float(m.sigma_t))
    apart = dr.square(line.length) + spread / 12 + LEAST_LENGTH2 / dr.square(dr.maximum(t, 1e-20))
    return phases(min(max(float(m.g), -MOST_G), MOST_G), d_o, d_i, line.d) * dr.exp(-t * line.length) / apart


def phases(g: float, d_o: Any, d_i: Any, d: Any) -> Any:
    """Both phase functions of light that goes along d from one end to the other, times (4 pi)²."""
    import drjit as dr

    a, b = number(1 + g * g), number(2 * g)
    c_o, c_i = dr.dot(d_o, d), -dr.dot(d_i, d)
    base = dr.maximum(a - b * c_o, LEAST_PHASE) * dr.maximum(a - b * c_i, LEAST_PHASE)
    return number((1 - g * g) ** 2) / (base * dr.sqrt(base))
