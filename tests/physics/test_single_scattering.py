"""Single scattering against closed forms, published numbers, its own integrals and an independent random walk."""

import math

import numpy as np
import pytest

from halfspace_sss import Medium
from halfspace_sss.backend import array_types
from halfspace_sss.physics import single_scattering as single
from halfspace_sss.physics.fresnel import F_t, mu_external, mu_internal

ETAS = [0.75, 1.0, 1.3, 1.5]
GS = [-0.9, 0.0, 0.6, 0.95]


def medium(g=0.0, eta=1.3, albedo=0.8, sigma_t=2.0) -> Medium:
    return Medium.from_albedo(albedo, sigma_t, g, eta)


def test_published_single_scattering_lies_within_its_noise(truths):
    rows = [r for r in truths if r["quantity"] == "R_d single scattering"]
    z = []
    for row in rows:
        mu_i = "diffuse" if row["mu_i"] == "diffuse" else float(row["mu_i"])
        m = medium(float(row["g"]), float(row["eta"]), float(row["albedo"]))
        z.append((single.reflectance(m, mu_i) - float(row["value"])) / float(row["uncertainty"]))
    assert len(z) == 20 and np.max(np.abs(z)) < 4 and np.mean(np.square(z)) < 2


def test_stored_factors_are_met_to_their_last_digit(truths):
    rows = [r for r in truths if r["quantity"] == "R_d single scattering / albedo"]
    assert rows
    for row in rows:
        factor = single.reflectance(medium(0.0, 1.0, 1.0), float(row["mu_i"]))
        assert factor == pytest.approx(float(row["value"]), abs=1e-12)


@pytest.mark.parametrize("mu_i", [1.0, 0.5, 0.1, 1e-3, 1e-6])
def test_matched_isotropic_reflectance_is_the_closed_form(mu_i):
    closed = 0.4 * (1 - mu_i * math.log1p(1 / mu_i))
    assert single.reflectance(medium(0.0, 1.0), mu_i) == pytest.approx(closed, rel=1e-13)


def test_matched_isotropic_diffuse_reflectance_is_the_closed_form():
    assert single.reflectance(medium(0.0, 1.0), "diffuse") == pytest.approx(2 / 3 * 0.8 * (1 - math.log(2)), rel=1e-13)


def brdf_flux(m, mu_i, n=160, n_phi=720):
    """∫ brdf mu_o dw_o by a product rule of its own: the t² rule in the cosine outside (inside for eta < 1)."""
    nodes, weights = np.polynomial.legendre.leggauss(n)
    t = 0.5 * (nodes + 1)
    mu_o, w = (t * t, t**3 * weights) if m.eta >= 1 else (mu_external(t * t, m.eta), m.eta**2 * t**3 * weights)
    phi = math.pi * (np.arange(n_phi) + 0.5) / n_phi
    return 2 * math.pi * np.sum(w * single.brdf(m, mu_i, mu_o[:, None], phi).mean(axis=1))


@pytest.mark.parametrize("eta", ETAS)
@pytest.mark.parametrize("g", GS)
@pytest.mark.parametrize("mu_i", [1.0, 0.7])
def test_brdf_integrates_to_the_reflectance(eta, g, mu_i):
    m = medium(g, eta)
    assert brdf_flux(m, mu_i) == pytest.approx(single.reflectance(m, mu_i), rel=1e-7)


@pytest.mark.parametrize("eta", ETAS)
@pytest.mark.parametrize("g", GS)
@pytest.mark.parametrize("mu_i", [1.0, 0.7])
def test_exitance_integrates_to_the_reflectance_and_its_moments(eta, g, mu_i):
    m = medium(g, eta)
    x = np.linspace(-22, 4, 140)
    r, phi = np.exp(x), math.pi * (np.arange(40) + 0.5) / 40
    M = single.exitance(m, r[:, None], mu_i, phi if mu_i < 1 else phi[:1])
    M_x = (M * np.cos(phi)).mean(axis=1) if mu_i < 1 else 0 * r
    flux = np.trapezoid(2 * math.pi * r**2 * M.mean(axis=1), x)
    assert flux == pytest.approx(single.reflectance(m, mu_i), rel=3e-8)
    mean_r2, mean_x = single.moments(m, mu_i)
    assert np.trapezoid(2 * math.pi * r**4 * M.mean(axis=1), x) / flux == pytest.approx(mean_r2, rel=3e-8)
    assert np.trapezoid(2 * math.pi * r**3 * M_x, x) / flux == pytest.approx(mean_x, rel=3e-8, abs=1e-12)


