"""Suns of an environment: small cones of directions from which much of its light comes.

A path that meets the environment by chance finds a sun of solid angle Ω, which brings the share e of all light, with
the probability Ω / 4 pi only, and so with the relative variance e² 4 pi / Ω. Where that is large, the cone is aimed at.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np

__all__ = ["Sun", "suns_of"]

SAMPLES = 160  # squared
MOST = 8  # suns
RADII = np.radians(0.15 * 1.3 ** np.arange(16))  # of cones, up to 7.7 degrees
HALO = 0.05  # radiance of the ring about a sun, to twice its radius, over that of the sun: a cone that has it all
MARGIN = 1.3  # of the radius, for what few samples do not show of the rim
LEAST_VARIANCE = 1.0  # that chance would have, of the square of the mean: below, a region is left to chance


class Sun(NamedTuple):
    """A cone of directions."""

    direction: tuple[float, float, float]
    radius: float  # half of its opening angle, radians


def suns_of(environment: Any) -> list[Sun]:
    """Suns of an environment emitter, brightest first."""
    d, L, energy = _light(environment)
    suns, left = [], np.ones(len(L), dtype=bool)
    while len(suns) < MOST and left.any():
        sun = _about(np.argmax(np.where(left, L, -1)), d, energy * left, energy.sum())
        if sun is None:
            break
        suns.append(sun)
        left &= _angles(d, np.array(sun.direction)) > 2 * sun.radius
    return suns


def _light(environment: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Directions (n, 3) that the environment draws, its radiance there, and their part of its light."""
    k = dr.arange(mi.UInt32, SAMPLES**2)
    u = mi.Point2f(k % SAMPLES + 0.5, k // SAMPLES + 0.5) / SAMPLES
    ds, weight = environment.sample_direction(dr.zeros(mi.Interaction3f, SAMPLES**2), u)
    energy = np.array(mi.Spectrum(weight) + dr.zeros(mi.Float, SAMPLES**2), dtype=float).max(axis=0)
    energy = np.where(np.isfinite(energy), energy, 0)
    return np.array(ds.d, dtype=float).T, energy * np.array(ds.pdf), energy


def _angles(d: np.ndarray, c: np.ndarray) -> np.ndarray:
    return 2 * np.arcsin(np.clip(0.5 * np.linalg.norm(d - c, axis=1), 0, 1))


def _about(k: int, d: np.ndarray, energy: np.ndarray, total: float) -> Sun | None:
    """The smallest cone about direction k that holds a region brighter than its ring, if it is worth aiming at."""
    if not total > 0:
        return None
    c = d[k]
    for radius in RADII:
        within = _angles(d, c) < radius
        mean = energy[within] @ d[within]
        c = mean / np.linalg.norm(mean) if mean.any() else c
        angle = _angles(d, c)
        held, ring = energy[angle < radius].sum(), energy[(angle >= radius) & (angle < 2 * radius)].sum()
        if ring / 3 < HALO * held:
            share, solid = held / total, 2 * np.pi * (1 - np.cos(radius))
            worth = share**2 * 4 * np.pi / solid > LEAST_VARIANCE
            return Sun(tuple(map(float, c)), float(MARGIN * radius)) if worth else None
    return None
