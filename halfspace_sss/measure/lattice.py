"""Reflectance on a lattice, for S that depends on both azimuths.

The refracted rays at x_i and x_o meet where x_o - x_i points along v = d_i/mu_i' + d_o/mu_o' in the plane; there S of a
network has its peak. The variables are ln r over what carries flux, the azimuth psi of x_o - x_i from v, mu_o, and the
azimuth between the directions. With psi and mu_o graded towards their ends the integrand is periodic, and a rank-1
lattice converges nearly as 1/n². The spread over random shifts is its error (Sloan and Joe 1994); the generating vector
is built component by component for the weights of order two.
"""

from __future__ import annotations

import math

import numpy as np

from halfspace_sss.backend import array_types
from halfspace_sss.interface.model import BSSRDF
from halfspace_sss.physics.fresnel import mu_external, mu_internal

GENERATOR = np.array([1, 2431, 563, 1027])
POINTS = 8192
SHIFTS, MOST_SHIFTS = 4, 12  # of one launch, and in all
ENOUGH = 1e-4  # relative error after which no shift is added
GRADE = 4  # power of t with which psi begins
Query = tuple[np.ndarray | float, ...]  # r, mu_i, phi_i, mu_o, phi_o
DECADES, PER_DECADE = 9, 4  # about the mean free path, where flux is looked for
FEW = 16  # directions at each of those distances
LEFT_OUT = 1e-7  # share of its largest value below which the integrand in ln r is left out


def lattice_reflectance(model: BSSRDF, mu_i: float) -> tuple[float, float]:
    """R(mu_i) of a model of a scalar medium, and its standard error."""
    window = _window(model, mu_i)
    if window is None:
        return 0.0, 0.0
    values: list[float] = []
    error = math.inf
    while not values or (len(values) < MOST_SHIFTS and error > ENOUGH * abs(np.mean(values))):
        shifts = [np.random.default_rng(len(values) + k).random(len(GENERATOR)) for k in range(SHIFTS)]
        query, weight = _points(POINTS, np.stack(shifts, axis=1), window, mu_i, model.medium.eta)
        values += np.mean((_evaluated(model, query) * weight).reshape(SHIFTS, POINTS), axis=1).tolist()
        error = float(np.std(values, ddof=1)) / math.sqrt(len(values))
    return float(np.mean(values)), error


def _evaluated(model: BSSRDF, query: Query) -> np.ndarray:
    """S of a query, in the array library in which the model is fast."""
    query = np.broadcast_arrays(*query)
    if model.fast_in == "drjit":
        Float = array_types().Float
        S = model.eval(*(Float(np.ravel(v).astype(np.float32)) for v in query)).numpy()
    else:
        S = model.eval(*query)
    return np.asarray(S, dtype=np.float64).reshape(query[0].shape)


def _points(
    n: int, shifts: np.ndarray, window: tuple[float, float], mu_i: float, eta: float
) -> tuple[Query, np.ndarray]:
    """Queries of the lattice for each column of shifts in turn, and the weights whose mean of S is R."""
    u = (np.arange(n) * GENERATOR[:, None, None] / n + shifts[..., None]).reshape(len(GENERATOR), -1) % 1.0
    # r, by ln r over the window that carries flux
    low, high = window
    r = np.exp(low + (high - low) * u[0])
    # psi over pi, graded towards the peak at psi = 0
    psi, w_psi = _graded(u[1], GRADE)
    between = 2 * math.pi * u[2]  # of the directions of travel; psi in [0, pi] then stands for both signs
    # mu_o = t on the thinner side of the surface, beyond which nothing refracts
    t, w_mu = _graded(u[3], 2)
    thin = min(eta, 1.0)
    mu_o = mu_external(t, thin)
    mu_in, mu_out = mu_internal(mu_i, eta), mu_internal(mu_o, eta)
    # azimuth of v from that of d_i, with the sines of both refracted rays
    into, out = mu_out * np.sqrt(1 - mu_in**2), mu_in * np.sqrt(1 - mu_out**2)  # of mu_i' mu_o' v
    along = np.arctan2(out * np.sin(between), into + out * np.cos(between)) + math.pi * psi
    # dA dw_o mu_o = r² dln r dpsi dbetween mu_o dmu_o
    weight = (high - low) * 2 * math.pi * r * r * w_psi * 2 * math.pi * thin**2 * t * w_mu
    return (r, mu_i, math.pi - along, mu_o, between - along), weight


def _graded(t: np.ndarray, power: int) -> tuple[np.ndarray, np.ndarray]:
    """[0, 1] onto itself, beginning as a power of t and ending flat, and the derivative p (p + 1) t^(p-1) (1 - t)."""
    p = power
    return t**p * (p + 1 - p * t), p * (p + 1) * t ** (p - 1) * (1 - t)


def _window(model: BSSRDF, mu_i: float) -> tuple[float, float] | None:
    """ln r between which r² S carries flux; None where there is none."""
    r = float(model.medium.mfp) * np.logspace(-DECADES, DECADES, 2 * DECADES * PER_DECADE + 1)
    query, _ = _points(FEW, np.full((len(GENERATOR), 1), 0.3), (0.0, 1.0), mu_i, model.medium.eta)
    mass = np.abs(_evaluated(model, (r[:, None], *query[1:]))).mean(axis=1) * r * r
    alive = np.nonzero(mass > LEFT_OUT * mass.max())[0]
    if not len(alive):
        return None
    return math.log(r[max(alive[0] - 1, 0)]), math.log(r[min(alive[-1] + 1, len(r) - 1)])
