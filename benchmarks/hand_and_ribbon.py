"""Shapes that stand for what users bring, of any material: hand, ribbon, pawn. Lengths are of the order of 1."""

from __future__ import annotations

import numpy as np

from benchmarks.modelling.meshes import capsule, join, overlap, twisted
from benchmarks.random_shapes import Made, box, margin


def hand() -> Made:
    """A flat palm, four fingers and a thumb."""

    def distance(p: np.ndarray) -> np.ndarray:
        d = box(p - (0, -0.25, 0), np.array([0.24, 0.25, 0.08]), 0.07)
        for x, tip in ((-0.19, 0.38), (-0.065, 0.5), (0.065, 0.47), (0.19, 0.3)):
            d = join(d, capsule(p, (x, -0.05, 0), (1.3 * x, tip, 0.05), 0.062, 0.048), 0.04)
        return join(d, capsule(p, (-0.15, -0.35, 0), (-0.46, -0.05, 0.12), 0.08, 0.055), 0.06)

    return distance, margin((-0.52, -0.5, -0.1), (0.31, 0.56, 0.18))


def ribbon() -> Made:
    """A strip, bent and twisted."""
    wide, tall, thick, bend, turns = 0.17, 0.5, 0.035, 0.12, 2.5

    def distance(p: np.ndarray) -> np.ndarray:
        q = np.array(p)
        q[..., 0] -= bend * np.sin(5 * p[..., 1])
        slope = np.sqrt(1 + (turns * wide) ** 2 + (5 * bend) ** 2)
        return box(twisted(q, turns), np.array([wide, tall, thick]), 0.8 * thick) / slope

    reach = (wide + bend, tall, wide)
    return distance, margin(-np.array(reach), np.array(reach))


def pawn() -> Made:
    """A foot with a flat sole, a neck and a head."""

    def distance(p: np.ndarray) -> np.ndarray:
        foot, neck, head = (
            capsule(p, (0, low, 0), (0, high, 0), *radii)
            for low, high, radii in ((-0.12, 0.1, (0.36, 0.2)), (0.1, 0.4, (0.16, 0.1)), (0.55, 0.55, (0.2, 0.2)))
        )
        return overlap(join(join(foot, neck, 0.1), head, 0.05), -0.2 - p[..., 1], 0.03)

    return distance, margin((-0.36, -0.2, -0.36), (0.36, 0.76, 0.36))


SHAPES = {f.__name__: f for f in (hand, ribbon, pawn)}
STANDING = ("pawn",)  # on a floor
