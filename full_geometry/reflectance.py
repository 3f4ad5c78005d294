"""What an exit is worth under the same light from everywhere: alpha(x_o, w_o) = ∫ S mu_i dw_i dA_i, learnt beside S.

alpha = F_t(mu_o) P_o sigmoid(a), a a small network of the exit alone: positive, and no more than enters and meets the
medium. With it as a control variate an even sky has no noise but that of what blocks it.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from full_geometry.features import Frame, Side, entering, side_features
from full_geometry.subject import Subject
from halfspace_sss.rendering.transport.plane import number

__all__ = ["Reflectance"]


@dataclass(frozen=True, eq=False)
class Reflectance:
    """alpha of one object, orders two and more.

    Args:
        subject: the object.
        frame: of the features.
        weights: A_k (outputs, inputs) and a_k of the layers.
    """

    subject: Subject
    frame: Frame
    weights: Mapping[str, np.ndarray]

    @functools.cached_property
    def _views(self) -> tuple[list, list]:
        import mitsuba as mi
        from drjit import nn

        n = len(self.weights) // 2
        tensors = [mi.TensorXf(np.ascontiguousarray(self.weights[f"A_{k}"], dtype=np.float32)) for k in range(n)]
        biases = [mi.Float(self.weights[f"a_{k}"].astype(np.float32)) for k in range(n)]
        views = nn.pack(*tensors, *biases)[-2 * n :]
        return list(views[:n]), list(views[n:])

    def __call__(self, exit: Side) -> Any:
        """alpha per channel."""
        import drjit as dr
        import mitsuba as mi
        from drjit import nn

        columns, media = side_features(self.frame, exit), self.subject.media
        x, (A, a) = nn.CoopVec(*columns), self._views
        for k, (matrix, bias) in enumerate(zip(A, a)):
            x = x if k == 0 else x * dr.clip(x * (1 / 6) + 0.5, 0, 1)
            x = nn.matvec(matrix, x, bias)
        live = mi.Spectrum([number(float(m.sigma_s) > 0) for m in media])
        most = mi.Spectrum(entering(columns, number(self.subject.eta), len(media)))
        return live * most / (1 + dr.exp(-mi.Spectrum(list(x))))
