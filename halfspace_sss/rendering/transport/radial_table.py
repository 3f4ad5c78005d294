"""A radial density about the exit for rendering: one table for all channels of a model, covering the whole object."""

from __future__ import annotations

import math
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from halfspace_sss.rendering.transport.plane import number

__all__ = ["RadialTable"]

N_CELLS = 512
FLOOR = 1e-3  # share of the probability that is spread evenly over log r, so that no point is out of reach
SHORTEST = 1e-4  # mean free paths of the densest channel; the first cell reaches from 0 to there


class RadialTable:
    """Mixture over the channels of the models' `pdf_position`, piecewise constant in r over cells even in log r.

    Args:
        models: one scalar model per channel, in scene units.
        reach: largest distance, scene units.
    """

    def __init__(self, models: list[Any], reach: float) -> None:
        densest = max(float(m.medium.sigma_t) for m in models)
        r_min = min(SHORTEST / densest, 1e-3 * reach)
        edges = np.concatenate([[0.0], np.geomspace(r_min, reach, N_CELLS)])
        middle = np.concatenate([[0.5 * r_min], np.sqrt(edges[1:-1] * edges[2:])])
        density = sum(np.asarray(m.pdf_position(middle, 0.0, 0.9)) for m in models)
        mass = density * middle * np.diff(edges)
        mass /= max(mass.sum(), 1e-300)
        probability = (1 - FLOOR) * mass + FLOOR / N_CELLS
        probability /= probability.sum()
        self.r_min, self.reach = r_min, reach
        self.per_log = (N_CELLS - 1) / math.log(reach / r_min)
        self.mean = float(np.sum(probability * middle))
        self._numpy = (np.cumsum(probability), probability, edges, probability / (2 * math.pi * np.diff(edges)))
        self._lanes: dict[str, Any] = {}

    def _arrays(self) -> tuple[Any, ...]:
        if mi.variant() not in self._lanes:
            numbers = (number(v) for v in (self.r_min, self.per_log, self.reach))
            self._lanes[mi.variant()] = (*(mi.Float(v.astype(np.float32)) for v in self._numpy), *numbers)
            dr.eval(self._lanes[mi.variant()])
        return self._lanes[mi.variant()]

    def sample(self, u: Any) -> Any:
        """Distance r for uniform u in [0, 1)."""
        cdf, probability, edges, *_ = self._arrays()
        k = dr.binary_search(0, N_CELLS - 1, lambda i: dr.gather(mi.Float, cdf, i) <= u)
        share = 1 - (dr.gather(mi.Float, cdf, k) - u) / dr.gather(mi.Float, probability, k)
        low, high = dr.gather(mi.Float, edges, k), dr.gather(mi.Float, edges, k + 1)
        return dr.lerp(low, high, dr.clip(share, 0, 1))

    def pdf(self, r: Any) -> Any:
        """Density over the plane at distance r, 1/(scene unit)²; 0 beyond the reach."""
        *_, times_r, r_min, per_log, reach = self._arrays()
        steps = dr.log(dr.maximum(r, r_min) / r_min) * per_log
        k = dr.select(r < r_min, 0, dr.minimum(mi.UInt32(steps) + 1, N_CELLS - 1))
        density = dr.gather(mi.Float, times_r, k) / dr.maximum(r, 1e-3 * r_min)
        return dr.select(r < reach, density, 0)
