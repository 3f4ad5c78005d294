"""Analytic models against values computed with their authors' code, closed forms and independent quadrature."""

from __future__ import annotations

import math
import re

import numpy as np
import pytest
from scipy.integrate import quad

from analytic_models._diffusion import DiffuseBoundary, Grosjean
from analytic_models.better_dipole import BetterDipole
from analytic_models.directional_dipole import DirectionalDipole
from analytic_models.forward_scattering_dipole import ForwardScatteringDipole, Monopole
from analytic_models.normalized_diffusion import NormalizedDiffusion, matched_albedos
from analytic_models.photon_beam_diffusion import PhotonBeamDiffusion
from analytic_models.standard_dipole import StandardDipole, StandardDipoleNormalized
from halfspace_sss import Medium
from halfspace_sss.arrays import library
from halfspace_sss.interface.model import Query
from halfspace_sss.physics import single_scattering
from halfspace_sss.physics.fresnel import F_r, F_t, boundary_A, boundary_A_jensen
from halfspace_sss.physics.medium import eval_hg
from halfspace_sss.physics.reflectance import unit_gauss

LIB = library(0.0)
MEDIA = [
    Medium(1.8075, 0.6025, 0.0, 1.3),
    Medium.from_albedo(0.9984, 2.6, 0.0, 1.5),
    Medium.from_albedo(0.9, 1.0, 0.5, 1.0),
    Medium.from_albedo(0.99905, 10.6, 0.862, 1.33),
]


def regression(truths, quantity: str) -> list[tuple[dict[str, float], dict[str, str]]]:
    """Rows of one quantity that were computed with the authors' or a direct port's code, and numbers in their text."""
    rows = [row for row in truths if row["kind"] == "code_regression" and row["quantity"].startswith(quantity)]
    assert rows
    return [({k: float(v) for k, v in re.findall(r"(\w+)=(-?[\d.]+\d|-?\d)", row["other"])}, row) for row in rows]


def row_medium(numbers: dict[str, float], row: dict[str, str]) -> Medium:
    return Medium(numbers["sigma_s"], numbers["sigma_a"], float(row["g"]), float(row["eta"]))


def exitance(model, r, mu_i=1.0, phi_i=0.0):
    """pi N G: radial exitance per flux that enters, without Fresnel factors, 1/mm²."""
    S = model.eval(np.asarray(r, dtype=np.float64), mu_i, phi_i, 1.0, 0.0)
    eta = model.medium.eta
    return math.pi * model.N * S / (F_t(mu_i, eta) * F_t(1.0, eta))


def plane_integral(profile, scale: float) -> float:
    """∫ 2 pi r profile(r) dr; `scale` is a length that the profile varies on."""
    x, w = unit_gauss(400)
    r = scale * np.exp(60 * x - 30)
    return float(np.sum(60 * w * 2 * math.pi * r * r * profile(r)))


def test_directional_dipole_equals_the_authors_code(truths):
    """Rows of S' with the polynomial Fresnel moments; the beam goes along +x, so phi_i = pi or 0."""
    for numbers, row in regression(truths, "directional dipole S'_d"):
        x = float(re.search(r"x_o-x_i=\((-?[\d.]+),0\)", row["other"])[1])
        model, mu_i = DirectionalDipole(row_medium(numbers, row), moments="published"), float(row["mu_i"])
        S = model.eval(abs(x), mu_i, math.pi if x > 0 else 0.0, 1.0, 0.0)
        value = S / (F_t(mu_i, model.medium.eta) * F_t(1.0, model.medium.eta))
        assert value == pytest.approx(float(row["value"]), rel=1e-9), row["id"]


def pbrt_boundary(eta: float) -> DiffuseBoundary:
    """The published polynomials, halved or divided by three, as float32 constants: so pbrt-v3 has them (eta >= 1).

    The terms cancel: this rounding alone changes E_d by 1e-4.
    """
    C_1 = [0.12746, -1.27198, 5.11455, -10.4646, 11.1136, -4.61686]
    C_2 = [45.3087, -218.725, 458.843, 0.63942, -9.00603, 54.9327, -189.519, 404.557, -547.033]
    C_1, C_2 = (np.float32(c).astype(np.float64) for c in (C_1, C_2))
    moment_2 = np.polyval([*C_2[:3], 0], 1 / eta) + np.polyval(C_2[3:], eta)
    return DiffuseBoundary((1 - 2 * np.polyval(C_1, eta)) / 4, (1 - 3 * moment_2) / 2, 1.0)


