"""Reflectance of any half-space model, R(mu_i) = ∫∫ S mu_o dw_o dA_o, and its error; exitance over distance.

And what a model keeps: reciprocity, positive values, energy; the variance of its own samples.

Over spatial frequency, R(f) = ∫ M(r) J_0(2 pi f r) dA, and the coefficients of a medium from it. Light projected as a
cosine over the plane comes back with its contrast multiplied by R(f) / R(0), which spatial frequency domain imaging
measures (Cuccia et al. 2009). The integral runs over panels between zeros of J_0.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from halfspace_sss.arrays import aligned
from halfspace_sss.backend import array_types
from halfspace_sss.checks import check_cosine, check_count, check_edges, rounding
from halfspace_sss.interface.model import BSSRDF
from halfspace_sss.measure.quadrature import Angles, Quadrature, cosine_nodes, distances, log_sum
from halfspace_sss.physics import single_scattering
from halfspace_sss.physics.fresnel import mu_external, mu_internal
from halfspace_sss.physics.medium import Medium, check_numbers, check_scalar_medium
from halfspace_sss.registry import bssrdf
from halfspace_sss.tracing.instrument import Readings, checked_frequencies, transformed

DEFAULT = Quadrature()
DIFFUSE_COSINES = 10  # of incidence, on the lattice
RING_NODES, NEAREST = 32, 1e-4  # of a ring; its least radius over the outer one


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
        ValueError: mu_i is out of range, the model cannot form the order, or the medium has derivatives.
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
    parts = [model] if m.n_channels is None else [model.for_medium(one) for one in m.channels()]
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


def ring_means(
    model: BSSRDF, radii: Sequence[float], mu_i: float = 1.0, quadrature: Quadrature = DEFAULT
) -> np.ndarray:
    """Mean exitance per incident flux over each ring between consecutive radii, 1/mm²: what `Trace.exitance` estimates.

    (1 / A_k) ∫ M(r) 2 pi r dr over the ring k of area A_k, by Gauss and Legendre in the logarithm of r; a ring that
    begins at 0 leaves out what lies within 1e-4 of its outer radius.

    Args:
        radii: edges in mm, >= 0, ascending.
        mu_i: external cosine of incidence, one number in [0, 1].

    Returns:
        One value for each ring; the channel axis is last if the medium has channels.

    Raises:
        ValueError: radii or mu_i are out of range.
    """
    edges = check_edges("radii", radii)
    t, weight = np.polynomial.legendre.leggauss(RING_NODES)
    low, high = np.log(np.maximum(edges[:-1], NEAREST * edges[1:])), np.log(edges[1:])
    half = 0.5 * (high - low)[:, None]
    r = np.exp(0.5 * (low + high)[:, None] + half * t)
    M = profile(model, r, mu_i, quadrature)
    # dA = 2 pi r dr = 2 pi r² d(log r)
    parts = 2 * half * weight * r * r / np.diff(edges**2)[:, None]
    return np.einsum("ij,ij...->i...", parts, M)


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
        values += np.mean((evaluated(model, query) * weight).reshape(SHIFTS, POINTS), axis=1).tolist()
        error = float(np.std(values, ddof=1)) / math.sqrt(len(values))
    return float(np.mean(values)), error


def evaluated(model: BSSRDF, query: Query) -> np.ndarray:
    """S of NumPy arrays in their precision, in the library that is fastest for the model; the result in double."""
    query = np.broadcast_arrays(*query)
    if model.fast_in == "drjit":
        Float = array_types().Float
        S = model.eval(*(aligned(Float, v) for v in query)).numpy()
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
    mass = np.abs(evaluated(model, (r[:, None], *query[1:]))).mean(axis=1) * r * r
    alive = np.nonzero(mass > LEFT_OUT * mass.max())[0]
    if not len(alive):
        return None
    return math.log(r[max(alive[0] - 1, 0)]), math.log(r[min(alive[-1] + 1, len(r) - 1)])


class ReciprocityGap(NamedTuple):
    """|S - S'| / (S + S'), S' with entry and exit exchanged: mean and largest over the queries, and share of energy."""

    mean: Values
    max: Values
    energy: Values


