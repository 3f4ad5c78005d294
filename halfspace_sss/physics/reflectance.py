"""The exact reflectance of the half-space by discrete ordinates, and the albedo that has a wanted reflectance.

Radiance that is the same at all azimuths obeys, with I⁺ going down and I⁻ going up at the cosines mu_j of a quadrature,

    s' = -(A + B) d,  d' = -(A - B) s,   s = I⁺ + I⁻,  d = I⁺ - I⁻,
    A - B = (1 - a E W) / mu,  A + B = (1 - a O W) / mu,

E and O the even and odd terms of sum_l beta_l P_l(mu) P_l(mu'), beta_l = (2 l + 1) g^l, and W the weights. What decays
as e^(-k tau) has (A + B)(A - B) s = k² s and k d = (A - B) s. Inside, the boundary reflects by Fresnel. The forward
peak is cut off by delta-M (Wiscombe 1977).

Source: Chandrasekhar 1960, chapter II; the reduction of the order is that of Stamnes et al. 1988.
"""

from __future__ import annotations

import functools
import math
import numbers
from typing import NamedTuple

import numpy as np

from halfspace_sss.physics.fresnel import F_r, F_t, mu_internal

__all__ = ["DIFFUSE", "albedo_of_reflectance", "half_space_reflectance"]

DIFFUSE = "diffuse"
NODES = 96
SLOWEST = 1e-7  # k below which a mode does not decay, at albedo 1
DEGREE = 40  # of R as a polynomial of s = sqrt(1 - albedo'), albedo = (1 - s²)/(1 - g s²)
DENSE = 8192  # values of it between which its inverse is looked up
STEPS = 2  # of Newton's method after that


class _Modes(NamedTuple):
    """Solutions that decay downwards: s and d at the nodes, one a column, with k; cosines, weights, and beta_l."""

    s: np.ndarray
    d: np.ndarray
    k: np.ndarray
    mu: np.ndarray
    w: np.ndarray
    a_beta: np.ndarray


def half_space_reflectance(albedo: float, g: float, eta: float, mu_i: float | str = DIFFUSE) -> float:
    """The fraction of incident flux that comes back out of the medium, all orders, as R(mu_i) of the conventions.

    Args:
        albedo: of single scattering, [0, 1].
        g: mean cosine of the Henyey-Greenstein phase function, (-1, 1).
        eta: index inside over outside, > 0.
        mu_i: cosine of incidence, [0, 1], or "diffuse" for uniform radiance from above.

    Left out: what the boundary reflects from outside. Relative error 1e-5 at most for |g| <= 0.99.
    """
    _check_direction(mu_i)
    m = _modes(albedo, g, eta)
    down, up = (m.s + m.d) / 2, (m.s - m.d) / 2
    T = F_t(m.mu, 1 / eta)
    share = np.linalg.solve(down - F_r(m.mu, 1 / eta)[:, None] * up, T * eta**2)  # under radiance 1 from everywhere
    if mu_i == DIFFUSE:
        return float(2 * np.sum(m.w * m.mu * T * (up @ share)))
    # reciprocity: what comes out towards mu_i then is R(mu_i)
    inside = mu_internal(mu_i, eta)
    P = np.polynomial.legendre.legvander(np.array([inside]), len(m.a_beta) - 1)[0] * m.a_beta
    nodes = np.polynomial.legendre.legvander(m.mu, len(m.a_beta) - 1)
    even, odd = ((P[k::2] @ nodes[:, k::2].T) * m.w for k in (0, 1))
    upwards = (even @ m.s - odd @ m.d) / (2 * (m.k * inside + 1))
    return float(F_t(mu_i, eta) * (upwards @ share) / eta**2)


def _check_direction(mu_i: float | str) -> None:
    if mu_i != DIFFUSE and not (isinstance(mu_i, numbers.Real) and 0 <= mu_i <= 1):
        raise ValueError(f"mu_i must be a number in [0, 1] or {DIFFUSE!r}, got {mu_i!r}")


