"""Better dipole: modified diffusion and an exitance of fluence and irradiance (d'Eon 2012)."""

from __future__ import annotations

import math

from analytic_models._diffusion import DiffuseBoundary, Grosjean, safe_differences
from halfspace_sss.arrays import Real
from halfspace_sss.interface.model import Query, Separable
from halfspace_sss.physics.medium import Medium


class BetterDipole(Separable):
    """Better dipole, S = T_12 R_d(r) T_21 / (4 pi C_phi(1/eta)): multiple scattering with a normalised exit lobe.

    R_d = albedo'² [C_phi(eta) phi + C_E(eta) E],
    phi = [exp(-sigma_tr d_r)/d_r - exp(-sigma_tr d_v)/d_v] / (4 pi D),
    E = [z_r (1 + sigma_tr d_r) exp(-sigma_tr d_r)/d_r³ + z_v (1 + sigma_tr d_v) exp(-sigma_tr d_v)/d_v³] / (4 pi),
    z_r = 1/sigma_t', z_v = z_r + 4 A D, D = (2 sigma_a + sigma_s')/(3 sigma_t'²), sigma_tr = sqrt(sigma_a/D).

    Left out: single scattering, so at low albedo most of the light; any direction but through the Fresnel factors.
    Valid for albedo' -> 1 and r of a mean free path 1/sigma_t' or more. Conserves energy: the plane integral of R_d
    is at most 1 and tends to 1 with albedo'.

    Args:
        moments: "exact" Fresnel moments, or the "published" polynomials (which diverge beyond eta = 2.5).
    """

    name = "better_dipole"
    orders = "multiple"
    source = "d'Eon 2012, A Better Dipole"

    def __init__(self, medium: Medium, *, moments: str = "exact") -> None:
        super().__init__(medium)
        self.moments = moments
        self._boundary = DiffuseBoundary.for_index(medium.eta, moments)
        self._c = Grosjean(medium, self._boundary)

    @property
    def N(self) -> float:
        return self._boundary.N

    def R_d(self, q: Query) -> Real:
        lib, c = q.lib, self._c
        sigma_tr, z_r, z_b, D = (q.constant(v) for v in (c.sigma_tr, 1 / c.sigma_t_prime, c.z_b, c.D))
        z_v = z_r + 2 * z_b
        d_r, d_v = lib.sqrt(q.r * q.r + z_r * z_r), lib.sqrt(q.r * q.r + z_v * z_v)
        delta = 4 * z_b * (z_r + z_b) / (d_r + d_v)
        decay, fluence, _ = safe_differences(lib, sigma_tr, d_r, d_v, delta)
        irradiance = z_r * (1 + sigma_tr * d_r) / (d_r * d_r * d_r)
        irradiance = irradiance + z_v * (1 + sigma_tr * d_v) * decay / (d_v * d_v * d_v)
        C_phi, C_E = q.constant(self._boundary.C_phi), q.constant(self._boundary.C_E)
        exitance = C_phi / D * fluence + C_E * irradiance
        return q.constant(c.albedo_prime**2 / (4 * math.pi)) * exitance * lib.exp(-sigma_tr * d_r)
