"""The path tracer against solvers that others wrote: adding-doubling, discrete ordinates, Chandrasekhar's H functions.

Fixed seeds; a z-test fails at 4 standard errors (two-sided 6e-5 each), the solver's own convergence error included.
"""

from __future__ import annotations

import math

import numpy as np
import pytest

from halfspace_sss import Medium, trace
from halfspace_sss.physics.fresnel import C_1, F_r

iadpython = pytest.importorskip("iadpython")
nanodisort = pytest.importorskip("nanodisort")

ADDING_DOUBLING = [
    (0.5, 0.0, 1.0), (0.99, 0.8, 1.0), (0.9, -0.4, 1.0), (0.9, 0.0, 1.5), (0.75, 0.0, 1.3), (0.99, 0.9, 1.33),
    (0.95, 0.5, 1.5), (0.3, 0.5, 1.4),
]  # fmt: skip
MATCHED = [(0.5, 0.5, 0.5), (0.9, 0.5, 0.2), (0.9, -0.4, 0.8), (0.99, 0.7, 0.5), (0.8, 0.0, 1.0)]
AZIMUTHS = (0.0, 60.0, 180.0)
COSINES = (0.2, 0.5, 0.9)


def distance(value: float, error: float, truth: float, uncertainty: float) -> float:
    """|z| of a traced value."""
    return abs(value - truth) / math.hypot(error, uncertainty)


def adding_doubling(albedo: float, g: float, eta: float, points: int) -> tuple[float, float]:
    """Total reflectance of normal and of diffuse light, specular included, from iadpython."""
    sample = iadpython.Sample(a=albedo, b=np.inf, g=g, n=eta, quad_pts=points)
    R_normal, _, R_diffuse, _ = sample.rt()
    assert np.sum(sample.twonuw) == pytest.approx(1.0, abs=1e-6), "iadpython's quadrature has failed"
    return R_normal, R_diffuse


@pytest.mark.parametrize(("albedo", "g", "eta"), ADDING_DOUBLING)
def test_reflectance_agrees_with_adding_doubling(albedo, g, eta):
    few, many = (16, 24) if eta == 1 else (32, 48)
    coarse, fine = adding_doubling(albedo, g, eta, few), adding_doubling(albedo, g, eta, many)
    medium = Medium.from_albedo(albedo, 1.7, g, eta)
    specular = (F_r(1.0, eta), 2 * C_1(1 / eta))
    for k, mu_i in enumerate((1.0, "diffuse")):
        R = trace(medium, mu_i, 500_000, 101).reflectance()
        assert R.standard_error < 1e-3
        assert distance(R.value + specular[k], R.standard_error, fine[k], abs(fine[k] - coarse[k])) < 4


def discrete_ordinates(albedo: float, g: float, mu_i: float, streams: int) -> tuple[np.ndarray, float]:
    """BRDF of a matched half-space at `COSINES` x `AZIMUTHS` and its reflectance, from nanodisort."""
    state = nanodisort.DisortState()
    state.nstr, state.nlyr, state.nmom, state.ntau, state.nphase = streams, 1, 400, 1, 2001
    state.numu, state.nphi = len(COSINES), len(AZIMUTHS)
    state.usrtau = state.usrang = state.lamber = state.quiet = state.intensity_correction = True
    state.onlyfl = state.planck = state.old_intensity_correction = False
    state.fbeam, state.umu0, state.phi0, state.fisot, state.albedo = 1 / mu_i, mu_i, 0.0, 0.0, 0.0  # irradiance 1
    state.allocate()
    cosine = np.cos(np.linspace(0.0, np.pi, state.nphase))
    state.mu_phase = cosine
    state.phase = ((1 - g * g) / (1 + g * g - 2 * g * cosine) ** 1.5)[None]
    state.pmom = (float(g) ** np.arange(state.nmom + 1))[:, None]
    state.dtauc, state.ssalb, state.utau = np.array([5e3]), np.array([albedo]), np.array([0.0])
    state.umu, state.phi = np.array(COSINES), np.array(AZIMUTHS)
    state.solve()
    return np.array(state.uu)[:, 0, :], float(np.ravel(state.flup)[0])


