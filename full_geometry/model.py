"""S of one object: a start, times what a small network has learnt, evaluated in Dr.Jit."""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import numpy as np

from full_geometry.features import Frame, Quadratic, Side, n_pair, n_side, pair_features, side_features
from full_geometry.reflectance import Reflectance
from full_geometry.subject import Subject, SurfacePoint
from halfspace_sss.interface.model import BSSRDF
from halfspace_sss.neural.perceptron import Perceptron

__all__ = ["BOUND", "FullGeometry", "PreparedExit", "Start"]

BOUND = 6.0  # of f: where walks leave but no proposal comes, nothing else would hold it


class Start(Protocol):
    """What the network of one object begins with and multiplies: `HalfSpace`, or the network of all shapes.

    Attributes:
        models: half-space model of each channel, whose radial densities probes follow.
    """

    @property
    def models(self) -> Sequence[BSSRDF]: ...

    def end(self, at: SurfacePoint, active: Any = True) -> Side:
        """What belongs to one end alone, its point and its first event among it."""

    def __call__(self, exit: Side, entry: Side, active: Any = True) -> Any:
        """S of two ends per channel, 1/((scene unit)² sr); 0 below the horizons."""


class PreparedExit(NamedTuple):
    """What is done once for all entries of an exit: its end of the start, its share of the first layer, and h."""

    side: Side
    hidden: list[Any]
    h: Any = ()


@dataclass(frozen=True, eq=False)
class FullGeometry:
    """S = S_start exp f, f = 6 tanh((g + h_o + h_i)/6), g a perceptron of the features of exit, entry and pair, and of
    what alpha's makes of exit and entry, h a quadratic function of those of one end.

    Orders two and more; positive; reciprocal as far as it has been learnt.

    Args:
        subject: the object.
        frame: of the features.
        start: S_start.
        weights: W_k (outputs, inputs) and b_k of the layers, Q of h.
        alpha: ∫ S mu_i of an exit, learnt beside S.
    """

    subject: Subject
    frame: Frame
    start: Start
    weights: Mapping[str, np.ndarray]
    alpha: Reflectance
    orders = "multiple"

    @functools.cached_property
    def _network(self) -> Perceptron:
        """The first layer in two parts, exit and the rest."""
        split = (self.weights["W_0"].shape[1] - n_pair(len(self.subject.media))) // 2
        return Perceptron.named(self.weights, "W", "b", splits=[split], looped=True)

    @functools.cached_property
    def _h(self) -> Quadratic:
        return Quadratic(self.weights["Q"], n_side(len(self.subject.media), self.subject.n_local))

    def prepare(self, at: SurfacePoint, active: Any = True) -> PreparedExit:
        """The exit's side, for as many entries as are asked for."""
        side, net = self.start.end(at, active), self._network
        features, h = self._end(side)
        return PreparedExit(side, net.numbers(net.first(0, features, biased=True)), h)

    def S(self, exit: PreparedExit, at: SurfacePoint, active: Any = True) -> Any:
        """S(x_i, w_i; x_o, w_o) per channel, 1/((scene unit)² sr); 0 below the horizons.

        Args:
            exit: from `prepare`.
            at: entry, with w_i.
            active: mask of lanes.
        """
        import drjit as dr
        import mitsuba as mi

        entry, net = self.start.end(at, active), self._network
        features, h = self._end(entry)
        features += pair_features(self.frame, exit.side, entry)
        f = mi.Spectrum(net.rest(net.activation(net.first(1, features) + net.vector(exit.hidden))))
        f += mi.Spectrum(exit.h) + mi.Spectrum(h)
        S_0 = self.start(exit.side, entry, active)
        return dr.select(active, S_0 * dr.exp(BOUND * dr.tanh(f / BOUND)), 0)

    def _end(self, side: Side) -> tuple[list[Any], list[Any]]:
        """Features of one end and what even light makes of them; h."""
        columns = side_features(self.frame, side)
        return [*columns, *self.alpha.units(columns)], self._h(columns)
