"""What several diffusion models share: boundary constants and differences that do not cancel."""

from __future__ import annotations

from dataclasses import dataclass

from halfspace_sss.arrays import Library, Real
from halfspace_sss.checks import check_choice
from halfspace_sss.physics import fresnel
from halfspace_sss.physics.medium import Medium

MOMENTS = ("exact", "published")


@dataclass(frozen=True)
class DiffuseBoundary:
    """Constants of the surface: weights of fluence and irradiance, A of the extrapolation distance, exit normaliser.
    A = (1 - C_E) / (2 C_phi), z_b = 2 A D, N = 4 C_phi(1/eta). Source: d'Eon and Irving 2011."""

    C_phi: float
    C_E: float
    N: float

    @property
    def A(self) -> float:
        return (1 - self.C_E) / (2 * self.C_phi)

    @staticmethod
    def for_index(eta: float, moments: str = "exact") -> DiffuseBoundary:
        """The boundary of a relative index.
        moments: by quadrature ("exact"), or by the polynomials printed in papers ("published", eta <= 2.5)."""
        check_choice("moments", moments, MOMENTS)
        if moments == "exact":
            return DiffuseBoundary(fresnel.C_phi(eta), fresnel.C_E(eta), 4 * fresnel.C_phi(1 / eta))
        two_C_1, three_C_2 = fresnel.published_polynomial_2C_1, fresnel.published_polynomial_3C_2
        return DiffuseBoundary((1 - two_C_1(eta)) / 4, (1 - three_C_2(eta)) / 2, 1 - two_C_1(1 / eta))


class Grosjean:
    """Constants of modified diffusion in mean free paths: D = (2 sigma_a + sigma_s') / (3 sigma_t'²), z_b = 2 A D.
    Source: Grosjean 1956 as used by d'Eon and Irving 2011."""

    def __init__(self, medium: Medium, boundary: DiffuseBoundary) -> None:
        m = medium.in_mfp()
        self.albedo_prime = m.albedo_prime
        self.sigma_t_prime = m.sigma_t_prime
        self.D = (2 * m.sigma_a + m.sigma_s_prime) / (3 * m.sigma_t_prime**2)
        self.sigma_tr = (m.sigma_a / self.D) ** 0.5
        self.z_b = 2 * boundary.A * self.D


def safe_differences(lib: Library, a: Real, d_r: Real, d_v: Real, delta: Real) -> tuple[Real, Real, Real]:
    """Differences between a real and a virtual source at distances d_r and d_v = d_r + delta, over exp(-a d_r).
    Returns exp(-a delta), 1/d_r - exp(-a delta)/d_v and the same of (1 + a d) exp(-a d)/d³; each is a sum of terms of
    one sign, whatever the size of delta, given from the difference of the squares."""
    x = lib.expm1(-a * delta)
    inverse_r, inverse_v = 1 / d_r, 1 / d_v
    fluence = inverse_v * (delta * inverse_r - x)
    v2 = inverse_v * inverse_v
    cubes = delta * inverse_r * inverse_v * (inverse_r * inverse_r + inverse_r * inverse_v + v2)
    squares = a * delta * inverse_r * inverse_v * (inverse_r + inverse_v)
    irradiance = cubes + squares - x * (1 + a * d_v) * v2 * inverse_v
    return 1 + x, fluence, irradiance
