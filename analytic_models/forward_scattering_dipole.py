"""Forward-scattering dipole: Green's function of strongly forward-peaked scattering (Frederickx and Dutré 2017)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from halfspace_sss.arrays import Library, Real, library
from halfspace_sss.checks import check_choice
from halfspace_sss.interface.model import BSSRDF, Query
from halfspace_sss.physics.fresnel import boundary_A, sine
from halfspace_sss.physics.medium import Medium
from halfspace_sss.physics.reflectance import unit_gauss

R_MIN, MU_MIN = 1e-6, 1e-3  # mean free paths; refracted cosine
VIRTUAL_SOURCES = ("classical", "grosjean", "directional")


def _power_series(coefficients: list[float], x: Real) -> Real:
    total = coefficients[-1] + 0 * x
    for c in reversed(coefficients[:-1]):
        total = c + x * total
    return total


# tau cosh tau - sinh tau = tau³ Σ ..., sinh 2 tau - 2 tau = tau³ Σ ..., in powers of tau²
_A_SERIES = [2 * k / math.factorial(2 * k + 1) for k in range(1, 9)]
_B_SERIES = [2 ** (2 * k + 1) / math.factorial(2 * k + 1) for k in range(1, 11)]


@dataclass(frozen=True)
class Monopole:
    """Coefficients of G = F^(3/2)/(4 pi^(5/2)) Z/(e^Z - 1) exp(-sigma_a s - D (1 + u_0.u_L) + E R.(u_0 + u_L) - F R²).

    Lengths in 1/p, p = sigma_s (1 - g)/2; tau = p s. With t = exp(-2 tau), A = tau - 1 + (tau + 1) t and
    B = 1 - 4 tau t - t²: D = 3 B/(4 (1 - t) A), E = 3 (1 - t)/(2 A), F = 3 (1 + t)/(2 A), Z = 6 t/(1 - t²), which is
    E²/F - 2 D; hence E/F = tanh(tau). A and B cancel for small tau: series there.
    """

    D: Real
    E: Real
    F: Real
    Z: Real
    tanh: Real

    @staticmethod
    def at(lib: Library, tau: Real) -> Monopole:
        t, one_minus_t = lib.exp(-2 * tau), -lib.expm1(-2 * tau)
        near = lib.minimum(tau, 0.5)
        square, cube = near * near, near * near * near
        small = tau < 0.5
        A = lib.where(small, 2 * lib.exp(-near) * cube * _power_series(_A_SERIES, square), tau - 1 + (tau + 1) * t)
        B = lib.where(small, 2 * t * cube * _power_series(_B_SERIES, square), 1 - 4 * tau * t - t * t)
        Z = 6 * t / (one_minus_t * (1 + t))
        D = 0.75 * B / (one_minus_t * A)
        return Monopole(D, 1.5 * one_minus_t / A, 1.5 * (1 + t) / A, Z, one_minus_t / (1 + t))

    def scale(self, lib: Library) -> Real:
        """F^(3/2) Z/(1 - e^-Z); its lost factor e^-Z belongs to `exponent`."""
        Z = lib.maximum(self.Z, 1e-30)
        return self.F * lib.sqrt(self.F) * Z / -lib.expm1(-Z)

    def exponent(self, r: Real, along: Real, across2: Real) -> Real:
        """-Z - D (1 + u_0.u_L) + E R.(u_0 + u_L) - F R² as three terms <= 0, nothing cancels.

        along and across2: component of u_0 + u_L along R, and the square of the rest. As 2 (1 + u_0.u_L) is the square
        of u_0 + u_L and E² / F = Z + 2 D, the exponent is -Z (1 - along²/4) - D across2/2 - F (R - along tanh/2)².
        """
        miss = r - 0.5 * along * self.tanh
        return -self.Z * (1 - 0.5 * along) * (1 + 0.5 * along) - 0.5 * self.D * across2 - self.F * miss * miss

    def virtual_deficit(self, mu_i: Real, mu_o: Real, z_v: Real) -> Real:
        """Exponent of the real source minus that of the virtual one, z_v over it and mirrored; never negative."""
        return 2 * self.D * mu_i * mu_o + z_v * (self.E * (mu_i + mu_o) + self.F * z_v)


class ForwardScatteringDipole(BSSRDF):
    """Forward-scattering dipole, S = T_12 T_21/eta² ∫_r^∞ [G(u_0, u_L, R, s) - G(u_0v, u_L, R - z_v n, s)] ds.

    G (see `Monopole`) is the radiance of a pulse after the path length s, with both directions in it; u_0 and u_L are
    the refracted directions of entry and exit, R = x_o - x_i, u_0v = u_0 mirrored; z_v = 4 A D, D = 1/(3 sigma_t').
    In a half-space G_v = G exp(-[2 D mu mu' + E z_v (mu + mu') + F z_v²]): the difference never turns negative, and the
    model is reciprocal. Paths shorter than r are left out, light cannot take them (G leaks there: up to some per cent).
    The paper is index matched; as G is radiance inside, the step through the boundary brings 1/eta².

    The integral runs in ln s on both sides of its maximum, which a scan finds, with Gauss-Legendre nodes clustered
    there by the measured width.

    Left out: the unscattered beam; anything of g but sigma_s (1 - g). Valid for g -> 1, refuses g < 0. Does not
    conserve energy: reflectance / T_12 tends to 1.09 (eta = 1), 1.03 (1.3), 1.01 (1.5) for albedo -> 1. Diverges for
    r -> 0 where entry and exit graze (eta <= 1): r is clamped at 1e-6 mean free paths,
    the refracted cosines at 1e-3. Evaluated in float64 whatever the precision of the query.

    Args:
        n_samples: quadrature nodes on each side, the knob between speed and accuracy.
        virtual_source: z_v = 4 A D ("classical"), 4 A D of Grosjean ("grosjean"), 2 A d_e ("directional").
    """

    name = "forward_scattering_dipole"
    orders = "total"
    reciprocal = True
    source = "Frederickx and Dutré 2017, A forward scattering dipole model from a functional integral approximation"

    def __init__(self, medium: Medium, *, n_samples: int = 16, virtual_source: str = "classical") -> None:
        super().__init__(medium)
        least_g = float(np.min(medium.detached().g))
        if least_g < 0:
            raise ValueError(f"g must be >= 0 for the forward-scattering dipole, got {least_g!r}")
        if not (isinstance(n_samples, int) and 2 <= n_samples <= 1000):
            raise ValueError(f"n_samples must be an integer in [2, 1000], got {n_samples!r}")
        check_choice("virtual_source", virtual_source, VIRTUAL_SOURCES)
        self.n_samples = n_samples
        self.virtual_source = virtual_source
        m = medium.in_mfp()
        lib = library(m.sigma_s)
        self._p = lib.maximum(0.5 * m.sigma_s * (1 - m.g), 1e-12)
        self._absorption = m.sigma_a / self._p
        D = 1 / (3 * m.sigma_t_prime)
        if virtual_source == "grosjean":
            D = (2 * m.sigma_a + m.sigma_s_prime) / (3 * m.sigma_t_prime**2)
        half_z_v = 2 * D
        if virtual_source == "directional":
            half_z_v = 2.131 * D / lib.sqrt(lib.maximum(m.albedo_prime, 1e-20))
        self._z_v = 2 * boundary_A(m.eta) * half_z_v * self._p
        self._scale = lib.where(m.sigma_s > 0, self._p**2, 0.0) / (4 * math.pi**2.5) / m.eta**2

    def G(self, q: Query) -> Real:
        q = q.in_float64()
        lib, integrand = q.lib, _Integrand(q, *(q.constant(v) for v in (self._p, self._absorption, self._z_v)))
        start, end = integrand.bounds()
        peak, width = integrand.peak(start, end)
        total = 0 * peak
        for length, sign in ((peak - start, -1.0), (end - peak, 1.0)):
            ratio = lib.maximum(length, 0.0) / width
            span = lib.log(ratio + lib.sqrt(ratio * ratio + 1))  # asinh: x = peak + width sinh(span y)

            def add(total: Real, y: Real, weight: Real, span: Real = span, sign: float = sign) -> tuple:
                e = lib.exp(span * y)
                jacobian = 0.5 * (e + 1 / e) * span * width
                return (total + weight * jacobian * integrand.value(peak + sign * width * 0.5 * (e - 1 / e)),)

            total = lib.fold(add, unit_gauss(self.n_samples), (total,), peak)[0]
        return q.constant(self._scale) * total


class _Integrand:
    """[G - G_v] s as a function of x = ln(p s), for one query."""

    def __init__(self, q: Query, p: Real, absorption: Real, z_v: Real) -> None:
        self.lib, self.absorption, self.z_v = q.lib, absorption, z_v
        lib = q.lib
        self.r = p * lib.maximum(q.r, R_MIN)
        self.mu_i, self.mu_o = lib.maximum(q.mu_i_in, MU_MIN), lib.maximum(q.mu_o_in, MU_MIN)
        sin_i, sin_o = sine(self.mu_i), sine(self.mu_o)
        self.along = sin_o * lib.cos(q.phi_o) - sin_i * lib.cos(q.phi_i)
        side = sin_o * lib.sin(q.phi_o) - sin_i * lib.sin(q.phi_i)
        self.across2 = side * side + (self.mu_o - self.mu_i) * (self.mu_o - self.mu_i)

    def _parts(self, x: Real) -> tuple[Real, Real]:
        lib = self.lib
        tau = lib.exp(x)
        m = Monopole.at(lib, tau)
        scale = m.scale(lib) * tau * -lib.expm1(-m.virtual_deficit(self.mu_i, self.mu_o, self.z_v))
        return scale, m.exponent(self.r, self.along, self.across2) - self.absorption * tau

    def value(self, x: Real) -> Real:
        scale, exponent = self._parts(x)
        return scale * self.lib.exp(exponent)

    def log(self, x: Real) -> Real:
        scale, exponent = self._parts(x)
        return self.lib.log(self.lib.maximum(scale, 1e-300)) + exponent

    def bounds(self) -> tuple[Real, Real]:
        """Range of x outside which the integrand is under e^-40 of its peak, or its power-law tail under 1e-7."""
        lib, r = self.lib, self.r
        # below 4e-3 (1 - along²/4) the exponent is under -700
        start = lib.maximum(r, 4e-3 * (1 - 0.25 * self.along * self.along))
        absorption = lib.maximum(0 * r + self.absorption, 1e-30)
        trial = lib.maximum(lib.maximum(start, r * lib.sqrt(1.5 / absorption)), lib.sqrt(6 / absorption))
        trial = lib.log(lib.minimum(trial, 1e12))
        absorbed = (60 - self._parts(trial)[1]) / absorption
        free = 6e4 * lib.maximum(1.0, lib.maximum(r, r * r))
        end = lib.maximum(lib.minimum(absorbed, free), 2 * start)
        return lib.log(start), lib.log(end)

    def peak(self, start: Real, end: Real) -> tuple[Real, Real]:
        """Where the integrand is largest, and over what width in x it falls by a factor e."""
        lib = self.lib

        def scan(best: Real, where: Real, y: Real) -> tuple:
            x = low + y * (high - low)
            log = self.log(x)
            return lib.maximum(best, log), lib.where(log > best, x, where)

        low, high, cell = start, end, 0.0
        best, where = self.log(start), start
        for n in (24, 8):
            best, where = lib.fold(scan, ((np.arange(n) + 1) / (n + 1),), (best, where), start)
            cell = (high - low) / (n + 1)
            low, high = lib.maximum(where - cell, start), lib.minimum(where + cell, end)
        drop = lib.maximum(best - self.log(where - cell), best - self.log(where + cell))
        slope = lib.maximum(lib.maximum(drop, lib.sqrt(2 * lib.maximum(drop, 0.0))), cell)
        return where, cell / slope
