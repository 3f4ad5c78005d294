"""Monotonic rational-quadratic splines of [-1, 1] onto itself, in Dr.Jit (Durkan, Bekasov, Murray, Papamakarios 2019).

K bins with widths, heights and K - 1 slopes between them; slopes are 1 at both ends. The numbers are bounded as zuko
bounds them: with l = -log(least), a/(1 + 2|a|/l) before the softmax of widths and heights, a/(1 + |a|/l) as logarithm
of a slope, so that no slope leaves [least, 1/least].
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

__all__ = ["BINS", "LEAST_SLOPE", "PARAMETERS", "Spline"]

BINS = 8
LEAST_SLOPE = 1e-2
PARAMETERS = 3 * BINS - 1


class _Bin(NamedTuple):
    """Ends of a bin in x and y, and the slopes at both."""

    x: Any
    y: Any
    dx: Any
    dy: Any
    d: Any
    d_next: Any


class Spline:
    """One spline for each lane.

    Args:
        raw: 3 K - 1 numbers of a network: widths, heights, slopes.
    """

    def __init__(self, raw: Sequence[Any]) -> None:
        import drjit as dr

        bound = -math.log(LEAST_SLOPE)
        slopes = [dr.exp(a / (1 + dr.abs(a) / bound)) for a in raw[2 * BINS :]]
        self.widths, self.heights = (_shares(part, bound) for part in (raw[:BINS], raw[BINS : 2 * BINS]))
        self.slopes = [1.0, *slopes, 1.0]

    def _bin(self, at: Any, by_y: bool) -> _Bin:
        """The bin in which x, or y, lies."""
        import drjit as dr
        import mitsuba as mi

        found = _Bin(*map(mi.Float, (-1, -1, self.widths[0], self.heights[0], self.slopes[0], self.slopes[1])))
        x, y = mi.Float(-1), mi.Float(-1)
        for k in range(1, BINS):
            x, y = x + self.widths[k - 1], y + self.heights[k - 1]
            here = _Bin(x, y, self.widths[k], self.heights[k], self.slopes[k], self.slopes[k + 1])
            beyond = at >= (y if by_y else x)
            found = _Bin(*(dr.select(beyond, a, b) for a, b in zip(here, found)))
        return found

    def forward(self, x: Any) -> tuple[Any, Any]:
        """y and dy/dx."""
        import drjit as dr

        b = self._bin(x, False)
        z = dr.clip((x - b.x) / b.dx, 0, 1)
        return b.y + b.dy * _rational(b, z), _slope(b, z)

    def inverse(self, y: Any) -> tuple[Any, Any]:
        """x and dy/dx there."""
        import drjit as dr

        b = self._bin(y, True)
        s, t = b.dy / b.dx, dr.clip((y - b.y) / b.dy, 0, 1)
        bend = t * (b.d + b.d_next - 2 * s)
        p, q, c = s - b.d + bend, b.d - bend, -s * t
        z = dr.clip(2 * c / (-q - dr.safe_sqrt(q * q - 4 * p * c)), 0, 1)
        return b.x + z * b.dx, _slope(b, z)


def _shares(raw: Sequence[Any], bound: float) -> list[Any]:
    """2 softmax of bounded numbers."""
    import drjit as dr

    found = [dr.exp(a / (1 + 2 * dr.abs(a) / bound)) for a in raw]
    scale = 2 / sum(found)
    return [v * scale for v in found]


def _rational(b: _Bin, z: Any) -> Any:
    s = b.dy / b.dx
    return (s * z * z + b.d * z * (1 - z)) / (s + (b.d + b.d_next - 2 * s) * z * (1 - z))


def _slope(b: _Bin, z: Any) -> Any:
    s = b.dy / b.dx
    over = s + (b.d + b.d_next - 2 * s) * z * (1 - z)
    return s * s * (2 * s * z * (1 - z) + b.d * (1 - z) * (1 - z) + b.d_next * z * z) / (over * over)
