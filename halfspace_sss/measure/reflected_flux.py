"""Reflectance of any half-space model, R(mu_i) = ∫∫ S mu_o dw_o dA_o, and its error; exitance over distance."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from halfspace_sss.backend import array_types
from halfspace_sss.checks import rounding
from halfspace_sss.interface.model import BSSRDF
from halfspace_sss.measure.quadrature import Angles, Quadrature, cosine_nodes, distances, log_sum
from halfspace_sss.physics import single_scattering
from halfspace_sss.physics.fresnel import mu_external, mu_internal

DEFAULT = Quadrature()
DIFFUSE_COSINES = 10  # of incidence, on the lattice


Incidence = float | np.ndarray | str  # external cosines, or "diffuse"
Values = float | np.ndarray  # one for each incidence, and for each channel if there are any


class Integral(NamedTuple):
    """A value and its error."""

    value: Values
    error: Values


def flux(angles: Angles, mu_i: float, q: Quadrature) -> np.ndarray:
    """R(mu_i) = 2 pi ∫ r² M dln r, one value per channel."""
    r = distances(angles, mu_i, q)
    M = angles.exitance(r, mu_i)[0]
    return 2 * math.pi * log_sum(M * r[:, None] ** 2, math.log(r[1] / r[0]))


def over_incidence(angles: Angles, mu_i: Incidence, q: Quadrature) -> Values:
    """`flux` for a number, an array or "diffuse", with the channel axis last if the medium has one."""
    _check_diffuse(mu_i)
    if isinstance(mu_i, str):
        mu, w = cosine_nodes(angles.medium.eta, q.n_mu)
        R = 2 * w @ np.stack([flux(angles, m, q) for m in mu])
    else:
        mu = checked_cosines(mu_i)
        R = np.stack([flux(angles, m, q) for m in mu.ravel()]).reshape(*mu.shape, -1)
    return R if angles.medium.n_channels is not None else R[..., 0][()]


def checked_cosines(mu_i: float | np.ndarray) -> np.ndarray:
    """Cosines in [0, 1] in float64, those that exceed 1 by rounding as 1; ValueError otherwise."""
    mu = np.asarray(mu_i, dtype=np.float64)
    mu = np.where((mu > 1) & (mu <= 1 + rounding(mu_i)), 1.0, mu)
    if not mu.size or not np.all((mu >= 0) & (mu <= 1)):
        bad = mu[~((mu >= 0) & (mu <= 1))]
        raise ValueError(
            f"mu_i must be in [0, 1], got {float(bad.flat[0])!r}" if bad.size else "mu_i must not be empty"
        )
    return mu


def reflectance(
    model: BSSRDF, mu_i: Incidence = 1.0, order: str | None = None, quadrature: Quadrature | None = None
) -> Values:
    """Fraction of incident flux that comes back out of the medium, R(mu_i) = ∫∫ S mu_o dw_o dA_o.

    Args:
        model: any model of the interface.
        mu_i: external cosine of incidence, number or NumPy array in [0, 1], or "diffuse" for uniform radiance from
            above, 2 ∫ R(mu_i) mu_i dmu_i.
        order: None for the orders the model contains, or "multiple", or "total", which adds the exact single order to
            a model of "multiple".
        quadrature: see `Quadrature`. None: its defaults where S does not depend on both azimuths (1e-6 relative for
            smooth models), else a lattice; `reflectance_estimate` tells the error.

    Returns:
        Array of the shape of mu_i, with the channel axis last if the medium has channels; a number for numbers.

    Raises:
        ValueError: mu_i is out of range, or the model cannot form the order.
    """
    check_order(model, order)
    angles = Angles(model.eval, model.medium, quadrature or DEFAULT)
    on_lattice = quadrature is None and angles.both_azimuths
    R = _lattice(model, mu_i).value if on_lattice else over_incidence(angles, mu_i, quadrature or DEFAULT)
    return R + _single(model, mu_i, order)


def reflectance_estimate(model: BSSRDF, mu_i: Incidence = 1.0, order: str | None = None) -> Integral:
    """`reflectance` with its error: on a lattice the standard error, else the difference from a rule of half as many.

    Arguments, shapes and errors as `reflectance`.
    """
    check_order(model, order)
    angles = Angles(model.eval, model.medium, DEFAULT)
    if angles.both_azimuths:
        R = _lattice(model, mu_i)
    else:
        half = Quadrature(DEFAULT.per_decade // 2, DEFAULT.n_azimuth // 2, DEFAULT.n_mu // 2)
        value = over_incidence(angles, mu_i, DEFAULT)
        R = Integral(value, abs(value - over_incidence(Angles(model.eval, model.medium, half), mu_i, half)))
    return Integral(R.value + _single(model, mu_i, order), R.error)


def check_order(model: BSSRDF, order: str | None) -> None:
    """ValueError unless the model can form the order, None or "total"."""
    if order not in (None, model.orders) and (order, model.orders) != ("total", "multiple"):
        raise ValueError(
            f'order must be {model.orders!r} or None for {model.name!r}, or "total" if "multiple", got {order!r}'
        )


def _single(model: BSSRDF, mu_i: Incidence, order: str | None) -> Values:
    added = order == "total" and model.orders == "multiple"
    return single_scattering.reflectance(model.medium, mu_i) if added else 0.0


def _lattice(model: BSSRDF, mu_i: Incidence) -> Integral:
    """By the lattice, for a number, an array or "diffuse", with the channel axis last if the medium has one."""
    _check_diffuse(mu_i)
    m = model.medium
    parts = [model] if m.n_channels is None else [model.for_medium(m.channel(k)) for k in range(m.n_channels)]
    diffuse = isinstance(mu_i, str)
    mu, w = cosine_nodes(m.eta, DIFFUSE_COSINES) if diffuse else (checked_cosines(mu_i), None)
    result = np.array([[lattice_reflectance(part, one) for part in parts] for one in mu.ravel().tolist()])
    result = 2 * np.tensordot(w, result, 1) if diffuse else result.reshape(*mu.shape, len(parts), 2)
    return Integral(*(v if m.n_channels is not None else v[..., 0][()] for v in (result[..., 0], result[..., 1])))


def _check_diffuse(mu_i: Incidence) -> None:
    if isinstance(mu_i, str) and mu_i != "diffuse":
        raise ValueError(f'mu_i must be cosines in [0, 1] or "diffuse", got {mu_i!r}')


class Moments(NamedTuple):
    """Mean square distance (mm²) and mean displacement along the incident light's travel (mm) of the exitant flux."""

    mean_r2: Values
    mean_x: Values


