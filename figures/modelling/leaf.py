"""A leaf, of a family of shapes that `neural_shape` was not trained on."""

from __future__ import annotations

import numpy as np

from full_geometry.learning.meshes import Box, Distance, capsule, join, margin, overlap

Made = tuple[Distance, Box]


def leaves(rng: np.random.Generator) -> Made:
    """A bent leaf with a rib and a stalk."""
    long, wide, thick = rng.uniform(0.7, 1.0), rng.uniform(0.25, 0.5), rng.uniform(0.025, 0.07)
    bend, fold = rng.uniform(0, 0.5), rng.uniform(0, 0.4)

    def distance(p: np.ndarray) -> np.ndarray:
        x, y, z = np.moveaxis(p, -1, 0)
        z = z - bend * x * x - fold * np.abs(y)
        edge = np.abs(y) - wide * np.clip(1 - (x / long) ** 2, 0, 1)
        leaf = overlap(np.maximum(edge, np.abs(x) - long) / 2, (np.abs(z) - thick) / (1 + bend + fold), 0.02)
        bent = np.stack([x, y, z], axis=-1)
        rib = capsule(bent, (-1.25 * long, 0, 0), (0.8 * long, 0, 0), 0.07, 0.04)
        return join(leaf, rib / (1 + bend + fold), 0.03)

    high = bend * 1.6 * long**2 + fold * wide + 0.12
    return distance, margin((-1.35 * long, -wide, -0.15), (long + 0.02, wide, high))


LEAVES = {"leaves": leaves}
