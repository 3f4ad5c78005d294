"""A pillar candle burnt down to a bowl with a pool of molten wax, its wick and flame; one homogeneous wax throughout.

56 mm wide, about 65 mm tall; the pool stands at 40 mm, the flame, 11 mm tall and 4.4 mm wide, in the bowl above it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from full_geometry.learning.meshes import (
    Box,
    Mesh,
    capsule,
    cut,
    fbm,
    join,
    length,
    noise,
    overlap,
    ring_noise,
    smoothstep,
    surface,
)

BOX = Box((-33.0, -1.0, -33.0), (33.0, 71.0, 33.0))
RADIUS, HEIGHT, POOL = 28.0, 64.0, 40.0
BOWL = 22.5  # radius at the rim
DIP, DIP_ANGLE = 9.0, 1.35  # of the rim where it has slumped, mm and azimuth from x towards z
WICK = ((0.0, POOL + 0.15, 0.0), (0.3, POOL + 3.5, 0.2), (1.1, POOL + 6.0, 0.5))
FLAME = (0.6, POOL + 8.7, 0.3)  # centre of its widest part
FLAME_FOOT = 2.8  # below it
FLAME_BOX = Box((-3.0, POOL + 4.0, -3.0), (4.2, POOL + 19.0, 3.6))
FLAME_CELLS = 40


@dataclass(frozen=True, eq=False)
class Candle:
    """The wax, the wick and the flame, three closed meshes that do not touch."""

    wax: Mesh
    wick: Mesh
    flame: Mesh


def make_candle(resolution: int = 160, seed: int = 0) -> Candle:
    """The candle.

    Args:
        resolution: grid cubes along its height, >= 8; that of wick and flame is fixed.
        seed: of the drips and the unevenness of rim and side.

    Raises:
        ValueError: the resolution is too small.
    """
    drips = _drips(seed)
    wax = surface(lambda p: wax_distance(p, seed, drips), BOX, resolution)
    box = Box((-1.5, POOL - 1.0, -1.5), (2.5, POOL + 8.0, 2.0))
    return Candle(wax, surface(wick_distance, box, FLAME_CELLS), surface(flame_distance, FLAME_BOX, FLAME_CELLS))


def wick_distance(p: np.ndarray) -> np.ndarray:
    """A bent rod that ends just above the pool."""
    a, b, c = (np.array(v) for v in WICK)
    a = a + (0, 0.7, 0)
    return join(capsule(p, a, b, 0.7, 0.65), capsule(p, b, c, 0.65, 0.5), 0.2)


def flame_distance(p: np.ndarray) -> np.ndarray:
    """A drop with the tip upwards: its radius is that of a ball at the foot and falls to nothing at the tip."""
    x, y, z = np.moveaxis(p - np.array(FLAME), -1, 0)
    t = np.clip(y / 9.0, -1, 1)
    lean = 0.5 * np.maximum(t, 0) ** 2
    wide = np.where(
        t < 0, np.sqrt(np.clip(1 - (y / FLAME_FOOT) ** 2, 0, 1)), (1 - np.maximum(t, 0) ** 1.6) ** 1.35 * (1 + 0.25 * t)
    )
    beyond = np.maximum(np.maximum(y - 9.0, -FLAME_FOOT - y), 0)
    return 0.5 * (length(x - lean, z, beyond) - 2.2 * wide)


def wax_distance(p: np.ndarray, seed: int, drips: list[tuple]) -> np.ndarray:
    """The pillar, less its bowl, with drips down the side."""
    x, y, z = np.moveaxis(p, -1, 0)
    angle = np.arctan2(z, x)
    off = np.angle(np.exp(1j * (angle - DIP_ANGLE)))
    rim = 1.6 * ring_noise(angle, seed) - DIP * np.exp(-((off / 0.75) ** 2))
    lift = y - rim * smoothstep(POOL - 8, HEIGHT, y)
    rho = length(x, z) - 0.5 * ring_noise(angle, seed + 1) * smoothstep(0, HEIGHT, y)
    side = rho - RADIUS - 0.25 * noise(p / 17, seed + 2)
    result = overlap(side, np.abs(lift - HEIGHT / 2) - HEIGHT / 2, 4.0)
    result = join(result, _rod_field(p, drips), 2.2)
    return cut(result, _bowl(rho, angle, lift, y, seed), 3.5) + 0.06 * fbm(p / 6, seed + 3, 2) * (lift > POOL + 2)


def _bowl(rho: np.ndarray, angle: np.ndarray, lift: np.ndarray, y: np.ndarray, seed: int) -> np.ndarray:
    """What is burnt away: flat over the pool, wider towards the rim, rounded where they meet."""
    wide = BOWL - 3.0 + 3.4 * smoothstep(POOL, HEIGHT + 4, lift) + 0.8 * ring_noise(angle, seed + 4)
    return overlap(rho - wide, POOL - y, 4.0)


def _drips(seed: int) -> list[tuple]:
    """Runs of wax over the rim: bent rods that start flat and end in a bead, as (points, radii)."""
    rng, results = np.random.default_rng([seed, 3]), []
    angles = DIP_ANGLE + np.array([0.1, -0.42, 0.58, -0.7, 2.4, 3.5, -1.7]) + rng.uniform(-0.1, 0.1, 7)
    for angle in angles:
        off = np.angle(np.exp(1j * (angle - DIP_ANGLE)))
        top = HEIGHT - DIP * np.exp(-((off / 0.75) ** 2)) - 2.0
        reach, thick = min(rng.uniform(12, 42), top - 9), rng.uniform(1.1, 1.9)
        t = np.array([0, 0.06, 0.2, 0.4, 0.6, 0.8, 0.93, 1.0])
        ways = angle + np.concatenate([[0, 0], np.cumsum(rng.normal(0, 0.018, 6))])
        out = RADIUS + thick * np.array([-2.2, -0.75, -0.45, -0.35, -0.3, -0.3, -0.25, -0.25])
        points = np.stack([out * np.cos(ways), top - t * reach, out * np.sin(ways)], axis=1)
        results.append((points, thick * np.array([1.6, 1.15, 0.95, 0.85, 0.8, 0.85, 1.2, 1.35])))
    return results


def _rod_field(p: np.ndarray, rods: list[tuple]) -> np.ndarray:
    result = np.full(p.shape[:-1], np.inf)
    for points, radii in rods:
        for a, b, r, s in zip(points[:-1], points[1:], radii[:-1], radii[1:]):
            result = np.minimum(result, capsule(p, a, b, r, s))
    return result
