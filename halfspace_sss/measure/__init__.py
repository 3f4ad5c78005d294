"""Measures of any half-space model through the shared interface alone: flux, profile, moments, reciprocity, energy.

Everything is an integral of S by a quadrature whose numbers are open (`Quadrature`): a trapezoid in ln r over the
distances that carry flux, periodic trapezoids in both azimuths with the mirror symmetry, Gauss-Legendre in mu_o.

Where S depends on both azimuths, the reflectance is summed on a shifted lattice. The refracted rays at x_i
and x_o meet where x_o - x_i points along v = d_i/mu_i' + d_o/mu_o' in the plane: there S of a network has its peak. The
variables are ln r over what carries flux, the azimuth psi of x_o - x_i from v, mu_o, and the azimuth between the
directions. With psi and mu_o graded towards their ends the integrand is periodic, and a rank-1 lattice converges nearly
as 1/n². The spread over random shifts is its error (Sloan and Joe 1994); the generating vector is built component by
component for the weights of order two.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from halfspace_sss.backend import array_types
from halfspace_sss.checks import check_cosine, check_count, rounding
from halfspace_sss.interface.model import BSSRDF
from halfspace_sss.physics import single_scattering
from halfspace_sss.physics.fresnel import C_1, F_t, mu_external, mu_internal
from halfspace_sss.physics.medium import Medium
from halfspace_sss.registry import bssrdf, models

if TYPE_CHECKING:
    import pandas

__all__ = [
    "Angles", "Integral", "Moments", "Quadrature", "ReciprocityGap", "clamped_energy", "cosine_nodes", "distances",
    "energy_table", "flux", "lattice_reflectance", "log_sum", "moments", "profile", "reciprocity_gap",
    "reflectance", "reflectance_estimate", "weight_variance",
]  # fmt: skip


GENERATOR = np.array([1, 2431, 563, 1027])
POINTS = 8192
SHIFTS, MOST_SHIFTS = 4, 12  # of one launch, and in all
ENOUGH = 1e-4  # relative error after which no shift is added
GRADE = 4  # power of t with which psi begins
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


def _evaluated(model: BSSRDF, query: tuple[Any, ...]) -> np.ndarray:
    """S where the model is fast."""
    query = np.broadcast_arrays(*query)
    if model.fast_in == "drjit":
        Float = array_types().Float
        S = model.eval(*(Float(np.ravel(v).astype(np.float32)) for v in query)).numpy()
    else:
        S = model.eval(*query)
    return np.asarray(S, dtype=np.float64).reshape(query[0].shape)


def _points(
    n: int, shifts: np.ndarray, window: tuple[float, float], mu_i: float, eta: float
) -> tuple[tuple[Any, ...], np.ndarray]:
    """Queries of the lattice for each column of shifts in turn, and the weights whose mean of S is R."""
    u = (np.arange(n) * GENERATOR[:, None, None] / n + shifts[..., None]).reshape(len(GENERATOR), -1) % 1.0
    low, high = window
    r = np.exp(low + (high - low) * u[0])
    psi, w_psi = _graded(u[1], GRADE)
    between = 2 * math.pi * u[2]  # of the directions of travel; psi in [0, pi] then stands for both signs
    t, w_mu = _graded(u[3], 2)
    thin = min(eta, 1.0)
    mu_o = mu_external(t, thin)
    mu_in, mu_out = mu_internal(mu_i, eta), mu_internal(mu_o, eta)
    into, out = mu_out * np.sqrt(1 - mu_in**2), mu_in * np.sqrt(1 - mu_out**2)  # of mu_i' mu_o' v
    along = np.arctan2(out * np.sin(between), into + out * np.cos(between)) + math.pi * psi
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


SCAN = (-9, 9)  # decades about the mean free path in which the flux is looked for
DEAD = 1e-9  # share of its largest value below which the integrand in ln r is left to a geometric series
LANES = 1 << 18  # values of S asked for at once


@dataclass(frozen=True)
class Quadrature:
    """How finely to integrate.

    Args:
        per_decade: distances per factor of ten in r, >= 4.
        n_azimuth: azimuths over the full circle, even, >= 4; an azimuth on which S does not depend gets one.
        n_mu: exit cosines, >= 2; also the cosines of incidence of "diffuse".
    """

    per_decade: int = 20
    n_azimuth: int = 32
    n_mu: int = 20

    def __post_init__(self) -> None:
        for name, least in (("per_decade", 4), ("n_azimuth", 4), ("n_mu", 2)):
            if not getattr(self, name) >= least:
                raise ValueError(f"{name} must be >= {least}, got {getattr(self, name)!r}")
        if self.n_azimuth % 2:
            raise ValueError(f"n_azimuth must be even, got {self.n_azimuth!r}")


class Angles:
    """Quadrature over exit directions and azimuths for one S(r, mu_i, phi_i, mu_o, phi_o) of a medium.

    `probe` is asked which azimuths matter where S itself is 0 at most queries and would not tell.
    """

    def __init__(self, evaluate: Callable, medium: Medium, q: Quadrature, probe: Callable | None = None) -> None:
        self.evaluate, self.medium = evaluate, medium
        self.mu_o, self.w_mu = cosine_nodes(medium.eta, q.n_mu)
        self.phi_o = 2 * math.pi * (np.arange(q.n_azimuth) + 0.5) / q.n_azimuth
        half = q.n_azimuth // 2
        self.phi_i = math.pi * np.arange(half + 1) / half
        self.w_i = np.r_[0.5, np.ones(half - 1), 0.5] / half
        self.w_x = -self.w_i * np.cos(self.phi_i)
        free_i, free_o = self._unused_azimuths(probe or evaluate)
        self.both_azimuths = not (free_i or free_o)
        if not self.both_azimuths:
            self._merge_exits(probe or evaluate)
        if free_i:
            self.phi_i, self.w_i, self.w_x = np.array([0.5 * math.pi]), np.ones(1), np.zeros(1)
        if free_o:
            self.phi_o = np.array([0.5 * math.pi])

    def _unused_azimuths(self, evaluate: Callable) -> tuple[bool, bool]:
        """Whether S ignores phi_i and phi_o, asked at random queries about the mean free paths of all channels."""
        rng = np.random.default_rng(1)
        n = 48
        r = np.exp(rng.uniform(math.log(0.01), math.log(20.0), n)) * rng.choice(np.atleast_1d(self.medium.mfp), n)
        mu_i, mu_o = (mu_external(np.sqrt(rng.uniform(0, 1, n)), min(self.medium.eta, 1.0)) for _ in range(2))
        phi_i, phi_o, other_i, other_o = rng.uniform(-math.pi, math.pi, (4, n))
        queries = ((phi_i, phi_o), (other_i, phi_o), (phi_i, other_o))
        phi_i, phi_o = (np.concatenate(columns) for columns in zip(*queries))
        S, *others = np.split(np.asarray(evaluate(np.tile(r, 3), np.tile(mu_i, 3), phi_i, np.tile(mu_o, 3), phi_o)), 3)
        return tuple(bool(np.all(np.abs(S - other) <= 1e-10 * np.abs(S))) for other in others)

    def _merge_exits(self, evaluate: Callable) -> None:
        """One exit cosine with the weight of all where S is a product with a function of mu_o."""
        rng = np.random.default_rng(2)
        n, last, mfp = 8, len(self.mu_o) - 1, np.atleast_1d(self.medium.mfp)
        r = np.exp(rng.uniform(math.log(0.01), math.log(20.0), (n, 1))) * rng.choice(mfp, (n, 1))
        phi_i, phi_o = rng.uniform(-math.pi, math.pi, (2, n, 1))
        S = np.asarray(evaluate(r, rng.uniform(0.1, 1, (n, 1)), phi_i, self.mu_o, phi_o), dtype=np.float64)
        S = np.moveaxis(S.reshape(n, last + 1, -1), 1, 0)
        lit = S[last] > 0
        if not lit.any():
            return
        ratio = S[:, lit] / S[last, lit]
        if np.ptp(ratio, axis=1).max() <= 1e-10 and not S[:, ~lit].any():
            self.mu_o, self.w_mu = self.mu_o[last:], np.array([self.w_mu @ ratio[:, 0]])

    def exitance(self, r: np.ndarray, mu_i: float) -> tuple[np.ndarray, np.ndarray]:
        """∫ S mu_o dw_o, averaged over azimuth, plain and times cos(azimuth from the far side); shape (r, channels)."""
        per_r = len(self.phi_i) * len(self.phi_o) * len(self.mu_o) * (self.medium.n_channels or 1)
        parts = [self._exitance(part, mu_i) for part in np.array_split(r, max(1, math.ceil(len(r) * per_r / LANES)))]
        return tuple(np.concatenate(p) for p in zip(*parts))

    def _exitance(self, r: np.ndarray, mu_i: float) -> tuple[np.ndarray, np.ndarray]:
        S = self.evaluate(r[:, None, None, None], mu_i, self.phi_i[:, None, None], self.mu_o[:, None], self.phi_o)
        S = np.asarray(S, dtype=np.float64).reshape(*S.shape[:4], -1)
        per_azimuth = 2 * math.pi * np.einsum("rimoc,m->ric", S, self.w_mu) / len(self.phi_o)
        return tuple(np.einsum("ric,i->rc", per_azimuth, w) for w in (self.w_i, self.w_x))


def cosine_nodes(eta: float, n: int) -> tuple[np.ndarray, np.ndarray]:
    """External cosines and weights of mu dmu on [0, 1]: Gauss in t, t² the cosine on the thinner side of the surface.

    For eta < 1 that is the cosine inside, since light outside the cone 1 - mu² < eta² does not refract.
    """
    nodes, weights = np.polynomial.legendre.leggauss(n)
    t = 0.5 * (nodes + 1)
    thin = min(eta, 1.0)
    return mu_external(t * t, thin), thin**2 * t**3 * weights


def distances(angles: Angles, mu_i: float, q: Quadrature, powers: tuple[int, int] = (2, 2)) -> np.ndarray:
    """Distances (mm), uniform in ln r, from where r^powers[0] M starts to carry flux to where r^powers[1] M has died.

    A profile that falls as a power of r, so that the integrand never dies out, is cut a million times beyond its peak.
    """
    mfp = np.atleast_1d(angles.medium.mfp)
    low, high = math.log10(mfp.min()) + SCAN[0], math.log10(mfp.max()) + SCAN[1]
    r = 10 ** np.linspace(low, high, 2 * math.ceil(high - low) + 1)
    M = np.abs(angles.exitance(r, mu_i)[0])
    alive = []
    for power in powers:
        mass = M * r[:, None] ** power
        top = mass.max(axis=0)
        alive.append(np.nonzero(np.any((mass > DEAD * top) & (top > 0), axis=1))[0])
    if not len(alive[0]):
        return r[:3]
    first, last = max(alive[0][0] - 1, 0), min(alive[1][-1] + 1, len(r) - 1)
    if alive[1][-1] == len(r) - 1:
        last = min(np.argmax(M * r[:, None] ** 2, axis=0).max() + 12, len(r) - 1)
    n = math.ceil(q.per_decade * math.log10(r[last] / r[first]))
    return np.geomspace(r[first], r[last], n + 1)


def log_sum(f: np.ndarray, h: float) -> np.ndarray:
    """Trapezoid sum of f(ln r) with step h, both ends continued as geometric series; inf where one does not fall."""
    top = np.maximum(np.max(np.abs(f), axis=0), 1e-300)
    total = np.sum(f, axis=0)
    for end, inner in ((f[0], f[1]), (f[-1], f[-2])):
        with np.errstate(divide="ignore", invalid="ignore"):
            q = np.where(inner != 0, end / inner, 0.0)
        falls = (q >= 0) & (q < 0.995)
        rest = end * np.where(falls, q, 0.0) / (1 - np.where(falls, q, 0.0))
        total = total + np.where(~falls & (np.abs(end) > 1e-6 * top), np.inf, rest)
    return h * total


def flux(angles: Angles, mu_i: float, q: Quadrature) -> np.ndarray:
    """R(mu_i) = 2 pi ∫ r² M dln r, one value per channel."""
    r = distances(angles, mu_i, q)
    M = angles.exitance(r, mu_i)[0]
    return 2 * math.pi * log_sum(M * r[:, None] ** 2, math.log(r[1] / r[0]))


DEFAULT = Quadrature()
DIFFUSE_COSINES = 10  # of incidence, on the lattice


class Integral(NamedTuple):
    """A value and its error."""

    value: Any
    error: Any


class Moments(NamedTuple):
    """Mean square distance (mm²) and mean displacement along the incident light's travel (mm) of the exitant flux."""

    mean_r2: Any
    mean_x: Any


