"""The smooth boundary: Fresnel factors, refraction, and the moments of diffuse light."""

import math

import numpy as np
import pytest

from halfspace_sss.backend import array_types
from halfspace_sss.physics import fresnel
from halfspace_sss.physics.fresnel import C_1, C_2, F_r, F_t, mu_external, mu_internal

MU = np.linspace(0, 1, 201)
ETAS = [0.5, 0.75, 0.999, 1.001, 1.3, 1.5, 2.5, 4.0]


@pytest.mark.parametrize(
    ("mu", "eta", "value"),
    [(1, 1.3, 0.0170132325), (1, 1.33, 0.0200593122), (1, 1.5, 0.04), (0.5, 1.5, 0.0891867128)],
)
def test_reflectance_has_the_published_values(mu, eta, value):
    assert F_r(np.float64(mu), eta) == pytest.approx(value, abs=5e-11)


@pytest.mark.parametrize("eta", ETAS)
def test_reflectance_and_transmittance_add_to_one(eta):
    np.testing.assert_allclose(F_r(MU, eta) + F_t(MU, eta), 1, atol=1e-14)


@pytest.mark.parametrize("eta", ETAS)
def test_reflectance_lies_in_0_1_and_is_1_at_grazing(eta):
    F = F_r(MU, eta)
    assert np.all((F >= 0) & (F <= 1)) and F[0] == 1


def test_equal_indices_reflect_exactly_nothing():
    assert np.all(F_r(MU, 1.0) == 0) and np.all(F_t(MU, 1.0) == 1)


@pytest.mark.parametrize("eta", [1.001, 1.3, 2.5])
def test_light_beyond_the_critical_angle_is_totally_reflected(eta):
    mu_c = math.sqrt(1 - 1 / eta**2)
    inside = np.linspace(0, mu_c * (1 - 1e-9), 50)
    assert np.all(F_r(inside, 1 / eta) == 1) and np.all(F_t(inside, 1 / eta) == 0)
    assert F_r(np.float64(min(1.0, mu_c * 1.01)), 1 / eta) < 1


@pytest.mark.parametrize("eta", ETAS)
def test_reflectance_is_the_same_from_both_sides(eta):
    mu = MU[(1 - MU**2 < eta**2 * (1 - 1e-3)) & (MU > 0)]
    np.testing.assert_allclose(F_r(mu, eta), F_r(mu_internal(mu, eta), 1 / eta), rtol=1e-10, atol=1e-14)


@pytest.mark.parametrize("eta", ETAS)
def test_refraction_follows_snell_and_returns(eta):
    mu = MU[1 - MU**2 < eta**2 * (1 - 1e-3)]
    inside = mu_internal(mu, eta)
    np.testing.assert_allclose(np.sqrt(1 - mu**2), eta * np.sqrt(np.maximum(1 - inside**2, 0)), atol=2e-8)
    np.testing.assert_allclose(mu_external(inside, eta), mu, atol=1e-7)


def test_transmittance_keeps_its_digits_at_grazing():
    mu = np.array([1e-12, 1e-9])
    np.testing.assert_allclose(F_t(mu, 1.5) / mu, F_t(np.float64(1e-6), 1.5) / 1e-6, rtol=2e-5)


@pytest.mark.parametrize("eta", [0.75, 1.0, 1.3, 1.5])
def test_float32_agrees_with_float64(eta):
    mu = MU[np.abs(1 - MU**2 - eta**2) > 0.05]
    for f in (F_r, F_t, mu_internal, mu_external):
        single = f(mu.astype(np.float32), eta)
        assert single.dtype == np.float32
        np.testing.assert_allclose(single, f(mu, eta), atol=3e-6)


@pytest.mark.parametrize("eta", [0.75, 1.0, 1.3])
def test_all_array_libraries_agree(eta):
    torch = pytest.importorskip("torch")
    llvm = array_types("llvm")
    for f in (F_r, F_t, mu_internal, mu_external):
        np.testing.assert_allclose(f(torch.tensor(MU), eta).numpy(), f(MU, eta), rtol=1e-14, atol=1e-15)
        np.testing.assert_allclose(f(llvm.Float64(MU), eta).numpy(), f(MU, eta), rtol=1e-12, atol=1e-14)


def dunkle(n: float) -> float:
    """External diffuse reflectance 2 C_1(1/n), n > 1, in closed form (Dunkle 1963)."""
    n2, n4 = n**2, n**4
    return (
        0.5
        + (n - 1) * (3 * n + 1) / (6 * (n + 1) ** 2)
        + n2 * (n2 - 1) ** 2 / (n2 + 1) ** 3 * math.log((n - 1) / (n + 1))
        - 2 * n**3 * (n2 + 2 * n - 1) / ((n2 + 1) * (n4 - 1))
        + 8 * n4 * (n4 + 1) * math.log(n) / ((n2 + 1) * (n4 - 1) ** 2)
    )


