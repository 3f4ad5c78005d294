"""Directional dipole: a ray source at the surface and its mirror image (Frisvad, Hachisuka and Kjeldsen 2014)."""

from __future__ import annotations

import math

from analytic_models._diffusion import DiffuseBoundary, safe_differences
from halfspace_sss.arrays import Real, library
from halfspace_sss.interface.model import BSSRDF, Query
from halfspace_sss.physics.medium import Medium

R_MIN = 1e-6  # mean free paths


class _Coefficients:
    """Constants in mean free paths; D = 1/(3 sigma_t'), d_e = 2.131 D / sqrt(albedo'), h = 2 A d_e."""

    def __init__(self, medium: Medium, boundary: DiffuseBoundary) -> None:
        m = medium.in_mfp()
        lib = library(m.sigma_s)
        self.D = 1 / (3 * m.sigma_t_prime)
        self.sigma_tr = lib.sqrt(3 * m.sigma_a * m.sigma_t_prime)
        # without scattering d_e is infinite: any finite value will do under the factor 0
        self.d_e = 2.131 * self.D / lib.sqrt(lib.maximum(m.albedo_prime, 1e-100))
        self.h = 2 * boundary.A * self.d_e
        self.scale = lib.where(m.sigma_s > 0, 1.0, 0 * m.sigma_s) / (4 * math.pi**2 * boundary.N)


class DirectionalDipole(BSSRDF):
    """Directional dipole, S = T_12 max(S'(x, w_12, d_r) - S'(x - x_v, w_v, d_v), 0) T_21, the light's direction kept.

    S'(x, w, d) = exp(-sigma_tr d)/(16 pi² C_phi(1/eta) d³) { C_phi [d²/D + 3 (1 + sigma_tr d) x.w]
    - C_E [3 D (1 + sigma_tr d) w.n - (1 + sigma_tr d + 3 D (3 (1 + sigma_tr d) + (sigma_tr d)²)/d² x.w) x.n] },
    d_r² = r² + D mu (D mu + 2 d_e sqrt((r² - (x.w_12)²)/(r² + d_e²))) for mu the refracted cosine, and the virtual
    source at height h = 2 A d_e over the entry with w_12 mirrored (in a half-space the modified normal is the normal).

    Left out: dependence on the exit direction but for T_21; reciprocity. Valid for high albedo', lit from the front.
    Does not conserve energy: reflectance / T_12 tends to 1.34 (eta = 1), 1.24 (1.3), 1.19 (1.5) for albedo -> 1, and
    it has no factor that lets it vanish with the albedo; nothing is rescaled here. No scattering at all gives 0.
    Singular for r -> 0 under grazing light at eta <= 1: r is clamped at 1e-6 mean free paths.
    Evaluated in float64 whatever the precision of the query, as it changes sign.

    Args:
        moments: "exact" Fresnel moments, or the "published" polynomials (which diverge beyond eta = 2.5).
    """

    name = "directional_dipole"
    orders = "total"
    reciprocal = False
    source = "Frisvad, Hachisuka and Kjeldsen 2014, Directional dipole model for subsurface scattering"

    def __init__(self, medium: Medium, *, moments: str = "exact") -> None:
        super().__init__(medium)
        self.moments = moments
        self._boundary = DiffuseBoundary.for_index(medium.eta, moments)
        self._c = _Coefficients(medium, self._boundary)

    def G(self, q: Query) -> Real:
        return q.lib.maximum(self.G_unclamped(q), 0.0)

    def G_unclamped(self, q: Query) -> Real:
        q = q.in_float64()
        lib, c = q.lib, self._c
        C_phi, C_E = q.constant(self._boundary.C_phi), q.constant(self._boundary.C_E)
        D, a, d_e, h, scale = (q.constant(v) for v in (c.D, c.sigma_tr, c.d_e, c.h, c.scale))
        mu, r = q.mu_i_in, lib.maximum(q.r, R_MIN)
        x_w = -r * q.sin_i * lib.cos(q.phi_i)  # x.w_12
        across = lib.maximum(r * r - x_w * x_w, 0.0)
        excess = D * mu * (D * mu + 2 * d_e * lib.sqrt(across / (r * r + d_e * d_e)))  # d_r² - r²
        d_r, d_v = lib.sqrt(r * r + excess), lib.sqrt(r * r + h * h)
        decay, fluence, k = safe_differences(lib, a, d_r, d_v, (h * h - excess) / (d_r + d_v))
        k_v = (1 + a * d_v) * decay / (d_v * d_v * d_v)
        m_v = (3 * (1 + a * d_v) + (a * d_v) * (a * d_v)) * decay / (d_v * d_v * d_v * d_v * d_v)
        # x.w_v = x.w_12 - h mu, w_v.n = mu, x.n = -h at the virtual source; k + 2 k_v = k_r + k_v
        by_fluence = fluence / D + 3 * x_w * k + 3 * h * mu * k_v
        by_irradiance = 3 * D * mu * (k + 2 * k_v) + h * k_v + 3 * D * h * m_v * (x_w - h * mu)
        return scale * lib.exp(-a * d_r) * (C_phi * by_fluence + C_E * by_irradiance)
