"""How much of an object surrounds a point: what the network of one object is told of fins, rims and folds.

For some widths s the share of a Gaussian ball that lies inside of the object, and for one of them its slope,

    O_s(p) = ∫ inside(q) exp(-|p - q|² / 2s²) / (2 pi s²)^(3/2) dq,    s grad O_s(p),

from a grid in the frame of the object, interpolated linearly; inside of it their mean is 0 and their spread 1.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.ndimage import gaussian_filter

from full_geometry.subject import Subject
from halfspace_sss.rendering.transport.plane import number

__all__ = ["FIELDS", "Surroundings", "insides", "surroundings"]

WIDTHS, SLOPED = (0.5, 1.0, 2.0, 4.0), 1  # mean free paths, or cells where those are larger; which has a slope
FIELDS = len(WIDTHS) + 3
CELL, MOST = 0.3, 96  # mean free paths; cells along the longest side
MARGIN = 0.02  # of that side, around the object
TRUNCATED = 3.0  # standard deviations
LEAST_SPREAD = 1e-2
RAYS = ((0.013, 0.027, 1.0), (1.0, 0.021, -0.017), (-0.015, -1.0, 0.031))  # along no axis: faces often are


@dataclass(frozen=True, eq=False)
class Surroundings:
    """The fields of one object.

    Args:
        texture: their values.
        low, scale: of a position in the frame, that turn it into one of the texture: (q - low) scale.
    """

    texture: Any
    low: Any
    scale: Any

    def __call__(self, q: Any) -> list[Any]:
        """Of a position in the frame."""
        import mitsuba as mi

        return self.texture.eval((mi.Point3f(q) - self.low) * self.scale)


def surroundings(subject: Subject, frame: Any) -> Surroundings:
    """The fields of an object.

    Args:
        subject: the object.
        frame: a `Frame` of its features.
    """
    import drjit as dr
    import mitsuba as mi

    low, high = _bounds(subject, frame)
    longest = float((high - low).max())
    low, high = low - MARGIN * longest, high + MARGIN * longest
    path = 1 / float(np.array(frame.sigma_t * frame.radius).ravel()[0])
    cell = max(CELL * path, longest / MOST)
    cells = np.maximum(np.ceil((high - low) / cell).astype(int), 2)
    values = _fields(insides(subject, frame, low, cell, cells), max(path / cell, 1.0))
    texture = mi.Texture3f(mi.TensorXf(values), use_accel=False, wrap_mode=dr.WrapMode.Clamp)
    return Surroundings(texture, mi.Point3f(*map(number, low)), mi.Vector3f(*map(number, 1 / (cell * cells))))


def insides(subject: Subject, frame: Any, low: np.ndarray, cell: float, cells: np.ndarray) -> np.ndarray:
    """1 where the middle of a cell lies inside, (z, y, x): where most of three rays meet the surface from within."""
    import drjit as dr
    import mitsuba as mi

    nx, ny, _ = (int(n) for n in cells)
    k = dr.arange(mi.UInt32, int(np.prod(cells)))
    index = (k % nx, (k // nx) % ny, k // (nx * ny))
    q = [number(a) + number(cell) * (mi.Float(i) + 0.5) for a, i in zip(low, index)]
    votes = mi.UInt32(0)
    for ray in RAYS:
        p, d = frame.back(mi.Vector3f(*q), dr.normalize(mi.Vector3f(*ray)))
        si = subject.found.scene.ray_intersect(mi.Ray3f(p, d))
        votes += dr.select(si.is_valid() & (dr.dot(d, si.n) * number(subject.found.sign) > 0), mi.UInt32(1), 0)
    return (votes >= 2).numpy().astype(np.float32).reshape(cells[::-1])


def _fields(inside: np.ndarray, path: float) -> np.ndarray:
    """All fields, (z, y, x, fields), for widths over `path` cells."""
    balls = [gaussian_filter(inside, s * path, mode="constant", truncate=TRUNCATED) for s in WIDTHS]
    slope = np.gradient(balls[SLOPED])[::-1]
    found = np.stack([*balls, *(WIDTHS[SLOPED] * path * part for part in slope)], axis=-1)
    within = found[inside > 0] if inside.any() else found.reshape(-1, FIELDS)
    return ((found - within.mean(axis=0)) / (within.std(axis=0) + LEAST_SPREAD)).astype(np.float32)


def _bounds(subject: Subject, frame: Any) -> tuple[np.ndarray, np.ndarray]:
    """Of the object in its frame."""
    import mitsuba as mi

    parameters = mi.traverse(subject.found.shape)
    if "vertex_positions" in parameters:
        corners = mi.Point3f(np.array(parameters["vertex_positions"]).reshape(-1, 3).T)
    else:
        box = subject.found.shape.bbox()
        low, high = (np.array(v, dtype=np.float32).ravel() for v in (box.min, box.max))
        corners = mi.Point3f(np.where(np.indices((2, 2, 2)).reshape(3, 8) > 0, high[:, None], low[:, None]))
    q = np.array(frame.position(corners)).reshape(3, -1).astype(float)
    return q.min(axis=1), q.max(axis=1)
