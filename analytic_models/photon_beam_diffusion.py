"""Photon beam diffusion: a beam of sources along the refracted ray (Habel, Christensen and Jarosz 2013)."""

from __future__ import annotations

import math

from analytic_models._diffusion import DiffuseBoundary, Grosjean, safe_differences
from halfspace_sss.arrays import Real
from halfspace_sss.checks import check_choice
from halfspace_sss.interface.model import BSSRDF, Query
from halfspace_sss.physics.fresnel import sine
from halfspace_sss.physics.medium import Medium
from halfspace_sss.physics.reflectance import unit_gauss

R_MIN, MU_MIN = 1e-6, 1e-3  # mean free paths; refracted cosine
KAPPAS = ("extinction", "reduced", "none")


class PhotonBeamDiffusion(BSSRDF):
    """Photon beam diffusion, S = T_12 R_ms T_21 / (4 pi C_phi(1/eta)): multiple scattering from sources along the beam.

    R_ms = ∫_0^∞ albedo'² sigma_t' exp(-sigma_t' t) kappa(t) [C_phi phi + C_E E] dt, with
    phi = [exp(-sigma_tr d_r)/d_r - exp(-sigma_tr d_v)/d_v] / (4 pi D), E = [k(z, d_r) + k(z + 2 z_b, d_v)] / (4 pi),
    k(z, d) = z (1 + sigma_tr d) exp(-sigma_tr d)/d³,
    z = t mu', d_r the distance to x_i + t w_12, d_v² = d_r² + 4 z_b (z + z_b), z_b, D and sigma_tr as in the better
    dipole, kappa = 1 - exp(-2 sigma_t (d_r + t)) with the unreduced sigma_t.

    The integral is deterministic: with h the distance of x_o from the beam, t = t_0 + h sinh(v + v_0) makes
    dt = d_r dv, which takes the near-singular peak away, and the exponential tail ends the range; Gauss-Legendre in v.

    Left out: single scattering; dependence on the exit direction but for T_21; reciprocity. Valid for high albedo'.
    R_ms grows as log(1/r) towards the beam: r is clamped at 1e-6 mean free paths, mu' at 1e-3 (eta = 1, grazing).

    Args:
        n_samples: quadrature nodes, the knob between speed and accuracy.
        kappa: "extinction" as above, "reduced" with sigma_t' instead, "none" for kappa = 1.
        moments: "exact" Fresnel moments, or the "published" polynomials (which diverge beyond eta = 2.5).
    """

    name = "photon_beam_diffusion"
    orders = "multiple"
    reciprocal = False
    source = "Habel, Christensen and Jarosz 2013, Photon beam diffusion"

    def __init__(
        self, medium: Medium, *, n_samples: int = 16, kappa: str = "extinction", moments: str = "exact"
    ) -> None:
        super().__init__(medium)
        if not (isinstance(n_samples, int) and 2 <= n_samples <= 1000):
            raise ValueError(f"n_samples must be an integer in [2, 1000], got {n_samples!r}")
        check_choice("kappa", kappa, KAPPAS)
        self.n_samples = n_samples
        self.kappa = kappa
        self.moments = moments
        self._boundary = DiffuseBoundary.for_index(medium.eta, moments)
        self._c = Grosjean(medium, self._boundary)
        self._kappa_rate = 2 * (self._c.sigma_t_prime if kappa == "reduced" else 1 + 0 * self._c.sigma_t_prime)

    @property
    def strength(self) -> Real:
        """Factor of the integral that does not vary along the beam, albedo'² sigma_t' / (4 pi), in 1/mfp."""
        return self._c.albedo_prime**2 * self._c.sigma_t_prime / (4 * math.pi)

    def exitance(self, q: Query, t: Real, mu: Real, d_r: Real) -> Real:
        """Integrand of R_ms times d_r over `strength`, for the source at t (mfp) along a beam of cosine mu inside."""
        lib, c = q.lib, self._c
        sigma_tr, sigma_t_prime, z_b, D = (q.constant(v) for v in (c.sigma_tr, c.sigma_t_prime, c.z_b, c.D))
        z = t * mu
        offset = 4 * z_b * (z + z_b)  # d_v² - d_r²
        d_v = lib.sqrt(d_r * d_r + offset)
        decay, fluence, _ = safe_differences(lib, sigma_tr, d_r, d_v, offset / (d_r + d_v))
        # E d_r exp(sigma_tr d_r) 4 pi = [k(z, d_r) + k(z + 2 z_b, d_v)] d_r exp(sigma_tr d_r)
        irradiance = z * (1 + sigma_tr * d_r) / (d_r * d_r)
        irradiance = irradiance + (z + 2 * z_b) * (1 + sigma_tr * d_v) * decay * (d_r / d_v) / (d_v * d_v)
        # C_phi phi + C_E E, times exp(-sigma_t' t)
        C_phi, C_E = q.constant(self._boundary.C_phi), q.constant(self._boundary.C_E)
        exitance = C_phi / D * (fluence * d_r) + C_E * irradiance
        exitance = exitance * lib.exp(-sigma_tr * d_r - sigma_t_prime * t)
        if self.kappa != "none":  # kappa = 1 - exp(-2 sigma_t (d_r + t))
            exitance = -lib.expm1(-q.constant(self._kappa_rate) * (d_r + t)) * exitance
        return exitance

    def G(self, q: Query) -> Real:
        lib, c = q.lib, self._c
        sigma_tr, sigma_t_prime = q.constant(c.sigma_tr), q.constant(c.sigma_t_prime)
        r, mu = lib.maximum(q.r, R_MIN), lib.maximum(q.mu_i_in, MU_MIN)
        sin_i = sine(mu)
        cosine, aside = -sin_i * lib.cos(q.phi_i), sin_i * lib.sin(q.phi_i)
        h2_over_r2 = mu * mu + aside * aside  # 1 - cosine², cosine that of the beam with x_o - x_i
        t_0 = r * cosine  # where the beam is nearest to x_o, at the distance h = r sqrt(h2_over_r2)
        gap = r * lib.where(cosine > 0, h2_over_r2 / (1 + lib.abs(cosine)), 1 - cosine)  # r - t_0
        log_tail = 7.0 + 0.5 * self.n_samples  # what is cut off is exp(-log_tail) of the integral
        rate = sigma_t_prime - sigma_tr * cosine  # of the decay at t = 0, where it is slowest
        end = lib.maximum(t_0, 0.0) + log_tail / sigma_t_prime
        end = lib.minimum(end, log_tail / lib.maximum(rate, 1e-30))
        # span = v(end) - v(0), t - t_0 = h sinh(v + v_0): exp(span) = (end - t_0 + d_end) / (r - t_0) = 1 + ratio
        d_end = lib.sqrt(r * r * h2_over_r2 + (end - t_0) * (end - t_0))
        ratio = end * (1 + (end - 2 * t_0) / (d_end + r)) / gap
        span = lib.where(ratio < 1e-2, ratio * (1 - 0.5 * ratio), lib.log(1 + ratio))

        def add(total: Real, x: Real, weight: Real) -> tuple:
            # with e = exp(v/2), s = sinh(v/2), r - t_0 = gap: t = 2 s (r/e + gap s), d_r = r/e² + gap sinh v
            half = lib.expm1(0.5 * x * span)
            e = 1 + half
            s, cosh = 0.5 * (half + half / e), 0.5 * (e + 1 / e)
            t = 2 * s * (r / e + gap * s)
            d_r = r / (e * e) + gap * (2 * s * cosh)
            return (total + weight * self.exitance(q, t, mu, d_r),)

        integral = lib.fold(add, unit_gauss(self.n_samples), (0 * (r + cosine),), r)[0]
        return q.constant(self.strength / (math.pi * self._boundary.N)) * span * integral
