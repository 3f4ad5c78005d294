"""The backbone of the learnt models is the sum that its docstring says, and warps fall off where they should."""

from __future__ import annotations

import math

import numpy as np
import pytest

from halfspace_sss.arrays import library
from halfspace_sss.physics.backbone import _boundary_A, backbone, length_scale, unwarp, warp
from halfspace_sss.physics.fresnel import boundary_A


@pytest.mark.parametrize(("albedo", "g", "eta"), [(0.75, 0.0, 1.3), (0.99, 0.8, 1.5), (0.3, -0.4, 1.0)])
def test_the_backbone_is_a_dipole_and_a_near_term(albedo: float, g: float, eta: float) -> None:
    sigma_t_prime = 1 - albedo * g
    D = (2 * (1 - albedo) + albedo * (1 - g)) / (3 * sigma_t_prime**2)
    s, z_r = math.sqrt((1 - albedo) / D), 1 / sigma_t_prime
    assert _boundary_A(eta) == pytest.approx(boundary_A(eta), rel=0.01)
    z_v = z_r + 4 * _boundary_A(eta) * D
    for r in (0.0, 0.1, 1.0, 10.0):
        far = 0.0
        for z in (z_r, z_v):
            d = math.hypot(r, z)
            far += z * (1 + s * d) * math.exp(-s * d) / d**3 / (4 * math.pi**2)
        near = ((1 - g) / sigma_t_prime) ** 2 * math.exp(-r) / (r + 0.05) / (16 * math.pi**2)
        assert float(backbone(r, albedo, g, eta)) == pytest.approx(albedo**2 * (far + near), rel=1e-9)


def test_the_length_is_that_of_the_decay_and_bounded_without_absorption() -> None:
    assert length_scale(0.75, 0.2) == pytest.approx(1 / math.sqrt(3 * 0.25 * (1 - 0.15)), rel=1e-12)
    assert length_scale(1.0, 0.5) == 40.0


def test_the_warp_is_logarithmic_near_and_linear_far() -> None:
    x = np.array([1e-6, 1.0, 19.9, 20.1, 500.0])
    np.testing.assert_allclose(warp(library(0.0), x), np.log(np.exp(x[:3]) - 1).tolist() + [20.1, 500.0], rtol=1e-9)


def test_unwarping_takes_back_what_the_warp_has_done_and_never_overflows() -> None:
    u = np.array([-12.0, 0.0, 15.0, 19.9, 20.1, 29.0, 31.0, 500.0, 1e5])
    x = unwarp(library(0.0), u)
    np.testing.assert_allclose(x, np.logaddexp(0, u), rtol=3e-9)
    np.testing.assert_allclose(warp(library(0.0), x), u, rtol=3e-9, atol=1e-9)