def reciprocity_gap(model: BSSRDF, n: int = 4096, seed: int = 0) -> ReciprocityGap:
    """How far S(x_i, w_i; x_o, w_o) is from S' = S(x_o, w_o; x_i, w_i), by |S - S'| / (S + S') at random queries.

    r is uniform in ln r from 0.01 mean free paths to 10 transport mean free paths, both directions follow the cosine
    over those that refract, azimuths are uniform. `mean` and `max` are over queries (0 where both vanish); `energy`
    is sum r² |S - S'| / sum r² |S + S'|, the share of the transported flux. One value per channel where there are any.

    Raises:
        ValueError: n < 1, or the medium has derivatives.
    """
    if n < 1:
        raise ValueError(f"n must be >= 1, got {n!r}")
    check_numbers("medium", m := model.medium)
    mfp, transport = np.atleast_1d(m.mfp), 1 / np.maximum(np.atleast_1d(m.sigma_t_prime), 1e-300)
    gaps = []
    for k in range(len(mfp)):
        rng = np.random.default_rng(seed)
        r = np.exp(rng.uniform(math.log(0.01 * mfp[k]), math.log(10 * transport[k]), n))
        mu_i, mu_o = (mu_external(np.sqrt(rng.uniform(0, 1, n)), min(m.eta, 1.0)) for _ in range(2))
        phi_i, phi_o = rng.uniform(-math.pi, math.pi, (2, n))
        S = np.reshape(model.eval(r, mu_i, phi_i, mu_o, phi_o), (n, -1))[:, k].astype(np.float64)
        back = np.reshape(model.eval(r, mu_o, phi_o + math.pi, mu_i, phi_i + math.pi), (n, -1))[:, k].astype(np.float64)
        gap, size = np.abs(S - back), np.abs(S + back)
        ratio = gap / np.where(size > 0, size, 1.0)
        gaps.append((ratio.mean(), ratio.max(), np.sum(r**2 * gap) / max(np.sum(r**2 * size), 1e-300)))
    return ReciprocityGap(*(np.array(v) if m.n_channels is not None else v[0] for v in zip(*gaps)))


def clamped_energy(model: BSSRDF, mu_i: Incidence = 1.0, quadrature: Quadrature = DEFAULT) -> Values:
    """Flux per incident flux that clamping negative values adds, ∫∫ (S - S_unclamped) mu_o dw_o dA_o, >= 0.

    0 for a model that does not clamp. Arguments, shapes and errors as `reflectance`.
    """
    if type(model).G_unclamped is BSSRDF.G_unclamped:
        coarse = Quadrature(4, 4, 2)
        return 0.0 * over_incidence(Angles(model.eval, model.medium, coarse), mu_i, coarse)

    def added(*query: np.ndarray) -> np.ndarray:
        return model.eval(*query) - model.eval_unclamped(*query)

    return over_incidence(Angles(added, model.medium, quadrature, model.eval), mu_i, quadrature)


def weight_variance(model: BSSRDF, mu_o: float = 0.8, n: int = 1 << 14, seed: int = 0) -> Values:
    """Relative variance of the weight S mu_i / (pdf_position pdf_direction) of the model's own samples.

    Var(w) / E(w)², E(w) the radiance that leaves under uniform light: the smaller, the fewer samples a render needs.

    Args:
        model: any model; a medium with channels gives one value for each.
        mu_o: cosine of exit, (0, 1].
        n: samples, at least 2; seed: of the uniform numbers.

    Raises:
        ValueError: an argument is out of range.
    """
    mu_o = check_cosine("mu_o", mu_o, 1e-6)
    check_count("n", n, 2)
    check_count("seed", seed, 0)
    if model.medium.n_channels is not None:
        parts = [model.for_medium(m) for m in model.medium.channels()]
        return np.array([weight_variance(part, mu_o, n, seed) for part in parts])
    u = np.random.default_rng(seed).random((4, n))
    at = model.sample_position(mu_o, (u[0], u[1]))
    phi_o = np.pi - at.phi
    w_i = model.sample_direction(at.r, mu_o, phi_o, (u[2], u[3]))
    w = model.eval(at.r, w_i.mu_i, w_i.phi_i, mu_o, phi_o) * w_i.mu_i / (at.pdf * w_i.pdf)
    return float(np.var(w, ddof=1) / np.mean(w) ** 2)


PANELS_PER_DECADE, NODES = 4, 8
MOST_ZEROS = 64  # of J_0 beyond which half of the last panel stands for the rest, whose signs alternate
START = (0.02, 10.0)  # sigma_a / sigma_s', and sigma_s' over the middle frequency, from which a fit begins


class ReducedCoefficients(NamedTuple):
    """Absorption and reduced scattering, 1/mm, each a value with its standard error."""

    sigma_a: Integral
    sigma_s_prime: Integral


def frequency_reflectance(
    model: BSSRDF, frequencies: Sequence[float], order: str | None = None, quadrature: Quadrature = DEFAULT
) -> np.ndarray:
    """R(f) of any half-space model for light along the normal.

    Args:
        model: of a scalar medium.
        frequencies: spatial frequencies, 1/mm, >= 0.
        order: as in `measure.reflectance`; "total" adds the exact single order.
        quadrature: of directions. Where S depends on both azimuths, as in networks, the default takes tens of seconds;
            `Quadrature(n_azimuth=8, n_mu=6)` takes 0.6 a frequency and is 1 % low for `neural` at albedo 0.95.

    Raises:
        ValueError: a frequency is out of range, the medium has channels, or the model cannot form the order.
    """
    from scipy.special import j0

    check_order(model, order)
    check_scalar_medium(model.medium)
    angles, result = Angles(model.eval, model.medium, quadrature), []
    range_of = distances(angles, 1.0, quadrature)[[0, -1]]
    for f in checked_frequencies(frequencies):
        k = 2 * math.pi * f
        r, w, n = _nodes(*range_of, k)
        M = angles.exitance(r, 1.0)[0][:, 0]
        if order == "total" and model.orders == "multiple":
            M = M + single_scattering.exitance(model.medium, r, 1.0, 0.0)
        panels = (M * j0(k * r) * 2 * math.pi * r * w).reshape(-1, NODES).sum(axis=1)
        result.append(panels.sum() - (0.5 * panels[-1] if n else 0.0))
    return np.array(result)