@pytest.mark.parametrize("n", [1.05, 1.3, 1.5, 2.0, 2.5, 4.0])
def test_first_moments_follow_the_closed_form(n):
    assert 2 * C_1(1 / n) == pytest.approx(dunkle(n), abs=1e-10)
    assert 1 - 2 * C_1(n) == pytest.approx((1 - dunkle(n)) / n**2, abs=1e-10)


def test_moments_have_the_stated_values():
    assert 2 * C_1(1.5) == pytest.approx(0.59634576, abs=5e-9)
    assert 2 * C_1(1 / 1.5) == pytest.approx(0.09177796, abs=5e-9)
    assert 3 * C_2(1.5) == pytest.approx(0.46443052, abs=5e-9)


@pytest.mark.parametrize("n", [0.4, 0.8, 0.99, 1.01, 1.3, 3.0])
def test_second_moment_is_that_of_brute_force(n):
    mu = (np.arange(400_000) + 0.5) / 400_000
    assert C_2(n) == pytest.approx(np.mean(F_r(mu, 1 / n) * mu**2), abs=1e-7)


def test_equal_indices_have_no_moments_and_unit_constants():
    assert C_1(1.0) == C_2(1.0) == 0
    assert fresnel.boundary_A(1.0) == fresnel.boundary_A_jensen(1.0) == 1
    assert 4 * fresnel.C_phi(1.0) == 2 * fresnel.C_E(1.0) == 1


@pytest.mark.parametrize("n", [1.01, 1.3, 1.5, 2.5])
def test_boundary_constant_has_two_equal_forms(n):
    assert fresnel.boundary_A(n) == pytest.approx((1 + 3 * C_2(n)) / (1 - 2 * C_1(n)), rel=1e-13)


@pytest.mark.parametrize("eta", [0.2, 0.25, 3.86, 4.0, 5.0])
def test_the_published_fit_is_refused_where_it_passes_1_and_dipoles_would_be_negative(eta):
    with pytest.raises(ValueError, match=rf"eta must be in \[0.26, 3.84\] for the published fit .*, got {eta:g}"):
        fresnel.boundary_A_jensen(eta)


@pytest.mark.parametrize("eta", [0.26, 0.9, 3.84])
def test_the_published_fit_is_positive_up_to_its_bounds(eta):
    assert fresnel.boundary_A_jensen(eta) > 0


def test_boundary_constants_have_the_stated_values():
    assert fresnel.boundary_A_jensen(1.3) == pytest.approx(2.602, abs=5e-4)
    assert fresnel.boundary_A(1.3) == pytest.approx(2.3405, abs=5e-5)
    assert fresnel.boundary_A_jensen(1.5) == pytest.approx(3.960, abs=6e-4)
    assert fresnel.boundary_A(1.5) == pytest.approx(3.628, abs=5e-4)


@pytest.mark.parametrize(
    ("low", "high", "error_1", "error_2"),
    [(0.5, 0.999, 2e-4, 3e-4), (1.05, 1.5, 1.6e-3, 4.6e-3), (1.5, 2.0, 9e-4, 1.9e-3), (2.0, 2.5, 1.4e-3, 6.9e-3)],
)
def test_published_polynomials_keep_their_stated_errors(low, high, error_1, error_2):
    for n in np.linspace(low, high, 12):
        assert abs(fresnel.published_polynomial_2C_1(n) - 2 * C_1(n)) <= 1.05 * error_1
        assert abs(fresnel.published_polynomial_3C_2(n) - 3 * C_2(n)) <= 1.05 * error_2


def test_published_polynomials_are_wrong_at_equal_indices():
    assert fresnel.published_polynomial_2C_1(1.0) == pytest.approx(0.00433, abs=5e-6)
    assert fresnel.published_polynomial_3C_2(1.0) == pytest.approx(-0.00684, abs=5e-4)


@pytest.mark.parametrize("n", [0.6, 0.7, 0.8, 0.9, 0.95, 1.2, 1.5, 1.8])
def test_the_published_fit_of_the_diffuse_reflectance_is_that_of_the_moments(n: float) -> None:
    A = fresnel.boundary_A_jensen(n)
    assert (A - 1) / (A + 1) == pytest.approx(2 * C_1(n), abs=1.5e-3)


def test_indices_as_an_array_give_what_each_gives_alone_and_equal_ones_let_all_through() -> None:
    eta, mu = np.array([0.8, 1.0, 1.3, 1.0]), np.array([0.9, 0.4, 0.2, 0.0])
    for f in (F_r, F_t):
        np.testing.assert_allclose(f(mu, eta), [f(m, float(n)) for m, n in zip(mu, eta)], rtol=1e-12, atol=1e-15)
    assert F_t(mu, eta)[3] == 1 and F_r(mu, eta)[3] == 0
