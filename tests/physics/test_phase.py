"""The Henyey-Greenstein phase function: normalisation, mean cosine, means over azimuth, sampling, extremes."""

import numpy as np
import pytest
from scipy import integrate, stats

from halfspace_sss.backend import array_types
from halfspace_sss.physics.medium import eval_hg, sample_hg
from halfspace_sss.physics.single_scattering import _mean_hg

GS = [-0.999, -0.9, -0.3, -1e-4, 0.0, 1e-4, 0.5, 0.95, 0.999]


def over_sphere(f, g):
    """∫ f(c) p(c) dw with the variable log(1 -+ c) at the peak, so that every g has smooth integrands."""
    x = np.linspace(-40, np.log(2), 40_001)
    c = 1 - np.exp(x) if g >= 0 else np.exp(x) - 1
    gap = np.exp(x)
    p = (1 - g**2) / (4 * np.pi * ((1 - abs(g)) ** 2 + 2 * abs(g) * gap) ** 1.5)
    np.testing.assert_allclose(eval_hg(c, g), p, rtol=1e-8)
    return 2 * np.pi * integrate.simpson(f(c) * eval_hg(c, g) * gap, x=x)


@pytest.mark.parametrize("g", GS)
def test_it_is_normalised(g):
    assert over_sphere(np.ones_like, g) == pytest.approx(1, abs=1e-8)


@pytest.mark.parametrize("g", GS)
def test_its_mean_cosine_is_g(g):
    assert over_sphere(lambda c: c, g) == pytest.approx(g, abs=1e-8)


@pytest.mark.parametrize("g", [-0.8, 0.3, 0.9])
def test_it_is_the_published_formula(g):
    c = np.linspace(-1, 1, 101)
    np.testing.assert_allclose(eval_hg(c, g), (1 - g**2) / (4 * np.pi * (1 + g**2 - 2 * g * c) ** 1.5), rtol=1e-12)


def test_forward_is_cosine_one():
    assert eval_hg(np.float64(1.0), 0.5) > eval_hg(np.float64(-1.0), 0.5)


def cdf_hg(c, g):
    """Probability of a cosine below c, in closed form."""
    if g == 0:
        return 0.5 * (1 + c)
    return (1 - g**2) / (2 * g) * (1 / np.sqrt(1 + g**2 - 2 * g * c) - 1 / (1 + g))


@pytest.mark.parametrize("g", [-0.999, -0.6, 0.0, 1e-9, 5e-4, 0.3, 0.9, 0.999])
def test_samples_pass_a_chi_square_test_at_one_in_a_thousand(g):
    c = sample_hg(np.random.default_rng(11).random(200_000), g)
    u = np.clip(cdf_hg(c, g if abs(g) >= 1e-6 else 0.0), 0, 1)  # rounding at the ends
    observed, _ = np.histogram(u, bins=50, range=(0, 1))
    assert stats.chisquare(observed, np.full(50, len(c) / 50)).pvalue > 1e-3


@pytest.mark.parametrize("g", [-0.9, -0.3, -2e-3, -1e-5, 0.0, 1e-5, 2e-3, 0.3, 0.9, 0.999])
def test_samples_are_as_exact_in_float32_as_a_cosine_can_be(g):
    g, u = np.float32(g), np.linspace(0, 1, 1001, endpoint=False, dtype=np.float32)
    exact = sample_hg(u.astype(np.float64), np.float64(g))
    np.testing.assert_allclose(sample_hg(u, g), exact, rtol=0, atol=6e-7 / (1 - abs(min(g, 0.0))))


def test_sampling_inverts_the_distribution():
    u = np.linspace(0, 1, 101, endpoint=False)
    for g in (-0.9, -0.1, 0.01, 0.5, 0.99):
        np.testing.assert_allclose(cdf_hg(sample_hg(u, g), g), u, atol=1e-10)


@pytest.mark.parametrize("g", GS)
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_samples_and_values_stay_in_range_in_both_precisions(g, dtype):
    u = np.array([0, 1e-7, 0.25, 0.5, 0.75, 1 - 1e-7], dtype=dtype)
    c = sample_hg(u, g)
    assert c.dtype == dtype and np.all((c >= -1) & (c <= 1))
    p = eval_hg(np.array([-1, 0, 1], dtype=dtype), g)
    assert p.dtype == dtype and np.all(np.isfinite(p) & (p > 0))


@pytest.mark.parametrize("g", GS)
def test_float32_agrees_with_float64(g):
    c = np.linspace(-1, 1, 33).astype(np.float32)
    np.testing.assert_allclose(eval_hg(c, g), eval_hg(c.astype(np.float64), g), rtol=2e-5)


@pytest.mark.parametrize("g", [0.0, 5e-4, 0.7, -0.9])
def test_all_array_libraries_agree_also_for_arrays_of_g(g):
    torch = pytest.importorskip("torch")
    llvm = array_types("llvm")
    c, u = np.linspace(-1, 1, 20), np.linspace(0, 0.99, 20)
    for f, x in ((eval_hg, c), (sample_hg, u)):
        want = f(x, g)
        np.testing.assert_allclose(f(x, np.full(20, g)), want, rtol=1e-12, atol=1e-15)
        np.testing.assert_allclose(f(torch.tensor(x), g).numpy(), want, rtol=1e-12, atol=1e-15)
        np.testing.assert_allclose(
            f(torch.tensor(x), torch.full((20,), g, dtype=torch.float64)), want, rtol=1e-12, atol=1e-15
        )
        np.testing.assert_allclose(f(llvm.Float64(x), g).numpy(), want, rtol=1e-10, atol=1e-12)
        np.testing.assert_allclose(f(llvm.Float64(x), llvm.Float64(g)).numpy(), want, rtol=1e-10, atol=1e-12)


@pytest.mark.parametrize("g", [-0.7, 0.3, 0.9])
def test_means_of_the_phase_function_over_azimuth_are_those_of_its_values(g):
    """Also next to the normal, where a series takes the place of a difference of elliptic integrals."""
    mu, sine = 0.8, 0.6
    nu_sine = np.array([0.0, 1e-6, 1e-4, 8e-4, 1.2e-3, 0.01, 0.3])
    nu, phi = np.sqrt(1 - nu_sine**2), 2 * np.pi * (np.arange(2048) + 0.5) / 2048
    p = eval_hg(-mu * nu[:, None] + sine * nu_sine[:, None] * np.cos(phi), g)
    mean, mean_cosine = _mean_hg(g, mu, sine, nu, nu_sine)
    np.testing.assert_allclose(mean, p.mean(axis=1), rtol=1e-13)
    np.testing.assert_allclose(mean_cosine, (p * np.cos(phi)).mean(axis=1), rtol=1e-12, atol=1e-15)


@pytest.mark.parametrize("array", ["torch", "drjit"])
def test_the_phase_function_has_its_derivative_by_g_where_scattering_is_even(array: str) -> None:
    cosine = np.linspace(-1, 1, 5)
    if array == "torch":
        torch = pytest.importorskip("torch")
        g = torch.zeros(5, dtype=torch.float64, requires_grad=True)
        eval_hg(torch.from_numpy(cosine), g).sum().backward()
        slope = g.grad.numpy()
    else:
        dr = pytest.importorskip("drjit")
        types = pytest.importorskip("drjit.llvm.ad")
        g = types.Float64(np.zeros(5))
        dr.enable_grad(g)
        dr.backward(eval_hg(types.Float64(cosine), g))
        slope = np.array(dr.grad(g))
    np.testing.assert_allclose(slope, 3 * cosine / (4 * np.pi), atol=1e-12)
