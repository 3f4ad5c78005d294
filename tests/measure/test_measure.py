"""Measures of a model against closed forms, and of synthetic models whose answers are known."""

import math

import numpy as np
import pytest

from halfspace_sss import BSSRDF, Medium, bssrdf, measure
from halfspace_sss.measure import Quadrature
from halfspace_sss.physics import single_scattering as single
from halfspace_sss.physics.fresnel import C_1, C_E, C_phi, F_t, boundary_A, boundary_A_jensen

MEDIA = [(0.75, 0.0, 1.3), (0.99, 0.8, 1.5), (0.9, 0.3, 1.0), (0.9, -0.5, 0.75), (1.0, 0.0, 1.3), (1 - 1e-7, 0.9, 1.33),
         (0.5, 0.0, 1.02), (0.8, 0.5, 2.5)]  # fmt: skip


def media():
    return pytest.mark.parametrize("m", [Medium.from_albedo(a, 3.0, g, eta) for a, g, eta in MEDIA], ids=str)


def standard_R_d(m):
    """(albedo'/2) (1 + exp(-4/3 A q)) exp(-q), q = sqrt(3 (1 - albedo'))."""
    q = math.sqrt(3 * (1 - m.albedo_prime))
    return m.albedo_prime / 2 * (1 + math.exp(-4 / 3 * boundary_A_jensen(m.eta) * q)) * math.exp(-q)


class Tilted(BSSRDF):
    """S = T T (1 + k cos(phi_i)) exp(-r)/(2 pi^2), lengths in mean free paths: every moment in closed form."""

    name, orders, reciprocal, source = "tilted", "multiple", False, "this test"
    tilt = -0.5

    def G(self, q):
        return (1 + self.tilt * q.lib.cos(q.phi_i)) * q.lib.exp(-q.r) / (2 * math.pi**2)


class Clamped(Tilted):
    """The same with a tilt that makes it negative on the near side, clamped there."""

    tilt = -2.0

    def G_unclamped(self, q):
        return Tilted.G(self, q)

    def G(self, q):
        return q.lib.maximum(self.G_unclamped(q), 0.0)


class Unclamped(BSSRDF):
    """Any model without its clamp."""

    name, orders, reciprocal, source = "unclamped", "total", False, "this test"

    def __init__(self, model):
        super().__init__(model.medium)
        self.model = model

    def G(self, q):
        return self.model.G_unclamped(q)


class Total(Tilted):
    orders = "total"


@media()
@pytest.mark.parametrize("mu_i", [1.0, 0.8])
def test_reflectance_of_the_standard_dipole_is_the_closed_form(m, mu_i):
    closed = F_t(mu_i, m.eta) * standard_R_d(m) * (1 - 2 * C_1(1 / m.eta))
    assert measure.reflectance(bssrdf("standard_dipole", m), mu_i) == pytest.approx(closed, rel=1e-9)


@media()
def test_diffuse_reflectance_of_the_standard_dipole_is_the_closed_form(m):
    closed = standard_R_d(m) * (1 - 2 * C_1(1 / m.eta)) ** 2
    assert measure.reflectance(bssrdf("standard_dipole", m), "diffuse") == pytest.approx(closed, rel=1e-9)


@media()
def test_reflectance_of_the_better_dipole_is_the_closed_form(m):
    a, A = m.albedo_prime, boundary_A(m.eta)
    x = math.sqrt((1 - a) * (2 - a) / 3)
    bracket = C_phi(m.eta) * (-math.expm1(-4 * A * x) / x if x else 4 * A) + C_E(m.eta) * (1 + math.exp(-4 * A * x))
    closed = F_t(0.8, m.eta) * a * a / 2 * math.exp(-math.sqrt(3 * (1 - a) / (2 - a))) * bracket
    assert measure.reflectance(bssrdf("better_dipole", m), 0.8) == pytest.approx(closed, rel=1e-6)


