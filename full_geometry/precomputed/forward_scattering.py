"""The split of a phase function, by which light that has only been scattered forwards counts as unscattered.

A grid holds the directions of light by few numbers: fluence, flux and second moments. A phase function p that is
narrow asks for more of them. It is parted into a quadratic Q of the cosine c, of which these numbers are all that
matters, and a forward rest:

    p = Q + p_f,    Q(c) = sum_(l <= 2) (2 l + 1) / (4 pi) q_l P_l(c),    p_f >= 0.

Q is the largest quadratic below p: equal at c = -1, tangent at c = 1/3, so that its share of all scattering is
r = pi p(-1) + 3 pi p(1/3), by the Radau rule of these nodes. For Henyey-Greenstein functions r is .92, .70, .25, .11
at g = .3, .5, .8, .9, and 1.1 (1 - g) near 1. For g < 0 all of this is mirrored.

The light that is precomputed, L_f, has met forward events alone: a ray of light turns by p and is multiplied by
1 - q(c), q = Q / p. At each of its events a walk adds weight ∫ Q L_f dw'. The first event that is not forward, seen
from the light, parts all paths, so that nothing is counted twice: what a walk meets when it leaves counts by the
product of 1 - q over its turns. L_f is smooth and reaches as deep as 1 / (r sigma_s + sigma_a). The split is exact,
unlike similarity relations, of which it has the lengths.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from halfspace_sss.arrays import library
from halfspace_sss.physics.medium import Medium, eval_hg

NODE = 1 / 3  # where Q is tangent


def quadratic_part(g: Any) -> tuple[Any, Any, Any]:
    """q_0, q_1, q_2 of the quadratic part of a Henyey-Greenstein function; q_0 = r."""
    lib = library(g)
    size = lib.abs(g)
    back = (1 - size) / ((1 + size) * (1 + size))
    gap = (1 - size) * (1 - size) + 2 * size * (1 - NODE)
    touch = (1 - size) * (1 + size) / (gap * lib.sqrt(gap))
    slope = 3 * size / gap * touch
    # touch + slope (c - 1/3) + bend (c - 1/3)², equal to `back` at c = -1
    bend = (back - touch + slope * (1 + NODE)) / (1 + NODE) ** 2
    q_1 = (slope - 2 * NODE * bend) / 3
    q_0 = touch - NODE * slope + NODE**2 * bend + bend / 3
    return q_0, lib.where(g < 0, -q_1, q_1), 2 / 15 * bend


def truncated(g: Any) -> tuple[Any, Any, Any]:
    """q_l = g^l for l <= 2 of a Henyey-Greenstein function that is not split."""
    return g * 0 + 1, g, g * g


def kept_forward(cosine: mi.Float, g: mi.Spectrum) -> mi.Spectrum:
    """1 - q(c) = 1 - Q(c) / p(c) by channel: the forward share of an event that turns by this cosine."""
    result = []
    for value in g:
        q_0, q_1, q_2 = quadratic_part(value)
        Q = (q_0 + 3 * q_1 * cosine + 2.5 * q_2 * (3 * dr.square(cosine) - 1)) / (4 * math.pi)
        result.append(dr.maximum(1 - Q / eval_hg(cosine, value), 0))
    return mi.Spectrum(result)


def split_extinction(medium: Medium) -> np.ndarray:
    """r sigma_s + sigma_a by channel, 1/mm: by what light is lost that only forward events may scatter."""
    sigma_s, sigma_t = np.atleast_1d(medium.sigma_s), np.atleast_1d(medium.sigma_t)
    r, _, _ = quadratic_part(np.broadcast_to(medium.g, sigma_t.shape).astype(float))
    return sigma_t - (1 - r) * sigma_s


@dataclass
class ForwardRun:
    """The events of a walk since it entered an object, as far as they may all have been forward.

    Args:
        share: product of 1 - q over their turns, by channel: of the light that the walk meets next without an event,
            this share has met forward events alone, and is not precomputed.
        along: direction of arrival at the last event.
        g: mean cosine there.
        turned: whether the turn at that event is still to be counted.
    """

    share: mi.Spectrum
    along: mi.Vector3f
    g: mi.Spectrum
    turned: mi.Bool

    @classmethod
    def none(cls, lanes: int) -> ForwardRun:
        """Of no event."""
        return cls(
            dr.full(mi.Spectrum, 1, lanes), dr.full(mi.Vector3f, 0, lanes), dr.full(mi.Spectrum, 0, lanes),
            dr.full(mi.Bool, False, lanes),
        )  # fmt: skip

    def onward(self, along: mi.Vector3f) -> ForwardRun:
        """With the turn at the last event, after which the walk went along this direction."""
        kept = kept_forward(dr.dot(self.along, along), self.g)
        share = dr.select(self.turned, self.share * kept, self.share)
        return ForwardRun(share, self.along, self.g, dr.full(mi.Bool, False, dr.width(self.turned)))

    def ended(self) -> ForwardRun:
        """Outside: nothing is left of what a mirror shows; the first event in an object begins anew."""
        return replace(self, share=dr.zeros(mi.Spectrum, dr.width(self.share)))
