"""Incident light for the paper's network: a constant and lobes max(0, w . l)^k, as functions of the direction."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from full_geometry.learning.radiance import LOBES, POWER

__all__ = ["Light", "measured_lights", "random_lights"]

MOST_LOBES = 3
FACTORS = (0.125, 8.0)  # of the augmentation by scale


@dataclass(frozen=True, eq=False)
class Light:
    """Light of m exits, one for each.

    Args:
        base: constant part (m, channels).
        axes: of lobes (m, k, 3).
        powers: of the lobes (m, k).
        colours: of the lobes (m, k, channels).
    """

    base: np.ndarray
    axes: np.ndarray
    powers: np.ndarray
    colours: np.ndarray

    def __call__(self, w: np.ndarray) -> np.ndarray:
        """Radiance (m, n, channels) from directions w (m, n, 3)."""
        c = np.maximum(np.einsum("mni,mki->mnk", w, self.axes), 0) ** self.powers[:, None, :]
        return (self.base[:, None, :] + np.einsum("mnk,mkc->mnc", c, self.colours)).astype(np.float32)


def random_lights(m: int, channels: int, rng: np.random.Generator) -> Light:
    """Lights of random lobes and colours, each times a random factor (augmentation by scale)."""
    axes = rng.standard_normal((m, MOST_LOBES, 3))
    axes /= np.linalg.norm(axes, axis=2, keepdims=True)
    powers = 2.0 ** rng.uniform(0, 6, (m, MOST_LOBES))
    factor = np.exp(rng.uniform(*np.log(FACTORS), (m, 1)))
    on = rng.random((m, MOST_LOBES, 1)) < 0.6
    colours = on * rng.random((m, MOST_LOBES, channels)) * factor[:, :, None]
    return Light(rng.random((m, channels)) * factor, axes, powers, colours)


def measured_lights(m: int, channels: int) -> list[Light]:
    """Constant light and the four lobes of the measured errors, the same for m exits."""
    none = np.zeros((m, 1, 3))
    found = [Light(np.ones((m, channels)), none, np.ones((m, 1)), np.zeros((m, 1, channels)))]
    for axis in LOBES:
        axes = np.broadcast_to(axis, (m, 1, 3))
        found.append(Light(np.zeros((m, channels)), axes, np.full((m, 1), POWER), np.ones((m, 1, channels))))
    return found