def test_finer_quadrature_changes_nothing_for_a_directional_model():
    model = bssrdf("directional_dipole", Medium.from_albedo(0.95, 1.0, 0.5, 1.4))
    fine = measure.reflectance(model, 0.4, quadrature=Quadrature(40, 64, 48))
    assert measure.reflectance(model, 0.4) == pytest.approx(fine, rel=1e-7)


@pytest.mark.parametrize("mu_i", [1.0, 0.4, "diffuse"])
def test_total_adds_the_exact_single_order(mu_i):
    model = bssrdf("standard_dipole", Medium.from_albedo(0.75, 1.0))
    added = measure.reflectance(model, mu_i, "total") - measure.reflectance(model, mu_i, "multiple")
    assert added == pytest.approx(single.reflectance(model.medium, mu_i), rel=1e-12)


def test_no_order_means_the_order_of_the_model():
    model = Total(Medium.from_albedo(0.75, 1.0))
    assert measure.reflectance(model) == measure.reflectance(model, order="total")


@pytest.mark.parametrize(
    ("model", "order"), [(Total, "multiple"), (Total, "single"), (Tilted, "single"), (Tilted, "both")]
)
def test_an_order_that_the_model_cannot_form_is_refused(model, order):
    with pytest.raises(ValueError, match=f"order must be .*got '{order}'"):
        measure.reflectance(model(Medium(1.0, 0.1)), order=order)


def test_arrays_of_incidence_keep_their_shape_and_channels_come_last():
    scalar, rgb = Medium(1.0, 0.5), Medium([1.0, 20.0, 3.0], [0.5, 0.1, 0.001], 0.2)
    mu_i = np.array([[1.0, 0.5]])
    assert measure.reflectance(bssrdf("standard_dipole", scalar), mu_i).shape == (1, 2)
    model = bssrdf("standard_dipole", rgb)
    R = measure.reflectance(model, mu_i)
    assert R.shape == (1, 2, 3) and measure.reflectance(model, "diffuse").shape == (3,)
    for k in range(3):
        one = bssrdf("standard_dipole", rgb.channel(k))
        np.testing.assert_allclose(R[..., k], measure.reflectance(one, mu_i), rtol=1e-9)
        assert measure.moments(model, 0.5).mean_r2[k] == pytest.approx(measure.moments(one, 0.5).mean_r2, rel=1e-9)


def test_nothing_comes_out_where_nothing_scatters_or_enters():
    assert measure.reflectance(bssrdf("standard_dipole", Medium(0.0, 1.0))) == 0
    assert measure.reflectance(bssrdf("standard_dipole", Medium(1.0, 0.1)), 0.0) == 0


@pytest.mark.parametrize("eta", [0.75, 1.0, 1.3])
def test_a_profile_in_the_azimuth_integrates_exactly(eta):
    m = Medium.from_albedo(0.8, 2.0, eta=eta)
    T_o = 1 - 2 * C_1(1 / eta)
    assert measure.reflectance(Tilted(m), 0.9) == pytest.approx(F_t(0.9, eta) * T_o, rel=1e-8)
    mean_r2, mean_x = measure.moments(Tilted(m), 0.9)
    assert mean_r2 == pytest.approx(6 / 2.0**2, rel=1e-8)
    assert mean_x == pytest.approx(0.25 * 2 / 2.0, rel=1e-8)


def test_moments_of_the_standard_dipole_are_the_closed_form():
    m = Medium.from_albedo(0.95, 2.0, 0.5, 1.4)
    s, z_r = math.sqrt(3 * m.sigma_a * m.sigma_t_prime), 1 / m.sigma_t_prime
    z_v = z_r * (1 + 4 / 3 * boundary_A_jensen(1.4))
    e_r, e_v = math.exp(-s * z_r), math.exp(-s * z_v)
    mean_r2, mean_x = measure.moments(bssrdf("standard_dipole", m), 0.7)
    assert mean_r2 == pytest.approx(2 / s * (z_r * e_r + z_v * e_v) / (e_r + e_v), rel=1e-9) and mean_x == 0


