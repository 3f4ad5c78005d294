"""Maps of many media and directions side by side: their sum is the reflectance that `trace` gives, their noise known.

All media are traced at once, each with 8 directions of incidence and 16 of observation, in 16 independent copies of two
halves: standard errors come from these 32 estimates.
"""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np
import pytest

from benchmarks.universal_training import looking_back
from halfspace_sss import Medium, trace
from halfspace_sss.comparison import model_errors as errors
from halfspace_sss.comparison.model_errors import ReferenceSize, TracedMaps, model_error, reference_maps
from halfspace_sss.maps.noisy_maps import (
    CellGrid,
    Groups,
    draw_directions,
    make_pool,
    radial_edges,
)
from halfspace_sss.physics import single_scattering
from halfspace_sss.physics.backbone import unwarp
from halfspace_sss.physics.fresnel import mu_internal

GRID = CellGrid(24, 8)
COPIES, SET = 16, 8
RATIOS = [(0.2, 0.0, 1.0), (0.9, 0.0, 1.5), (0.2, 0.8, 1.5), (0.9, 0.8, 1.0), (0.2, -0.3, 1.0), (0.9, -0.3, 1.5)]
MEDIA = [Medium.from_albedo(albedo, 1.0, g, eta) for albedo, g, eta in RATIOS]
over_media = pytest.mark.parametrize("k", range(len(MEDIA)), ids=[str(r) for r in RATIOS])


def _joined(parts: list[Groups]) -> Groups:
    return Groups(*(np.concatenate([getattr(p, f.name) for p in parts]) for f in dataclasses.fields(Groups)))


@pytest.fixture(scope="module")
def references() -> list[TracedMaps]:
    """Reciprocal maps of each medium: the same 8 x 16 pairs of directions in all copies."""
    rng = np.random.default_rng(5)
    parts = [_joined([errors._reciprocal_directions(m, 1, GRID.n_psi, rng)] * COPIES) for m in MEDIA]
    halves = make_pool(_joined(parts), GRID, 4e7, (9,)).reshape(len(MEDIA), COPIES * SET, 2, 16, 24, 8)
    return [TracedMaps(m, p, GRID, errors._mean_of_both_ways(p, h), 1) for m, p, h in zip(MEDIA, parts, halves)]


def _copies(reference: TracedMaps, block: int) -> np.ndarray:
    """Energies of blocks, (copy, direction, half, ...)."""
    E = dataclasses.replace(reference, block=block).energies()
    return E.reshape(COPIES, SET, *E.shape[1:])


@pytest.mark.slow
@over_media
@pytest.mark.parametrize("i", [0, 4])
def test_the_sum_over_the_plane_is_the_traced_reflectance(references: list[TracedMaps], k: int, i: int) -> None:
    """192 pairs of directions, each within 4 standard errors (by luck alone one is not with a chance of 5 %).

    What the maps leave out is told by their outermost rows of cells. G grows at most logarithmically towards r = 0, so
    that r < 0.02 holds at most twice what the density of the innermost row makes of that disk (found: 0.2 to 2 % of
    the reflectance); and it falls by a third or more per row at 12 L, where at most twice the last row is missing.
    """
    reference, medium = references[k], MEDIA[k]
    g = reference.groups[i : i + 1]
    weight = float(g.mu_i[0]) * g.mu_o[0]
    rows = _copies(reference, 1)[:, i].sum(axis=-1).reshape(2 * COPIES, 16, GRID.n_u) / weight[:, None]
    total = rows.sum(axis=-1)
    value, error = total.mean(axis=0), total.std(axis=0, ddof=1) / math.sqrt(2 * COPIES)
    r = g.L[0] * np.log1p(np.exp(radial_edges(g, GRID)[0]))
    missing = 2 * rows[..., 0].mean(axis=0) * r[0] ** 2 / (r[1] ** 2 - r[0] ** 2) + 2 * rows[..., -1].mean(axis=0)
    n_paths = 1_200_000 if medium.albedo < 0.5 else 400_000
    directions = list(zip(g.mu_o[0], g.delta_phi[0]))
    expected, its_error = trace(medium, float(g.mu_i[0]), n_paths, 3, directions=directions).angular_reflectance(
        "multiple"
    )
    sigma = np.hypot(error, its_error)
    assert np.all(sigma < 0.06 * value) and np.all(missing < 0.06 * value)
    assert np.all(expected - value > -4 * sigma)
    assert np.all(expected - value < missing + 4 * sigma)


