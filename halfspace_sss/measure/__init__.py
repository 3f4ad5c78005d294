"""Measures of one model by quadrature: reflectance, profile, moments of the exit, reciprocity."""

from halfspace_sss.measure.integrals import (
    Integral,
    Moments,
    Quadrature,
    ReciprocityGap,
    clamped_energy,
    energy_table,
    moments,
    profile,
    reciprocity_gap,
    reflectance,
    reflectance_estimate,
    weight_variance,
)

__all__ = [
    "Integral", "Moments", "Quadrature", "ReciprocityGap", "clamped_energy", "energy_table", "moments", "profile",
    "reciprocity_gap", "reflectance", "reflectance_estimate", "weight_variance",
]  # fmt: skip
