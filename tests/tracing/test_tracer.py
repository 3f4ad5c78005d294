"""The path tracer: what energy, symmetry and scaling demand, the exact single order, honest errors, repeatable bits.

Statistical tests have fixed seeds; a z-test fails at 4 standard errors (two-sided 6e-5), a chi-square test at 1e-4.
"""

from __future__ import annotations

import math

import numpy as np
import pytest
from traced import MEDIA, check_spread, z

from halfspace_sss import Medium, trace
from halfspace_sss.physics import single_scattering
from halfspace_sss.physics.fresnel import F_r
from halfspace_sss.tracing.tracer import Estimate

EXTREMES = [
    (albedo, g, eta, mu_i)
    for albedo, g in [(1 - 1e-7, 0.0), (0.9, 0.99), (0.9, -0.99), (1e-6, 0.5)]
    for eta in (0.66, 1.0, 3.0)
    for mu_i in (1.0, 0.0)
]


@pytest.fixture(scope="module", params=MEDIA)
def medium(request) -> Medium:
    return MEDIA[request.param]


@pytest.fixture(scope="module")
def run(medium):
    """One oblique run with directions and rings."""
    directions, radii = [(0.9, 0.4), (0.9, -0.4)], np.array([0.0, 0.05, 0.2, 1.0, 3.0]) * medium.mfp
    return trace(medium, 0.8, 600_000, 11, directions=directions, radii=radii)


@pytest.mark.parametrize("order", ["single", "multiple", "total"])
def test_no_order_reflects_more_than_enters(run, medium, order):
    assert 0 < run.reflectance(order).value < 1 - F_r(0.8, medium.eta)


def test_single_and_multiple_add_up_to_total(run):
    for measure in (run.reflectance, run.angular_reflectance, run.exitance):
        parts = np.add(measure("single").value, measure("multiple").value)
        np.testing.assert_allclose(parts, measure("total").value, rtol=1e-12)


def test_moments_of_the_orders_mix_in_proportion_to_their_flux(run):
    for measure in (run.mean_r2, run.mean_x, run.mean_path_length):
        mixed = sum(measure(o).value * run.reflectance(o).value for o in ("single", "multiple"))
        assert mixed == pytest.approx(measure().value * run.reflectance().value, rel=1e-10)


def test_a_dataset_of_xarray_holds_what_the_methods_say(run):
    data = run.to_xarray()
    for name in ("reflectance", "mean_r2", "mean_x", "mean_path_length", "exitance"):
        for order in data.order.values:
            value, error = getattr(run, name)(order)
            np.testing.assert_array_equal(data[name].sel(order=order), value)
            np.testing.assert_array_equal(data[f"{name}_error"].sel(order=order), error)


def test_rings_hold_no_more_flux_than_leaves(run, medium):
    radii = np.array([0.0, 0.05, 0.2, 1.0, 3.0]) * medium.mfp
    for order in ("single", "multiple"):
        flux = np.sum(run.exitance(order).value * np.pi * np.diff(radii**2))
        assert 0 < flux <= run.reflectance(order).value * (1 + 1e-6)


def test_rings_to_infinity_hold_all_flux(medium):
    result = trace(medium, 1.0, 100_000, 12, radii=[0.0, 1e6 * medium.mfp])
    flux = result.exitance().value[0] * np.pi * 1e12 * medium.mfp**2
    assert flux == pytest.approx(result.reflectance().value, rel=1e-5)


def test_extinction_changes_lengths_only(medium):
    radii = np.array([0.0, 0.5, 2.0])
    a = trace(medium, 0.7, 50_000, 5, radii=radii, directions=[(0.5, 1.0)])
    b = trace(medium.scaled(4.0), 0.7, 50_000, 5, radii=radii / 4, directions=[(0.5, 1.0)])
    for name, factor in [("reflectance", 1), ("angular_reflectance", 1), ("exitance", 16)]:
        assert np.array_equal(getattr(b, name)().value, factor * np.asarray(getattr(a, name)().value))
    for name, factor in [("mean_r2", 16), ("mean_x", 4), ("mean_path_length", 4)]:
        assert getattr(b, name)().value == pytest.approx(getattr(a, name)().value / factor, rel=1e-14)


@pytest.mark.parametrize("delta_phi", [0.0, 1.0, math.pi])
def test_angular_reflectance_is_reciprocal(medium, delta_phi):
    there = trace(medium, 0.95, 400_000, 21, directions=[(0.75, delta_phi)])
    back = trace(medium, 0.75, 400_000, 22, directions=[(0.95, delta_phi)])
    for order in ("single", "multiple"):
        assert abs(z(there.angular_reflectance(order), back.angular_reflectance(order))[0]) < 4


def test_angular_reflectance_is_symmetric_about_the_plane_of_incidence(run, medium):
    other = trace(medium, 0.8, 600_000, 23, directions=[(0.9, -0.4), (0.9, 0.4)])
    assert np.all(np.abs(z(run.angular_reflectance(), other.angular_reflectance())) < 4)


