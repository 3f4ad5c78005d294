"""Smooth dielectric boundary: unpolarised reflectance, refraction, diffuse moments."""

from __future__ import annotations

import functools
import math

import numpy as np

from halfspace_sss.arrays import Real, library

SMALLEST_SQUARE = 1e-24  # of a sine


def _matched(eta: Real) -> bool:
    """Whether the index is the number 1, for which formulas shorten to exact ones; arrays are masked instead."""
    return isinstance(eta, (int, float)) and eta == 1


def _m2(mu: Real, eta: Real) -> Real:
    """(eta mu_t)² = eta² - 1 + mu², which keeps its digits for eta -> 1 and mu -> 0."""
    return (eta - 1) * (eta + 1) + mu * mu


def F_r(mu: Real, eta: Real) -> Real:
    """Unpolarised Fresnel reflectance of light that meets the surface at cosine mu.

    F = (r_s² + r_p²) / 2, r_s = (mu - m) / (mu + m), r_p = (eta² mu - m) / (eta² mu + m) with m = eta mu_t =
    sqrt(eta² - 1 + mu²), mu_t the cosine of the refracted direction; total internal reflection gives 1,
    eta = 1 gives exactly 0.

    Args:
        mu: cosine on the incident side, [0, 1].
        eta: index beyond the surface over index on the incident side (light leaving the medium:
            1 / medium.eta), a number or an array of the library of mu.

    Returns:
        Reflectance in [0, 1], the shape and precision of mu.
    """
    lib = library(mu, eta)
    if _matched(eta):
        return 0 * mu
    m2, eta2 = _m2(mu, eta), eta * eta
    m = lib.sqrt(lib.maximum(m2, 0.0))
    # eta >= 1: both denominators vanish only where m does too, i.e. never; eta < 1: under the mask
    r_s = (mu - m) / lib.maximum(mu + m, 1e-30)
    r_p = (eta2 * mu - m) / lib.maximum(eta2 * mu + m, 1e-30)
    F = lib.where(m2 <= 0, 1 + 0 * mu, lib.minimum(0.5 * (r_s * r_s + r_p * r_p), 1.0))
    return F if isinstance(eta, (int, float)) else lib.where(eta == 1, 0 * mu, F)


def F_t(mu: Real, eta: Real) -> Real:
    """Fresnel transmittance 1 - F_r, with the digits of T kept at grazing incidence.

    T = 2 eta mu mu_t [1 / (mu + eta mu_t)² + 1 / (eta mu + mu_t)²]. Same function for light entering
    under the external cosine mu and leaving under it. Arguments as `F_r`.
    """
    lib = library(mu, eta)
    if _matched(eta):
        return 1 + 0 * mu
    mu_t = mu_internal(mu, eta)
    s, p = lib.maximum(mu + eta * mu_t, 1e-15), lib.maximum(eta * mu + mu_t, 1e-15)
    T = 2 * eta * mu * mu_t * (1 / (s * s) + 1 / (p * p))
    return T if isinstance(eta, (int, float)) else lib.where(eta == 1, 1 + 0 * mu, T)


def mu_internal(mu: Real, eta: Real) -> Real:
    """Cosine inside for the cosine mu outside, sqrt(1 - (1 - mu²)/eta²); 0 where nothing refracts (eta < 1)."""
    lib = library(mu, eta)
    if _matched(eta):
        return mu
    result = lib.sqrt(lib.maximum(_m2(mu, eta), 0.0)) / eta
    return lib.where(result > 1, 1 + 0 * result, result)  # in float32 mu = 1 may give 1 + 1e-7


def sine(mu: Real) -> Real:
    """Sine of the angle with the cosine mu; 1e-12 at normal incidence, as a root has no derivative at 0."""
    lib = library(mu)
    return lib.sqrt(lib.maximum((1 - mu) * (1 + mu) + SMALLEST_SQUARE, 0.5 * SMALLEST_SQUARE))


def mu_external(mu: Real, eta: Real) -> Real:
    """Cosine outside for the cosine mu inside; 0 beyond the critical angle (eta > 1)."""
    return mu_internal(mu, 1 / eta)