@pytest.mark.parametrize("mu_i", [1.0, 0.5])
def test_exitance_is_the_integral_along_the_beam(mu_i):
    m, r, phi = medium(0.5, 1.4, sigma_t=1.0), 0.7, 0.6
    a, sine = mu_internal(mu_i, 1.4), math.sqrt(1 - mu_i**2) / 1.4
    t = (np.arange(2_000_000) + 0.5) * 1e-5
    x, y, z = r * math.cos(phi) - t * sine, r * math.sin(phi), t * a
    d = np.sqrt(x * x + y * y + z * z)
    c = (x * sine - z * a) / d
    p = (1 - 0.25) / (4 * math.pi * (1.25 - c) ** 1.5)
    integrand = 0.8 * p * np.exp(-t - d) * F_t(mu_external(z / d, 1.4), 1.4) * (z / d) / d**2
    want = F_t(np.float64(mu_i), 1.4) * integrand.sum() * 1e-5
    assert single.exitance(m, r, mu_i, phi) == pytest.approx(want, rel=1e-6)


def test_exitance_goes_as_one_over_r_towards_the_beam():
    r = np.array([1e-9, 1e-7])
    rM = r * single.exitance(medium(0.3, 1.3), r)
    assert rM[0] == pytest.approx(rM[1], rel=2e-5)
    assert single.exitance(medium(), 0.0) == math.inf


@pytest.mark.parametrize("eta", ETAS)
@pytest.mark.parametrize("g", [-0.999, 0.0, 0.999])
def test_extremes_are_finite_and_not_negative(eta, g):
    mu = np.array([0.0, 1e-8, 0.3, 1.0])
    for albedo in (0.0, 1.0):
        m = medium(g, eta, albedo, 1.0)
        M = single.exitance(m, np.array([1e-8, 1.0, 1e6])[:, None, None], mu[:, None], np.array([0.0, 1.0, math.pi]))
        R = single.reflectance(m, mu)
        assert np.all(np.isfinite(M) & (M >= 0)) and np.all(np.isfinite(R) & (R >= 0) & (R <= F_t(mu, eta) + 1e-12))
        f = single.brdf(m, mu[1:, None], mu, 0.7)
        assert np.all(np.isfinite(f) & (f >= 0))


@pytest.mark.parametrize("eta", ETAS)
@pytest.mark.parametrize("g", GS)
def test_brdf_is_reciprocal(eta, g):
    mu_i, mu_o, phi = np.random.default_rng(2).uniform(0, 1, (3, 200)) * np.array([[1], [1], [6.3]])
    there, back = single.brdf(medium(g, eta), mu_i, mu_o, phi), single.brdf(medium(g, eta), mu_o, mu_i, -phi)
    np.testing.assert_allclose(there, back, rtol=1e-13)


def test_light_leaves_on_the_far_side_for_forward_scattering():
    assert single.brdf(medium(0.8), 0.3, 0.3, 0.0) > single.brdf(medium(0.8), 0.3, 0.3, math.pi)


@pytest.mark.parametrize(("g", "eta", "mu_i"), [(0.0, 1.0, 1.0), (0.5, 1.3, 0.6), (-0.5, 0.75, 0.9), (0.9, 1.5, 0.2)])
def test_an_independent_random_walk_agrees_within_4_sigma(g, eta, mu_i):
    rng, n = np.random.default_rng(5), 400_000
    sine = math.sqrt(1 - mu_i**2) / eta
    a = math.sqrt(1 - sine**2)
    s, u, psi = rng.exponential(1, n), rng.random(n), rng.uniform(0, 2 * math.pi, n)
    q = (1 - g * g) / (1 - g + 2 * g * u)
    c = 1 - 2 * u if g == 0 else (1 + g * g - q * q) / (2 * g)
    b = np.sqrt(1 - c * c)
    direction = np.array([sine * c + a * b * np.cos(psi), b * np.sin(psi), -a * c + sine * b * np.cos(psi)])
    up = direction[2] > 0
    mu = np.where(up, direction[2], 1.0)
    n_i, n_o = 1.0, eta
    sin2 = (1 - mu**2) * (n_o / n_i) ** 2
    cos_t = np.sqrt(np.maximum(1 - sin2, 0))
    r_s, r_p = (eta * mu - cos_t) / (eta * mu + cos_t), (mu - eta * cos_t) / (mu + eta * cos_t)
    leave = np.where(up & (sin2 < 1), 1 - 0.5 * (r_s**2 + r_p**2), 0.0)
    d = s * a / mu
    weight = 0.8 * float(F_t(np.float64(mu_i), eta)) * leave * np.exp(-d)
    x, y = s * sine + d * direction[0], d * direction[1]
    m = medium(g, eta, sigma_t=1.0)
    R = single.reflectance(m, mu_i)
    mean_r2, mean_x = single.moments(m, mu_i)
    for sample, exact in ((weight, R), (weight * x, R * mean_x), (weight * (x * x + y * y), R * mean_r2)):
        assert abs(sample.mean() - exact) <= 4 * sample.std() / math.sqrt(n) + 1e-12
    r, phi = np.hypot(x, y), np.arctan2(y, x)
    inside = weight * ((r > 0.2) & (r < 0.8) & (np.abs(phi) < 1.0))
    nodes, w = np.polynomial.legendre.leggauss(24)
    radius, angle = 0.5 + 0.3 * nodes, nodes
    M = single.exitance(m, radius[:, None], mu_i, angle)
    assert abs(inside.mean() - np.einsum("i,j,ij", 0.3 * w * radius, w, M)) <= 4 * inside.std() / math.sqrt(n)


