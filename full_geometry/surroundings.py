"""How much of an object surrounds a point: what the network of one object is told of fins, rims and folds.

For some widths s the share of a Gaussian ball that lies inside of the object, and for one of them its slope,

    O_s(p) = ∫ inside(q) exp(-|p - q|² / 2s²) / (2 pi s²)^(3/2) dq,    s grad O_s(p),

from a grid in the frame of the object, interpolated linearly. Widths say nearly the same, and what sets them apart, how
the surface bends, is small: over random points of the surface, and apart from these over their first events, the fields
have mean 0, spread 1 and no correlation, turned by C^(-1/2) of their covariance C.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.ndimage import gaussian_filter

from full_geometry.first_event import first_event
from full_geometry.subject import Subject
from halfspace_sss.rendering.transport.plane import number
from halfspace_sss.tracing.walk import generator, pass_seed

__all__ = ["EVENT", "FIELDS", "POINT", "Surroundings", "insides", "surroundings"]

POINT, EVENT = 0, 1  # kinds of places: of the surface, and of first events

WIDTHS, SLOPED = (0.5, 1.0, 2.0, 4.0), 1  # mean free paths, or cells where those are larger; which has a slope
FIELDS = len(WIDTHS) + 3
CELL, MOST = 0.3, 96  # mean free paths; cells along the longest side
MARGIN = 0.02  # of that side, around the object
TRUNCATED = 3.0  # standard deviations
LEAST_SPREAD = 5e-3
POINTS, SEED = 8192, 11  # of the surface, that the covariance is taken over
RAYS = ((0.013, 0.027, 1.0), (1.0, 0.021, -0.017), (-0.015, -1.0, 0.031))  # along no axis: faces often are


@dataclass(frozen=True, eq=False)
class Surroundings:
    """The fields of one object.

    Args:
        textures: their values, turned for points and for first events.
        low, scale: of a position in the frame, that turn it into one of a texture: (q - low) scale.
        turns: (2, fields, fields + 1), C^(-1/2) and -C^(-1/2) of the mean for points and for first events.
    """

    textures: tuple[Any, Any]
    low: Any
    scale: Any
    turns: np.ndarray

    def __call__(self, q: Any, kind: int) -> list[Any]:
        """Of a position in the frame, a `POINT` or an `EVENT`."""
        import mitsuba as mi

        return self.textures[kind].eval((mi.Point3f(q) - self.low) * self.scale)


def surroundings(subject: Subject, frame: Any, turns: np.ndarray | None = None) -> Surroundings:
    """The fields of an object.

    Args:
        subject: the object.
        frame: a `Frame` of its features.
        turns: those of training; by default made from random points.
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
    places = mi.Point3f(*map(number, low)), mi.Vector3f(*map(number, 1 / (cell * cells)))

    def turned(turns: np.ndarray) -> Surroundings:
        every = (values @ turn[:, :-1].T + turn[:, -1] for turn in turns.astype(np.float32))
        textures = (mi.Texture3f(mi.TensorXf(v), use_accel=False, wrap_mode=dr.WrapMode.Clamp) for v in every)
        return Surroundings(tuple(textures), *places, turns)

    straight = np.eye(FIELDS, FIELDS + 1, dtype=np.float32)
    return turned(_turns(subject, frame, turned(np.stack([straight] * 2))) if turns is None else turns)


def _turns(subject: Subject, frame: Any, fields: Surroundings) -> np.ndarray:
    """C^(-1/2) of the fields over random points and over their first events, with what takes their means off."""
    import mitsuba as mi

    at = subject.random_points(generator(mi, POINTS, pass_seed(SEED)))
    found = []
    for kind, place in ((POINT, at.p), (EVENT, first_event(subject, at).y)):
        values = np.stack([v.numpy() for v in fields(frame.position(place), kind)]).astype(float)
        spread, axes = np.linalg.eigh(np.cov(values))
        turn = (axes / np.sqrt(np.maximum(spread, 0) + LEAST_SPREAD**2)) @ axes.T
        found.append(np.column_stack([turn, -turn @ values.mean(axis=1)]))
    return np.array(found, dtype=np.float32)


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
    return np.stack([*balls, *(WIDTHS[SLOPED] * path * part for part in slope)], axis=-1)


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
