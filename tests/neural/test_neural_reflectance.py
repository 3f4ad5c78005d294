"""`neural` against exact reflectances and radial profiles of tables and walks, matched boundaries included."""

from __future__ import annotations

import math
import time

import numpy as np
import pytest

from benchmarks.truths import Truth, read_truths
from benchmarks.universal_training import calibration_terms
from halfspace_sss import Medium, bssrdf, trace
from halfspace_sss.comparison.sampled_exits import exits, sampled_reflectance
from halfspace_sss.neural.network import N_TERMS, log_calibration
from halfspace_sss.neural.universal import in_range, load_hypernetwork, shipped_weights
from halfspace_sss.physics import single_scattering
from halfspace_sss.physics.fresnel import F_r, mu_internal

POINTS, RING_POINTS = 2**13, 2**16
WITHIN = 0.015  # of every reflectance
TRACED = [  # albedo, g, mu_i, eta
    (0.5, 0.0, 1.0, 1.4), (0.75, 0.5, 0.5, 1.0), (0.9, 0.9, 1.0, 1.1), (0.95, -0.4, 0.5, 1.4), (0.97, 0.8, 0.5, 1.0),
    (0.99, 0.5, 0.5, 1.4), (0.9, 0.0, 1.0, 1.0), (0.8, 0.3, 1.0, 1.4),
]  # fmt: skip
COUNTS = 0.005  # share of the light that a ring must have to count


def _bright(measures: tuple[str, ...]) -> list[Truth]:
    return [
        t
        for t in read_truths()[0]
        if t.measure in measures and 0.5 <= t.medium.albedo and t.medium.g <= 0.95 and in_range(t.medium)
    ]


def _with_single(R: float, t: Truth) -> float:
    """Of all orders, and with the surface reflection where the row has it."""
    mirrored = float(F_r(t.mu_i, t.medium.eta)) if t.measure == "R_total" else 0.0
    return R + float(single_scattering.reflectance(t.medium, t.mu_i)) + mirrored


@pytest.mark.slow
def test_every_eighth_reflectance_of_the_table_is_met_within_1_5_percent() -> None:
    """`python -m benchmarks truths` tells all of them."""
    models, known, off = {}, {}, {}
    for t in _bright(("R_d", "R_total"))[::8]:
        key = (t.medium, t.mu_i)
        if key not in known:
            model = models.setdefault(t.medium, bssrdf("neural", t.medium))
            known[key] = sampled_reflectance(model, t.mu_i, points=POINTS)[0]
        doubt = 3 * t.uncertainty if t.kind == "published" else 0.0  # walks of others, few digits
        off[t.id] = (abs(_with_single(known[key], t) - t.value) - doubt) / t.value
    assert len(off) > 31 and any(t.medium.eta == 1 for t in _bright(("R_d",)))
    assert {row: round(v, 4) for row, v in off.items() if v > WITHIN} == {}
    assert np.median(list(off.values())) < 0.003


def _rings(medium: Medium, mu_i: float, edges: np.ndarray) -> np.ndarray:
    """Light of `neural` that leaves within each ring, order >= 2."""
    found = exits(bssrdf("neural", medium), [mu_i], RING_POINTS, (5,))
    return np.histogram(found.r[0], edges, weights=found.flux[0])[0]


@pytest.mark.slow
def test_radial_profiles_of_the_table_are_met() -> None:
    rows: dict[tuple, list[Truth]] = {}
    for t in _bright(("ring",)):
        if t.uncertainty < 0.01 * t.value:
            rows.setdefault((t.medium, t.mu_i), []).append(t)
    off = []
    for (medium, mu_i), mine in rows.items():
        edges = np.unique(np.round([v for t in mine for v in t.ring], 9))
        light = _rings(medium, mu_i, edges)
        x, w = np.polynomial.legendre.leggauss(6)
        for t in mine:
            low, high = t.ring
            r = 0.5 * (high - low) * x + 0.5 * (high + low)
            single = math.pi * (high - low) * np.sum(w * r * single_scattering.exitance(medium, r, mu_i))
            k = int(np.searchsorted(edges, low + 1e-9)) - 1
            value = t.factor * (light[k] + single) / (math.pi * (high**2 - low**2))
            off.append(abs(value / t.value - 1))
    assert len(off) > 60 and np.median(off) < 0.01 and np.quantile(off, 0.9) < 0.03