class ReciprocityGap(NamedTuple):
    """|S - S'| / (S + S'), S' with entry and exit exchanged: mean and largest over the queries, and share of energy."""

    mean: Any
    max: Any
    energy: Any


def _over_incidence(angles: Angles, mu_i: Any, q: Quadrature) -> np.ndarray:
    """`flux` for a number, an array or "diffuse", with the channel axis last if the medium has one."""
    _check_diffuse(mu_i)
    if isinstance(mu_i, str):
        mu, w = cosine_nodes(angles.medium.eta, q.n_mu)
        R = 2 * w @ np.stack([flux(angles, m, q) for m in mu])
    else:
        mu = _cosines(mu_i)
        R = np.stack([flux(angles, m, q) for m in mu.ravel()]).reshape(*mu.shape, -1)
    return R if angles.medium.n_channels is not None else R[..., 0][()]


def _cosines(mu_i: Any) -> np.ndarray:
    """Cosines in [0, 1] in float64, those that exceed 1 by rounding as 1; ValueError otherwise."""
    mu = np.asarray(mu_i, dtype=np.float64)
    mu = np.where((mu > 1) & (mu <= 1 + rounding(mu_i)), 1.0, mu)
    if not mu.size or not np.all((mu >= 0) & (mu <= 1)):
        bad = mu[~((mu >= 0) & (mu <= 1))]
        raise ValueError(
            f"mu_i must be in [0, 1], got {float(bad.flat[0])!r}" if bad.size else "mu_i must not be empty"
        )
    return mu