def test_angular_reflectance_integrates_to_the_reflectance(medium):
    nodes, weights = np.polynomial.legendre.leggauss(12)
    u, w = 0.5 * (nodes + 1), 0.5 * weights
    low = math.sqrt(max(1 - medium.eta**2, 0.0))
    mu = low + (1 - low) * u**2
    result = trace(medium, 1.0, 300_000, 24, directions=[(m, 0.0) for m in mu])
    flux = Estimate(*(np.asarray(v) * 2 * np.pi * mu * w * 2 * u * (1 - low) for v in result.angular_reflectance()))
    # the directions share their walks, so that their errors add up at worst linearly
    assert abs(flux.value.sum() - result.reflectance().value) < 4 * flux.standard_error.sum()


def test_diffuse_light_is_beams_weighted_by_their_cosine(medium):
    nodes, weights = np.polynomial.legendre.leggauss(8)
    low = max(1 - medium.eta**2, 0.0)
    mu2 = low + (1 - low) * 0.5 * (nodes + 1)  # 2 mu dmu = d(mu²)
    runs = [trace(medium, math.sqrt(m), 200_000, 250 + k).reflectance() for k, m in enumerate(mu2)]
    R, error = (np.array(v) for v in zip(*runs))
    w = 0.5 * (1 - low) * weights
    whole = Estimate(np.sum(w * R), math.sqrt(np.sum((w * error) ** 2)))
    assert abs(z(trace(medium, "diffuse", 400_000, 26).reflectance(), whole)) < 4


@pytest.mark.parametrize(("g", "eta", "mu_i"), [(0.0, 1.0, 1.0), (0.5, 1.3, 0.5), (-0.4, 0.8, 0.9)])
def test_albedo_one_gives_back_all_that_enters(g, eta, mu_i):
    R = trace(Medium(1.0, 0.0, g, eta), mu_i, 8192, 31).reflectance()
    assert R.standard_error < 0.02 and abs(R.value - (1 - F_r(mu_i, eta))) < 4 * R.standard_error


def test_albedo_zero_reflects_nothing_and_has_no_moments():
    result = trace(Medium(0.0, 1.0, 0.3, 1.3), 1.0, 1024, directions=[(0.5, 0.0)], radii=[0.0, 1.0])
    for measure in (result.reflectance, result.angular_reflectance, result.exitance):
        assert np.all(np.asarray(measure()) == 0)
    assert all(math.isnan(v) for v in result.mean_r2())


def test_light_that_cannot_refract_in_reflects_nothing():
    result = trace(Medium(1.0, 0.1, 0.0, 0.66), 0.7, 1024, directions=[(1.0, 0.0)])
    assert result.reflectance().value == 0 and result.angular_reflectance().value[0] == 0


def test_nothing_leaves_towards_directions_that_nothing_refracts_to():
    result = trace(Medium(1.0, 0.1, 0.0, 0.66), 1.0, 1024, directions=[(0.7, 0.0), (1.0, 0.0)])
    values = result.angular_reflectance().value
    assert values[0] == 0 and values[1] > 0


@pytest.mark.parametrize(("albedo", "g", "eta", "mu_i"), EXTREMES)
def test_extremes_stay_finite_and_between_zero_and_one(albedo, g, eta, mu_i):
    m = Medium.from_albedo(albedo, 1e3, g, eta)
    result = trace(m, mu_i, 1024, 41, directions=[(1.0, 0.0), (1e-3, 2.0), (0.0, 0.0)], radii=[0.0, 1e-5, 1.0])
    R = result.reflectance()
    assert 0 <= R.value <= 1 + 4 * R.standard_error
    for estimate in (R, result.angular_reflectance(), result.exitance()):
        assert all(np.all(np.isfinite(v)) and np.all(np.asarray(v) >= 0) for v in estimate)
    if R.value > 0:
        assert np.all(np.isfinite([result.mean_r2(), result.mean_x(), result.mean_path_length()]))


def bits(result) -> list:
    parts = (result.reflectance(), result.mean_r2(), result.exitance(), result.angular_reflectance())
    return [np.asarray(v).tobytes() for p in parts for v in p]


def test_the_same_seed_gives_the_same_bits_and_another_seed_other_ones():
    arguments = {"directions": [(0.5, 0.3)], "radii": [0.0, 0.1, 1.0]}
    a, b, c = (trace(MEDIA["denser"], 0.6, 100_000, seed, **arguments) for seed in (51, 51, 52))
    assert bits(a) == bits(b) and all(x != y for x, y in zip(bits(a), bits(c)))


@pytest.mark.parametrize("mu_i", [1.0, 0.8, "diffuse"])
def test_the_single_order_has_the_exact_reflectance(medium, mu_i):
    R = trace(medium, mu_i, 800_000, 61).reflectance("single")
    assert R.standard_error < 0.02 * R.value
    assert abs(z(R, (single_scattering.reflectance(medium, mu_i), 0.0))) < 4


def test_the_single_order_has_the_exact_moments(medium):
    result = trace(medium, 0.8, 800_000, 62)
    r2, x = single_scattering.moments(medium, 0.8)
    assert abs(z(result.mean_r2("single"), (r2, 0.0))) < 4 and abs(z(result.mean_x("single"), (x, 0.0))) < 4