def pbrt_samples(medium: Medium, r: float) -> float:
    """The model's integrand with the reduced kappa and 100 exponentially distributed samples, 1/mm²."""
    model = PhotonBeamDiffusion(medium, kappa="reduced")
    model._boundary = pbrt_boundary(medium.eta)
    model._c = Grosjean(medium, model._boundary)
    rate = model._c.sigma_t_prime
    t = -np.log1p(-(np.arange(100) + 0.5) / 100) / rate
    q = Query(LIB, medium.sigma_t * r, 1.0, 0.0, 1.0, 0.0, medium.eta)
    d_r = np.sqrt(q.r**2 + t * t)
    weights = model.strength / (d_r * rate * np.exp(-rate * t))
    return medium.sigma_t**2 * float(np.mean(model.exitance(q, t, 1.0, d_r) * weights))


def test_beam_diffusion_equals_pbrt_under_its_choices(truths):
    """Those are the reduced kappa, polynomial moments and 100 fixed samples."""
    for numbers, row in regression(truths, "pbrt-v3 E_d"):
        value = pbrt_samples(row_medium(numbers, row), numbers["r"])
        assert value == pytest.approx(float(row["value"]), rel=3e-7), row["id"]


def test_beam_diffusion_differs_from_pbrt_only_by_its_choices(truths):
    """Integrating exactly with exact moments takes 4 % at most, where 100 samples miss the peak; at r >= 1 0.2 %."""
    for numbers, row in regression(truths, "pbrt-v3 E_d"):
        medium = row_medium(numbers, row)
        model = PhotonBeamDiffusion(medium, kappa="reduced")
        R_ms = math.pi * DiffuseBoundary.for_index(medium.eta).N * model.eval(numbers["r"], 1.0, 0.0, 1.0, 0.0)
        R_ms /= F_t(1.0, medium.eta) ** 2
        assert R_ms == pytest.approx(float(row["value"]), rel=2e-3 if numbers["r"] >= 1 else 0.05), row["id"]


def single_by_samples(m: Medium, r: float, n: int) -> float:
    """Exitance of the single order over T_12, n samples of the depth beyond total internal reflection, 1/mm²."""
    critical = r * math.sqrt(m.eta**2 - 1)
    t = critical - np.log1p(-(np.arange(n) + 0.5) / n) / m.sigma_t
    d = np.hypot(r, t)
    score = np.exp(-m.sigma_t * (d + critical)) / d**2 * eval_hg(-t / d, m.g) * (1 - F_r(t / d, 1 / m.eta)) * t / d
    return m.albedo * float(np.mean(score))


def test_single_scattering_equals_pbrt_but_for_its_100_samples(truths):
    """They are 8 % high at sigma_t r = 0.01, 0.3 % at most from 0.1 on; pbrt's float32 constants take 3e-7."""
    for numbers, row in regression(truths, "pbrt-v3 E_ss"):
        medium, r, value = row_medium(numbers, row), numbers["r"], float(row["value"])
        exact = single_scattering.exitance(medium, r, 1.0) / F_t(1.0, medium.eta)
        assert single_by_samples(medium, r, 100) == pytest.approx(value, rel=5e-7), row["id"]
        assert single_by_samples(medium, r, 100_000) == pytest.approx(exact, rel=3e-6), row["id"]
        assert exact == pytest.approx(value, rel=3e-3 if medium.sigma_t * r >= 0.1 else 0.09), row["id"]


