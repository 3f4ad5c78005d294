"""Media and statistics that the tests of traced quantities share."""

from __future__ import annotations

import numpy as np
from scipy.stats import chi2

from halfspace_sss import Medium
from halfspace_sss.tracing.passes import Estimate

MEDIA = {
    "matched": Medium.from_albedo(0.9, 1.0, 0.5, 1.0),
    "denser": Medium.from_albedo(0.8, 2.0, -0.3, 1.4),
    "thinner": Medium.from_albedo(0.95, 0.5, 0.7, 0.75),
}


def z(a: Estimate, b: Estimate | tuple) -> np.ndarray:
    """Difference of two independent estimates in units of its standard error."""
    return (np.asarray(a[0]) - b[0]) / np.hypot(a[1], b[1])


def check_spread(values: tuple, errors: tuple) -> None:
    """Chi-square test of the scatter of runs about their mean, in units of their stated errors."""
    values, errors = np.array(values), np.array(errors)
    spread = np.sum((values - values.mean(axis=0)) ** 2, axis=0) / np.mean(errors**2, axis=0)
    dof = len(values) - 1
    assert np.all(spread > chi2.ppf(5e-5, dof)) and np.all(spread < chi2.isf(5e-5, dof))
