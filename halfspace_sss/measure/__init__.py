"""Measures of any half-space model through the shared interface alone: flux, profile, moments, reciprocity, energy.

Everything is an integral of S by a quadrature whose numbers are open (`Quadrature`): a trapezoid in ln r over the
distances that carry flux, periodic trapezoids in both azimuths with the mirror symmetry, Gauss-Legendre in mu_o. Where
S depends on both azimuths, the reflectance is summed on a shifted lattice.
"""

from halfspace_sss.measure.quadrature import Quadrature
from halfspace_sss.measure.reflected_flux import (
    Integral,
    Moments,
    ReciprocityGap,
    ReducedCoefficients,
    clamped_energy,
    coefficients_of_frequencies,
    frequency_reflectance,
    moments,
    profile,
    reciprocity_gap,
    reflectance,
    reflectance_estimate,
    ring_means,
    weight_variance,
)

__all__ = [
    "Integral", "Moments", "Quadrature", "ReciprocityGap", "ReducedCoefficients", "clamped_energy",
    "coefficients_of_frequencies", "frequency_reflectance", "moments", "profile", "reciprocity_gap",
    "reflectance", "reflectance_estimate", "ring_means", "weight_variance",
]  # fmt: skip
