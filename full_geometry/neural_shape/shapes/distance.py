"""Signed distances: primitives, how they are joined, bent and made rough; points (..., 3) in mm, y up, inside < 0.

Most are bounds rather than distances where primitives were joined or displaced; the surface is where they are zero.
"""

from __future__ import annotations

import numpy as np

__all__ = [
    "capsule", "cells", "cut", "ellipsoid", "fbm", "join", "length", "noise", "overlap", "ridges", "ring_noise",
    "rotated", "smoothstep", "twisted",
]  # fmt: skip

_GRADIENTS = np.array(
    [(1, 1, 0), (-1, 1, 0), (1, -1, 0), (-1, -1, 0), (1, 0, 1), (-1, 0, 1), (1, 0, -1), (-1, 0, -1), (0, 1, 1)]
    + [(0, -1, 1), (0, 1, -1), (0, -1, -1), (1, 1, 0), (-1, 1, 0), (0, -1, 1), (0, -1, -1)],
    dtype=np.float32,
)  # Perlin 2002


def length(*components: np.ndarray) -> np.ndarray:
    """Euclidean norm of a vector given by its components."""
    return np.sqrt(sum(c * c for c in components))


def smoothstep(low: float, high: float, x: np.ndarray) -> np.ndarray:
    """0 below low, 1 above high, 3 t² - 2 t³ between; falling where low > high."""
    t = np.clip((x - low) / (high - low), 0, 1)
    return t * t * (3 - 2 * t)


def ellipsoid(p: np.ndarray, radii: tuple[float, float, float]) -> np.ndarray:
    """Ellipsoid about the origin: k (k - 1) / |p / r²|, k = |p / r|; exact to first order at the surface."""
    r = np.asarray(radii)
    k = length(*np.moveaxis(p / r, -1, 0))
    gradient = length(*np.moveaxis(p / r**2, -1, 0))
    return k * (k - 1) / np.maximum(gradient, 1e-6)


def capsule(p: np.ndarray, a: np.ndarray, b: np.ndarray, radius_a: float, radius_b: float) -> np.ndarray:
    """A rod from a to b with round ends, whose radius goes from radius_a to radius_b."""
    a, along = np.asarray(a, dtype=float), np.asarray(b, dtype=float) - np.asarray(a, dtype=float)
    t = np.clip((p - a) @ along / max(float(along @ along), 1e-12), 0, 1)
    off = p - a - t[..., None] * along
    return length(*np.moveaxis(off, -1, 0)) - (radius_a + (radius_b - radius_a) * t)


def join(a: np.ndarray, b: np.ndarray, blend: float = 0.0) -> np.ndarray:
    """Union; with blend > 0 (mm) the crease is filled: min(a, b) - h²/(4 blend), h = max(blend - |a - b|, 0)."""
    found = np.minimum(a, b)
    if blend > 0:
        found = found - np.maximum(blend - np.abs(a - b), 0) ** 2 / (4 * blend)
    return found


def overlap(a: np.ndarray, b: np.ndarray, blend: float = 0.0) -> np.ndarray:
    """Intersection, its edge rounded over `blend` mm."""
    return -join(-a, -b, blend)


def cut(a: np.ndarray, b: np.ndarray, blend: float = 0.0) -> np.ndarray:
    """a without b, its edge rounded over `blend` mm."""
    return overlap(a, -b, blend)


def rotated(p: np.ndarray, axis: int, angle: float) -> np.ndarray:
    """Points turned about an axis (0 x, 1 y, 2 z) by an angle, radians, right-handed."""
    i, j = [(1, 2), (2, 0), (0, 1)][axis]
    found, c, s = np.array(p), np.cos(angle), np.sin(angle)
    found[..., i], found[..., j] = c * p[..., i] - s * p[..., j], s * p[..., i] + c * p[..., j]
    return found


