"""How different two linear images look, as one number: the door "flip" of `halfspace_sss.figures`."""

from __future__ import annotations

import numpy as np

from figures.computing.metrics import flip_ldr
from figures.computing.tone import luminance, srgb

__all__ = ["mean_flip"]

WHITE = 0.9  # encoded luminance of the bright end
BRIGHT = 99.0  # percentile that comes out there


def mean_flip(reference: np.ndarray, test: np.ndarray) -> float:
    """Mean LDR-FLIP of two images, both exposed so that the bright end of the reference is nearly white."""
    level = float(np.percentile(luminance(reference), BRIGHT))
    exposure = float(np.log2(WHITE / level)) if level > 0 else 0.0
    return flip_ldr(srgb(reference, exposure), srgb(test, exposure)).mean