def _single_by_quadrature(m: Medium, groups: Groups, k: int, j: int) -> np.ndarray:
    """Energies of single scattering in cells from points s on the exit ray: its integral over s is the BRDF."""
    log_s, step = np.linspace(-14, 5, 400_000, retstep=True)
    s = np.exp(log_s)
    mu_i, mu_o, delta_phi = groups.mu_i[k], groups.mu_o[k, j], groups.delta_phi[k, j]
    a, b = mu_internal(mu_i, m.eta), mu_internal(mu_o, m.eta)
    forth, back = s * np.sqrt(1 - b * b), s * b / a * np.sqrt(1 - a * a)  # in the plane, along the rays out and in
    x, y = forth + back * np.cos(delta_phi), -back * np.sin(delta_phi)  # x_o - x_i, x along the direction of exit
    rate = m.sigma_t * (1 + b / a)
    value = mu_i * single_scattering.brdf(m, mu_i, mu_o, delta_phi) * rate * np.exp(-rate * s)
    r, psi = np.hypot(x, y), np.arctan2(y, x) + delta_phi  # from forward
    edges = groups.L[k] * unwarp(errors.library(0.0), radial_edges(groups, GRID)[k])
    turn = np.mod(psi + math.pi, 2 * math.pi)
    cells = np.histogram2d(r, turn, [edges, np.linspace(0, 2 * math.pi, GRID.n_psi + 1)], weights=value * s * step)
    return mu_o * cells[0]


@over_media
def test_single_energies_are_the_integrals_of_the_exact_single_order(k: int) -> None:
    """Cell by cell, but for the points of the quadrature on both sides of an edge."""
    rng, m = np.random.default_rng(k), MEDIA[k]
    groups = draw_directions(*(np.full(8, v) for v in RATIOS[k]), rng)
    reference = TracedMaps(m, groups, GRID, np.zeros((8, 2, 16, GRID.n_u, GRID.n_psi), np.float32), 1)
    E = reference.single_energies()
    for pair in [(0, 0), (2, 5), (5, 11), (7, 15)]:
        np.testing.assert_allclose(
            E[pair], _single_by_quadrature(m, groups, *pair), rtol=1e-3, atol=1e-5 * E[pair].max()
        )


@over_media
def test_single_energies_sum_to_the_single_reflectance(k: int) -> None:
    """But for r < 0.02 and r > 12 L: nothing is added, and at most a tenth is missing."""
    rng, m = np.random.default_rng(k), MEDIA[k]
    groups = draw_directions(*(np.full(8, v) for v in RATIOS[k]), rng)
    reference = TracedMaps(m, groups, GRID, np.zeros((8, 2, 16, GRID.n_u, GRID.n_psi), np.float32), 1)
    mu_i, mu_o = groups.mu_i[:, None], groups.mu_o
    exact = single_scattering.brdf(m, mu_i, mu_o, groups.delta_phi) * mu_i * mu_o
    share = reference.single_energies().sum(axis=(2, 3)) / exact
    assert np.all(share < 1 + 1e-9) and np.median(share) > 0.9