def profile(model: BSSRDF, r: float | np.ndarray, mu_i: float = 1.0, quadrature: Quadrature = DEFAULT) -> np.ndarray:
    """Exitance per incident flux at distance r, averaged over azimuth, M(r) = (1/2pi) ∫∫ S mu_o dw_o dphi, 1/mm².

    Args:
        r: distances in mm, >= 0, any shape; the result adds the channel axis last if the medium has channels.
        mu_i: external cosine of incidence, one number in [0, 1].

    Raises:
        ValueError: r or mu_i is out of range.
    """
    r = np.asarray(r, dtype=np.float64)
    mu_i = float(checked_cosines(mu_i))
    M = Angles(model.eval, model.medium, quadrature).exitance(r.ravel(), mu_i)[0].reshape(*r.shape, -1)
    return M if model.medium.n_channels is not None else M[..., 0][()]


def moments(model: BSSRDF, mu_i: float = 1.0, quadrature: Quadrature = DEFAULT) -> Moments:
    """Where the exitant flux leaves on average: ⟨r²⟩ = ∫ r² M dA / ∫ M dA in mm², ⟨x⟩ likewise in mm.

    x runs along the horizontal direction of travel of the incident light. A moment that diverges (no absorption: the
    profile falls as r^-3) is inf; NaN where nothing comes out. mu_i: one number in [0, 1]; ValueError otherwise.
    """
    mu_i = float(checked_cosines(mu_i))
    angles = Angles(model.eval, model.medium, quadrature)
    r = distances(angles, mu_i, quadrature, (2, 4))
    M, M_x = angles.exitance(r, mu_i)
    h, r = math.log(r[1] / r[0]), r[:, None]
    with np.errstate(invalid="ignore", divide="ignore"):
        R = log_sum(M * r**2, h)
        result = log_sum(M * r**4, h) / R, log_sum(M_x * r**3, h) / R
    return Moments(*(v if model.medium.n_channels is not None else v[0] for v in result))


# ---- Reflectance on a lattice, for S that depends on both azimuths.
#
# The refracted rays at x_i and x_o meet where x_o - x_i points along v = d_i/mu_i' + d_o/mu_o' in the plane; there S
# of a network has its peak. The variables are ln r over what carries flux, the azimuth psi of x_o - x_i from v, mu_o,
# and the azimuth between the directions. With psi and mu_o graded towards their ends the integrand is periodic, and a
# rank-1 lattice converges nearly as 1/n². The spread over random shifts is its error (Sloan and Joe 1994); the
# generating vector is built component by component for the weights of order two.

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
