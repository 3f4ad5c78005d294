"""The families of shapes that the network never sees in training."""

from __future__ import annotations

import numpy as np

from benchmarks.head_and_leaf import leaves
from benchmarks.modelling.meshes import capsule, cut, join, length, overlap, rotated, smoothstep
from benchmarks.random_shapes import Made, margin

STROKES = {  # of letters, in a square
    "A": [((0, 0), (0.5, 1)), ((0.5, 1), (1, 0)), ((0.2, 0.4), (0.8, 0.4))],
    "E": [((0, 0), (0, 1)), ((0, 0), (0.8, 0)), ((0, 0.5), (0.7, 0.5)), ((0, 1), (0.8, 1))],
    "H": [((0, 0), (0, 1)), ((1, 0), (1, 1)), ((0, 0.5), (1, 0.5))],
    "K": [((0, 0), (0, 1)), ((0, 0.45), (0.9, 1)), ((0.3, 0.6), (0.9, 0))],
    "S": [((0.9, 1), (0, 0.8)), ((0, 0.8), (0.9, 0.3)), ((0.9, 0.3), (0, 0))],
}


def letters(rng: np.random.Generator) -> Made:
    """A letter of flat strokes on a plate or without."""
    strokes = STROKES[str(rng.choice(list(STROKES)))]
    wide, deep = rng.uniform(0.06, 0.14), rng.uniform(0.06, 0.25)
    plate = rng.uniform(0.04, 0.12) if rng.random() < 0.5 else 0.0

    def distance(p: np.ndarray) -> np.ndarray:
        flat = np.array(p)
        flat[..., 2] = 0
        d = np.full(p.shape[:-1], 10.0)
        for a, b in strokes:
            d = join(d, capsule(flat, (*a, 0), (*b, 0), wide, wide))
        d = overlap(d, np.abs(p[..., 2]) - deep, 0.02)
        if plate:
            q = np.abs(p - (0.5, 0.5, -deep)) - (0.65, 0.7, plate)
            d = join(d, np.max(q, axis=-1), 0.02)
        return d

    return distance, margin((-0.25, -0.3, -deep - plate - 0.03), (1.25, 1.3, deep + 0.03))


def hourglasses(rng: np.random.Generator) -> Made:
    """Two bulbs with a waist."""
    waist, bulb, wave = rng.uniform(0.05, 0.2), rng.uniform(0.3, 0.5), rng.uniform(0.8, 1.2)

    def distance(p: np.ndarray) -> np.ndarray:
        x, y, z = np.moveaxis(p, -1, 0)
        radius = waist + (bulb - waist) * smoothstep(0, 0.5 * wave, np.abs(y))
        return overlap((length(x, z) - radius) / 1.8, np.abs(y) - 0.8, 0.05)

    return distance, margin((-bulb, -0.85, -bulb), (bulb, 0.85, bulb))


def springs(rng: np.random.Generator) -> Made:
    """A coil of a round wire."""
    radius, wire, pitch = rng.uniform(0.35, 0.55), rng.uniform(0.06, 0.16), rng.uniform(0.35, 0.6)
    t = np.linspace(-1.5, 1.5, 60)
    line = np.stack([radius * np.cos(2 * np.pi * t), pitch * t, radius * np.sin(2 * np.pi * t)], -1)

    def distance(p: np.ndarray) -> np.ndarray:
        d = np.full(p.shape[:-1], 10.0)
        for a, b in zip(line, line[1:]):
            d = np.minimum(d, capsule(p, a, b, wire, wire))
        return d

    return distance, margin(line.min(0) - wire, line.max(0) + wire)


def lattices(rng: np.random.Generator) -> Made:
    """A piece of a gyroid: sheets with holes everywhere."""
    waves, thick, radius = rng.uniform(3, 6), rng.uniform(0.25, 0.8), rng.uniform(0.7, 0.9)
    shift = rng.uniform(0, 6, 3)

    def distance(p: np.ndarray) -> np.ndarray:
        x, y, z = np.moveaxis(waves * p + shift, -1, 0)
        gyroid = np.sin(x) * np.cos(y) + np.sin(y) * np.cos(z) + np.sin(z) * np.cos(x)
        return overlap((np.abs(gyroid) - thick) / (1.6 * waves), length(*np.moveaxis(p, -1, 0)) - radius, 0.03)

    return distance, margin((-radius,) * 3, (radius,) * 3)


def trees(rng: np.random.Generator) -> Made:
    """A trunk that branches."""
    rods, tips = [], [(np.zeros(3), np.array([0.0, 0.5, 0.0]), 0.16)]
    for _ in range(3):
        onward = []
        for at, along, r in tips:
            rods.append((at, at + along, r, 0.75 * r))
            for _ in range(2):
                turn = along + rng.normal(0, 0.55, 3) * np.linalg.norm(along)
                onward.append((at + along, 0.72 * np.linalg.norm(along) * turn / np.linalg.norm(turn), 0.75 * r))
        tips = onward

    def distance(p: np.ndarray) -> np.ndarray:
        d = np.full(p.shape[:-1], 10.0)
        for a, b, r_a, r_b in rods:
            d = join(d, capsule(p, a, b, r_a, r_b), 0.04)
        return d

    ends = np.array([v for a, b, *_ in rods for v in (a, b)])
    return distance, margin(ends.min(0) - 0.2, ends.max(0) + 0.2)


def gears(rng: np.random.Generator) -> Made:
    """A wheel with cogs and a hole."""
    n, high, deep = int(rng.integers(6, 13)), rng.uniform(0.06, 0.15), rng.uniform(0.08, 0.3)
    hole = rng.uniform(0.1, 0.4)

    def distance(p: np.ndarray) -> np.ndarray:
        x, y, z = np.moveaxis(rotated(p, 0, 0.3), -1, 0)
        r, angle = length(x, y), np.arctan2(y, x)
        cog = 0.65 + high * np.tanh(3 * np.cos(n * angle))
        return overlap(cut((r - cog) / (1 + n * high * 2), r - hole), np.abs(z) - deep, 0.02)

    reach = 0.68 + high + deep
    return distance, margin((-reach,) * 3, (reach,) * 3)


HELD_OUT = {f.__name__: f for f in (letters, leaves, hourglasses, springs, lattices, trees, gears)}
