"""Distances between entry and exit, drawn by the radial profile of a model."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from halfspace_sss.arrays import Library, Real

R_MIN, R_MAX = 1e-5, 1e6  # mean free paths; the table starts and can at most end there
TAIL_MASS = 1e-4  # least probability of the power-law tail, so that no distance has density 0


class RadialSampler:
    """Piecewise density over r in mean free paths, exact to sample and to evaluate.

    Cells are uniform in log r below the radius where r² R(r) has died out; within a cell r is uniform, so
    the density over the plane is P_k / (2 pi r (r_{k+1} - r_k)). Beyond the last edge r_max the tail follows
    r_max / r², which covers the plane also where a profile falls as r⁻³ (no absorption).

    Args:
        S: `BSSRDF.eval` of a model of a scalar medium with sigma_t = 1.
    """

    def __init__(self, S: Callable[..., Real], n_cells: int = 256) -> None:
        r = np.geomspace(R_MIN, R_MAX, 2 * n_cells)
        mass = r * r * _profile(S, r)
        top = max(float(mass.max()), 1e-300)
        beyond = np.nonzero(mass > 1e-7 * top)[0]
        r_max = r[min(beyond[-1] + 1, len(r) - 1)] if len(beyond) else 1.0
        self.edges = np.concatenate([[0.0], np.geomspace(R_MIN, r_max, n_cells)])
        middle = np.concatenate([[0.5 * R_MIN], np.sqrt(self.edges[1:-1] * self.edges[2:])])
        weight = middle * _profile(S, middle) * np.diff(self.edges)
        if not weight.sum() > 0:
            weight = np.diff(np.log(np.maximum(self.edges, 0.5 * R_MIN)))
        probability = np.append((1 - TAIL_MASS) * weight / weight.sum(), TAIL_MASS)
        self.cdf = np.concatenate([[0.0], np.cumsum(probability)])
        self.cdf[-1] = 1.0
        self.probability = np.diff(self.cdf)
        self.width = np.append(np.diff(self.edges), r_max)
        self.r_max = r_max

    def sample(self, lib: Library, u: Real) -> Real:
        """Distance r in mean free paths for uniform u in [0, 1)."""
        u64 = lib.float64(u)
        k = lib.interval(self.cdf[:-1], u64)
        fraction = (u64 - lib.take(self.cdf[:-1], k, u64)) / lib.maximum(lib.take(self.probability, k, u64), 1e-300)
        fraction = lib.minimum(lib.maximum(fraction, 0.0), 1 - 1e-12)
        inner = lib.take(self.edges, k, u64) + fraction * lib.take(self.width, k, u64)
        r = lib.where(k == len(self.edges) - 1, self.r_max / (1 - fraction), inner)
        return lib.like(r, u)

    def pdf(self, lib: Library, r: Real) -> Real:
        """Density over the plane, 1/mfp²."""
        r64 = lib.float64(r)
        k = lib.interval(self.edges, r64)
        density = lib.take(self.probability / self.width, k, r64)
        ratio = self.r_max / lib.maximum(r64, self.r_max)  # 1 inside the table
        return lib.like(density * ratio * ratio / (2 * math.pi * lib.maximum(r64, 1e-12)), r)


def _profile(S: Callable[..., Real], r: np.ndarray) -> np.ndarray:
    """∫ S mu_i dw_i over directions of incidence at steep exit, averaged over azimuths: what positions follow."""
    mu_i = np.array([0.95, 0.7, 0.4])
    phi = np.linspace(0, math.pi, 5)
    values = S(r[:, None, None], mu_i[:, None], phi, 0.9, 0.5 * math.pi)
    values = np.where(np.isfinite(values), values, 0.0)
    return (values * mu_i[:, None]).mean(axis=(1, 2))