@pytest.mark.parametrize(("albedo", "g", "mu_i"), MATCHED)
def test_angular_reflectance_agrees_with_discrete_ordinates(albedo, g, mu_i):
    (coarse, _), (fine, R) = (discrete_ordinates(albedo, g, mu_i, n) for n in (32, 64))
    directions = [(mu_o, math.radians(phi)) for mu_o in COSINES for phi in AZIMUTHS]
    result = trace(Medium.from_albedo(albedo, 0.6, g, 1.0), mu_i, 800_000, 102, directions=directions)
    value, error = (v.reshape(fine.shape) for v in result.angular_reflectance())
    assert np.all(error < 0.02 * value)
    assert np.all(np.abs(value - fine) < 4 * np.hypot(error, np.abs(fine - coarse)))
    assert distance(*result.reflectance(), R, 1e-6) < 4


def H(mu: float | np.ndarray, albedo: float) -> np.ndarray:
    """Chandrasekhar's H function of isotropic scattering.

    H(mu) = exp(-(mu/pi) ∫_0^{pi/2} ln(1 - albedo theta cot theta) / (cos² theta + mu² sin² theta) dtheta), with the
    nodes drawn towards both ends: the logarithm diverges at 0 for albedo 1, the rest peaks at pi/2 for small mu.
    """
    nodes, weights = np.polynomial.legendre.leggauss(400)
    t = 0.5 * (nodes + 1)
    theta, slope = 0.5 * np.pi * t * t * (3 - 2 * t), 0.5 * np.pi * 6 * t * (1 - t)
    small = theta**2 / 3 + theta**4 / 45 + 2 * theta**6 / 945
    gap = np.where(theta < 0.03, small, 1 - theta / np.tan(theta))  # 1 - theta cot theta
    mu = np.asarray(mu, dtype=np.float64)[..., None]
    integrand = np.log((1 - albedo) + albedo * gap) / (np.cos(theta) ** 2 + (mu * np.sin(theta)) ** 2)
    return np.exp(-mu[..., 0] / np.pi * np.sum(0.5 * weights * slope * integrand, axis=-1))


def test_the_h_function_used_here_has_its_published_value():
    assert H(1.0, 1.0) == pytest.approx(2.907810529, abs=1e-8)


@pytest.mark.parametrize(("albedo", "mu_i"), [(0.2, 1.0), (0.2, 0.05), (0.9, 0.3), (0.995, 1.0), (0.995, 0.05)])
def test_matched_isotropic_reflectance_is_chandrasekhars(albedo, mu_i):
    R = trace(Medium.from_albedo(albedo, 3.0, 0.0, 1.0), mu_i, 400_000, 103).reflectance()
    assert R.standard_error < 7e-4
    assert distance(*R, 1 - math.sqrt(1 - albedo) * H(mu_i, albedo), 1e-8) < 4


def test_matched_isotropic_diffuse_reflectance_is_chandrasekhars():
    nodes, weights = np.polynomial.legendre.leggauss(64)
    mu = 0.5 * (nodes + 1)
    R = trace(Medium.from_albedo(0.9, 3.0, 0.0, 1.0), "diffuse", 400_000, 104).reflectance()
    assert distance(*R, 1 - 2 * math.sqrt(0.1) * np.sum(0.5 * weights * mu * H(mu, 0.9)), 1e-8) < 4


@pytest.mark.slow
@pytest.mark.parametrize(("albedo", "mu_i"), [(0.5, 0.5), (0.95, 0.2), (1.0, 1.0)])
def test_matched_isotropic_radiance_is_chandrasekhars(albedo, mu_i):
    mu_o = np.array([0.1, 0.4, 0.7, 1.0])
    n_paths = 30_000 if albedo == 1 else 400_000
    result = trace(Medium.from_albedo(albedo, 3.0, 0.0, 1.0), mu_i, n_paths, 105, directions=[(m, 1.0) for m in mu_o])
    value, error = result.angular_reflectance()
    exact = albedo * H(mu_i, albedo) * H(mu_o, albedo) / (4 * math.pi * (mu_i + mu_o))
    assert np.all(error < 0.02 * value) and np.all(np.abs(value - exact) < 4 * error)
