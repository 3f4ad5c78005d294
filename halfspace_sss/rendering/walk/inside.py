"""One step of the random walk inside an object, with spectral multiple importance sampling.

A walk draws distances and angles with the coefficients of one channel, chosen at its start. Every channel c gets a
value: with f_c the measured contribution and p_k the density of the whole walk under channel k, the weight is
w_c = f_c / mean_k p_k (balance heuristic over channels). State are w_c and q_k = p_k / mean_j p_j; both stay in range
whatever the length of the walk. Absorption is part of w.

Source: Wilkie et al. 2014 (hero wavelength sampling); Miller, Georgiev and Jarosz 2019 for volumes.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import drjit as dr
import mitsuba as mi

from halfspace_sss.physics.phase import eval_hg, sample_hg
from halfspace_sss.rendering.surface.variants import channel_mean
from halfspace_sss.rendering.walk.media import Coefficients
from halfspace_sss.tracing.walk import ROULETTE_BOOST, ROULETTE_WEIGHT

__all__ = ["Flight", "eval_phase", "fly", "free_path", "pick", "roulette", "turn", "weigh"]


class Flight(NamedTuple):
    """How a free flight ended: in a scattering event, a null collision or at the boundary; the weights after it."""

    scatters: mi.Bool
    null: mi.Bool
    weight: mi.Spectrum
    density: mi.Spectrum


def pick(values: Any, channel: Any) -> Any:
    """The value of one channel."""
    value = values[0]
    for c in range(1, len(values)):
        value = dr.select(channel == c, values[c], value)
    return value


def weigh(weight: Any, density: Any, value: Any, pdf: Any) -> tuple[Any, Any]:
    """w and q after a step with the value f_c and the density p_c, each up to one factor that they share."""
    if len(weight) == 1:
        return weight * value / pdf, density
    grown = density * pdf
    scale = 1 / dr.maximum(channel_mean(grown), 1e-37)
    return weight * value * scale, grown * scale


def free_path(m: Coefficients, channel: Any, u: Any) -> Any:
    """Distance to the next collision, scene units; where the medium is homogeneous, that is a scattering event."""
    return -dr.log(1 - u) / pick(m.majorant, channel)


def fly(m: Coefficients, weight: Any, density: Any, channel: Any, t: Any, reach: Any, u: Any = None) -> Flight:
    """A free flight of length t, cut short by the boundary where that is at a distance `reach` < t.

    Collisions are drawn by the majorant M_k of the channel of the walk. With M_c - sigma_t,c of null matter added, all
    channels fly through T_c = exp(-M_c t), and a collision is real with the probability sigma_t,k / M_k, so that the
    path, null collisions included, gains (Miller, Georgiev and Jarosz 2019, section 4)

        f_c = T_c sigma_s,c,             p_c = T_c sigma_t,c             real collision,
        f_c = T_c (M_c - sigma_t,c),     p_c = T_c (M_c - sigma_t,c)     null collision,
        f_c = T_c,                       p_c = T_c                       boundary.

    Every part of f_c is at most that of p_c, so that w_c = f_c / mean_k p_k is at most the number of channels, before
    roulette. One majorant for all channels makes w less noisy but walks longer: 1.2 to 1.7 times the variance x time of
    this at sigma_t of 1:2:4 and three null collisions in four.

    Args:
        m: coefficients at the distance t.
        u: uniform number that decides whether a collision is real; None where M = sigma_t, so that all are.
    """
    collides = t < reach
    scatters = collides if u is None else collides & (u * pick(m.majorant, channel) < pick(m.sigma_t, channel))
    null = mi.Bool(False) if u is None else collides & ~scatters
    if len(weight) == 1:
        value = dr.select(scatters, m.sigma_s / m.sigma_t, 1)
        return Flight(scatters, null, weight * value, density)
    # over that of the walk's channel
    through = dr.exp(-(m.majorant - pick(m.majorant, channel)) * dr.minimum(t, reach))
    otherwise = mi.Spectrum(1) if u is None else dr.select(null, dr.maximum(m.majorant - m.sigma_t, 0), 1)
    value = dr.select(scatters, m.sigma_s, otherwise) * through
    pdf = dr.select(scatters, m.sigma_t, otherwise) * through
    return Flight(scatters, null, *weigh(weight, density, value, pdf))


def eval_phase(m: Coefficients, cosine: Any) -> Any:
    """Henyey-Greenstein phase function of each channel, 1/sr."""
    return mi.Spectrum([eval_hg(cosine, g) for g in m.g])


def turn(m: Coefficients, weight: Any, density: Any, channel: Any, d: Any, u: Any, same_g: bool) -> tuple:
    """A new direction by the phase function, and w and q after it."""
    cosine = sample_hg(u.x, pick(m.g, channel))
    sine = dr.safe_sqrt((1 - cosine) * (1 + cosine))
    sin_phi, cos_phi = dr.sincos(2 * dr.pi * u.y)
    new = mi.Frame3f(d).to_world(mi.Vector3f(sine * cos_phi, sine * sin_phi, cosine))
    new *= 1.5 - 0.5 * dr.squared_norm(new)  # one Newton step: float32 drifts over thousands of turns
    if same_g or len(weight) == 1:
        return new, weight, density
    phase = eval_phase(m, cosine)
    return new, *weigh(weight, density, phase, phase)


def roulette(weight: Any, scale: Any, u: Any) -> tuple[Any, Any]:
    """Whether a walk goes on, and its weight if it does; `scale` is the square of the relative index passed so far."""
    size = dr.max(weight) * scale
    survive = dr.select(size < ROULETTE_WEIGHT, size / (ROULETTE_WEIGHT * ROULETTE_BOOST), 1)
    return u < survive, dr.select(survive < 1, weight / dr.maximum(survive, 1e-30), weight)
