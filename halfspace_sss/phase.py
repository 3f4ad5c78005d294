"""Henyey-Greenstein phase function, normalised to one over the sphere."""

from __future__ import annotations

import math
from typing import Any

from halfspace_sss.arrays import library

__all__ = ["eval_hg", "pdf_hg", "sample_hg"]

G_ISOTROPIC = 1e-3  # below this |g| the inverse of the distribution loses more digits than g = 0 is wrong by


def eval_hg(cos_theta: Any, g: Any) -> Any:
    """Henyey-Greenstein phase function p(cos_theta), 1/sr.

    p = (1 - g²) / (4 pi (1 + g² - 2 g cos_theta)^(3/2)), cos_theta = 1 forward. The bracket is
    evaluated as (1 - |g|)² + 2 |g| (1 -+ cos_theta), which keeps its digits for |g| -> 1.

    Args:
        cos_theta: cosine between the directions of travel before and after, [-1, 1].
        g: mean cosine, (-1, 1).

    Source: Henyey and Greenstein 1941.
    """
    lib = library(cos_theta, g)
    size = abs(g) if isinstance(g, (int, float)) else lib.abs(g)
    aligned = (
        lib.where(g >= 0, cos_theta, -cos_theta) if not isinstance(g, (int, float)) else math.copysign(1, g) * cos_theta
    )
    gap = lib.maximum((1 - size) * (1 - size) + 2 * size * (1 - aligned), 1e-30)
    return (1 - size) * (1 + size) / (4 * math.pi * gap * lib.sqrt(gap))


def pdf_hg(cos_theta: Any, g: Any) -> Any:
    """Density of `sample_hg` per solid angle, 1/sr: the phase function itself."""
    return eval_hg(cos_theta, g)


def sample_hg(u: Any, g: Any) -> Any:
    """Cosine of the scattering angle for a uniform number u in [0, 1).

    g = 0: 1 - 2u; otherwise (1 + g² - q²) / (2g), q = (1 - g²) / (1 - g + 2gu); clamped to [-1, 1].
    The azimuth about the old direction is uniform and left to the caller.
    """
    lib = library(u, g)
    if isinstance(g, (int, float)):
        if abs(g) < G_ISOTROPIC:
            return 1 - 2 * u
        q = (1 - g * g) / (1 - g + 2 * g * u)
        return lib.minimum(lib.maximum((1 + g * g - q * q) / (2 * g), -1.0), 1.0)
    isotropic = lib.abs(g) < G_ISOTROPIC
    g = lib.where(isotropic, 0.5, g)
    q = (1 - g * g) / (1 - g + 2 * g * u)
    cosine = lib.minimum(lib.maximum((1 + g * g - q * q) / (2 * g), -1.0), 1.0)
    return lib.where(isotropic, 1 - 2 * u, cosine)
