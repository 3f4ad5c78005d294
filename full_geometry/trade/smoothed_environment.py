"""An environment map smoothed over directions, by which few walks tell how wrong a model is.

A walk through a refracting boundary meets a window by chance alone. What S makes of light after two orders and more
varies little over direction, so that a smoothed map leaves its relative error nearly the same
(benchmarks/notes/trade_check.md):

    L'(w) = c + g [∫ K(w.w') L(w') dw' - c],  K(x) = κ exp(κ (x - 1)) / (2 pi (1 - exp(-2 κ))),  κ = 1 / WIDTH²,

with c the mean of L over the sphere, which L' keeps. g = 1 / (coth κ - 1/κ) keeps its first moment too; it is less
where L' would be below 0.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import mitsuba as mi
import numpy as np

WIDTH = 0.4  # radians
ROWS = 17  # of the map of L', from pole to pole
LOOKED_AT = 64  # rows of L at most: blocks of more pixels are taken together


@dataclass(eq=False)
class SmoothedEnvironment:
    """The environment map of a scene, which shows its own or its smoothed pixels.

    Args:
        parameters: of the emitter.
        own, blurred: pixels of both.
    """

    parameters: mi.SceneParameters
    own: mi.TensorXf
    blurred: mi.TensorXf
    _is_smoothed: bool = False

    @classmethod
    def of(cls, scene: mi.Scene) -> SmoothedEnvironment | None:
        """The map of a scene; None if there is none, or one of so few pixels that it is smooth."""
        sky = scene.environment()
        if sky is None or sky.class_name() != "EnvironmentMapEmitter" or mi.is_spectral:
            return None
        parameters = mi.traverse(sky)
        own = mi.TensorXf(parameters["data"])  # a copy, as the emitter changes what it gives
        return cls(parameters, own, mi.TensorXf(smoothed(np.array(own)))) if len(own) > ROWS else None

    def show(self, smoothed: bool) -> None:
        """Let the scene have its own or the smoothed map."""
        if smoothed != self._is_smoothed:
            self.parameters["data"], self._is_smoothed = self.blurred if smoothed else self.own, smoothed
            self.parameters.update()


def smoothed(pixels: np.ndarray) -> np.ndarray:
    """L' of an environment map, (rows, columns, channels) with the first and last column twice as `envmap` has them.

    It has as many pixels, as kernels know how many there are.
    """
    L = pixels[:, 1:-1]
    theta, phi = _angles(*L.shape[:2])
    step = math.ceil(len(theta) / LOOKED_AT)
    rows, columns = (np.arange(0, len(angle), step) for angle in (theta, phi))
    flux = np.add.reduceat(L * np.sin(theta)[:, None, None], rows, axis=0)
    flux = np.add.reduceat(flux, columns, axis=1).reshape(-1, L.shape[2])
    flux *= 2 * math.pi**2 / (len(theta) - 1) / len(phi)
    means = (np.add.reduceat(angle, at) / np.diff([*at, len(angle)]) for angle, at in ((theta, rows), (phi, columns)))
    kappa, few = 1 / WIDTH**2, _angles(ROWS, 2 * ROWS - 2)
    K = np.exp(kappa * (_directions(*few) @ _directions(*means).T - 1))
    c, blurred = flux.sum(axis=0) / (4 * math.pi), K @ flux * kappa / (2 * math.pi * -math.expm1(-2 * kappa))
    g = min(1 / (1 / math.tanh(kappa) - 1 / kappa), float((c / np.maximum(c - blurred, 1e-30)).min()))
    soft = (c + g * (blurred - c)).reshape(ROWS, -1, L.shape[2])
    by_row, by_column = _weights(theta, few[0]), _weights(phi, few[1], 2 * math.pi)
    soft = np.stack([by_row @ soft[..., k] @ by_column.T for k in range(L.shape[2])], axis=-1)
    return np.concatenate([soft[:, -1:], soft, soft[:, :1]], axis=1).astype(np.float32)


def _weights(fine: np.ndarray, coarse: np.ndarray, period: float | None = None) -> np.ndarray:
    """The matrix that interpolates values at coarse angles to fine ones."""
    return np.stack([np.interp(fine, coarse, row, period=period) for row in np.eye(len(coarse))], axis=1)


def _angles(rows: int, columns: int) -> tuple[np.ndarray, np.ndarray]:
    """Polar angles and azimuths of the pixels of a map, from pole to pole."""
    return np.linspace(0, np.pi, rows), (np.arange(columns) + 0.5) * 2 * np.pi / columns


def _directions(theta: np.ndarray, phi: np.ndarray) -> np.ndarray:
    """Directions of pixels at these angles, (rows columns, 3), about any axis."""
    theta, phi = theta[:, None], phi[None]
    x, y, z = np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta) + 0 * phi
    return np.stack([x, y, z], axis=-1).reshape(-1, 3)