def test_forward_scattering_monopole_equals_the_authors_code(truths):
    for numbers, row in regression(truths, "forward-scattering monopole G"):
        r, s = float(re.search(r"R=\(([\d.]+),", row["other"])[1]), numbers["s"]
        mu_i, mu_o = numbers["mi"], numbers["mo"]
        p = 0.5 * numbers["sigma_s"] * (1 - float(row["g"]))
        m = Monopole.at(LIB, np.float64(p * s))
        along = math.sqrt(1 - mu_i**2) + math.sqrt(1 - mu_o**2)
        exponent = m.exponent(p * r, along, (mu_o - mu_i) ** 2) - numbers["sigma_a"] * s
        if "virtual" in row["quantity"]:
            exponent -= m.virtual_deficit(mu_i, mu_o, p * numbers["z_v"])
        value = p**3 * m.scale(LIB) * math.exp(exponent) / (4 * math.pi**2.5)
        assert value == pytest.approx(float(row["value"]), rel=1e-9), row["id"]


@pytest.mark.parametrize("medium", MEDIA)
@pytest.mark.parametrize("model", [StandardDipole, StandardDipoleNormalized])
def test_standard_dipole_has_its_closed_plane_integral(model, medium):
    """(albedo'/2) (1 + exp(-4 A q / 3)) exp(-q), q = sqrt(3 (1 - albedo'))."""
    a = medium.albedo_prime
    q = math.sqrt(3 * (1 - a))
    expected = 0.5 * a * (1 + math.exp(-4 / 3 * boundary_A_jensen(medium.eta) * q)) * math.exp(-q)
    total = plane_integral(lambda r: exitance(model(medium), r), 1 / medium.sigma_t_prime)
    assert total == pytest.approx(expected, rel=1e-9)


def modified_diffusion_bracket(medium: Medium) -> tuple[float, float]:
    """C_phi (1 - e^-4Ax)/x + C_E (1 + e^-4Ax) with x = sigma_tr D; and sigma_tr / sigma_t'."""
    a, b = medium.albedo_prime, DiffuseBoundary.for_index(medium.eta)
    x = math.sqrt((1 - a) * (2 - a) / 3)
    decay = math.exp(-4 * boundary_A(medium.eta) * x)
    return b.C_phi * (1 - decay) / x + b.C_E * (1 + decay), math.sqrt(3 * (1 - a) / (2 - a))


@pytest.mark.parametrize("medium", MEDIA)
def test_better_dipole_has_its_closed_plane_integral(medium):
    bracket, ratio = modified_diffusion_bracket(medium)
    expected = 0.5 * medium.albedo_prime**2 * math.exp(-ratio) * bracket
    total = plane_integral(lambda r: exitance(BetterDipole(medium), r), 1 / medium.sigma_t_prime)
    assert total == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize("medium", MEDIA)
@pytest.mark.parametrize("mu_i", [1.0, 0.4])
def test_beam_diffusion_without_kappa_has_its_closed_plane_integral(medium, mu_i):
    """(albedo'²/2) [...] / (1 + mu' sigma_tr / sigma_t')."""
    model = PhotonBeamDiffusion(medium, kappa="none", n_samples=64)
    bracket, ratio = modified_diffusion_bracket(medium)
    mu_in = math.sqrt(1 - (1 - mu_i**2) / medium.eta**2)
    expected = 0.5 * medium.albedo_prime**2 * bracket / (1 + mu_in * ratio)
    phi = 2 * math.pi * (np.arange(48) + 0.5) / 48

    def ring(r: np.ndarray) -> np.ndarray:
        S = model.eval(r[:, None], mu_i, phi, 1.0, 0.0).mean(axis=1)
        return math.pi * DiffuseBoundary.for_index(medium.eta).N * S / (F_t(mu_i, medium.eta) * F_t(1.0, medium.eta))

    # the clamp at r = 1e-6 takes less than 1e-6 of a profile that grows as 1/r
    assert plane_integral(ring, 1 / medium.sigma_t_prime) == pytest.approx(expected, rel=2e-6)