def reflectance(model: BSSRDF, mu_i: Any = 1.0, order: str | None = None, quadrature: Quadrature | None = None) -> Any:
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
    R = _lattice(model, mu_i).value if on_lattice else _over_incidence(angles, mu_i, quadrature or DEFAULT)
    return R + _single(model, mu_i, order)


def reflectance_estimate(model: BSSRDF, mu_i: Any = 1.0, order: str | None = None) -> Integral:
    """`reflectance` with its error: on a lattice the standard error, else the difference from a rule of half as many.

    Arguments, shapes and errors as `reflectance`.
    """
    _check_order(model, order)
    angles = Angles(model.eval, model.medium, DEFAULT)
    if angles.both_azimuths:
        R = _lattice(model, mu_i)
    else:
        half = Quadrature(DEFAULT.per_decade // 2, DEFAULT.n_azimuth // 2, DEFAULT.n_mu // 2)
        value = _over_incidence(angles, mu_i, DEFAULT)
        R = Integral(value, abs(value - _over_incidence(Angles(model.eval, model.medium, half), mu_i, half)))
    return Integral(R.value + _single(model, mu_i, order), R.error)


def _check_order(model: BSSRDF, order: str | None) -> None:
    if order not in (None, model.orders) and (order, model.orders) != ("total", "multiple"):
        raise ValueError(
            f'order must be {model.orders!r} or None for {model.name!r}, or "total" if "multiple", got {order!r}'
        )


def _single(model: BSSRDF, mu_i: Any, order: str | None) -> Any:
    added = order == "total" and model.orders == "multiple"
    return single_scattering.reflectance(model.medium, mu_i) if added else 0.0


def _lattice(model: BSSRDF, mu_i: Any) -> Integral:
    """By the lattice, for a number, an array or "diffuse", with the channel axis last if the medium has one."""
    _check_diffuse(mu_i)
    m = model.medium
    parts = [model] if m.n_channels is None else [model.for_medium(m.channel(k)) for k in range(m.n_channels)]
    diffuse = isinstance(mu_i, str)
    mu, w = cosine_nodes(m.eta, DIFFUSE_COSINES) if diffuse else (_cosines(mu_i), None)
    result = np.array([[lattice_reflectance(part, one) for part in parts] for one in mu.ravel().tolist()])
    result = 2 * np.tensordot(w, result, 1) if diffuse else result.reshape(*mu.shape, len(parts), 2)
    return Integral(*(v if m.n_channels is not None else v[..., 0][()] for v in (result[..., 0], result[..., 1])))


def _check_diffuse(mu_i: Any) -> None:
    if isinstance(mu_i, str) and mu_i != "diffuse":
        raise ValueError(f'mu_i must be cosines in [0, 1] or "diffuse", got {mu_i!r}')


def profile(model: BSSRDF, r: Any, mu_i: float = 1.0, quadrature: Quadrature = DEFAULT) -> np.ndarray:
    """Exitance per incident flux at distance r, averaged over azimuth, M(r) = (1/2pi) ∫∫ S mu_o dw_o dphi, 1/mm².

    Args:
        r: distances in mm, >= 0, any shape; the result adds the channel axis last if the medium has channels.
        mu_i: external cosine of incidence, one number in [0, 1].

    Raises:
        ValueError: r or mu_i is out of range.
    """
    r = np.asarray(r, dtype=np.float64)
    mu_i = float(_cosines(mu_i))
    M = Angles(model.eval, model.medium, quadrature).exitance(r.ravel(), mu_i)[0].reshape(*r.shape, -1)
    return M if model.medium.n_channels is not None else M[..., 0][()]


def moments(model: BSSRDF, mu_i: float = 1.0, quadrature: Quadrature = DEFAULT) -> Moments:
    """Where the exitant flux leaves on average: ⟨r²⟩ = ∫ r² M dA / ∫ M dA in mm², ⟨x⟩ likewise in mm.

    x runs along the horizontal direction of travel of the incident light. A moment that diverges (no absorption: the
    profile falls as r^-3) is inf; NaN where nothing comes out. mu_i: one number in [0, 1]; ValueError otherwise.
    """
    mu_i = float(_cosines(mu_i))
    angles = Angles(model.eval, model.medium, quadrature)
    r = distances(angles, mu_i, quadrature, (2, 4))
    M, M_x = angles.exitance(r, mu_i)
    h, r = math.log(r[1] / r[0]), r[:, None]
    with np.errstate(invalid="ignore", divide="ignore"):
        R = log_sum(M * r**2, h)
        result = log_sum(M * r**4, h) / R, log_sum(M_x * r**3, h) / R
    return Moments(*(v if model.medium.n_channels is not None else v[0] for v in result))


def reciprocity_gap(model: BSSRDF, n: int = 4096, seed: int = 0) -> ReciprocityGap:
    """How far S(x_i, w_i; x_o, w_o) is from S' = S(x_o, w_o; x_i, w_i), by |S - S'| / (S + S') at random queries.

    r is uniform in ln r from 0.01 mean free paths to 10 transport mean free paths, both directions follow the cosine
    over those that refract, azimuths are uniform. `mean` and `max` are over queries (0 where both vanish); `energy`
    is sum r² |S - S'| / sum r² |S + S'|, the share of the transported flux. One value per channel where there are any.

    Raises:
        ValueError: n < 1.
    """
    if n < 1:
        raise ValueError(f"n must be >= 1, got {n!r}")
    m = model.medium
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


def clamped_energy(model: BSSRDF, mu_i: Any = 1.0, quadrature: Quadrature = DEFAULT) -> Any:
    """Flux per incident flux that clamping negative values adds, ∫∫ (S - S_unclamped) mu_o dw_o dA_o, >= 0.

    0 for a model that does not clamp. Arguments, shapes and errors as `reflectance`.
    """
    if type(model).G_unclamped is BSSRDF.G_unclamped:
        coarse = Quadrature(4, 4, 2)
        return 0.0 * _over_incidence(Angles(model.eval, model.medium, coarse), mu_i, coarse)

    def added(*query: Any) -> Any:
        return model.eval(*query) - model.eval_unclamped(*query)

    return _over_incidence(Angles(added, model.medium, quadrature, model.eval), mu_i, quadrature)


def energy_table(
    media: Mapping[str, Medium], names: Iterable[str] | None = None, mu_i: Iterable[Any] = (1.0, 0.3, "diffuse"),
    quadrature: Quadrature | None = None,
) -> pandas.DataFrame:  # fmt: skip
    """Reflectance of models over media against what can enter, where models leave [0, 1].

    Args:
        media: media by name.
        names: registered models, by default all.
        mu_i: incidences as in `reflectance`.

    Returns:
        One row per medium, channel, model and incidence: `reflectance` at the model's own orders, `total` with the
        single order added to models of "multiple", `limit` = T_12(mu_i) (diffuse: 1 - 2 C_1(1/eta)), `inside`, whether
        total lies in [0, limit] to 1e-6, and `note`, why a model refuses the medium (NaN, and None for `inside`).
    """
    import pandas

    rows = []
    for medium_name, medium in media.items():
        for name in models() if names is None else names:
            for incidence in mu_i:
                rows += _energy_rows(medium_name, medium, name, incidence, quadrature)
    return pandas.DataFrame(rows)


def _energy_rows(medium_name: str, medium: Medium, name: str, mu_i: Any, quadrature: Quadrature | None) -> list[dict]:
    n = medium.n_channels or 1
    try:
        model = bssrdf(name, medium)
        orders, note = model.orders, ""
        R = np.broadcast_to(reflectance(model, mu_i, quadrature=quadrature), n)
    except ValueError as error:
        if name not in models():
            raise
        orders, note, R = "", str(error), np.full(n, np.nan)
    total = R + (single_scattering.reflectance(medium, mu_i) if orders == "multiple" else 0.0)
    limit = 1 - 2 * C_1(1 / medium.eta) if isinstance(mu_i, str) else float(F_t(np.float64(mu_i), medium.eta))
    inside = [None if note else bool(-1e-6 <= t <= limit + 1e-6) for t in total]
    return [
        {"medium": medium_name, "channel": k, "model": name, "orders": orders, "mu_i": mu_i, "reflectance": R[k],
         "total": total[k], "limit": limit, "inside": inside[k], "note": note}
        for k in range(n)
    ]  # fmt: skip


def weight_variance(model: BSSRDF, mu_o: float = 0.8, n: int = 1 << 14, seed: int = 0) -> Any:
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
        parts = [model.for_medium(model.medium.channel(k)) for k in range(model.medium.n_channels)]
        return np.array([weight_variance(part, mu_o, n, seed) for part in parts])
    u = np.random.default_rng(seed).random((4, n))
    at = model.sample_position(mu_o, (u[0], u[1]))
    phi_o = np.pi - at.phi
    w_i = model.sample_direction(at.r, mu_o, phi_o, (u[2], u[3]))
    w = model.eval(at.r, w_i.mu_i, w_i.phi_i, mu_o, phi_o) * w_i.mu_i / (at.pdf * w_i.pdf)
    return float(np.var(w, ddof=1) / np.mean(w) ** 2)
