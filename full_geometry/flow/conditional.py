"""A masked autoregressive flow of splines over [0, 1)^d given a context, evaluated in Dr.Jit with trained weights.

z_j = s_j(x_j; network(x_1 ... x_{j-1}, context)), z uniform: p(x | context) = prod_j ds_j/dx_j. The hidden layers are
masked, so one evaluation of the network gives the density, and d of them a sample.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from full_geometry.flow.spline import PARAMETERS, Spline
from halfspace_sss.neural.perceptron import Perceptron, relu

__all__ = ["ConditionalFlow"]


@dataclass(frozen=True, eq=False)
class ConditionalFlow:
    """The flow.

    Args:
        n: its dimensions d.
        weights: F_k (outputs, inputs) and h_k of the layers, masks multiplied in; inputs are d coordinates and the
            context, outputs 3 K - 1 numbers for each coordinate.
    """

    n: int
    weights: Mapping[str, np.ndarray]

    @functools.cached_property
    def _network(self) -> Perceptron:
        return Perceptron.named(self.weights, "F", "h", activation=relu, looped=True)

    def _splines(self, x: Sequence[Any], context: Sequence[Any]) -> list[Any]:
        return self._network([*x, *context])

    def _spline(self, raw: list[Any], j: int) -> Spline:
        return Spline(raw[j * PARAMETERS : (j + 1) * PARAMETERS])

    def sample(self, context: Sequence[Any], u: Sequence[Any]) -> tuple[list[Any], Any]:
        """x in [0, 1)^d for d uniform numbers, and its density."""
        x, density = [0.0] * self.n, 1.0
        for j in range(self.n):
            spline = self._spline(self._splines(x, context), j)
            x[j], slope = spline.inverse(2 * u[j] - 1)
            density = density * slope
        return [0.5 * (v + 1) for v in x], density

    def density(self, context: Sequence[Any], x: Sequence[Any]) -> Any:
        """Of x in [0, 1)^d."""
        inner, density = [2 * v - 1 for v in x], 1.0
        raw = self._splines(inner, context)
        for j in range(self.n):
            density = density * self._spline(raw, j).forward(inner[j])[1]
        return density

    def uniforms(self, context: Sequence[Any], x: Sequence[Any]) -> list[Any]:
        """The uniform numbers that `sample` makes x of."""
        inner = [2 * v - 1 for v in x]
        raw = self._splines(inner, context)
        return [0.5 * (self._spline(raw, j).forward(inner[j])[0] + 1) for j in range(self.n)]
