"""Standard dipole: a real and a mirrored isotropic source below and above the plane (Jensen et al. 2001)."""

from __future__ import annotations

import math

from halfspace_sss.arrays import Real, library
from halfspace_sss.interface.model import Query, Separable, exit_normaliser
from halfspace_sss.physics.fresnel import boundary_A_jensen
from halfspace_sss.physics.medium import Medium


class _Dipole:
    """Constants of the standard dipole in mean free paths, and its profile."""

    def __init__(self, medium: Medium) -> None:
        m = medium.in_mfp()
        self.albedo_prime = m.albedo_prime
        self.sigma_tr = library(m.sigma_a).sqrt(3 * m.sigma_a * m.sigma_t_prime)
        self.z_r = 1 / m.sigma_t_prime
        self.z_v = self.z_r * (1 + 4 / 3 * boundary_A_jensen(m.eta))

    def R_d(self, q: Query) -> Real:
        sigma_tr, z_r, z_v = q.constant(self.sigma_tr), q.constant(self.z_r), q.constant(self.z_v)
        d_r, d_v = q.lib.sqrt(q.r * q.r + z_r * z_r), q.lib.sqrt(q.r * q.r + z_v * z_v)
        real = z_r * (1 + sigma_tr * d_r) * q.lib.exp(-sigma_tr * d_r) / (d_r * d_r * d_r)
        virtual = z_v * (1 + sigma_tr * d_v) * q.lib.exp(-sigma_tr * d_v) / (d_v * d_v * d_v)
        return q.constant(self.albedo_prime) * (real + virtual) / (4 * math.pi)


class StandardDipole(Separable):
    """Standard dipole as published, S = T_12 R_d(r) T_21 / pi.

    R_d = albedo'/(4 pi) [k(z_r, d_r) + k(z_v, d_v)], k(z, d) = z (1 + sigma_tr d) exp(-sigma_tr d)/d³, d² = r² + z²,
    z_r = 1/sigma_t', z_v = z_r (1 + 4A/3), sigma_tr = sqrt(3 sigma_a sigma_t'), A from the published fit of F_dr.

    Left out: single scattering, any direction but through the Fresnel factors. The second Fresnel factor is not
    renormalised and loses 6 % (eta = 1.3) to 9 % (eta = 1.5) of the flux; `standard_dipole_normalized` does not.
    Valid for albedo' -> 1 and r of a mean free path 1/sigma_t' or more.
    """

    name = "standard_dipole"
    orders = "multiple"
    source = "Jensen, Marschner, Levoy and Hanrahan 2001, eq. 4-5"
    N = 1.0

    def __init__(self, medium: Medium) -> None:
        super().__init__(medium)
        self._dipole = _Dipole(medium)

    def R_d(self, q: Query) -> Real:
        return self._dipole.R_d(q)


class StandardDipoleNormalized(Separable):
    """Standard dipole whose exit lobe has unit flux, S = T_12 R_d(r) T_21 / (4 pi C_phi(1/eta)); else as published."""

    name = "standard_dipole_normalized"
    orders = "multiple"
    source = "Jensen et al. 2001 with the exit normalisation of d'Eon 2012"

    def __init__(self, medium: Medium) -> None:
        super().__init__(medium)
        self._dipole = _Dipole(medium)

    @property
    def N(self) -> float:
        return exit_normaliser(self.medium.eta)

    def R_d(self, q: Query) -> Real:
        return self._dipole.R_d(q)