def _moment(n: float, k: int) -> float:
    """C_k(n) = ∫_0^1 F(mu; 1/n) mu^k dmu, split at the critical cosine whose square-root kink mu_c + t² removes."""
    if n == 1:
        return 0.0
    nodes, weights = np.polynomial.legendre.leggauss(96)
    if n > 1:
        mu_c = math.sqrt((n - 1) * (n + 1)) / n
        scale = math.sqrt(1 - mu_c)
        t = 0.5 * scale * (nodes + 1)
        mu, w = mu_c + t * t, 0.5 * scale * weights * 2 * t
        return mu_c ** (k + 1) / (k + 1) + float(np.sum(w * F_r(mu, 1 / n) * mu**k))
    # n < 1, n -> 1: F falls from 1 to 0 within mu ~ sqrt(1 - n²); mu = t² puts nodes there
    t = 0.5 * (nodes + 1)
    return float(np.sum(0.5 * weights * 2 * t * F_r(t * t, 1 / n) * t ** (2 * k)))


@functools.lru_cache(maxsize=1024)
def C_1(n: float) -> float:
    """First Fresnel moment ∫ F(mu; 1/n) mu dmu; n = (medium the light is in) / (medium beyond).

    C_1(eta) is the internal (large) moment, C_1(1/eta) the external one; 2 C_1 is the diffuse
    reflectance. Its quadrature has about 1e-12; exactly 0 at n = 1. Source: d'Eon and Irving 2011.
    """
    return _moment(float(n), 1)


@functools.lru_cache(maxsize=1024)
def C_2(n: float) -> float:
    """Second Fresnel moment ∫ F(mu; 1/n) mu² dmu; argument and accuracy as `C_1`."""
    return _moment(float(n), 2)


def C_phi(n: float) -> float:
    """Weight of the fluence in the exitance, (1 - 2 C_1(n)) / 4; C_phi(eta) is the internal one."""
    return (1 - 2 * C_1(n)) / 4


def C_E(n: float) -> float:
    """Weight of the vector irradiance in the exitance, (1 - 3 C_2(n)) / 2; C_E(eta) is the internal one."""
    return (1 - 3 * C_2(n)) / 2


def boundary_A(eta: float) -> float:
    """Boundary constant A = (1 - C_E(eta)) / (2 C_phi(eta)), z_b = 2 A D; 1 at eta = 1.

    Source: d'Eon and Irving 2011 (moment form), used by all diffusion models but the standard dipole.
    """
    return (1 - C_E(eta)) / (2 * C_phi(eta))


def boundary_A_jensen(eta: float) -> float:
    """Boundary constant (1 + F_dr)/(1 - F_dr) with the published fit of F_dr.

    eta >= 1: F_dr = -1.440/eta² + 0.710/eta + 0.668 + 0.0636 eta; eta < 1: -0.4399 + 0.7099/eta - 0.3319/eta² +
    0.0636/eta³. At eta = 1 the fit gives 0.0016 instead of 0; exactly matched media use A = 1.
    Source: Jensen et al. 2001; Egan and Hilgeman 1979 for eta < 1.

    Raises:
        ValueError: the fit passes 1 at that index, so that A and what is made of it would be negative.
    """
    if eta == 1:
        return 1.0
    if eta > 1:
        F_dr = -1.440 / eta**2 + 0.710 / eta + 0.668 + 0.0636 * eta
    else:
        F_dr = -0.4399 + 0.7099 / eta - 0.3319 / eta**2 + 0.0636 / eta**3
    if F_dr >= 1:
        raise ValueError(
            f"eta must be in [0.26, 3.84] for the published fit of F_dr, which passes 1 there, got {eta:g}"
        )
    return (1 + F_dr) / (1 - F_dr)


def published_polynomial_2C_1(n: float) -> float:
    """The published polynomial for 2 C_1, kept to reproduce papers; diverges beyond n = 2.5.

    Source: d'Eon and Irving 2011. Within 1.6e-3 of `C_1` for 1.05 <= n <= 2.5, 0.0043 at n = 1.
    """
    if n < 1:
        return np.polyval([-1.36881, 4.98554, -7.80989, 6.75335, -3.4793, 0.919317], n)
    return np.polyval([0.254913, -2.54396, 10.2291, -20.9292, 22.2272, -9.23372], n)


def published_polynomial_3C_2(n: float) -> float:
    """The published polynomial for 3 C_2, kept to reproduce papers; source and range as for 2 C_1."""
    if n < 1:
        return np.polyval([0.145787, 0.236494, -1.95284, 3.36231, -2.62051, 0.828421], n)
    inverse = 135.926 / n**3 - 656.175 / n**2 + 1376.53 / n
    return inverse + np.polyval([1.91826, -27.0181, 164.798, -568.556, 1213.67, -1641.1], n)
