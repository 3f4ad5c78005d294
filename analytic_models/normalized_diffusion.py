"""Normalised diffusion: two exponentials over r fitted to path-traced profiles (Christensen and Burley 2015)."""

from __future__ import annotations

import functools
import math

import numpy as np

from halfspace_sss.arrays import Real, library
from halfspace_sss.interface.model import Query, Separable, exit_normaliser
from halfspace_sss.physics.fresnel import C_1
from halfspace_sss.physics.medium import Medium
from halfspace_sss.physics.reflectance import unit_gauss

R_MIN = 1e-6  # mean free paths


@functools.cache
def _nodes() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """1 - theta cot theta at the nodes in theta, the kernel with their weights for each mu, and the weights in mu."""
    v, w = unit_gauss(200)
    theta, w_theta = 0.5 * math.pi * v**4, 2 * math.pi * w * v**3  # nodes where the logarithm peaks, theta -> 0
    mu, w_mu = unit_gauss(48)
    mu = np.append(mu, 1.0)[:, None]
    deficit = np.where(theta < 1e-3, theta**2 / 3, 1 - theta / np.tan(theta))
    kernel = mu / (np.cos(theta) ** 2 + (mu * np.sin(theta)) ** 2) * w_theta / math.pi
    return deficit, kernel, 2 * w_mu * mu[:-1, 0]


def matched_albedos(albedo: Real) -> tuple[Real, Real]:
    """Reflectance of an isotropic half-space without a boundary: under normal and under diffuse incidence.

    1 - sqrt(1 - albedo) H(1) and 1 - 2 sqrt(1 - albedo) ∫ H(mu) mu dmu, with
    ln H(mu) = -(mu/pi) ∫_0^(pi/2) ln(1 - albedo theta cot theta) / (cos² theta + mu² sin² theta) dtheta.
    Source: Chandrasekhar 1960; both vanish with the albedo without loss of digits.
    """
    lib = library(albedo)
    deficit, kernel, w_mu = (lib.like(v, albedo) for v in _nodes())
    # 1 - albedo theta cot theta, each form where it keeps its digits
    log = lib.log1p(-albedo * (1 - deficit)) if albedo < 0.5 else lib.log((1 - albedo) + albedo * deficit)
    half_log = 0.5 * lib.log1p(-albedo) if albedo < 1 else -math.inf
    plane = -lib.expm1(half_log - kernel @ log)  # plane albedo at mu
    return abs(plane[-1]), w_mu @ plane[:-1]  # abs: -0 at albedo 0


class NormalizedDiffusion(Separable):
    """Normalised diffusion, S = T_12 R(r) T_21 / (4 pi C_phi(1/eta)), R = A [exp(-r/d) + exp(-r/(3d))] / (8 pi d r).

    The shape is the searchlight fit d = 1 / (sigma_t' s), s = 1.85 - A_0 + 7 |A_0 - 0.8|³, made for an isotropic medium
    without a boundary; sigma_t' and albedo' stand for its coefficients (similarity). A_0 is its reflectance under
    normal incidence, 1 - sqrt(1 - albedo') H(1). The flux that leaves is A = A_0 (1 - rho) / (1 - rho A_d) with the
    internal diffuse reflectance rho = 2 C_1(eta) and A_d the reflectance under diffuse incidence (Saunderson): what
    the boundary sends back is scattered again. So A is the fraction of the flux that entered; at most 1, exact for
    eta = 1, g = 0 and normal incidence, and reciprocity holds as A does not depend on the direction.

    Left out: any direction but through the Fresnel factors; what the boundary does to the shape.
    R ~ 1/r towards r = 0 (integrable): r is clamped at 1e-6 mean free paths. Valid for every albedo and r to about
    10/sigma_t'.
    """

    name = "normalized_diffusion"
    orders = "total"
    source = "Christensen and Burley 2015, Approximate reflectance profiles, eq. 3 and 6 (searchlight)"

    def __init__(self, medium: Medium) -> None:
        super().__init__(medium)
        m = medium.in_mfp()
        albedos = [matched_albedos(channel.albedo_prime) for channel in m.channels()]
        A_0, A_d = albedos[0] if m.n_channels is None else map(library(m.sigma_s).stack, zip(*albedos))
        rho = 2 * C_1(medium.eta)
        self.A = A_0 * (1 - rho) / (1 - rho * A_d)
        self.d = 1 / (m.sigma_t_prime * (1.85 - A_0 + 7 * abs(A_0 - 0.8) ** 3))

    @property
    def N(self) -> float:
        return exit_normaliser(self.medium.eta)

    def R_d(self, q: Query) -> Real:
        lib, A, d = q.lib, q.constant(self.A), q.constant(self.d)
        r = lib.maximum(q.r, R_MIN)
        third = lib.exp(-r / (3 * d))
        return A / (8 * math.pi) * third * (1 + lib.exp(-2 * r / (3 * d))) / (d * r)
