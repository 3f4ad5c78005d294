"""Reflectance of models whose S depends on both azimuths: a shifted lattice in all variables, graded at the cusps.

S of a network has a cusp where phi_o or phi_i is 0 or pi. With phi = pi (3 t² - 2 t³) between them, mu_o likewise and
ln r over what carries flux, the integrand is periodic and a rank-1 lattice converges nearly as 1/n². The spread over
random shifts is its error (Sloan and Joe 1994); the generating vector is built component by component for the weights
of order two.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from halfspace_sss.backend import array_types
from halfspace_sss.interface.model import BSSRDF
from halfspace_sss.physics.fresnel import mu_external

__all__ = ["lattice_reflectance"]

GENERATOR = np.array([1, 4845, 6383, 7357])
POINTS = 16384
SHIFTS = (3, 6)  # least and most
ENOUGH = 5e-5  # relative error after which no shift is added
DECADES, PER_DECADE = 9, 4  # about the mean free path, where flux is looked for
FEW = 16  # directions at each of those distances
DEAD = 1e-7  # share of its largest value below which the integrand in ln r is left out


def lattice_reflectance(model: BSSRDF, mu_i: float) -> tuple[float, float]:
    """R(mu_i) of a model of a scalar medium, and its standard error."""
    window = _window(model, mu_i)
    if window is None:
        return 0.0, 0.0
    least, most = SHIFTS
    values: list[float] = []
    error = math.inf
    while len(values) < least or (len(values) < most and error > ENOUGH * abs(np.mean(values))):
        shift = np.random.default_rng(len(values)).random(len(GENERATOR))
        query, weight = _points(POINTS, shift, window, mu_i, model.medium.eta)
        values.append(float(np.mean(_evaluated(model, query) * weight)))
        if len(values) > 1:
            error = float(np.std(values, ddof=1)) / math.sqrt(len(values))
    return float(np.mean(values)), error


def _evaluated(model: BSSRDF, query: tuple[Any, ...]) -> np.ndarray:
    """S where the model is fast."""
    if model.fast_in == "drjit":
        types = array_types()
        return model.eval(*(types.Float(np.broadcast_to(v, POINTS)) for v in query)).numpy().astype(np.float64)
    return np.asarray(model.eval(*query), dtype=np.float64)


def _points(
    n: int, shift: np.ndarray, window: tuple[float, float], mu_i: float, eta: float
) -> tuple[tuple[Any, ...], np.ndarray]:
    """Queries of the lattice, and the weights whose mean of S is R."""
    u = (np.arange(n) * GENERATOR[:, None] / n + shift[:, None]) % 1.0
    low, high = window
    r = np.exp(low + (high - low) * u[0])
    phi_i, w_i = _graded(u[1])
    t, w_o = _graded(2 * u[2] % 1)
    phi_o = t - (u[2] >= 0.5)
    t, w_mu = _graded(u[3])
    thin = min(eta, 1.0)
    weight = (high - low) * 2 * math.pi * r * r * w_i * 2 * math.pi * w_o * thin**2 * t * w_mu
    return (r, mu_i, math.pi * phi_i, mu_external(t, thin), math.pi * phi_o), weight


def _graded(t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """[0, 1] onto itself with the derivative 0 at both ends, and that derivative."""
    return t * t * (3 - 2 * t), 6 * t * (1 - t)


def _window(model: BSSRDF, mu_i: float) -> tuple[float, float] | None:
    """ln r between which r² S carries flux; None where there is none."""
    r = float(model.medium.mfp) * np.logspace(-DECADES, DECADES, 2 * DECADES * PER_DECADE + 1)
    query, weight = _points(FEW, np.full(len(GENERATOR), 0.3), (0.0, 1.0), mu_i, model.medium.eta)
    S = model.eval(r[:, None], *query[1:])
    mass = np.abs(np.asarray(S, dtype=np.float64)).mean(axis=1) * r * r
    alive = np.nonzero(mass > DEAD * mass.max())[0]
    if not len(alive):
        return None
    return math.log(r[max(alive[0] - 1, 0)]), math.log(r[min(alive[-1] + 1, len(r) - 1)])
