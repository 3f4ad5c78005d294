"""Where a set of training maps is sampled: directions of incidence and observation, and cells of the plane."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from halfspace_sss.arrays import library
from halfspace_sss.checks import check_count
from halfspace_sss.physics.backbone import length_scale, unwarp, warp
from halfspace_sss.physics.medium import Medium

R_SMALLEST, R_LARGEST = 0.02, 12.0  # first edge in min(L, mfp), last edge in L
MOST_THETA, MOST_CELLS = 4096, 2**22  # 3 GiB for the maps of one direction of incidence


@dataclass(frozen=True)
class MapGrid:
    """Numbers of directions and cells of a set of maps.

    Args:
        n_theta, n_phi: directions of incidence; each pair has one map with its own direction of observation.
        n_r, n_psi: cells of a map in distance and azimuth.

    Raises:
        ValueError: a number is out of its bounds, n_theta <= 4096 and n_phi n_r n_psi <= 2**22 (3 GiB) among them, or
            n_phi is no multiple of 16 (maps are traced 16 at a time).
    """

    n_theta: int = 16
    n_phi: int = 64
    n_r: int = 48
    n_psi: int = 24

    def __post_init__(self) -> None:
        for name, least in (("n_theta", 1), ("n_phi", 16), ("n_r", 2), ("n_psi", 2)):
            check_count(name, getattr(self, name), least)
        if self.n_theta > MOST_THETA:
            raise ValueError(f"n_theta must be at most {MOST_THETA}, got {self.n_theta}")
        cells = self.n_phi * self.n_r * self.n_psi
        if cells > MOST_CELLS:
            given = f"{self.n_phi} x {self.n_r} x {self.n_psi} = {cells}"
            raise ValueError(f"n_phi n_r n_psi must be at most {MOST_CELLS}, which memory holds at once, got {given}")
        if self.n_phi % 16:
            raise ValueError(f"n_phi must be a multiple of 16, got {self.n_phi}")


def radial_scale(medium: Medium) -> float:
    """Length L of the radial grid of a scalar medium in mean free paths, `length_scale` of its ratios."""
    return float(length_scale(float(medium.albedo), float(medium.g)))


def cell_edges(medium: Medium, grid: MapGrid) -> tuple[np.ndarray, np.ndarray]:
    """Edges of the cells: distances in mean free paths (uniform in `warp`), azimuths of x_o - x_i in [-pi, pi]."""
    lib, L = library(0.0), radial_scale(medium)
    low, high = warp(lib, np.array([R_SMALLEST * min(L, 1.0) / L, R_LARGEST]))
    return L * unwarp(lib, np.linspace(low, high, grid.n_r + 1)), np.linspace(-math.pi, math.pi, grid.n_psi + 1)


def map_directions(medium: Medium, grid: MapGrid, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Directions of a set: mu_i (theta), mu_o and delta_phi (theta, phi); delta_phi = 0 is the far side.

    mu_i stands in the middle of equal steps of the cosine. The observations of one mu_i are a jittered Latin
    square over cosine and azimuth, another one for each mu_i. For eta < 1 cosines stay where light refracts.
    """
    lowest = math.sqrt(max(1 - medium.eta**2, 0.0))
    mu_i = lowest + (1 - lowest) * (np.arange(grid.n_theta) + 0.5) / grid.n_theta
    rng = np.random.default_rng([seed, 1])
    shape = (grid.n_theta, grid.n_phi)
    strata = np.stack([rng.permutation(grid.n_phi) for _ in range(2 * grid.n_theta)]).reshape(2, *shape)
    u = (strata + rng.uniform(0.1, 0.9, strata.shape)) / grid.n_phi
    return mu_i, lowest + (1 - lowest) * u[0], 2 * math.pi * u[1] - math.pi