def _nodes(low: float, high: float, k: float) -> tuple[np.ndarray, np.ndarray, bool]:
    """Distances and weights of dr, panels in turn, and whether they end before the profile does."""
    from scipy.special import jn_zeros

    zeros = jn_zeros(0, MOST_ZEROS) / k if k > 0 else np.zeros(0)
    zeros = zeros[(zeros > low) & (zeros < high)]
    turn = zeros[0] if len(zeros) else high
    edges = np.geomspace(low, turn, math.ceil(PANELS_PER_DECADE * math.log10(turn / low)) + 2)
    cut = len(zeros) == MOST_ZEROS
    edges = np.concatenate([edges, zeros[1:], [] if cut or not len(zeros) else [high]])
    x, w = np.polynomial.legendre.leggauss(NODES)
    half = 0.5 * np.diff(edges)[:, None]
    return (edges[:-1, None] + half * (1 + x)).ravel(), (half * w).ravel(), cut


def coefficients_of_frequencies(
    frequencies: Sequence[float], reflectance: Sequence[float], error: float | Sequence[float],
    by: str | Readings, *, g: float = 0.0, eta: float = 1.0,
) -> ReducedCoefficients:  # fmt: skip
    """Absorption and reduced scattering of a medium from its reflectance at two or more spatial frequencies.

    Least squares in ln sigma_a and ln sigma_s'; the errors follow from `error` by the derivatives at the solution.

    Args:
        frequencies: two or more, 1/mm, >= 0.
        reflectance: R at each, without what the surface mirrors.
        error: standard error of R, one or one for each.
        by: the name of a model, asked for the total order; or the readings of a trace that has walked a medium without
            absorption with `white` and with radii that hold all light, which are exact but for their noise.
        g, eta: of the medium, for a model; a trace has its own.

    Raises:
        ValueError: there are fewer than two frequencies, a number is out of range, or no medium has this reflectance
            to within five errors.
    """
    from scipy.optimize import least_squares

    f = checked_frequencies(frequencies)
    R, error = np.asarray(reflectance, dtype=np.float64), np.broadcast_to(np.asarray(error, dtype=np.float64), f.shape)
    if len(set(f.tolist())) < 2:
        raise ValueError(f"frequencies must be two or more, got {f.tolist()}")
    if R.shape != f.shape or not np.all((R > 0) & (R < 1)):
        raise ValueError(f"reflectance must be in (0, 1) for each frequency, got {R.tolist()}")
    if not np.all(error > 0):
        raise ValueError(f"error must be > 0, got {error.tolist()}")
    white = _by_white_trace(by) if isinstance(by, Readings) else None

    def residual(x: np.ndarray) -> np.ndarray:
        sigma_a, sigma_s_prime = np.exp(x).tolist()
        if white:
            return (white(f, sigma_a, sigma_s_prime) - R) / error
        model = bssrdf(by, Medium(sigma_s_prime / (1 - g), sigma_a, g, eta))
        return (frequency_reflectance(model, f, "total") - R) / error

    s = START[1] * max(np.median(f), 1e-3)
    fit = least_squares(residual, np.log([START[0] * s, s]), bounds=(np.log(1e-8), np.log(1e6)), x_scale=1.0)
    if not np.sqrt(np.mean(fit.fun**2)) < 5:
        raise ValueError(f"reflectance must be that of a medium, got {R.tolist()}, off by {fit.fun.tolist()} errors")
    value, spread = np.exp(fit.x), np.sqrt(np.diag(np.linalg.pinv(fit.jac.T @ fit.jac)))
    return ReducedCoefficients(*(Integral(float(v), float(v * e)) for v, e in zip(value, spread)))


def _by_white_trace(readings: Readings) -> Callable[..., np.ndarray]:
    """By the scaling of a half-space: lengths in 1/sigma_s'."""
    medium = readings.medium
    if medium.sigma_a != 0:
        raise ValueError(f"by must be of a medium without absorption, got sigma_a = {medium.sigma_a!r}")

    mean = replace(readings, _samples={"white": readings.histogram().mean(axis=0, keepdims=True)})

    def forward(f: np.ndarray, sigma_a: float, sigma_s_prime: float) -> np.ndarray:
        scale = medium.sigma_s_prime / sigma_s_prime
        return transformed(mean.at_absorptions(sigma_a * scale), mean.radii, f * scale)[0, :, 0]

    return forward