def _modes(albedo: float, g: float, eta: float) -> _Modes:
    mu, w = _nodes(NODES, eta)
    n = len(mu)
    peak = g**n
    a = albedo * (1 - peak) / (1 - albedo * peak)
    order = np.arange(n)
    a_beta = a * (2 * order + 1) * (float(g) ** order - peak) / (1 - peak)
    P = np.polynomial.legendre.legvander(mu, n - 1)
    even, odd = ((P[:, k::2] * a_beta[k::2]) @ P[:, k::2].T * w for k in (0, 1))
    minus, plus = ((np.eye(len(mu)) - term) / mu[:, None] for term in (even, odd))
    k2, s = np.linalg.eig(plus @ minus)
    k, s = np.sqrt(np.maximum(k2.real, 0)), s.real
    d = np.where(k > SLOWEST, minus @ s / np.maximum(k, SLOWEST), 0)
    return _Modes(s, d, k, mu, w, a_beta)


def _nodes(n: int, eta: float) -> tuple[np.ndarray, np.ndarray]:
    """Gauss points of [0, 1], close together on both sides of the critical cosine, where radiance has a kink."""
    x, w = np.polynomial.legendre.leggauss(n if eta <= 1 else n // 2)
    t, w = 0.5 * (x + 1), 0.5 * w
    if eta <= 1:
        return t, w
    c = math.sqrt((eta - 1) * (eta + 1)) / eta
    return np.concatenate([c * (1 - t * t), c + (1 - c) * t * t]), np.concatenate([c * 2 * t * w, (1 - c) * 2 * t * w])


def albedo_of_reflectance(reflectance: np.ndarray, g: float, eta: float, mu_i: float | str = DIFFUSE) -> np.ndarray:
    """The albedo of single scattering of the half-space with the given reflectance.

    Args:
        reflectance: array of any shape, from 0 to that of albedo 1.
        g, eta, mu_i: as in `half_space_reflectance`.

    Raises:
        ValueError: a reflectance is out of reach; bound and value are named.
    """
    _check_direction(mu_i)
    R = np.asarray(reflectance, dtype=np.float64)
    s, values, polynomial = _inverse(float(g), float(eta), mu_i if mu_i == DIFFUSE else float(mu_i))
    most = half_space_reflectance(1.0, g, eta, mu_i)
    reached = (R >= 0) & (R <= most * (1 + 1e-9))
    if not reached.all():
        wrong = R[~reached].flat[0]
        raise ValueError(
            f"reflectance must be in [0, {most:.4g}], what a medium without absorption reflects at eta {eta:g}, "
            f"got {float(wrong)!r}"
        )
    found, slope = np.interp(R, values, s), polynomial.deriv()
    for _ in range(STEPS):
        found = np.clip(found - (polynomial(found) - R) / np.minimum(slope(found), -1e-12), 0, 1)
    return _albedo(found, g)


@functools.lru_cache(maxsize=64)
def _inverse(g: float, eta: float, mu_i: float | str) -> tuple[np.ndarray, np.ndarray, np.polynomial.Chebyshev]:
    """s falling from 1 to 0, the reflectance there, and that as a polynomial."""

    def R(s: np.ndarray) -> np.ndarray:
        return np.array([half_space_reflectance(_albedo(v, g), g, eta, mu_i) for v in np.atleast_1d(s)])

    polynomial = np.polynomial.Chebyshev.interpolate(R, DEGREE, domain=[0, 1])
    s = np.linspace(1, 0, DENSE)
    return s, np.maximum.accumulate(polynomial(s)), polynomial


def _albedo(s: np.ndarray, g: float) -> np.ndarray:
    """The albedo whose reduced one is 1 - s²."""
    return (1 - s) * (1 + s) / (1 - g * s * s)
