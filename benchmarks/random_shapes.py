"""Random shapes by a seed: signed distances put together at random and meshed. Lengths are of the order of one.

Families of training and those that are held out share no generator.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from benchmarks.modelling.meshes import (
    Box,
    Distance,
    Mesh,
    capsule,
    cut,
    ellipsoid,
    fbm,
    join,
    length,
    overlap,
    rotated,
    surface,
    twisted,
)
from halfspace_sss.checks import check_choice, check_count

Made = tuple[Distance, Box]
Family = Callable[[np.random.Generator], Made]


def margin(low: np.ndarray, high: np.ndarray) -> Box:
    """The box from low to high with a margin of 6 % of its longest side."""
    low, high = np.asarray(low, float), np.asarray(high, float)
    wide = 0.06 * float((high - low).max())
    return Box(tuple((low - wide).tolist()), tuple((high + wide).tolist()))


def turned_points(p: np.ndarray, angles: np.ndarray) -> np.ndarray:
    for axis, angle in enumerate(angles):
        p = rotated(p, axis, angle)
    return p


def box(p: np.ndarray, half: np.ndarray, rounding: float = 0.0) -> np.ndarray:
    """Distance to a box about the origin with half its sides, edges rounded."""
    q = np.abs(p) - (np.asarray(half) - rounding)
    return length(*np.moveaxis(np.maximum(q, 0), -1, 0)) + np.minimum(q.max(axis=-1), 0) - rounding


def blobs(rng: np.random.Generator) -> Made:
    """Ellipsoids and rods that are blended."""
    n, blend = int(rng.integers(1, 6)), rng.uniform(0.01, 0.3)
    centres, radii = rng.normal(0, 0.4, (n, 3)), np.exp(rng.uniform(np.log(0.12), np.log(0.6), (n, 3)))
    angles = rng.uniform(-np.pi, np.pi, (n, 3))
    rods = rng.normal(0, 0.6, (int(rng.integers(0, 3)), 2, 3))
    thin = rng.uniform(0.06, 0.25, (len(rods), 2))

    def distance(p: np.ndarray) -> np.ndarray:
        d = np.full(p.shape[:-1], 10.0)
        for c, r, a in zip(centres, radii, angles):
            d = join(d, ellipsoid(turned_points(p - c, a), tuple(r)), blend)
        for (a, b), (r_a, r_b) in zip(rods, thin):
            d = join(d, capsule(p, a, b, r_a, r_b), blend)
        return d

    points = np.concatenate([centres - radii.max(1, keepdims=True), centres + radii.max(1, keepdims=True)])
    ends = rods.reshape(-1, 3)
    points = np.concatenate([points, ends - 0.3, ends + 0.3])
    return distance, margin(points.min(0) - blend, points.max(0) + blend)


def boxes(rng: np.random.Generator) -> Made:
    """Boxes put together or cut out of the first, with edges from sharp to round."""
    n, blend = int(rng.integers(1, 5)), float(rng.choice([0.0, 0.0, rng.uniform(0.02, 0.2)]))
    halves = np.exp(rng.uniform(np.log(0.1), np.log(0.7), (n, 3)))
    centres, angles = rng.normal(0, 0.35, (n, 3)), rng.uniform(-0.6, 0.6, (n, 3))
    away, rounding = rng.random(n) < 0.35, float(rng.choice([0.0, rng.uniform(0, 0.09)]))
    centres[0], away[0] = 0, False

    def distance(p: np.ndarray) -> np.ndarray:
        d = np.full(p.shape[:-1], 10.0)
        for c, h, a, gone in zip(centres, halves, angles, away):
            part = box(turned_points(p - c, a), h, min(rounding, 0.9 * h.min()))
            d = cut(d, part, blend) if gone else join(d, part, blend)
        return d

    reach = np.linalg.norm(halves, axis=1, keepdims=True)
    return distance, margin((centres - reach).min(0) - blend, (centres + reach).max(0) + blend)


def sheets(rng: np.random.Generator) -> Made:
    """A thin plate, wavy, of uneven thickness, with a rim."""
    half, thick = rng.uniform(0.4, 1.0, 2), np.exp(rng.uniform(np.log(0.035), np.log(0.2)))
    waves, phase, high = rng.uniform(0.5, 4, 2), rng.uniform(0, 6, 2), rng.uniform(0, 0.2)
    uneven, seed, taper = rng.uniform(0, 0.4), int(rng.integers(1, 10**6)), rng.uniform(0, 0.6)

    def distance(p: np.ndarray) -> np.ndarray:
        x, y, z = np.moveaxis(p, -1, 0)
        middle = high * (np.sin(waves[0] * x + phase[0]) + np.sin(waves[1] * y + phase[1]))
        wide = thick * (1 + uneven * fbm(2 * p, seed, 2)) * (1 - taper * np.clip(x / half[0] * 0.5 + 0.5, 0, 1))
        slope = 1 + high * waves.max()
        off = np.stack([x, y, (z - middle) / slope], axis=-1)
        return box(off, np.array([half[0], half[1], thick]), 0.9 * thick) + 0.5 * (thick - wide)

    reach = (half[0], half[1], 2 * high + 2.5 * thick)
    return distance, margin(-np.array(reach), np.array(reach))


def shells(rng: np.random.Generator) -> Made:
    """A bowl: an ellipsoid hollowed out and opened by a plane."""
    radii, thick = rng.uniform(0.4, 0.8, 3), np.exp(rng.uniform(np.log(0.035), np.log(0.2)))
    level, tilt, blend = rng.uniform(-0.4, 0.5), rng.uniform(-np.pi, np.pi, 3), rng.uniform(0.0, 0.05)

    def distance(p: np.ndarray) -> np.ndarray:
        outer = ellipsoid(p, tuple(radii))
        hollow = np.abs(outer + thick) - thick
        return overlap(hollow, turned_points(p, tilt)[..., 2] - level * radii.min(), blend)

    return distance, margin(-radii - blend, radii + blend)


def ribbons(rng: np.random.Generator) -> Made:
    """A twisted bar of any section, straight or bent."""
    wide, thick = rng.uniform(0.12, 0.5), np.exp(rng.uniform(np.log(0.04), np.log(0.25)))
    turns, bend, tall = rng.uniform(-3, 3), rng.uniform(0, 0.4), rng.uniform(0.5, 1.0)
    phase = rng.uniform(0, 6)

    def distance(p: np.ndarray) -> np.ndarray:
        q = np.array(p)
        q[..., 0] -= bend * np.sin(2 * p[..., 1] + phase)
        q = twisted(q, turns)
        slope = np.sqrt(1 + (turns * wide) ** 2 + (2 * bend) ** 2)
        return box(q, np.array([wide, tall, thick]), 0.5 * min(thick, wide)) / slope

    reach = np.array([wide + thick + bend, tall, wide + thick])
    return distance, margin(-reach, reach)


def tori(rng: np.random.Generator) -> Made:
    """One or two rings, with a ball in it or not."""
    n, blend = int(rng.integers(1, 3)), rng.uniform(0.0, 0.15)
    major = rng.uniform(0.35, 0.7, n)
    minor = np.exp(rng.uniform(np.log(0.06), np.log(0.3), n))
    angles, centres = rng.uniform(-np.pi, np.pi, (n, 3)), rng.normal(0, 0.2, (n, 3))
    ball = rng.uniform(0.15, 0.5) if rng.random() < 0.4 else 0.0

    def distance(p: np.ndarray) -> np.ndarray:
        d = length(*np.moveaxis(p, -1, 0)) - ball if ball else np.full(p.shape[:-1], 10.0)
        for R, r, a, c in zip(major, minor, angles, centres):
            x, y, z = np.moveaxis(turned_points(p - c, a), -1, 0)
            d = join(d, length(length(x, y) - R, z) - r, blend)
        return d

    reach = (np.abs(centres) + (major + minor)[:, None]).max(0) + blend
    return distance, margin(-np.maximum(reach, ball), np.maximum(reach, ball))


def combs(rng: np.random.Generator) -> Made:
    """A base with teeth: rods that taper, close to each other."""
    n, high = int(rng.integers(3, 9)), rng.uniform(0.3, 0.9)
    base = np.array([rng.uniform(0.5, 0.9), rng.uniform(0.06, 0.25), rng.uniform(0.1, 0.35)])
    feet = np.stack([rng.uniform(-1, 1, n) * base[0] * 0.85, np.zeros(n), rng.uniform(-1, 1, n) * base[2] * 0.7], -1)
    tips = feet + np.stack([rng.normal(0, 0.12, n), high * rng.uniform(0.5, 1, n), rng.normal(0, 0.12, n)], -1)
    radii = np.stack([rng.uniform(0.05, 0.16, n), rng.uniform(0.03, 0.1, n)], -1)
    blend = rng.uniform(0, 0.1)

    def distance(p: np.ndarray) -> np.ndarray:
        d = box(p, base, 0.8 * base.min())
        for foot, tip, (a, b) in zip(feet, tips, radii):
            d = join(d, capsule(p, foot, tip, a, b), blend)
        return d

    points = np.concatenate([feet - 0.2, tips + 0.2, tips - 0.2, [base, -base]])
    return distance, margin(points.min(0) - blend, points.max(0) + blend)


def rocks(rng: np.random.Generator) -> Made:
    """An ellipsoid made rough, cut or with holes."""
    radii, seed = rng.uniform(0.3, 0.9, 3), int(rng.integers(1, 10**6))
    waves, rough = rng.uniform(1.5, 5), rng.uniform(0.02, 0.3)
    holes = rng.normal(0, 0.45, (int(rng.integers(0, 4)), 3))
    sizes = rng.uniform(0.1, 0.35, len(holes))

    def distance(p: np.ndarray) -> np.ndarray:
        d = (ellipsoid(p, tuple(radii)) + rough * radii.min() * fbm(waves * p, seed, 3)) / (1 + rough)
        for c, r in zip(holes, sizes):
            d = cut(d, length(*np.moveaxis(p - c, -1, 0)) - r, 0.03)
        return d

    return distance, margin(-radii - rough, radii + rough)


TRAINING: dict[str, Family] = {f.__name__: f for f in (blobs, boxes, sheets, shells, ribbons, tori, combs, rocks)}
TRIES = 8


def make_shape(family: str, seed: int, resolution: int = 48, families: Mapping[str, Family] = TRAINING) -> Mesh:
    """A random shape of a family.
    `family`: its name in `families`. `seed`: whole number >= 0. `resolution`: grid cubes along its longest side, >= 8.
    `families`: generators by name. ValueError if an argument is out of range, or no shape of that family came out in
    eight tries."""
    check_choice("family", family, tuple(families))
    check_count("seed", seed, 0)
    check_count("resolution", resolution, 8)
    refusal: ValueError | None = None
    for k in range(TRIES):
        distance, box = families[family](np.random.default_rng([seed, k]))
        try:
            return surface(distance, box, resolution)
        except ValueError as error:
            refusal = error
    raise ValueError(f"seed must give a shape of the family {family!r}, got {seed!r}: {refusal}")
