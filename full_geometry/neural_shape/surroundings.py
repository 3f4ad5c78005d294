"""What a point inside an object sees of its surface: rays in fixed directions, against what they would see on a plane.

From y, the mean place of the first event, at the depth z below x, the way d_j to the surface is measured along N
directions omega_j, uniform in solid angle and turned with n and w, so that they follow the object when it is moved. For
lengths l_k, a mean free path and multiples of a transport mean free path, with c_j the chance 1 - exp(-d_j/l_k) that
something happens on the way, and c'_j that on the way z/(omega_j.n) to a plane (1 downwards),

    L_k = log[(mean_j c_j + e)/(mean_j c'_j + e)] / 2,    V_k = mean_j omega_j c'_j / (mean_j c'_j + e) - the same of c.

Both are 0 on a half-space, and tell thin from thinner however thin it is. A mesh is looked at by rays only, so its
resolution does not count.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from full_geometry.first_event import FirstEvent
from full_geometry.subject import Subject, SurfacePoint
from halfspace_sss.rendering.transport.plane import number

__all__ = ["N_LENGTHS", "RAYS", "Surroundings", "directions", "look"]

RAYS = 8
LENGTHS = (2.0, 8.0, 32.0)  # transport mean free paths
N_LENGTHS = 1 + len(LENGTHS)
LEAST_CHANCE = 1e-4  # e
FAR = 1e30
LEAST_SINE2 = 1e-8  # below it w has no azimuth


class Surroundings(NamedTuple):
    """L and V for each length, and the depth z in scene units."""

    L: list[Any]
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
            known[key] = _from(subject, at, y, key, active)
    return [known[float(m.sigma_t), float(m.sigma_t_prime)] for m in subject.media]


def _from(subject: Subject, at: SurfacePoint, y: Any, extinctions: tuple[float, float], active: Any) -> Surroundings:
    """Surroundings of the points y below the points of a surface, for sigma_t and sigma_t'."""
    import drjit as dr
    import mitsuba as mi

    tables = [mi.Float(row.astype(np.float32)) for row in directions()]
    sigma_t, sigma_t_prime = extinctions
    decays = [number(v) for v in (sigma_t, *(sigma_t_prime / length for length in LENGTHS))]
    n, (t, b) = at.n_out, _tangents(at)
    depth = dr.maximum(dr.dot(at.p - y, n), 0)

    def step(j: Any, *sums: list) -> tuple:
        u, v, w = (dr.gather(mi.Float, table, j) for table in tables)
        d = mi.Vector3f(t * u + b * v + n * w)
        hit = subject.found.scene.ray_intersect_preliminary(mi.Ray3f(y, d), False, active)
        ways = dr.select(hit.is_valid(), hit.t, FAR), dr.select(w > 0, depth / dr.maximum(w, 1e-6), FAR)
        c, c_plane = ([1 - dr.exp(-way * decay) for decay in decays] for way in ways)
        new = c, c_plane, [d * v for v in c], [d * v for v in c_plane]
        return j + 1, *([a + b for a, b in zip(old, added)] for old, added in zip(sums, new))

    state = (mi.UInt32(0), *([kind(0) for _ in decays] for kind in (mi.Float, mi.Float, mi.Vector3f, mi.Vector3f)))
    _, *sums = dr.while_loop(state, lambda j, *_: j < RAYS, step, label="surroundings")
    C, C_plane, M, M_plane = ([v / RAYS for v in each] for each in sums)
    L = [0.5 * dr.log((a + LEAST_CHANCE) / (b + LEAST_CHANCE)) for a, b in zip(C, C_plane)]
    V = [m_p / (b + LEAST_CHANCE) - m / (a + LEAST_CHANCE) for a, b, m, m_p in zip(C, C_plane, M, M_plane)]
    return Surroundings(L, V, depth)


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