@pytest.mark.slow
def test_radial_profiles_of_walks_are_met_also_where_the_boundary_is_matched() -> None:
    off = []
    for albedo, g, mu_i, eta in TRACED:
        medium = Medium.from_albedo(albedo, 1.0, g, eta)
        L = 1 / math.sqrt(3 * (1 - albedo) * (1 - albedo * g))
        edges = np.concatenate([[0.0], np.geomspace(0.02, 20, 13)]) * max(L, 0.3)
        walks = trace(medium, mu_i=mu_i, n_paths=750_000, seed=11, radii=edges)
        area = math.pi * np.diff(edges**2)
        multiple, total = (walks.exitance(order).value * area for order in ("multiple", "total"))
        counts = multiple > COUNTS * walks.reflectance("multiple").value
        off += (np.abs(_rings(medium, mu_i, edges) - multiple) / total)[counts].tolist()
    assert len(off) > 50 and np.median(off) < 0.01 and np.quantile(off, 0.9) < 0.03


STEEP, MATCHED = [(g, eta) for g in (0.9, 0.98) for eta in (1.1, 1.5, 2.0)], [1.0, 1.02, 1.1, 1.5, 2.0]
CORNERS = [(a, *rest) for a in (0.05, 0.5, 0.9, 0.97, 0.999, 1.0)
           for rest in [*STEEP, *((g, eta) for g in (-0.5, 0.0, 0.8) for eta in MATCHED)]]  # fmt: skip
DARK = 2e-4  # R that is off by less is of hardly any light
DAILY_CORNERS = [
    (1.0, -0.5, 1.0),
    (1.0, 0.8, 1.0),
    (1.0, 0.98, 1.1),
    (1.0, 0.98, 2.0),
    (0.97, 0.98, 1.1),
    (0.999, 0.8, 1.02),
]


@pytest.mark.parametrize(
    "corners", [pytest.param(DAILY_CORNERS, id="some"), pytest.param(CORNERS[::8], id="more", marks=pytest.mark.slow)]
)
def test_reflectances_of_the_corners_of_the_range_are_met_within_1_5_percent_and_none_is_above_1(corners) -> None:
    """At albedo 1, g 0.98 it was 0.76 to 2.3 times the exact one for eta 1 to 1.05, 3 to 6 % off for larger ones."""
    off, mu_i = {}, [0.05, 0.1, 0.3, 1.0]
    for ratios in corners:
        medium = Medium.from_albedo(ratios[0], 1.0, *ratios[1:])
        flux = exits(bssrdf("neural", medium), np.repeat(mu_i, 3).tolist(), POINTS // 2, (0,)).flux.sum(axis=1)
        R, error = flux.reshape(-1, 3).mean(axis=1), flux.reshape(-1, 3).std(axis=1, ddof=1) / math.sqrt(3)
        R += single_scattering.reflectance(medium, np.array(mu_i))
        exact = np.array([medium.reflectance(mu) for mu in mu_i])
        assert np.all(R < 1 + 3 * error)
        wrong = np.abs(R - exact) - 3 * error > np.maximum(WITHIN * exact, DARK)
        if wrong.any():
            off[ratios] = (np.round(R / exact - 1, 4), np.round(error / exact, 4))
    assert off == {}


@pytest.mark.parametrize("albedo", [0.0, 0.5, 1.0])
@pytest.mark.parametrize(("g", "eta"), [(-0.5, 1.0), (0.8, 1.0), (-0.5, 2.0), (0.98, 2.0), (0.98, 1.1)])
def test_the_factor_of_every_medium_is_between_a_half_and_two_but_for_grazing_light(
    albedo: float, g: float, eta: float
) -> None:
    c, mu = load_hypernetwork(shipped_weights()).calibration(albedo, g, eta), np.linspace(0, 1, 11)
    factor = np.abs(log_calibration(c, mu, mu_internal(mu, eta)))
    assert len(c) == N_TERMS and factor[0] < math.log(4) and factor[1:].max() < math.log(2)


def test_the_logarithm_of_the_factor_is_a_sum_of_its_terms() -> None:
    c, mu = np.array([0.3, -0.2, 0.1, 0.05, 0.2, -0.4]), np.linspace(0, 1, 7)
    inside = mu_internal(mu, 1.3)
    np.testing.assert_allclose(log_calibration(c, mu, inside), calibration_terms(mu, inside) @ c, atol=1e-15)
    assert np.all(log_calibration((), mu, inside) == 0)


def test_a_model_is_made_in_20_ms_and_names_its_factor() -> None:
    media = [Medium.from_albedo(0.5 + 0.004 * k, 1.0, 0.2, 1.3) for k in range(50)]
    bssrdf("neural", media[0])
    started = time.process_time()
    models = [bssrdf("neural", m) for m in media]
    assert (time.process_time() - started) / len(media) < 0.02
    before = models[0].checksums
    models[0].calibrations = [(0.0,) * N_TERMS]
    assert models[0].checksums != before