@over_media
@pytest.mark.parametrize("block", [2, 4])
def test_the_noise_estimated_from_halves_is_that_over_copies(references: list[TracedMaps], k: int, block: int) -> None:
    """Mean over 16 copies; their spread leaves 1.2 % of uncertainty, cells that few scores meet 3 % of bias."""
    E = _copies(references[k], block)
    mean, total = E.mean(axis=2), E.mean(axis=2).sum() / COPIES
    estimated = 0.5 * np.abs(E[:, :, 0] - E[:, :, 1]).sum() / (COPIES * total)
    actual = np.abs(mean - mean.mean(axis=0)).sum() / (COPIES * total) / math.sqrt(1 - 1 / COPIES)
    assert actual == pytest.approx(estimated, rel=0.07)


def _first_copy(reference: TracedMaps, block: int) -> TracedMaps:
    return dataclasses.replace(reference, groups=reference.groups[:SET], halves=reference.halves[:SET], block=block)


def _answer(monkeypatch: Any, E: np.ndarray) -> Any:
    """A model that has these energies."""
    monkeypatch.setattr(TracedMaps, "model_energies", lambda self, model: E)
    return type("Model", (), {"orders": "multiple"})()


@over_media
def test_the_error_of_the_mean_of_other_seeds_is_noise_and_is_removed(
    references: list[TracedMaps], monkeypatch: Any, k: int
) -> None:
    """What is left is the noise of the 15 other copies, 0.26 of that of one, and the uncertainty of the noise."""
    E = _copies(references[k], 4)
    model = _answer(monkeypatch, E[1:].mean(axis=(0, 2)))
    error = model_error(model, _first_copy(references[k], 4))
    assert error.raw == pytest.approx(error.noise * math.sqrt(16 / 15), rel=0.1)
    assert error.error < 0.5 * error.noise < 0.05
    assert abs(error.bias) < 0.02


@pytest.mark.slow
def test_what_is_left_of_the_error_of_the_truth_falls_with_the_events(monkeypatch: Any) -> None:
    """From 1.6e5 to 4e6 events noise falls fivefold, and with it what is left."""
    left = []
    for events in (1.6e5, 4e6):
        (found,) = reference_maps([MEDIA[1]], ReferenceSize(1, GRID, 4), events, (7,))
        again = errors._mean_of_both_ways(found.groups, make_pool(found.groups, GRID, 12 * events, (8,)))
        truth = dataclasses.replace(found, halves=again).energies().mean(axis=1)
        left.append(model_error(_answer(monkeypatch, truth), found))
    few, many = left
    assert many.noise == pytest.approx(few.noise / 5, rel=0.15)
    assert many.error < 0.5 * many.noise < 0.03


@pytest.mark.parametrize(("factor", "bias"), [(0.0, -1.0), (2.0, 1.0)])
def test_a_model_that_is_off_by_all_has_an_error_of_one(
    references: list[TracedMaps], monkeypatch: Any, factor: float, bias: float
) -> None:
    E = factor * _copies(references[1], 4).mean(axis=(0, 2))
    error = model_error(_answer(monkeypatch, E), _first_copy(references[1], 4))
    assert error.error == pytest.approx(1, abs=0.03) and error.bias == pytest.approx(bias, abs=0.03)


def test_two_observations_of_a_group_can_look_back_along_the_incident_ray():
    rng = np.random.default_rng(3)
    groups = draw_directions(*(np.full(2000, v) for v in (0.9, 0.3, 1.4)), rng)
    back = looking_back(groups, rng)
    assert np.array_equal(back.mu_o[:, :14], groups.mu_o[:, :14])
    w_i = np.stack([-np.sqrt(1 - groups.mu_i**2), 0 * groups.mu_i, groups.mu_i])[..., None]
    sine = np.sqrt(1 - back.mu_o**2)
    w_o = np.stack([sine * np.cos(back.delta_phi), sine * np.sin(back.delta_phi), back.mu_o])
    distance = np.linalg.norm(w_o - w_i, axis=0)
    assert distance[:, 14:].max() < 0.65  # twice 0.3, where the horizon is crossed and z turned up
    assert np.median(distance[:, 14:]) < 0.03 < np.quantile(distance[:, :14], 0.02)
