"""What the kinds of light that leave an object are expected to bring, by which the path loop chooses among them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from halfspace_sss import measure
from halfspace_sss.interface.model import bssrdf
from halfspace_sss.physics import single_scattering
from halfspace_sss.physics.medium import Medium

__all__ = ["Expected", "expected_of"]


class Expected(NamedTuple):
    """Means over channels.

    Args:
        single: reflectance of the half-space at normal incidence by single scattering.
        multiple: by the orders from two on.
        albedo: of single scattering, which nearly all leaves something thin.
    """

    single: float
    multiple: float
    albedo: float


def expected_of(media: Sequence[Medium]) -> Expected:
    """Of the media of the channels."""
    rows = []
    for m in media:
        multiple = float(measure.reflectance(bssrdf("better_dipole", m), 1.0)) if float(m.sigma_s) > 0 else 0.0
        rows.append((float(single_scattering.reflectance(m, 1.0)), multiple, float(m.albedo)))
    return Expected(*np.mean(rows, axis=0).tolist())