def test_a_moment_that_diverges_is_infinite():
    assert measure.moments(bssrdf("standard_dipole", Medium(1.0, 0.0))).mean_r2 == math.inf


def test_the_profile_is_the_azimuthal_mean_of_the_exitance():
    m = Medium.from_albedo(0.8, 2.0, eta=1.3)
    r = np.array([[0.0, 0.3], [1.0, 4.0]])
    want = 4 * F_t(0.6, 1.3) * (1 - 2 * C_1(1 / 1.3)) * np.exp(-2 * r) / (2 * math.pi)
    np.testing.assert_allclose(measure.profile(Tilted(m), r, 0.6), want, rtol=1e-9)
    assert measure.profile(Tilted(Medium([1.0, 2.0], 0.1)), r).shape == (2, 2, 2)
    assert np.ndim(measure.profile(Tilted(m), 0.5)) == 0


def test_a_reciprocal_model_has_no_gap():
    assert measure.reciprocity_gap(bssrdf("standard_dipole", Medium(1.0, 0.1))).max < 1e-12


def test_the_gap_of_a_tilted_model_is_that_of_its_formula():
    gap = measure.reciprocity_gap(Tilted(Medium(1.0, 0.1)), n=40_000, seed=3)
    phi_i, phi_o = np.random.default_rng(1).uniform(-math.pi, math.pi, (2, 400_000))
    there, back = 1 - 0.5 * np.cos(phi_i), 1 + 0.5 * np.cos(phi_o)
    ratio = np.abs(there - back) / (there + back)
    assert gap.mean == pytest.approx(ratio.mean(), abs=4 * ratio.std() / 200)
    assert 0.4 < gap.max <= 0.5
    assert 0 < gap.energy < gap.max


def test_the_gap_is_the_same_for_the_same_seed_and_comes_per_channel():
    model = Tilted(Medium([1.0, 2.0], 0.1))
    assert measure.reciprocity_gap(model, 100, 7).mean.shape == (2,)
    np.testing.assert_array_equal(measure.reciprocity_gap(model, 100, 7), measure.reciprocity_gap(model, 100, 7))


def test_clamping_adds_the_energy_of_the_negative_part():
    m = Medium.from_albedo(0.8, 2.0, eta=1.3)
    negative = (2 * math.sin(math.pi / 3) - math.pi / 3) / math.pi  # mean of max(0, 2 cos - 1) over azimuth
    want = negative * F_t(0.9, 1.3) * (1 - 2 * C_1(1 / 1.3))
    assert measure.clamped_energy(Clamped(m), 0.9, Quadrature(n_azimuth=512)) == pytest.approx(want, rel=1e-4)
    assert measure.clamped_energy(Clamped(Medium([1.0, 2.0], 0.1)), 0.9).shape == (2,)


@pytest.mark.parametrize(("albedo", "g", "mu_i"), [(0.9, 0.3, 0.3), (0.9, 0.3, 0.1), (0.99, 0.0, 0.2)])
def test_the_directional_dipole_is_clamped_under_oblique_light_by_what_its_plane_integrals_differ(albedo, g, mu_i):
    model, fine = bssrdf("directional_dipole", Medium.from_albedo(albedo, 1.0, g, 1.0)), Quadrature(80, 128, 24)
    energy = measure.clamped_energy(model, mu_i, fine)
    difference = measure.reflectance(model, mu_i, quadrature=fine) - measure.reflectance(
        Unclamped(model), mu_i, quadrature=fine
    )
    assert energy == pytest.approx(difference, rel=1e-3) and energy > 1e-3
    assert measure.clamped_energy(model, 1.0) == 0


