"""Reflectance of any half-space model, R(mu_i) = ∫∫ S mu_o dw_o dA_o, and its error; exitance over distance."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from halfspace_sss.checks import rounding
from halfspace_sss.interface.model import BSSRDF
from halfspace_sss.measure.lattice import lattice_reflectance
from halfspace_sss.measure.quadrature import Angles, Quadrature, cosine_nodes, distances, log_sum
from halfspace_sss.physics import single_scattering

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
    _check_order(model, order)
    angles = Angles(model.eval, model.medium, quadrature or DEFAULT)
    on_lattice = quadrature is None and angles.both_azimuths
    R = _lattice(model, mu_i).value if on_lattice else over_incidence(angles, mu_i, quadrature or DEFAULT)
    return R + _single(model, mu_i, order)


def reflectance_estimate(model: BSSRDF, mu_i: Incidence = 1.0, order: str | None = None) -> Integral:
    """`reflectance` with its error: on a lattice the standard error, else the difference from a rule of half as many.

    Arguments, shapes and errors as `reflectance`.
    """
    _check_order(model, order)
    angles = Angles(model.eval, model.medium, DEFAULT)
    if angles.both_azimuths:
        R = _lattice(model, mu_i)
    else:
        half = Quadrature(DEFAULT.per_decade // 2, DEFAULT.n_azimuth // 2, DEFAULT.n_mu // 2)
        value = over_incidence(angles, mu_i, DEFAULT)
        R = Integral(value, abs(value - over_incidence(Angles(model.eval, model.medium, half), mu_i, half)))
    return Integral(R.value + _single(model, mu_i, order), R.error)


def _check_order(model: BSSRDF, order: str | None) -> None:
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