def beam_integrand(model: PhotonBeamDiffusion, r: float, mu_in: float, phi_i: float, t: float) -> float:
    """R_ms' integrand as printed, term by term, lengths in mean free paths."""
    m, b = model.medium.in_mfp(), DiffuseBoundary.for_index(model.medium.eta)
    D = (2 * m.sigma_a + m.sigma_s_prime) / (3 * m.sigma_t_prime**2)
    a, z_b, z = math.sqrt(m.sigma_a / D), 2 * b.A * D, t * mu_in
    s = math.sqrt(1 - mu_in**2)
    d_r = math.hypot(r + s * t * math.cos(phi_i), s * t * math.sin(phi_i), z)
    d_v = math.sqrt(d_r**2 + 4 * z_b * z + 4 * z_b**2)
    phi = (math.exp(-a * d_r) / d_r - math.exp(-a * d_v) / d_v) / D
    E = z * (1 + a * d_r) * math.exp(-a * d_r) / d_r**3
    E += (z + 2 * z_b) * (1 + a * d_v) * math.exp(-a * d_v) / d_v**3
    source = m.albedo_prime**2 * m.sigma_t_prime * math.exp(-m.sigma_t_prime * t)
    return source * (1 - math.exp(-2 * (d_r + t))) * (b.C_phi * phi + b.C_E * E) / (4 * math.pi)


@pytest.mark.parametrize("medium", [MEDIA[0], MEDIA[1], MEDIA[3]])
def test_beam_diffusion_converges_to_adaptive_quadrature(medium):
    model, nodes = PhotonBeamDiffusion(medium), {12: 1e-3, 16: 3e-4, 24: 1e-5, 32: 1e-6}
    models = {rel: PhotonBeamDiffusion(medium, n_samples=n) for n, rel in nodes.items()}
    for r in (1e-4, 0.01, 0.3, 3.0, 20.0):
        for mu_i, phi_i in ((1.0, 0.0), (0.5, 0.4), (0.1, math.pi)):
            mu_in = math.sqrt(1 - (1 - mu_i**2) / medium.eta**2)
            points = sorted({0.1 * r, r, min(10 * r, 5.0), 1.0, 5.0})
            ends = [0.0, *points, 60 / medium.in_mfp().sigma_t_prime]
            pieces = [
                quad(lambda t: beam_integrand(model, r, mu_in, phi_i, t), *e, epsabs=0, epsrel=1e-9, limit=200)[0]  # noqa: B023
                for e in zip(ends[:-1], ends[1:])
            ]
            factor = math.pi * DiffuseBoundary.for_index(medium.eta).N / (F_t(mu_i, medium.eta) * F_t(1.0, medium.eta))
            for rel, each in models.items():
                S = each.eval(r / medium.sigma_t, mu_i, phi_i, 1.0, 0.0) / medium.sigma_t**2 * factor
                assert pytest.approx(sum(pieces), rel=rel) == S, (r, mu_i)


@pytest.mark.parametrize("medium", MEDIA)
def test_forward_scattering_dipole_converges_to_adaptive_quadrature(medium):
    models = {rel: ForwardScatteringDipole(medium, n_samples=n) for n, rel in {16: 1e-3, 48: 1e-6}.items()}
    m = medium.in_mfp()
    p, z_v = 0.5 * m.sigma_s_prime, 4 * boundary_A(medium.eta) / (3 * m.sigma_t_prime)
    for r, mu_i, phi_i, mu_o, phi_o in (
        (0.05, 0.9, 0.3, 0.8, 1.0),
        (1.0, 0.4, 2.5, 0.3, -0.4),
        (30.0, 1.0, 0.0, 0.6, 2.0),
    ):
        mu, nu = (math.sqrt(1 - (1 - x**2) / medium.eta**2) for x in (mu_i, mu_o))
        s_i, s_o = math.sqrt(1 - mu**2), math.sqrt(1 - nu**2)
        along = s_o * math.cos(phi_o) - s_i * math.cos(phi_i)
        across2 = (s_o * math.sin(phi_o) - s_i * math.sin(phi_i)) ** 2 + (nu - mu) ** 2

        def integrand(x: float) -> float:
            tau = math.exp(x)
            pole = Monopole.at(LIB, np.float64(tau))
            deficit = pole.virtual_deficit(mu, nu, p * z_v)  # noqa: B023
            exponent = pole.exponent(p * r, along, across2) - m.sigma_a / p * tau  # noqa: B023
            return float(pole.scale(LIB) * math.exp(exponent) * -math.expm1(-deficit) * tau)

        low = math.log(p * r)
        steps = [quad(integrand, low + k, low + k + 1, epsabs=1e-30, epsrel=1e-9, limit=200)[0] for k in range(24)]
        expected = (
            p**2 / (4 * math.pi**2.5 * medium.eta**2) * sum(steps) * F_t(mu_i, medium.eta) * F_t(mu_o, medium.eta)
        )
        for rel, model in models.items():
            S = model.eval(r / medium.sigma_t, mu_i, phi_i, mu_o, phi_o) / medium.sigma_t**2
            assert pytest.approx(expected, rel=rel) == S, r


