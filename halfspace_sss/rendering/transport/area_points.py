"""Points uniform over the area of an object, with its geometric and its shading normal."""

from __future__ import annotations

from typing import Any, NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np

from halfspace_sss.rendering.transport.plane import number

__all__ = ["AreaPoints", "Point"]


class Point(NamedTuple):
    """Position, geometric normal, shading normal (as the shape has them) and face of a point."""

    p: Any
    n: Any
    n_shading: Any
    prim_index: Any


class AreaPoints:
    """Uniform points of a shape; for a mesh by its faces, as Mitsuba gives one of the two normals only.

    Args:
        shape: the Mitsuba shape.
    """

    def __init__(self, shape: Any) -> None:
        self.shape = shape
        self.faces = self.centre = None
        parameters = mi.traverse(shape)
        if shape.class_name() == "Sphere":  # Mitsuba's normals of sampled points are wrong where it is mirrored
            self.centre = np.array(parameters["to_world"].matrix, dtype=np.float64).reshape(4, 4)[:3, 3]
        if "faces" in parameters:
            faces = np.array(parameters["faces"]).reshape(-1, 3)
            a, b, c = np.array(parameters["vertex_positions"]).reshape(-1, 3)[faces].transpose(1, 0, 2)
            areas = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)
            self.faces = mi.DiscreteDistribution(mi.Float(areas.astype(np.float32)))

    def sample(self, u_face: Any, u: Any, active: Any) -> Point:
        """A point for uniform numbers u_face and the pair u."""
        if self.faces is None:
            ps = self.shape.sample_position(0.0, u, active)
            n = ps.n if self.centre is None else self._radial(ps.p)
            return Point(ps.p, n, n, mi.UInt32(0))
        return self.on_face(self.faces.sample(u_face, active), u, active)

    def _radial(self, p: Any) -> Any:
        n = dr.normalize(p - mi.Point3f(*(number(c) for c in self.centre)))
        return mi.Normal3f(-n if self.shape.has_flipped_normals() else n)

    def on_face(self, face: Any, u: Any, active: Any = True) -> Point:
        """A uniform point of a face of a mesh."""
        index = self.shape.face_indices(face, active)
        corners = [self.shape.vertex_position(i, active) for i in (index.x, index.y, index.z)]
        b = mi.warp.square_to_uniform_triangle(u)
        weights = (1 - b.x - b.y, b.x, b.y)
        n = dr.normalize(dr.cross(corners[1] - corners[0], corners[2] - corners[0]))
        n = -n if self.shape.has_flipped_normals() else n
        n_shading = n
        if self.shape.has_vertex_normals():
            normals = [self.shape.vertex_normal(i, active) for i in (index.x, index.y, index.z)]
            n_shading = dr.normalize(sum(w * v for w, v in zip(weights, normals)))
        p = sum(w * c for w, c in zip(weights, corners))
        return Point(mi.Point3f(p), mi.Normal3f(n), mi.Normal3f(n_shading), face)
