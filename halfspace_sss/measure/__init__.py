"""Measures of one model by quadrature: reflectance, profile, moments of the exit, reciprocity."""

from halfspace_sss.measure.integrals import (
    Moments,
    Quadrature,
    ReciprocityGap,
    clamped_energy,
    energy_table,
    moments,
    profile,
    reciprocity_gap,
    reflectance,
    weight_variance,
)

__all__ = [
    "Moments", "Quadrature", "ReciprocityGap", "clamped_energy", "energy_table", "moments", "profile",
    "reciprocity_gap", "reflectance", "weight_variance",
]  # fmt: skip
