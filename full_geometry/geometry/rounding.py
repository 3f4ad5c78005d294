"""How far rounding puts points off the surfaces that rays meet, and rays that begin clear of a surface.

A point that a ray has met is off its surface by what float32 takes from its coordinates, and by what the intersection
takes from the size of the shape. With h the largest half of the sides of the bounding box and c the sum of the largest
coordinates in it, points are within

    e = eps (16 h + 3 c),    eps = 2^-24,

and rays that begin so far above one side do not meet the surface there again. For shapes that Mitsuba leaves the points
of where the ray has put them, which are no meshes, spheres or disks, it is 256 h, and 2 t more after a ray of length t.
Rays of Mitsuba begin 1500 eps (1 + c) away, in whatever unit a scene has: in metres, or at a metre from the origin,
beyond a leaf of 0.1 mm.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

EPSILON = 2.0**-24
OF_SIZE, OF_SIZE_BY_RAY, OF_PLACE, OF_WAY = 16.0, 256.0, 3.0, 2.0


def bounds(shape: mi.Shape, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """e of a shape where its bounding box has these corners, arrays (..., 3), in the unit of the corners."""
    h, c = 0.5 * np.max(high - low, axis=-1), np.sum(np.maximum(np.abs(low), np.abs(high)), axis=-1)
    exact = shape.is_mesh() or shape.class_name() in ("Sphere", "Disk")
    return EPSILON * ((OF_SIZE if exact else OF_SIZE_BY_RAY) * h + OF_PLACE * c)


def box_ends(box: mi.ScalarBoundingBox3f) -> np.ndarray:
    """The least and the largest coordinates of a box, shape (2, 3), double precision."""
    return np.array([np.ravel(np.array(end, dtype=float)) for end in (box.min, box.max)])


def bound_of(shape: mi.Shape) -> float:
    """e of a shape where it is; 0 of one without a bounding box."""
    box = shape.bbox()
    return float(bounds(shape, *box_ends(box))) if box.valid() else 0.0


def place_bound(p: mi.Point3f) -> mi.Float:
    """A bound of the rounding of a point in float32, for a point of no known shape."""
    return OF_PLACE * EPSILON * dr.sum(dr.abs(p))


def clear(n: mi.Normal3f, d: mi.Vector3f, e: mi.Float | float) -> mi.Vector3f:
    """The offset from a point with the normal n to where a ray along d is clear of its surface."""
    return mi.Vector3f(n) * dr.mulsign(mi.Float(e), dr.dot(n, d))


def ray_from(at: mi.Interaction3f, d: mi.Vector3f, e: mi.Float | float) -> mi.Ray3f:
    """A ray along d from a point of a surface, clear of that."""
    ray = mi.Ray3f(mi.Point3f(at.p + clear(at.n, d, e)), mi.Vector3f(d))
    ray.time, ray.wavelengths = at.time, at.wavelengths
    return ray


def before(p: mi.Point3f, distance: mi.Float, e: mi.Float | float = 0.0) -> mi.Float:
    """How far a ray of some length has to end before a point of a surface, clear of that; of a point alone e is 0."""
    return 2 * (e + place_bound(p) + OF_WAY * EPSILON * distance)


def blocked(scene: mi.Scene, ray: mi.Ray3f, active: mi.Bool | bool = True) -> mi.Bool:
    """Whether something lies on a ray; Mitsuba's own test meets spheres by 1e-5 of the distance before their place."""
    return scene.ray_intersect_preliminary(ray, False, active=active).is_valid()


def ray_to(at: mi.Interaction3f, p: mi.Point3f, e: mi.Float | float, e_p: mi.Float | float = 0.0) -> mi.Ray3f:
    """A ray from a point of a surface to one before p, clear of both; e of both."""
    o = at.p + clear(at.n, p - at.p, e)
    way = p - o
    length = dr.norm(way)
    ray = mi.Ray3f(mi.Point3f(o), mi.Vector3f(way / length))
    ray.maxt = length - before(p, length, e_p)
    ray.time, ray.wavelengths = at.time, at.wavelengths
    return ray
