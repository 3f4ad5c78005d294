"""The tally of a path: its radiance, or in a replay the derivatives of its radiance.

Derivatives follow path replay backpropagation (Vicini, Speierer and Jakob 2021). A path is traced, then traced again
with the same random numbers. At every vertex of the replay the radiance still to come is known. Each factor is then
differentiated on its own with the others held, and no loop is recorded. Directions and densities are held too.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

__all__ = ["PathTally", "Primal", "Replay"]


@dataclass
class PathTally:
    """What the paths of a launch sum up."""

    L: mi.Spectrum  # primal: radiance so far; replay: radiance still to come
    derivative: mi.Spectrum | tuple[()]  # replay forward: derivative of L; backward: adjoint of L; primal: nothing


@dataclass(frozen=True)
class Primal:
    """The first pass: radiance is added up."""

    tracks = False

    def add(self, tally: PathTally, light: mi.Spectrum) -> PathTally:
        """Add the light of one estimator of the path."""
        return PathTally(tally.L + light, tally.derivative)

    def settle(
        self, tally: PathTally, light: mi.Spectrum, weight: mi.Spectrum, continues: mi.Bool, shown: mi.Spectrum | float
    ) -> PathTally:
        """Add the light of a vertex.

        Args:
            light: light of next-event estimation at the vertex.
            weight: factor of the throughput at the vertex.
            continues: whether the path goes on with that weight.
            shown: light per weight that has the weight too and is in the tally already.
        """
        return self.add(tally, light)


@dataclass(frozen=True)
class Replay:
    """The second pass: radiance is taken away again, and each factor is differentiated.

    Args:
        backward: whether adjoints are handed on to the parameters, or derivatives of parameters to the radiance.
    """

    backward: bool
    tracks = True

    def add(self, tally: PathTally, light: mi.Spectrum) -> PathTally:
        """Take the light of one estimator away, and differentiate it."""
        tally = self._differentiate(tally, light)
        return PathTally(tally.L - dr.detach(light), tally.derivative)

    def settle(
        self, tally: PathTally, light: mi.Spectrum, weight: mi.Spectrum, continues: mi.Bool, shown: mi.Spectrum | float
    ) -> PathTally:
        """As of `Primal`; d(light + weight L_next) with L_next = (L - light) / weight held."""
        L = tally.L - dr.detach(light)
        fixed = dr.detach(weight)
        L_next = dr.select(continues & (fixed != 0), L / dr.select(fixed != 0, fixed, 1), 0)
        return self._differentiate(PathTally(L, tally.derivative), light + weight * (L_next + shown))

    def _differentiate(self, tally: PathTally, value: mi.Spectrum) -> PathTally:
        if not dr.grad_enabled(value):
            return tally
        if self.backward:
            dr.backward_from(tally.derivative * value)
            return tally
        return PathTally(tally.L, tally.derivative + dr.forward_to(value))
