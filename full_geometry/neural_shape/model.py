"""S of any object: the half-space times what one network says of the shape around two points, evaluated in Dr.Jit."""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from full_geometry.neural_shape.backbone import Backbone
from full_geometry.neural_shape.descriptors import CURVED_OWN, CURVED_SHARED, N_OWN, End, Pair, describe, end, medium
from full_geometry.neural_shape.mixing import mixed
from full_geometry.subject import Subject, SurfacePoint
from halfspace_sss.interface.model import BSSRDF
from halfspace_sss.neural.perceptron import Perceptron
from halfspace_sss.rendering.transport.plane import number

__all__ = ["LEAST", "PLACE_OF_G", "NeuralShape", "most"]

LEAST, MOST, MOST_FORWARD = -6.0, 3.0, 1.5  # of f: what is too bright costs more than what is too dark
FORWARD = 0.5  # g from which on the most is that of forward scattering
PLACE_OF_G = 2  # among the numbers of a medium


@dataclass(frozen=True, eq=False)
class NeuralShape:
    """S = s S_0 P_o P_i exp f, f = b tanh(h . tanh(u) / b), b = 1.5 to 3 above 0, see `most`, and 6 below.

    u = (c_o + c_i, c_oi) is what is 0 on a plane, h a perceptron whose first layer is asked for both ends in turn and
    summed, so that S is reciprocal as far as S_0 is; on a plane f = 0. Orders two and more;
    positive; 0 below the horizons.

    Args:
        subject: the object.
        half_space: S_0 P_o P_i.
        weights: W_k (outputs, inputs) and b_k of the layers.
        media: numbers of each channel.
        scales: s of each channel, see `balance`; 1 if there are none.
    """

    subject: Subject
    half_space: Backbone
    weights: Mapping[str, np.ndarray]
    media: Sequence[np.ndarray]
    scales: Sequence[float] = ()
    orders = "multiple"

    @classmethod
    def of(cls, subject: Subject, weights: Mapping[str, np.ndarray]) -> NeuralShape:
        """The model of an object from the arrays of a file, not held to walks."""
        mixtures = mixed(subject)
        numbers = [medium(subject, c, mixture) for c, mixture in enumerate(mixtures)]
        return cls(subject, Backbone(subject, mixtures), weights, numbers)

    @functools.cached_property
    def _network(self) -> Perceptron:
        """The first layer in two parts, own and the rest."""
        return Perceptron.named(self.weights, "W", "b", splits=[N_OWN])

    @functools.cached_property
    def _media(self) -> list[list[Any]]:
        return [[number(v) for v in numbers] for numbers in self.media]

    @functools.cached_property
    def _scale(self) -> Any:
        import mitsuba as mi

        return mi.Spectrum([number(s) for s in self.scales or [1.0] * len(self.media)])

    @property
    def models(self) -> list[BSSRDF]:
        """The half-space model of each channel."""
        return self.half_space.models

    def end(self, at: SurfacePoint, active: Any = True) -> End:
        """What belongs to one end alone."""
        return end(self.subject, at, active)

    def prepare(self, at: SurfacePoint, active: Any = True) -> End:
        """The exit's side, for as many entries as are asked for."""
        return self.end(at, active)

    def S(self, exit: End, at: SurfacePoint, active: Any = True) -> Any:
        """S(x_i, w_i; x_o, w_o) per channel, 1/((scene unit)² sr); 0 below the horizons.

        Args:
            exit: from `prepare`.
            at: entry, with w_i.
            active: mask of lanes.
        """
        return self(exit, self.end(at, active), active)

    def __call__(self, exit: End, entry: End, active: Any = True) -> Any:
        """S of two ends, as `S`."""
        import drjit as dr
        import mitsuba as mi

        S_0 = self.half_space(exit, entry)
        pairs = describe(self.subject, exit, entry, self.half_space.shares(S_0, exit, entry), active)
        f = mi.Spectrum([self._f(pair, numbers) for pair, numbers in zip(pairs, self._media)])
        return dr.select(active, S_0 * dr.exp(f) * self._scale, 0)

    def _f(self, pair: Pair, numbers: list[Any]) -> Any:
        import drjit as dr

        net = self._network
        rest = net.first(1, [*pair.shared, *numbers], biased=True)
        ends = [net.activation(net.first(0, own) + rest) for own in (pair.exit, pair.entry)]
        x = net.rest(ends[0] + ends[1])
        u = [a + b for a, b in zip(pair.exit[CURVED_OWN], pair.entry[CURVED_OWN])] + pair.shared[CURVED_SHARED]
        g = sum(h * dr.tanh(v) for h, v in zip(x, u))
        g = dr.select(dr.isfinite(g), g, 0)  # S_0 alone rather than a hole in the picture
        bound = dr.select(g > 0, most(dr, numbers[PLACE_OF_G]), -LEAST)
        return bound * dr.tanh(g / bound)


def most(lib: Any, g: Any) -> Any:
    """The bound of f above: 3 for g <= 0, falling to 1.5 at g = 0.5.

    Light that is scattered forwards comes from few pairs, which too large an f makes far too bright in what is thin.
    """
    return MOST - (MOST - MOST_FORWARD) * lib.clip(g / FORWARD, 0, 1)