def test_the_single_order_has_the_exact_radiance(run, medium):
    exact = single_scattering.brdf(medium, 0.8, np.array([0.9, 0.9]), np.array([0.4, -0.4]))
    assert np.all(np.abs(z(run.angular_reflectance("single"), (exact, 0.0))) < 4)


def ring_means(medium: Medium, mu_i: float, radii: np.ndarray) -> np.ndarray:
    """Exact single-order exitance averaged over rings, by Gauss nodes in r and even azimuths."""
    nodes, weights = np.polynomial.legendre.leggauss(24)
    phi = (np.arange(96) + 0.5) * np.pi / 96
    means = []
    for inner, outer in zip(radii[:-1], radii[1:]):
        r = inner + 0.5 * (outer - inner) * (nodes + 1)
        M = single_scattering.exitance(medium, r[:, None], mu_i, phi).mean(axis=1)
        means.append(np.sum(0.5 * (outer - inner) * weights * 2 * r * M) / (outer**2 - inner**2))
    return np.array(means)


def test_the_single_order_has_the_exact_exitance(run, medium):
    radii = np.array([0.0, 0.05, 0.2, 1.0, 3.0]) * medium.mfp
    assert np.all(np.abs(z(run.exitance("single"), (ring_means(medium, 0.8, radii), 0.0))) < 4)


def test_standard_errors_are_the_spread_of_independent_runs():
    m, arguments = MEDIA["denser"], {"directions": [(0.6, 2.0)], "radii": [0.0, 0.1, 0.5, 1.0]}
    runs = [trace(m, 0.7, 32_768, 700 + k, **arguments) for k in range(20)]
    names = ("reflectance", "mean_r2", "mean_x", "mean_path_length", "angular_reflectance", "exitance")
    for name in names:
        check_spread(*zip(*(getattr(r, name)() for r in runs)))


def test_a_relative_error_that_is_met_ends_the_run_early():
    result = trace(MEDIA["denser"], 1.0, 10**9, 91, relative_error=0.01)
    R = result.reflectance()
    assert R.standard_error <= 0.01 * R.value and result.n_paths < 10**8


def test_progress_counts_every_pass():
    seen = []
    trace(MEDIA["denser"], 1.0, 1024, progress=lambda done, passes: seen.append((done, passes)))
    assert seen == [(1, 1)]


BAD = [
    ({"mu_i": 1.5}, "mu_i", r"\[0, 1\]", "1.5"),
    ({"mu_i": math.nan}, "mu_i", r"\[0, 1\]", "nan"),
    ({"mu_i": "sun"}, "mu_i", r"\[0, 1\]", "sun"),
    ({"n_paths": 10}, "n_paths", ">= 256", "10"),
    ({"mu_i": np.float64(1.5)}, "mu_i", r"\[0, 1\]", "got 1.5$"),
    ({"n_paths": 1000.5}, "n_paths", "whole number", "1000.5"),
    ({"seed": -1}, "seed", ">= 0", "-1"),
    ({"directions": [(1.2, 0.0)]}, "mu_o", r"\[0, 1\]", "1.2"),
    ({"directions": [0.5]}, "directions", "pairs", "shape"),
    ({"directions": [(0.5, math.nan)]}, "delta_phi", "finite", "nan"),
    ({"directions": [(0.5, 0.0)], "mu_i": "diffuse"}, "directions", "None", "directions"),
    ({"radii": [1.0, 0.5]}, "radii", "ascending", r"\[1.0, 0.5\]"),
    ({"radii": "all"}, "radii", "lengths in mm", "all"),
    ({"radii": [-1.0, 0.5]}, "radii", ">= 0", "-1.0"),
    ({"radii": [0.0, 1.0], "mu_i": "diffuse"}, "radii", "None", "radii"),
    ({"relative_error": 2.0}, "relative_error", r"\[0, 1\]", "2.0"),
    ({"backend": "metal"}, "backend", "llvm, cuda", "metal"),
]


@pytest.mark.parametrize(("arguments", "parameter", "bound", "value"), BAD)
def test_bad_input_is_refused_with_name_bound_and_value(arguments, parameter, bound, value):
    with pytest.raises(ValueError, match=f"{parameter} must be.*({bound}).*{value}"):
        trace(MEDIA["matched"], **arguments)


def test_walks_and_events_are_counted():
    """Where all is absorbed a walk has one event."""
    result = trace(Medium(0.0, 1.0), 1.0, 1.024e3)
    assert result.n_paths == result.n_events == 1024


def test_a_medium_with_channels_is_refused():
    with pytest.raises(ValueError, match="medium must have one channel.*got 3 channels"):
        trace(Medium([1.0, 1.0, 1.0], 0.1))


def test_what_was_not_asked_for_is_refused():
    result = trace(MEDIA["matched"], n_paths=256)
    for measure, name in ((result.exitance, "radii"), (result.angular_reflectance, "directions")):
        with pytest.raises(ValueError, match=f"{name} must be given.*got None"):
            measure()
    with pytest.raises(ValueError, match="order must be one of single, multiple, total, got 'double'"):
        result.reflectance("double")
