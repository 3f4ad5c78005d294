"""Quadrature over exit points and directions: trapezoids in ln r and both azimuths, Gauss-Legendre in mu_o."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from halfspace_sss.checks import check_count
from halfspace_sss.physics.fresnel import mu_external
from halfspace_sss.physics.medium import Medium, check_numbers

SCAN = (-9, 9)  # decades about the mean free path in which the flux is looked for
DEAD = 1e-9  # share of its largest value below which the integrand in ln r is left to a geometric series
LANES = 1 << 18  # values of S asked for at once


Evaluate = Callable[..., np.ndarray]  # S of r, mu_i, phi_i, mu_o, phi_o


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
            check_count(name, getattr(self, name), least)
        if self.n_azimuth % 2:
            raise ValueError(f"n_azimuth must be even, got {self.n_azimuth!r}")


class Angles:
    """Quadrature over exit directions and azimuths for one S(r, mu_i, phi_i, mu_o, phi_o) of a medium.

    `probe` is asked which azimuths matter where S itself is 0 at most queries and would not tell.
    """

    def __init__(self, evaluate: Evaluate, medium: Medium, q: Quadrature, probe: Evaluate | None = None) -> None:
        check_numbers("medium", medium)
        self.mu_o: np.ndarray
        self.w_mu: np.ndarray
        self.evaluate = evaluate
        self.medium = medium
        self.mu_o, self.w_mu = cosine_nodes(medium.eta, q.n_mu)
        self.phi_o: np.ndarray = 2 * math.pi * (np.arange(q.n_azimuth) + 0.5) / q.n_azimuth
        half = q.n_azimuth // 2
        self.phi_i: np.ndarray = math.pi * np.arange(half + 1) / half
        self.w_i: np.ndarray = np.r_[0.5, np.ones(half - 1), 0.5] / half
        self.w_x: np.ndarray = -self.w_i * np.cos(self.phi_i)
        free_i, free_o = self._unused_azimuths(probe or evaluate)
        self.both_azimuths: bool = not (free_i or free_o)
        if not self.both_azimuths:
            self._merge_exits(probe or evaluate)
        if free_i:
            self.phi_i, self.w_i, self.w_x = np.array([0.5 * math.pi]), np.ones(1), np.zeros(1)
        if free_o:
            self.phi_o = np.array([0.5 * math.pi])

    def _unused_azimuths(self, evaluate: Evaluate) -> tuple[bool, bool]:
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

    def _merge_exits(self, evaluate: Evaluate) -> None:
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
    mfp, transport_mfp = np.atleast_1d(angles.medium.mfp), np.atleast_1d(1 / angles.medium.sigma_t_prime)
    farthest = max(mfp.max(), 1e-6 * transport_mfp.max())  # the latter for g within 1e-6 of 1
    low, high = math.log10(mfp.min()) + SCAN[0], math.log10(farthest) + SCAN[1]
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