def test_a_model_that_does_not_clamp_has_no_clamped_energy():
    for model in ("standard_dipole", "forward_scattering_dipole"):
        assert measure.clamped_energy(bssrdf(model, Medium(1.0, 0.1))) == 0
    assert measure.clamped_energy(Tilted(Medium([1.0, 2.0], 0.1)), "diffuse").tolist() == [0, 0]


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda s: measure.reflectance(s, 1.2), r"mu_i must be in \[0, 1\], got 1.2"),
        (lambda s: measure.reflectance(s, [0.5, math.nan]), r"mu_i must be in \[0, 1\], got nan"),
        (lambda s: measure.reflectance(s, []), "mu_i must not be empty"),
        (lambda s: measure.reflectance(s, "sunny"), "mu_i must be cosines .*'sunny'"),
        (lambda s: measure.profile(s, -1.0), r"r must be .*-1"),
        (lambda s: measure.profile(s, 1.0, -0.1), r"mu_i must be in \[0, 1\], got -0.1"),
        (lambda s: measure.moments(s, 2.0), r"mu_i must be in \[0, 1\], got 2.0"),
        (lambda s: measure.reciprocity_gap(s, 0), "n must be >= 1, got 0"),
        (lambda s: Quadrature(per_decade=1), "per_decade must be a whole number >= 4, got 1"),
        (lambda s: Quadrature(n_azimuth=7), "n_azimuth must be even, got 7"),
        (lambda s: Quadrature(n_mu=1), "n_mu must be a whole number >= 2, got 1"),
    ],
)
def test_bad_arguments_are_refused_with_modelbound_and_value(call, message):
    with pytest.raises(ValueError, match=message):
        call(bssrdf("standard_dipole", Medium(1.0, 0.1)))


@pytest.mark.parametrize("call", [measure.reflectance, measure.moments, measure.reciprocity_gap])
def test_media_with_derivatives_are_refused_by_name(call):
    sigma_s = pytest.importorskip("torch").tensor(1.0, requires_grad=True)
    with pytest.raises(ValueError, match=r"medium must be of numbers \(take medium.detached\(\)\)"):
        call(bssrdf("standard_dipole", Medium(sigma_s, 0.1)))


def test_positions_of_a_denser_medium_raise_the_variance_of_the_weight(name):
    try:
        model, other = (bssrdf(name, Medium.from_albedo(0.9, sigma_t, 0.3, 1.3)) for sigma_t in (1.0, 8.0))
    except ValueError as error:
        pytest.skip(f"refused: {error}")
    own = measure.weight_variance(model)
    model.sample_position = other.sample_position
    assert 0 < own < 10
    assert measure.weight_variance(model) > 2 * own


def test_light_that_is_hardly_turned_is_found_however_far_it_goes():
    """g within 1e-6 of 1: the flux leaves 1e9 mean free paths away and more."""
    media = (Medium(1.0, 0.0, 1 - e) for e in (1e-5, 1e-12))
    R = [measure.reflectance(bssrdf("better_dipole", medium), 0.5) for medium in media]
    np.testing.assert_allclose(R[1], R[0], rtol=2e-5)


def test_ring_means_are_those_of_the_profile_and_add_up_to_the_reflectance() -> None:
    model = bssrdf("better_dipole", Medium([1.0, 2.0], [0.2, 0.1], 0.3, 1.4))
    edges = np.array([0.0, 0.5, 1.0, 4.0, 60.0])
    rings = measure.ring_means(model, edges, 0.7)
    r = np.linspace(0.5, 1.0, 2001)
    M = measure.profile(model, r, 0.7) * r[:, None]
    assert np.allclose(rings[1], ((M[1:] + M[:-1]) / 2).sum(axis=0) * (r[1] - r[0]) * 2 / (1 - 0.25), rtol=1e-5)
    whole = (rings * np.pi * np.diff(edges**2)[:, None]).sum(axis=0)
    assert np.allclose(whole, measure.reflectance(model, 0.7), rtol=1e-3)
    with pytest.raises(ValueError, match="radii must be two or more"):
        measure.ring_means(model, [1.0])
