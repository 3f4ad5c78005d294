"""What is known of an error whose square was freed of noise: that square may come out below 0, and is never exact."""

from __future__ import annotations

import math
from typing import NamedTuple

Z_UPPER = 1.645  # a bound that holds in 95 % of cases
CERTAIN = 2.0  # standard errors of the square below which an error is lost in noise


class NoiseFree(NamedTuple):
    """A squared relative error and the standard error of that square; all else follows from them."""

    square: float
    square_error: float

    @property
    def value(self) -> float:
        """The error, 0 for a square below 0."""
        return math.sqrt(max(self.square, 0.0)) if not math.isnan(self.square) else math.nan

    @property
    def standard_error(self) -> float:
        """Standard error of the error, or of its bound where the error is lost in noise."""
        scale = max(self.value, math.sqrt(self.square_error), 1e-12) if self.square_error > 0 else 1.0
        return self.square_error / (2 * scale)

    @property
    def bound(self) -> float:
        """What the error is below in 95 % of cases; a square that came out below 0 counts as 0."""
        return math.sqrt(max(self.square, 0.0) + Z_UPPER * self.square_error)

    @property
    def lost(self) -> bool:
        """Whether noise hides it, so that the bound is all that is known."""
        return self.square < CERTAIN * self.square_error

    def told(self) -> str:
        """In percent: with its standard error, or what it is below."""
        if math.isnan(self.square):
            return "–"
        if self.lost:
            return f"< {short(100 * self.bound)}"
        return f"{short(100 * self.value)} ± {short(100 * self.standard_error, 1)}"


def short(value: float, digits: int = 2) -> str:
    """A number with few digits and without an exponent."""
    return f"{float(f'{value:.{digits}g}'):.6g}"
