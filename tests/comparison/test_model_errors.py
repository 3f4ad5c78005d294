"""Errors freed of noise: their standard errors hold, and noise is never told as an error of 0."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from halfspace_sss import Medium, bssrdf
from halfspace_sss.comparison import model_errors
from halfspace_sss.comparison.model_errors import ModelError, TracedMaps, model_error
from halfspace_sss.maps.noisy_maps import CellGrid, draw_directions
from halfspace_sss.noise_free import NoiseFree

MEDIUM, GRID, N, RUNS = Medium.from_albedo(0.9, 1.0, 0.0, 1.3), CellGrid(8, 4), 32, 200
MODEL = bssrdf("better_dipole", MEDIUM)
FEW_PER_CELL = 50.0  # scores, so that noise is 14 %


def _errors(monkeypatch: pytest.MonkeyPatch, off: float) -> list[ModelError]:
    """Errors of a model that is off by so much, up and down, in cells of equal energy, by independent noisy maps."""
    rng = np.random.default_rng(11)
    one = np.ones(N)
    groups = draw_directions(0.9 * one, 0.0 * one, 1.3 * one, rng)
    truth = np.ones((N, 16, GRID.n_u, GRID.n_psi))
    signs = rng.choice([-1.0, 1.0], truth.shape)
    monkeypatch.setattr(TracedMaps, "model_energies", lambda self, model: truth * (1 + off * signs))
    monkeypatch.setattr(TracedMaps, "single_energies", lambda self: np.zeros_like(truth))
    monkeypatch.setattr(TracedMaps, "energies", lambda self: self.halves)
    found = []
    for _ in range(RUNS):
        halves = truth[:, None] * (1 + rng.standard_normal((N, 2, *truth.shape[1:])) / math.sqrt(FEW_PER_CELL))
        found.append(model_error(MODEL, TracedMaps(MEDIUM, groups, GRID, halves, 1)))
    return found


def test_an_error_below_its_noise_keeps_a_bound(monkeypatch: Any) -> None:
    found = _errors(monkeypatch, 0.0)
    assert min(e.noise for e in found) > 0.05 and sum(e.error == 0 for e in found) > RUNS / 4
    assert all(e.known.bound > 0 for e in found)
    assert sum(e.known.lost for e in found) > 0.9 * RUNS  # below two standard errors: 97.7 % at least


@pytest.mark.parametrize("off", [0.0, 0.1])
def test_standard_errors_of_the_square_are_not_below_its_spread(monkeypatch: Any, off: float) -> None:
    found = _errors(monkeypatch, off)
    spread = np.std([e.square for e in found], ddof=1)
    assert spread < np.mean([e.square_error for e in found]) < 1.7 * spread  # pairs count as if shared: sqrt(2)


def test_one_direction_of_incidence_has_no_spread_and_no_certainty() -> None:
    one = np.ones(1)
    assert model_errors._known(one, 0 * one, one).square_error == math.inf


@pytest.mark.parametrize(
    ("square", "error", "told"),
    [
        (1e-4, 1e-6, "1 ± 0.005"), (-1e-3, 1e-4, "< 1.3"), (1.9e-4, 1e-4, "< 1.9"), (0.0, 0.0, "0 ± 0"),
        (math.nan, math.nan, "–"),
    ],
)  # fmt: skip
def test_an_error_is_told_with_its_standard_error_or_as_a_bound(square: float, error: float, told: str) -> None:
    assert NoiseFree(square, error).told() == told
