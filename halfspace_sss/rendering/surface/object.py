"""The geometry of one translucent object: its shape alone, its pieces, which side is outside, whether it is closed."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from typing import Any

import numpy as np

__all__ = ["RAYS", "Object", "is_inside", "same_objects", "survey"]

RAYS = 4096  # of the survey
MOST_HITS = 64  # that one ray counts
MAJORITY = 0.75  # of the first hits from outside agree on the side of the normals, unless the object is a sheet


@dataclass(frozen=True, eq=False)
class Object:
    """A shape with a translucent surface.

    Args:
        shape: the Mitsuba shape.
        scene: a scene that holds this shape only.
        sign: 1 if its normals point outwards, -1 if inwards.
        closed: whether rays that enter also leave.
        pieces: UInt32 array of the connected piece of each face, or None if there is one piece.
        size: diagonal of the bounding box, scene units.
        area: scene units squared.
    """

    shape: Any
    scene: Any
    sign: float
    closed: bool
    pieces: Any
    size: float
    area: float

    def piece(self, prim_index: Any, active: Any) -> Any:
        """The number of the piece that a face belongs to."""
        import drjit as dr
        import mitsuba as mi

        if self.pieces is None:
            return mi.UInt32(0)
        return dr.gather(mi.UInt32, self.pieces, prim_index, active)


def same_objects(a: list[Any], b: list[Any]) -> bool:
    """Whether two lists hold the same objects of Mitsuba."""
    return len(a) == len(b) and all(x is y for x, y in zip(a, b))


def survey(shape: Any) -> Object:
    """Look at a shape from outside with rays; warns if it is not closed.

    Raises:
        ValueError: the shape is an instance, whose geometry belongs to several objects.
    """
    import mitsuba as mi

    if "nstance" in shape.class_name():
        raise ValueError(f"a translucent object must not be an instance, got {shape.id() or shape}")
    scene = mi.load_dict({"type": "scene", "shape": shape})
    box = scene.bbox()
    low, high = np.array(box.min, dtype=float), np.array(box.max, dtype=float)
    size = float(np.linalg.norm(high - low))
    sides, odd = _outside_view(scene, 0.5 * (low + high), 0.5 * size)
    outward = sides[sides != 0]
    share = float((outward > 0).mean()) if len(outward) else 1.0
    sheet = 1 - MAJORITY < share < MAJORITY
    if odd > 0 or sheet:
        warnings.warn(
            f"object {shape.id()!r} is not closed: {100 * odd:.2g} % of the rays that enter it do not leave it again; "
            "light that enters or leaves at the gap is lost",
            stacklevel=2,
        )
    area = float(np.sum(np.array(shape.surface_area())))
    return Object(
        shape, scene, -1.0 if share <= 1 - MAJORITY else 1.0, odd == 0 and not sheet, _pieces(shape), size, area
    )


def _outside_view(scene: Any, centre: np.ndarray, radius: float) -> tuple[np.ndarray, float]:
    """Per ray the side of the normal at the first hit (1 towards the ray, 0 no hit); share of rays with odd hits."""
    import mitsuba as mi

    rng = np.random.default_rng(7)
    ends = rng.standard_normal((2, 3, RAYS))
    ends /= np.linalg.norm(ends, axis=1, keepdims=True)
    start = centre[:, None] + 1.1 * radius * ends[0]
    target = centre[:, None] + 0.9 * radius * ends[1] * rng.random(RAYS) ** (1 / 3)
    along = target - start
    along /= np.linalg.norm(along, axis=0)
    ray = mi.Ray3f(mi.Point3f(start), mi.Vector3f(along))
    side, count = crossings(scene, ray)
    side, count = np.array(side), np.array(count)
    hit = count > 0
    return side, float((count[hit] % 2).mean()) if hit.any() else 0.0


def crossings(scene: Any, ray: Any) -> tuple[Any, Any]:
    """Side of the first hit of each ray (1: the normal points to the ray, 0: no hit) and the number of hits."""
    import drjit as dr
    import mitsuba as mi

    def step(ray: Any, side: Any, count: Any, active: Any) -> tuple:
        si = scene.ray_intersect(ray, mi.RayFlags.Minimal, False, active)
        active &= si.is_valid()
        first = dr.select(dr.dot(si.n, ray.d) < 0, 1.0, -1.0)
        side = dr.select(active & (count == 0), first, side)
        count = dr.select(active, count + 1, count)
        return dr.select(active, si.spawn_ray(ray.d), ray), side, count, active & (count < MOST_HITS)

    n = dr.width(ray)
    state = (ray, dr.zeros(mi.Float, n), dr.zeros(mi.UInt32, n), dr.full(mi.Bool, True, n))
    return dr.while_loop(state, lambda ray, side, count, active: active, step, label="crossings")[1:3]


def is_inside(found: Object, point: Any) -> bool:
    """Whether a point lies inside a closed object, by the parity of the hits of rays from it."""
    import mitsuba as mi

    if not found.closed:
        return False
    along = np.random.default_rng(11).standard_normal((3, 65))
    along /= np.linalg.norm(along, axis=0)
    start = np.repeat(np.asarray(point, dtype=float)[:, None], along.shape[1], axis=1)
    _, count = crossings(found.scene, mi.Ray3f(mi.Point3f(start), mi.Vector3f(along)))
    return bool((np.array(count) % 2).mean() > 0.5)


def _pieces(shape: Any) -> Any:
    """Connected pieces of a mesh over shared positions: Mitsuba merges meshes that have the same BSDF."""
    import mitsuba as mi
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    parameters = mi.traverse(shape)
    if "faces" not in parameters:
        return None
    faces = np.array(parameters["faces"]).reshape(-1, 3)
    positions = np.array(parameters["vertex_positions"]).reshape(-1, 3)
    _, vertex = np.unique(positions, axis=0, return_inverse=True)
    faces = vertex.reshape(-1)[faces]
    ends = np.concatenate([faces[:, :2], faces[:, 1:]])
    graph = coo_array((np.ones(len(ends)), (ends[:, 0], ends[:, 1])), shape=(vertex.max() + 1,) * 2)
    n, label = connected_components(graph, directed=False)
    return mi.UInt32(label[faces[:, 0]].astype(np.uint32)) if n > 1 else None