def twisted(p: np.ndarray, per_mm: float) -> np.ndarray:
    """Points turned about y by an angle in proportion to their height, radians per mm."""
    angle = per_mm * p[..., 1]
    c, s = np.cos(angle), np.sin(angle)
    x, z = p[..., 0], p[..., 2]
    return np.stack([c * x - s * z, p[..., 1], s * x + c * z], axis=-1)


def _hash(i: np.ndarray, j: np.ndarray, k: np.ndarray, seed: int) -> np.ndarray:
    """Bits of a lattice point, uint32."""
    salt = np.uint32((seed * 0x27D4EB2F + 0x165667B1) & 0xFFFFFFFF)
    h = i.astype(np.uint32) * np.uint32(0x8DA6B343) ^ j.astype(np.uint32) * np.uint32(0xD8163841)
    h = (h ^ k.astype(np.uint32) * np.uint32(0xCB1AB31F)) + salt
    h = (h ^ (h >> np.uint32(15))) * np.uint32(0x2C1B3C6D)
    h = (h ^ (h >> np.uint32(12))) * np.uint32(0x297A2D39)
    return h ^ (h >> np.uint32(15))


def noise(p: np.ndarray, seed: int) -> np.ndarray:
    """Gradient noise of wavelength about 1 with values about in [-1, 1] (Perlin 2002); scale p to choose the size."""
    corner = np.floor(p)
    f = (p - corner).astype(np.float32)
    lattice = corner.astype(np.int64)
    fade = f * f * f * (f * (f * 6 - 15) + 10)
    found = np.zeros(p.shape[:-1], np.float32)
    for corner_index in range(8):
        d = np.array([corner_index & 1, corner_index >> 1 & 1, corner_index >> 2 & 1])
        gradient = _GRADIENTS[_hash(*np.moveaxis(lattice + d, -1, 0), seed) & np.uint32(15)]
        weight = np.prod(np.where(d, fade, 1 - fade), axis=-1)
        found += weight * np.sum(gradient * (f - d.astype(np.float32)), axis=-1)
    return found


def fbm(p: np.ndarray, seed: int, octaves: int = 3) -> np.ndarray:
    """Sum over k of 2^-k noise(2^k p), k < octaves."""
    return sum(0.5**k * noise(p * 2**k, seed + 7919 * k) for k in range(octaves))


def ridges(p: np.ndarray, seed: int, octaves: int = 2) -> np.ndarray:
    """1 on the sheets where fbm is zero, falling to 0 away from them: 1 - |fbm|, at least 0."""
    return np.clip(1 - np.abs(fbm(p, seed, octaves)), 0, 1)


def ring_noise(angle: np.ndarray, seed: int, waves: int = 4) -> np.ndarray:
    """Smooth periodic noise of an angle (radians) in [-1, 1]: the first `waves` harmonics with random phase."""
    rng = np.random.default_rng([seed, 11])
    amplitude, phase = rng.uniform(0.4, 1, waves) / np.arange(1, waves + 1), rng.uniform(0, 2 * np.pi, waves)
    harmonics = (a * np.sin((k + 1) * angle + c) for k, (a, c) in enumerate(zip(amplitude, phase)))
    return sum(harmonics) / amplitude.sum()


def cells(p: np.ndarray, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Distance to the nearest and to the second nearest of random points, one per unit cube, and the nearest's number.

    The number is in [0, 1) (Worley 1996).
    """
    lattice = np.floor(p).astype(np.int64)
    first, second = np.full((2, *p.shape[:-1]), np.inf)
    number = np.zeros(p.shape[:-1])
    for d in np.ndindex(3, 3, 3):
        at = np.moveaxis(lattice + np.array(d) - 1, -1, 0)
        bits = [_hash(*at, seed + 101 * axis) for axis in range(3)]
        jitter = np.stack([b.astype(np.float64) / 2**32 for b in bits], axis=-1)
        r = length(*np.moveaxis(np.moveaxis(at, 0, -1) + jitter - p, -1, 0))
        number = np.where(r < first, bits[0] / 2**32, number)
        second = np.minimum(second, np.maximum(first, r))
        first = np.minimum(first, r)
    return first, second, number
