"""Energies of models in the cells of maps, also where S is much narrower in azimuth than a cell."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from scipy.special import i0e

import halfspace_sss
from halfspace_sss.arrays import library
from halfspace_sss.comparison.model_errors import BRIGHT, FIRST_N_PSI, N_U, cell_energies
from halfspace_sss.maps.noisy_maps import CellGrid, Groups, radial_edges
from halfspace_sss.physics.backbone import unwarp

GRID = CellGrid(40, 16)
ALBEDO, G, N = 0.5, 0.2, 3


class Ridge(halfspace_sss.BSSRDF):
    """exp(-r) over distance, a von Mises ridge of sharpness kappa where light goes straight on."""

    name, orders, reciprocal, source = "ridge", "multiple", False, "test"

    def __init__(self, medium: halfspace_sss.Medium, kappa: float, fast_in: str = "drjit") -> None:
        super().__init__(medium)
        self.kappa, self.fast_in, self.evaluated = kappa, fast_in, 0

    def G(self, q: Any) -> Any:
        self.evaluated += len(q.r)
        return q.lib.exp(-q.r - self.kappa * (1 + q.lib.cos(q.phi_i)))


def _groups() -> Groups:
    rng, one = np.random.default_rng(3), np.ones(N)
    mu_i, mu_o = rng.uniform(0.1, 1, N), rng.uniform(0.1, 1, (N, 16))
    return Groups(ALBEDO * one, G * one, one, mu_i, mu_o, rng.uniform(-math.pi, math.pi, (N, 16)))


def _model(kappa: float, fast_in: str = "drjit") -> Ridge:
    return Ridge(halfspace_sss.Medium.from_albedo(ALBEDO, 1.0, G, 1.0), kappa, fast_in)


@pytest.mark.parametrize("kappa", [0.0, 5.0, 1000.0])
@pytest.mark.parametrize("fast_in", ["drjit", "numpy"])
def test_rings_hold_the_exact_energy_however_narrow_the_ridge(kappa: float, fast_in: str) -> None:
    groups = _groups()
    r = groups.L[:, None] * unwarp(library(0.0), radial_edges(groups, GRID))
    along = -np.diff((1 + r) * np.exp(-r), axis=1) * 2 * math.pi * i0e(kappa)
    exact = (groups.mu_i[:, None] * groups.mu_o)[..., None] * along[:, None]
    found = cell_energies(_model(kappa, fast_in), groups, GRID).sum(axis=3)
    np.testing.assert_allclose(found.sum(axis=2), exact.sum(axis=2), rtol=2e-3)
    np.testing.assert_allclose(found, exact, rtol=5e-3, atol=1e-4 * exact.sum(axis=2).min())


def test_the_ridge_lies_in_the_cells_of_its_azimuth() -> None:
    cells = cell_energies(_model(1000.0), _groups(), GRID).sum(axis=2)
    middle = cells[..., GRID.n_psi // 2 - 1 : GRID.n_psi // 2 + 1].sum(axis=-1)
    np.testing.assert_allclose(middle, cells.sum(axis=-1), rtol=1e-3)


def test_what_is_smooth_is_not_refined() -> None:
    model = _model(1.0)
    cell_energies(model, _groups(), GRID)
    assert model.evaluated == N * GRID.n_u * GRID.n_psi * N_U * (16 * FIRST_N_PSI + BRIGHT * 2 * FIRST_N_PSI)


def test_no_direction_is_asked_twice_with_the_same_points() -> None:
    model = _model(1000.0)  # needs 12 points, which 24 confirm
    cell_energies(model, _groups(), GRID)
    assert model.evaluated == N * GRID.n_u * GRID.n_psi * N_U * (16 * 6 + 16 * 12 + BRIGHT * 24)
