"""A factor of each end alone, a(mu_i) a(mu_o), which holds a learnt S to the exact reflectance of its medium.

The factor keeps S positive, reciprocal and mirror-invariant, and the shape of S over the plane as it was. That
a(mu_i) ∫∫ S a(mu_o) mu_o dw_o dA is the exact R(mu_i) for all mu_i has one solution a > 0 (Sinkhorn 1964).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

__all__ = ["N_TERMS", "chebyshev", "log_balance"]

N_TERMS = 4


def log_balance(c: Sequence[Any], mu: Any) -> Any:
    """log a(mu) = sum_k c_k T_k(2 mu - 1) of an outside cosine, by Clenshaw's recurrence; 0 for no terms.

    Args:
        c: coefficients of a medium, numbers or arrays of the library of mu.
        mu: outside cosines, [0, 1].
    """
    if not len(c):
        return 0.0 * mu
    twice, after, last = 4 * mu - 2, 0.0, 0.0 * mu
    for c_k in reversed(list(c)[1:]):
        last, after = c_k + twice * last - after, last
    return c[0] + 0.5 * twice * last - after


def chebyshev(mu: np.ndarray) -> np.ndarray:
    """T_k(2 mu - 1), k the last axis."""
    return np.polynomial.chebyshev.chebvander(2 * np.asarray(mu) - 1, N_TERMS - 1)
