"""What leaves at an exit under the same light from everywhere, learnt beside S.

Of the light that F_t lets in, 1 - P leaves without an event; the rest leaves after one, alpha_1, or after more,

    alpha = ∫ S mu_i dw_i dA_i,    alpha_1, alpha = F_t(mu_o) P_o sigmoid(a),

a a small network of the exit alone: positive, and no more than is scattered. As control variates they leave an even
sky no noise but that of what blocks it. The units before its last layer are further inputs of the network of S, of exit
and entry: what is simple in S walks teach alpha sooner.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from full_geometry.features import Frame, Side, entering, side_features
from full_geometry.first_event import first_event
from full_geometry.subject import Subject, SurfacePoint
from halfspace_sss.neural.perceptron import Perceptron
from halfspace_sss.rendering.transport.plane import number

__all__ = ["Reflectance"]


@dataclass(frozen=True, eq=False)
class Reflectance:
    """Of one object.

    Args:
        subject: the object.
        frame: of the features.
        weights: A_k (outputs, inputs) and a_k of the layers.
        trusted: (2, channels) from `even_light.trusted`.
    """

    subject: Subject
    frame: Frame
    weights: Mapping[str, np.ndarray]
    trusted: np.ndarray

    @functools.cached_property
    def _networks(self) -> tuple[Perceptron, Perceptron]:
        """All layers but the last, and that."""
        n = len(self.weights) // 2
        layers = [[self.weights[f"{name}_{k}"] for k in range(n)] for name in ("A", "a")]
        parts = ([arrays[:-1] for arrays in layers], [arrays[-1:] for arrays in layers])
        return tuple(Perceptron(*part, looped=True) for part in parts)

    def units(self, columns: list[Any]) -> list[Any]:
        """What the last layer is told of a side with these features."""
        net = self._networks[0]
        return net.numbers(net.activation(net.vector(net(columns))))

    def parts(self, at: SurfacePoint, active: Any = True) -> tuple[Any, Any, Any]:
        """What passes unscattered, alpha_1 and alpha, per channel."""
        import drjit as dr
        import mitsuba as mi

        columns = side_features(self.frame, Side(at, first_event(self.subject, at, active)))
        media = self.subject.media
        x, n = self._networks[1](self.units(columns)), len(media)
        live = mi.Spectrum([number(float(m.sigma_s) > 0) for m in media])
        enters, most = (mi.Spectrum(v) for v in entering(columns, number(self.subject.eta), n))
        once, more = (live * most / (1 + dr.exp(-mi.Spectrum(part))) for part in (x[:n], x[n:]))
        return tuple(dr.select(active, part, 0) for part in (enters - most, once, more))

    @property
    def evened(self) -> tuple[Any, Any]:
        """Channels in which orders below two, and the others, may stand for even light."""
        import mitsuba as mi

        return tuple(mi.Spectrum([number(float(v)) for v in row]) for row in self.trusted)

    def __call__(self, at: SurfacePoint, active: Any = True) -> tuple[Any, Any]:
        """Orders zero and one, and alpha, per channel; 0 where they may not stand for even light."""
        unscattered, once, more = self.parts(at, active)
        few, others = self.evened
        return few * (unscattered + once), others * more