def test_monopole_coefficients_agree_on_both_sides_of_the_series():
    """Also E² / F = Z + 2 D, which the stable exponent rests on."""
    below, above = (Monopole.at(LIB, np.float64(x)) for x in (0.5 - 1e-12, 0.5))
    for key in ("D", "E", "F", "Z"):
        assert getattr(below, key) == pytest.approx(getattr(above, key), rel=1e-10)
    m = Monopole.at(LIB, np.array([1e-4, 1e-2, 0.3, 2.0, 15.0]))
    np.testing.assert_allclose(m.E**2 / m.F, m.Z + 2 * m.D, rtol=1e-12)
    np.testing.assert_allclose(m.E / m.F, m.tanh, rtol=1e-12)


@pytest.mark.parametrize("medium", MEDIA)
def test_normalized_diffusion_has_its_cdf(medium):
    """The flux within r is A (1 - exp(-r/d)/4 - 3 exp(-r/(3d))/4)."""
    model = NormalizedDiffusion(medium)
    d = model.d / medium.sigma_t
    for end in (0.1, 1.0, 5.0):
        x, w = unit_gauss(64)
        r = end * d * x
        inside = float(np.sum(end * d * w * 2 * math.pi * r * exitance(model, r)))
        expected = model.A * (1 - 0.25 * math.exp(-end) - 0.75 * math.exp(-end / 3))
        assert inside == pytest.approx(float(expected), rel=1e-9)


def test_normalized_diffusion_takes_the_exact_albedo_of_a_matched_half_space(truths):
    """Rows of the exact normal-incidence reflectance for eta = 1, g = 0."""
    rows = [row for row in truths if (row["kind"], row["quantity"], row["geometry"]) == ("exact", "R_d", "half-space")]
    rows = [row for row in rows if (float(row["eta"]), float(row["g"])) == (1, 0) and row["mu_i"] in ("1", "1.0")]
    assert len(rows) >= 3
    for row in rows:
        assert matched_albedos(float(row["albedo"]))[0] == pytest.approx(float(row["value"]), rel=1e-6), row["id"]


@pytest.mark.parametrize("eta", [0.8, 1.0, 1.3, 1.5, 2.5])
def test_normalized_diffusion_returns_all_light_without_absorption(eta):
    assert float(NormalizedDiffusion(Medium(1.0, 0.0, 0.3, eta)).A) == pytest.approx(1, abs=1e-12)
    assert 0 < float(NormalizedDiffusion(Medium(1.0, 0.1, 0.3, eta)).A) < 0.9


def test_directional_dipole_gains_energy_as_documented():
    """Reflectance / T_12 for albedo -> 1: 1.34, 1.24, 1.19 at eta = 1, 1.3, 1.5."""
    for eta, expected in ((1.0, 1.34), (1.3, 1.24), (1.5, 1.19)):
        model = DirectionalDipole(Medium(1.0, 1e-9, 0.0, eta))
        lobe = math.pi * DiffuseBoundary.for_index(eta).N / F_t(1.0, eta) ** 2
        total = plane_integral(lambda r: lobe * model.eval(r, 1.0, 0.0, 1.0, 0.0), 1.0)  # noqa: B023
        assert total == pytest.approx(expected, abs=0.01)
