"""Media drawn over the whole range of the universal network."""

from __future__ import annotations

import numpy as np

__all__ = ["RANGES", "draw_media"]

RANGES = {"albedo": (0.0, 1.0), "g": (-0.5, 0.98), "eta": (1.0, 2.0)}  # what the shipped weights were trained on
LEAST_ABSORPTION = 1e-5  # 1 - albedo of the log-uniform half


def draw_media(
    n: int, rng: np.random.Generator, steep_share: float = 1 / 3
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """albedo, g and eta of n media.

    albedo: half uniform, half log-uniform in 1 - albedo down to 1e-5, one in fifty exactly 1. g: uniform, but for
    `steep_share` log-uniform in 1 - g below 0.5. eta: uniform, one in ten exactly 1.
    """
    u = rng.random((6, n))
    (a_0, a_1), (g_0, g_1), (e_0, e_1) = RANGES["albedo"], RANGES["g"], RANGES["eta"]
    albedo = np.where(u[0] < 0.5, a_0 + (a_1 - a_0) * u[1], 1 - LEAST_ABSORPTION ** u[1])
    albedo = np.where(u[0] > 0.98, 1.0, albedo)
    g = np.where(u[2] < 1 - steep_share, g_0 + (g_1 - g_0) * u[3], 1 - 0.5 * ((1 - g_1) / 0.5) ** u[3])
    eta = np.where(u[4] < 0.1, 1.0, e_0 + (e_1 - e_0) * u[5])
    return albedo, g, eta
