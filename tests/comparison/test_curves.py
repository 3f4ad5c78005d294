"""Reflectance curves: what is compared with what, and what is refused."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

import halfspace_sss
from halfspace_sss import Medium, measure
from halfspace_sss.comparison.curve_set import TRACED, CurveSet
from halfspace_sss.comparison.reflectance_curves import default_paths, default_range
from halfspace_sss.interface.model import BSSRDF, Query
from halfspace_sss.physics import single_scattering

FIG10 = Medium.from_albedo(0.75, 0.241)
PATHS = 400_000


class InverseSquare(BSSRDF):
    """S proportional to 1/(r + 1)² that keeps what it was asked."""

    name, orders, reciprocal, source = "inverse_square", "multiple", True, "this test"

    def __init__(self, medium: Medium) -> None:
        super().__init__(medium)
        self.asked: list[Query] = []

    def G(self, q: Query) -> Any:
        self.asked.append(q)
        return 1 / (q.r + 1) ** 4


@pytest.fixture(scope="module")
def fig10() -> CurveSet:
    return halfspace_sss.curves(theta_i_deg=(0, 60), n_paths=PATHS)


def test_without_arguments_the_range_is_that_of_fig_10() -> None:
    assert default_range(FIG10) == (0.05, 25.0)


def test_the_default_range_scales_with_the_medium() -> None:
    near, far = np.array(default_range(FIG10.scaled(10)))
    assert (near, far) == pytest.approx((0.005, 2.5), rel=0.05)


@pytest.mark.slow
def test_all_models_and_the_traced_curve_are_there(fig10: CurveSet) -> None:
    assert fig10.series == (TRACED, *halfspace_sss.models())
    assert fig10.theta_i_deg == (0.0, 60.0)


def test_photon_beam_diffusion_is_within_half_of_the_traced_energy(fig10: CurveSet) -> None:
    errors = fig10.errors().query("series == 'photon_beam_diffusion' and r_from_mm == 0.05 and r_to_mm == 25")
    assert errors["L1"].max() < 0.5
    assert errors["noise"].max() < 0.05


def test_the_standard_dipole_is_dark_near_the_entry(fig10: CurveSet) -> None:
    errors = fig10.errors().query("series == 'standard_dipole' and r_to_mm == 0.1")
    assert errors.set_index("theta_i_deg").loc[0.0, "bias"] < -0.8


def test_traced_reflectance_agrees_with_the_solver(fig10: CurveSet) -> None:
    for theta, truth in ((0.0, 0.1467950239), (60.0, 0.1582170600)):
        value, error = fig10.curve(TRACED, theta).reflectance["total"]
        assert abs(value - truth) < 4 * error


def test_traced_radiance_integrates_to_the_exitance_of_mcml() -> None:
    """Normal incidence, 8.0 to 8.2 mm: 2 pi ∫ S mu_o dmu_o with the single order is 0.0087271 ± 0.00003 1/cm²."""
    x, w = np.polynomial.legendre.leggauss(4)
    total, variance = float(single_scattering.exitance(FIG10, 8.1, 1.0)), 0.0
    for mu_o, weight in zip(0.5 * (x + 1), 0.5 * w):
        s = halfspace_sss.curves(
            FIG10, theta_i_deg=[0], theta_o_deg=math.degrees(math.acos(mu_o)), r_min=7.4, r_max=8.86, n_r=2,
            half_width=math.pi, models=[], n_paths=PATHS,
        )  # fmt: skip
        c, share = s.curve(TRACED, 0.0), 2 * math.pi * weight * mu_o
        total += share * math.sqrt(c.S[0] * c.S[1])
        variance += np.sum((0.5 * share * c.standard_error) ** 2)
    assert total == pytest.approx(0.0087271e-2, abs=4 * math.sqrt(variance) + 0.01 * 0.0087271e-2)


def test_models_are_asked_with_azimuths_from_entry_to_exit() -> None:
    model = InverseSquare(FIG10)
    halfspace_sss.curves(
        FIG10, theta_i_deg=[30], theta_o_deg=20, delta_phi_deg=50, line_deg=120, models=[model], n_paths=1000, n_r=3
    )
    at_middle = next(q for q in model.asked if np.shape(q.r) == (3,))
    assert np.allclose(at_middle.phi_i, math.radians(180 - 120))
    assert np.allclose(at_middle.phi_o, math.radians(50 - 120))
    assert np.allclose(at_middle.mu_o, math.cos(math.radians(20)))


def test_cell_means_of_a_model_are_means_over_area() -> None:
    model = InverseSquare(FIG10)
    s = halfspace_sss.curves(FIG10, theta_i_deg=[0], r_min=1, r_max=100, n_r=4, models=[model], n_paths=1000)
    c, t = s.curve(model.name, 0.0), 0.241 * s.r_edges + 1
    scale = c.S_at_r * (0.241 * s.r + 1) ** 4
    integral = -np.diff(1 / (2 * t**2) - 1 / (3 * t**3))  # ∫ x / (x + 1)^4 dx
    assert c.S == pytest.approx(scale * 2 * integral / np.diff((t - 1) ** 2), rel=1e-3)
    assert abs(c.S / c.S_at_r - 1).max() > 0.05


def test_on_the_far_side_the_traced_curve_and_a_directional_model_are_brighter() -> None:
    bright, dark = (
        halfspace_sss.curves(
            FIG10, theta_i_deg=[60], line_deg=line, r_min=2, r_max=8, n_r=2, models=["photon_beam_diffusion"],
            n_paths=PATHS,
        )
        for line in (0, 180)
    )  # fmt: skip
    for series in (TRACED, "photon_beam_diffusion"):
        assert np.all(bright.curve(series, 60.0).S > 1.3 * dark.curve(series, 60.0).S)


def test_the_same_seed_gives_the_same_curve_and_another_seed_another() -> None:
    first, again, other = (
        halfspace_sss.curves(FIG10, theta_i_deg=[30], models=[], n_paths=10_000, seed=seed).curve(TRACED, 30.0).S
        for seed in (3, 3, 4)
    )
    assert np.array_equal(first, again)
    assert not np.array_equal(first, other)


def test_a_material_is_found_by_name_and_channel() -> None:
    s = halfspace_sss.curves("marble", channel="g", theta_i_deg=[0], models=["better_dipole"], n_paths=256)
    assert s.title == "marble G"
    assert s.medium == halfspace_sss.materials.load("marble").medium.channel(1)


def test_total_adds_the_exact_single_order_to_the_reflectance_of_a_model_without_it() -> None:
    options = {"theta_i_deg": [60], "models": ["better_dipole"], "n_paths": 256}
    multiple, total = (
        halfspace_sss.curves(FIG10, orders=o, **options).errors().iloc[-1] for o in ("multiple", "total")
    )
    single = single_scattering.reflectance(FIG10, 0.5)
    assert total["reflectance"] - multiple["reflectance"] == pytest.approx(single)
    assert total["reflectance_traced"] > multiple["reflectance_traced"]


def test_reflectance_of_models_is_that_of_the_measure(fig10: CurveSet) -> None:
    for name in ("better_dipole", "directional_dipole"):
        row = fig10.errors().query("series == @name and theta_i_deg == 60").iloc[0]
        exact = measure.reflectance(halfspace_sss.bssrdf(name, FIG10), math.cos(math.radians(60)))
        assert row["reflectance"] == pytest.approx(exact, rel=1e-3)


def test_a_model_that_refuses_the_medium_is_left_out_with_a_note() -> None:
    s = halfspace_sss.curves(Medium.from_albedo(0.5, 1.0, g=-0.5), theta_i_deg=[0], n_paths=256)
    assert "forward_scattering_dipole" not in s.series
    assert "forward_scattering_dipole left out: g must be >= 0" in s.notes[0]


def test_progress_counts_to_the_end() -> None:
    seen: list[tuple[int, int]] = []
    halfspace_sss.curves(
        FIG10, theta_i_deg=[0, 30], models=["better_dipole"], n_paths=256, progress=lambda *p: seen.append(p)
    )
    assert [done for done, _ in seen] == list(range(seen[-1][1] + 1))


def test_models_alone_are_asked_without_a_walk(monkeypatch: pytest.MonkeyPatch, tmp_path: Any) -> None:
    monkeypatch.setattr("halfspace_sss.comparison.reflectance_curves.trace_curve", None)
    found = halfspace_sss.curves(FIG10, theta_i_deg=[0, 30], models=["better_dipole"], n_paths=0)
    assert found.series == ("better_dipole",) and found.n_paths == 0
    errors = found.errors()
    assert errors["L1"].isna().all() and (errors["reflectance"] > 0.09).all()
    assert {path.suffix for path in found.save(tmp_path)} >= {".csv", ".json", ".pdf"}


def test_the_flux_of_a_curve_is_that_of_a_trace_of_the_same_seed() -> None:
    """Both walk the same."""
    theta, seed = 60.0, 3
    curve = halfspace_sss.curves(FIG10, theta_i_deg=[theta], models=[], n_paths=20_000, seed=seed).curve(TRACED, theta)
    trace = halfspace_sss.trace(FIG10, math.cos(math.radians(theta)), 20_000, seed)
    assert curve.reflectance["multiple"] == tuple(trace.reflectance("multiple"))


def test_bright_media_get_fewer_walks_by_default() -> None:
    dim, bright = (default_paths(Medium.from_albedo(albedo, 1.0)) for albedo in (0.1, 0.999))
    assert dim == 64_000_000
    assert 250_000 <= bright < 16_000_000


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"theta_i_deg": [90]}, r"theta_i_deg must be a number in \[0, 90\) degrees, got 90"),
        ({"theta_i_deg": []}, "theta_i_deg must hold at least one angle"),
        ({"theta_i_deg": [5, 5]}, "theta_i_deg must be different angles"),
        ({"theta_o_deg": -1}, "theta_o_deg must be a number in"),
        ({"line_deg": math.nan}, "line_deg must be a number in"),
        ({"r_min": 0.0}, "r_min must be a number in"),
        ({"r_min": 30.0}, "r_min must be < r_max = 25 mm, got 30"),
        ({"n_r": 1}, "n_r must be a whole number >= 2, got 1"),
        ({"half_width": 4.0}, "half_width must be"),
        ({"n_paths": 5}, "n_paths must be a whole number >= 256, got 5"),
        ({"seed": -1}, "seed must be"),
        ({"models": ["beter_dipole"]}, "did you mean 'better_dipole'"),
        ({"models": ["better_dipole"] * 2}, "models must be different"),
        ({"models": [InverseSquare(Medium(1, 1))]}, "models must be of the medium"),
        ({"orders": "single"}, "orders must be 'multiple' or 'total', got 'single'"),
        ({"orders": "total", "line_deg": 0}, "orders must be 'multiple' on a line where the refracted rays meet"),
        ({"backend": "metal"}, "backend must be one of"),
        ({"medium": "marbel"}, "did you mean 'marble'"),
        ({"medium": "marble", "channel": "X"}, "channel must be one of R, G, B"),
        ({"medium": FIG10, "channel": 1}, "channel must be left out"),
        ({"medium": 3}, "medium must be a Medium, a Material or the name of one, got 3"),
    ],
)
def test_bad_input_is_refused_with_name_bound_and_value(options: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        halfspace_sss.curves(**{"n_paths": 256, **options})


def test_the_stated_standard_error_is_the_scatter_between_seeds() -> None:
    runs = [
        halfspace_sss.curves(FIG10, theta_i_deg=[30], models=[], n_paths=8192, n_r=6, seed=100 * k).curve(TRACED, 30.0)
        for k in range(24)
    ]
    scatter = np.std([c.S for c in runs], axis=0, ddof=1)
    stated = np.sqrt(np.mean([c.standard_error**2 for c in runs], axis=0))
    assert scatter[2:] == pytest.approx(stated[2:], rel=0.6)
