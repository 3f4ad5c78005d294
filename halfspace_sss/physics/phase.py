"""Henyey-Greenstein phase function, normalised to one over the sphere."""

from __future__ import annotations

import math
from typing import Any

from halfspace_sss.arrays import library

__all__ = ["eval_hg", "sample_hg"]


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


def sample_hg(u: Any, g: Any) -> Any:
    """Cosine of the scattering angle for a uniform number u in [0, 1).

    cos = 1 - (1 - g) (1 - u) (1 - g + q) / b with b = 1 - g + 2gu, q = (1 - g²) / b: the published
    (1 + g² - q²) / (2g) without its division by g, so that it holds for every g, 0 included, and keeps its digits.
    The azimuth about the old direction is uniform and left to the caller; the density per solid angle is `eval_hg`.
    """
    lib = library(u, g)
    ratio = (1 - g) / (1 - g + 2 * g * u)
    return lib.maximum(1 - ratio * (1 - u) * (1 - g + ratio * (1 + g)), -1.0)
