"""Where what was learnt of even light is good enough to stand for it.

S sees the surface around both its points, alpha is a network of the exit alone, which misses what changes over a mean
free path. So each channel is judged at the end of a training, as parts of all light that leaves,

    |alpha_1 - E T_1|, |alpha - E T| <= 5 % of the mean of E T_0 + E T_1 + E T,   or alpha no worse than S,

and where that fails images take even light by S or by the way of one event, as all other light.
"""

from __future__ import annotations

import numpy as np

from full_geometry.learning.model_errors import ModelError, of_even_light
from full_geometry.learning.radiance import Estimate, Reference, traced
from full_geometry.model import FullGeometry

__all__ = ["trusted"]

MOST = 0.05


def trusted(
    model: FullGeometry, truth: Reference, errors: list[ModelError], walks: int, seed: tuple[int, ...]
) -> np.ndarray:
    """1 where even light may be used and 0 where not, (2, channels): orders below two, then the others.

    Args:
        model: S and alpha.
        truth: exits and walks of orders from two on.
        errors: of S there.
        walks: of each exit, for order one.
        seed: of them.
    """
    once = traced(model.subject, truth.exits, walks, seed, fewest=1, most=1)
    unscattered, *alphas = (np.array(part).reshape(len(once.mean), -1) for part in model.alpha.parts(truth.exits))
    known = (once, truth.truth)
    means = [part.mean[:, :, 0].mean(axis=1) for part in known]
    light = np.maximum(unscattered.mean(axis=1) + sum(means), 1e-30)
    wrong = np.stack([_error(a, b) * mean / light for a, b, mean in zip(alphas, known, means)])
    by_S = np.array([row.error for row in errors if row.light == "constant"]) * means[1] / light
    return (wrong <= np.stack([0 * by_S + MOST, np.maximum(by_S, MOST)])).astype(np.float16)


def _error(found: np.ndarray, truth: Estimate) -> np.ndarray:
    """Relative RMSE of shares (channels, exits) under constant light, without the noise of walks."""
    shares = found[:, :, None].astype(float)
    return np.array([row.error for row in of_even_light(Estimate(shares, np.zeros_like(shares)), truth)])
