"""What a point inside an object sees of its surface: rays in fixed directions, less what they would see on a plane.

From y, the mean place of the first event, at the depth z below x, the way d_j to the surface is measured along N
directions omega_j, uniform in solid angle and turned with n and w, so that they follow the object when it is moved. For
lengths l_k, multiples of a transport mean free path, with the way z/(omega_j.n) to a plane (none downwards),

    D_k = mean_j [exp(-d_j/l_k) - exp(-z/(omega_j.n l_k))],    V_k = mean_j omega_j [...].

Both are 0 on a half-space. A mesh is looked at by rays only, so its resolution does not count.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from full_geometry.first_event import FirstEvent
from full_geometry.subject import Subject, SurfacePoint
from halfspace_sss.rendering.transport.plane import number

__all__ = ["LENGTHS", "RAYS", "Surroundings", "directions", "look"]

RAYS = 16
LENGTHS = (0.5, 2.0, 8.0, 32.0, 128.0)  # transport mean free paths
FAR = 1e30
LEAST_SINE2 = 1e-8  # below it w has no azimuth


class Surroundings(NamedTuple):
    """D and V for each length, and the depth z in scene units."""

    D: list[Any]
    V: list[Any]
    depth: Any


def directions(n: int = RAYS) -> np.ndarray:
    """n directions over the sphere, uniform in solid angle, (3, n)."""
    k = np.arange(n)
    z, phi = 1 - 2 * (k + 0.5) / n, math.pi * (3 - math.sqrt(5)) * k + 0.3
    s = np.sqrt(1 - z * z)
    return np.stack([s * np.cos(phi), s * np.sin(phi), z])


def look(subject: Subject, at: SurfacePoint, event: FirstEvent, active: Any = True) -> list[Surroundings]:
    """Surroundings of the first events of each channel; channels of the same extinction share them.

    Args:
        subject: the object.
        at: points of its surface, with the directions outside that light goes along.
        event: their first events.
        active: mask of lanes.
    """
    known: dict[tuple[float, float], Surroundings] = {}
    for m, y in zip(subject.media, event.ys):
        key = float(m.sigma_t), float(m.sigma_t_prime)
        if key not in known:
            known[key] = _from(subject, at, y, key[1], active)
    return [known[float(m.sigma_t), float(m.sigma_t_prime)] for m in subject.media]


def _from(subject: Subject, at: SurfacePoint, y: Any, sigma_t_prime: float, active: Any) -> Surroundings:
    """Surroundings of the points y below the points of a surface."""
    import drjit as dr
    import mitsuba as mi

    tables = [mi.Float(row.astype(np.float32)) for row in directions()]
    decays = [number(sigma_t_prime / length) for length in LENGTHS]
    n, (t, b) = at.n_out, _tangents(at)
    depth = dr.maximum(dr.dot(at.p - y, n), 0)

    def step(j: Any, D: list, V: list) -> tuple:
        u, v, w = (dr.gather(mi.Float, table, j) for table in tables)
        d = mi.Vector3f(t * u + b * v + n * w)
        hit = subject.found.scene.ray_intersect_preliminary(mi.Ray3f(y, d), False, active)
        way = dr.select(hit.is_valid(), hit.t, FAR)
        plane = dr.select(w > 0, depth / dr.maximum(w, 1e-6), FAR)
        e = [dr.exp(-way * decay) - dr.exp(-plane * decay) for decay in decays]
        return j + 1, [a + v for a, v in zip(D, e)], [a + d * v for a, v in zip(V, e)]

    state = (mi.UInt32(0), [mi.Float(0) for _ in LENGTHS], [mi.Vector3f(0) for _ in LENGTHS])
    _, D, V = dr.while_loop(state, lambda j, D, V: j < RAYS, step, label="surroundings")
    return Surroundings([v / RAYS for v in D], [v / RAYS for v in V], depth)


def _tangents(at: SurfacePoint) -> tuple[Any, Any]:
    """Two axes across the normal, the first one along w."""
    import drjit as dr
    import mitsuba as mi

    n = at.n_out
    along = at.w - n * dr.dot(n, at.w)
    spare, _ = mi.coordinate_system(n)
    t = dr.normalize(dr.select(dr.squared_norm(along) > LEAST_SINE2, along, spare))
    t = mi.Vector3f(dr.normalize(t - n * dr.dot(n, t)))
    return t, mi.Vector3f(dr.cross(n, t))