def test_channels_are_answered_each_for_itself():
    m = Medium([1.0, 2.0, 0.0], [0.1, 0.2, 1.0], [0.0, 0.5, -0.9], 1.3)
    mu = np.array([0.3, 0.8])

    def found(medium: Medium) -> list:
        return [
            single.brdf(medium, mu, 0.5, 0.3), single.exitance(medium, mu, 0.6, 0.3), single.reflectance(medium, mu)
        ]  # fmt: skip

    for k in range(3):
        for all_channels, channel in zip(found(m), found(m.channel(k))):
            np.testing.assert_allclose(all_channels[..., k], channel, rtol=1e-12)
    assert single.reflectance(m, "diffuse").shape == (3,)


def test_lengths_scale_with_the_mean_free_path():
    thin, thick = medium(0.4, sigma_t=1.0), medium(0.4, sigma_t=3.0)
    assert single.exitance(thick, 0.2, 0.7, 0.4) == pytest.approx(9 * single.exitance(thin, 0.6, 0.7, 0.4), rel=1e-13)
    assert single.reflectance(thick, 0.7) == pytest.approx(single.reflectance(thin, 0.7), rel=1e-14)
    np.testing.assert_allclose(np.array(single.moments(thin, 0.7)) / single.moments(thick, 0.7), [9, 3], rtol=1e-12)


@pytest.mark.parametrize("precision", [np.float32, np.float64])
def test_numpy_torch_and_drjit_agree(precision):
    torch = pytest.importorskip("torch")
    llvm = array_types("llvm")
    lanes = llvm.Float if precision is np.float32 else llvm.Float64
    args = np.random.default_rng(3).random((3, 32)).astype(precision) * 0.98 + precision(0.01)
    m, rtol = medium(0.7, 1.4), 2e-5 if precision is np.float32 else 1e-12
    want, of_torch, of_drjit = (single.brdf(m, *map(kind, args)) for kind in (np.asarray, torch.as_tensor, lanes))
    assert want.dtype == precision and of_torch.numpy().dtype == precision and type(of_drjit) is lanes
    for found in (of_torch, of_drjit):
        np.testing.assert_allclose(found.numpy(), want, rtol=rtol, atol=rtol * 1e-2)


def test_exitance_agrees_in_torch_and_keeps_the_precision_of_the_query():
    torch = pytest.importorskip("torch")
    r = np.array([0.1, 1.0])
    want = single.exitance(medium(0.7), r, 0.5, 0.3)
    tensors = (torch.tensor(v, dtype=torch.float64) for v in (r, 0.5, 0.3))
    np.testing.assert_allclose(single.exitance(medium(0.7), *tensors), want, rtol=1e-12)
    single_precision = single.exitance(medium(0.7), r.astype(np.float32), 0.5, 0.3)
    assert single_precision.dtype == np.float32
    np.testing.assert_allclose(single_precision, want, rtol=1e-5)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda m: single.brdf(m, 1.2, 0.5, 0.0), r"mu_i must be finite and in \[0, 1\], got 1.2"),
        (lambda m: single.brdf(m, 0.5, -0.1, 0.0), r"mu_o must be finite and in \[0, 1\], got -0.1"),
        (lambda m: single.brdf(m, 0.5, 0.5, math.nan), "delta_phi must be finite, got nan"),
        (lambda m: single.exitance(m, -1.0), r"r must be finite and in \[0, inf\], got -1.0"),
        (lambda m: single.exitance(m, 1.0, 0.5, math.inf), "phi must be finite, got inf"),
        (lambda m: single.reflectance(m, [0.5, 2.0]), r"mu_i must be finite and in \[0, 1\], got 2.0"),
        (lambda m: single.reflectance(m, "sunny"), "mu_i must be cosines .*'sunny'"),
        (lambda m: single.moments(m, "diffuse"), "mu_i must be cosines .*'diffuse'"),
    ],
)
@pytest.mark.parametrize("channels", [False, True])
def test_bad_arguments_are_refused_with_name_bound_and_value(call, message, channels):
    with pytest.raises(ValueError, match=message):
        call(Medium([1.0, 2.0], 0.1) if channels else medium())


def test_exitance_at_the_beam_is_infinite_only_where_light_scatters():
    r = np.array([0.0, 1.0])
    assert np.array_equal(np.isinf(single.exitance(medium(), r)), [True, False])
    assert np.array_equal(single.exitance(Medium(0.0, 1.0), r), [0.0, 0.0])


def test_light_comes_from_above_unless_it_is_said_otherwise():
    m = medium(0.4)
    assert single.reflectance(m) == single.reflectance(m, 1.0)
    assert single.moments(m) == single.moments(m, 1.0)
    assert single.exitance(m, 0.5) == single.exitance(m, 0.5, 1.0, 0.0)


def test_nothing_leaves_at_the_beam_where_nothing_scatters():
    assert single.exitance(medium(albedo=0.0), 0.0) == 0.0
