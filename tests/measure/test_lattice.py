"""Reflectance on a lattice, of models whose S depends on both azimuths, against closed forms and the tracer."""

import math

import numpy as np
import pytest

import halfspace_sss
from halfspace_sss import BSSRDF, Medium, bssrdf, measure
from halfspace_sss.physics.fresnel import C_1, F_t


class Cusped(BSSRDF):
    """S = T T exp(-r) exp(-k |phi_o|) (1 + cos(phi_i) / 2) / (2 pi²) with a cusp where phi_o = 0, in closed form."""

    name, orders, reciprocal, source = "cusped", "multiple", False, "this test"
    sharpness, fast_in = 5.0, "numpy"

    def G(self, q):
        phi_o = np.abs((q.phi_o + math.pi) % (2 * math.pi) - math.pi)
        return (1 + 0.5 * q.lib.cos(q.phi_i)) * np.exp(-q.r - self.sharpness * phi_o) / (2 * math.pi**2)


def closed(mu_i, eta):
    k = Cusped.sharpness
    return F_t(mu_i, eta) * (1 - 2 * C_1(1 / eta)) * (1 - math.exp(-k * math.pi)) / (k * math.pi)


@pytest.mark.parametrize("eta", [1.0, 1.3, 0.75])
def test_a_cusp_is_integrated_within_its_error(eta):
    found = measure.reflectance_estimate(Cusped(Medium(1.0, 0.5, eta=eta)), 0.9)
    assert abs(found.value - closed(0.9, eta)) < 4 * found.error < 8e-4 * found.value


def test_uniform_radiance_cusps_and_channels_go_together():
    found = measure.reflectance_estimate(Cusped(Medium([1.0, 30.0], [0.5, 1.0], eta=1.3)), "diffuse")
    entering = 1 - 2 * C_1(1 / 1.3)
    np.testing.assert_allclose(found.value, closed(0.9, 1.3) / F_t(0.9, 1.3) * entering, rtol=3e-4)
    assert found.value.shape == found.error.shape == (2,) and np.all(found.error < 2e-4 * found.value)
    assert measure.reflectance(Cusped(Medium([1.0, 30.0], 0.5)), np.full((2, 1), 0.9)).shape == (2, 1, 2)


@pytest.mark.parametrize(("albedo", "g", "eta", "bias"), [(0.3, 0.9, 1.33, 0.03), (0.75, 0.9, 1.33, 0.02)])
def test_neural_reflects_what_the_tracer_finds_but_for_its_own_bias(albedo, g, eta, bias):
    medium = Medium.from_albedo(albedo, 1.0, g, eta)
    found = measure.reflectance_estimate(bssrdf("neural", medium), 1.0)
    traced = halfspace_sss.trace(medium, mu_i=1.0, n_paths=4_000_000, seed=1).reflectance("multiple")
    error = math.hypot(found.error, traced.standard_error)
    assert abs(found.value - traced.value) < 4 * error + bias * traced.value
