"""Where light of a model leaves, and how much of it.

It is drawn by quasi Monte Carlo of several proposals at once. S of a medium that scatters
forwards has ridges: light that enters near the horizon leaves close by, onwards and near the horizon again. Beside the
positions of the model under a cosine, which see the rest of S, two lobes about the mirrored direction are drawn, which
weigh the more the lower light enters. Each point counts by its share in the sum of all densities (balance heuristic,
Veach and Guibas 1995).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from halfspace_sss.comparison.model_errors import in_single
from halfspace_sss.interface.model import BSSRDF
from halfspace_sss.physics.medium import eval_hg, sample_hg

LOBES = ((0.6, 0.3), (0.95, 0.03))  # mean cosine about the mirrored direction, width in azimuth of the position
NEAR = (1e-3, 50.0)  # mean free paths; their distances are uniform in the logarithm
LEAST_MU = 1e-7


class SampledExits(NamedTuple):
    """Distances r (mm), outside cosines and fluxes of light that leaves, a row for each cosine of incidence.
    The fluxes of a row sum up to R(mu_i)."""

    r: np.ndarray
    mu_o: np.ndarray
    flux: np.ndarray


class _Points(NamedTuple):
    """r (mm), azimuths of position and direction from the forward direction, cosines of incidence and exit."""

    r: np.ndarray
    psi: np.ndarray
    delta: np.ndarray
    mu_i: np.ndarray
    mu_o: np.ndarray


def exits(model: BSSRDF, mu_i: Sequence[float | str], points: int, seed: Sequence[int]) -> SampledExits:
    """Light that leaves for light that enters at each of the cosines mu_i, or for uniform radiance, "diffuse".
    `model`: of a scalar medium; evaluated in single precision. `points`: of each of the three proposals, a power of
    two; scrambled Sobol points, others for each row."""
    rows = [_draw(model, mu, points, (*seed, k)) for k, mu in enumerate(mu_i)]
    p = _Points(*(np.stack(values) for values in zip(*rows)))
    S = in_single(model, (p.r, p.mu_i, math.pi - p.psi, p.mu_o, p.delta - p.psi))
    weight = np.where(np.arange(p.r.shape[1]) < points, 1.0, _weight(p.mu_i))
    return SampledExits(p.r, p.mu_o, S * p.mu_o * weight / (_density(model, p) * points))


def _weight(mu_i: np.ndarray) -> np.ndarray:
    """Of a lobe, where the positions of the model weigh 1."""
    return 1 - mu_i


def _draw(model: BSSRDF, mu_i: float | str, points: int, seed: Sequence[int]) -> _Points:
    from scipy.stats import qmc

    parts = []
    for k in range(len(LOBES) + 1):
        u = qmc.Sobol(5, seed=np.random.default_rng([*seed, k])).random(points).T
        mu = np.sqrt(u[4]) if mu_i == "diffuse" else np.full(points, float(mu_i))
        parts.append(_by_position(model, mu, u) if k == 0 else _by_lobe(model, mu, u, *LOBES[k - 1]))
    return _Points(*(np.concatenate(values) for values in zip(*parts)))


def _by_position(model: BSSRDF, mu_i: np.ndarray, u: np.ndarray) -> _Points:
    mu_o, delta = np.sqrt(u[2]), 2 * math.pi * ((u[1] + u[3]) % 1) - math.pi  # S knows it from the position
    r = model.sample_position(mu_o, (u[0], u[1])).r
    return _Points(r, 2 * math.pi * u[1] - math.pi, delta, mu_i, np.maximum(mu_o, LEAST_MU))


def _by_lobe(model: BSSRDF, mu_i: np.ndarray, u: np.ndarray, g: float, width: float) -> _Points:
    """Directions of a Henyey-Greenstein lobe, mirrored upwards; positions near half their azimuth."""
    cosine = sample_hg(u[2], g)
    sine, angle = np.sqrt(np.maximum(1 - cosine**2, 0)), 2 * math.pi * u[3]
    sin_i = np.sqrt((1 - mu_i) * (1 + mu_i))
    x = sin_i * cosine + mu_i * sine * np.cos(angle)
    z = np.abs(mu_i * cosine - sin_i * sine * np.cos(angle))
    delta = np.arctan2(sine * np.sin(angle), x)
    psi = 0.5 * delta + 2 * np.arctan(math.tanh(width / 2) * np.tan(math.pi * (u[1] - 0.5)))
    r = NEAR[0] * (NEAR[1] / NEAR[0]) ** u[0] / model.medium.sigma_t
    return _Points(r, psi, delta, mu_i, np.clip(z, LEAST_MU, 1.0))


def _density(model: BSSRDF, p: _Points) -> np.ndarray:
    """Sum of the densities of all proposals over the plane and outside directions, 1/(mm² sr)."""
    result = model.pdf_position(p.r, 0.0, 1.0) * p.mu_o / math.pi
    tau = model.medium.sigma_t * p.r
    near = ((tau > NEAR[0]) & (tau < NEAR[1])) / (p.r * p.r * math.log(NEAR[1] / NEAR[0]))
    sines = np.sqrt((1 - p.mu_i) * (1 + p.mu_i) * (1 - p.mu_o) * (1 + p.mu_o)) * np.cos(p.delta)
    for g, width in LOBES:
        lobe = eval_hg(sines + p.mu_i * p.mu_o, g) + eval_hg(sines - p.mu_i * p.mu_o, g)
        cauchy = math.sinh(width) / (2 * math.pi * (math.cosh(width) - np.cos(p.psi - 0.5 * p.delta)))
        result = result + _weight(p.mu_i) * near * lobe * cauchy
    return result


POINTS, REPEATS = 2**13, 4  # of each proposal; scrambles


def sampled_reflectance(model: BSSRDF, mu_i: float | str, points: int = POINTS) -> tuple[float, float]:
    """R(mu_i) = ∫∫ S mu_o dw_o dA of a scalar medium by quasi Monte Carlo (`exits`), and its error.
    mu_i is a cosine or "diffuse". The error is that of the mean of independent scrambles."""
    values = exits(model, [mu_i] * REPEATS, points, (0,)).flux.sum(axis=1)
    return float(values.mean()), float(values.std(ddof=1) / math.sqrt(REPEATS))
