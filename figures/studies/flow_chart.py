"""Coordinates of flows: a square on each patch, a square of directions, and what a flow is told."""

from __future__ import annotations

from typing import Any, NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np

from full_geometry.object.features import ObjectFrame, Side
from full_geometry.object.patches import Patches, mesh_faces
from full_geometry.object.subject import Subject
from halfspace_sss.rendering.object.entries import Point

# ---- The square [0, 1)² laid onto each patch of a surface, so that equal areas stay equal ----------
# A patch has two axes, the principal ones of its faces. Along the first its faces are put together to strips; u_1
# chooses
# the strip and u_2 the face in the strip, both by area, in the order of the axes; what is left of both is a point of
# the
# face. The map can be inverted, and the density of uniform (u_1, u_2) is one over the area of the patch.


INSIDE = 1.0 - 2.0**-20  # largest coordinate


class PatchFrame(NamedTuple):
    """Centre, two axes and normal of a patch, and its radius: sqrt of its area over pi. Scene units."""

    centre: Any
    axes: tuple[Any, Any, Any]
    radius: Any


class Chart:
    """Points of patches by coordinates, and coordinates of points.

    Args:
        subject: the object.
        frame: of the object; the axes of patches turn with it.
        patches: of its surface.
    """

    def __init__(self, subject: Subject, frame: ObjectFrame, patches: Patches) -> None:
        self.subject = subject
        centroids, normals, areas = mesh_faces(subject)
        turn = np.eye(3) if frame.turn is None else np.array([np.array(row).ravel() for row in frame.turn])
        centres, axes = _axes(centroids, normals * subject.object.sign, areas, patches, turn)
        along, across = (np.einsum("fi,fi->f", centroids - centres[patches.of_face], axes[patches.of_face, k])
                         for k in (0, 1))  # fmt: skip
        strips = _strips(along, areas, patches)
        order = np.lexsort((across, strips.of_face))
        self.tables = {name: mi.Float(v.astype(np.float32)) for name, v in strips.floats.items()}
        low, high = _within(order, strips.of_face, areas, len(strips.first))
        self.tables |= {"low_2": mi.Float(low.astype(np.float32)), "size_2": mi.Float(high.astype(np.float32))}
        ordered = low[order].astype(np.float32)
        ends = np.searchsorted(strips.of_face[order], np.arange(len(strips.first) + 1))
        self.tables |= {"ordered_low": mi.Float(ordered), "face": mi.UInt32(order.astype(np.uint32))}
        self.tables |= {"start": mi.UInt32(ends.astype(np.uint32)), "strip": mi.UInt32(strips.of_face)}
        self.tables |= {"strips": mi.UInt32(strips.ends.astype(np.uint32))}
        radius = np.sqrt(patches.areas / np.pi)
        values = np.concatenate([centres, axes.reshape(-1, 9), radius[:, None]], axis=1)
        self.tables |= {"frames": mi.Float(values.astype(np.float32).ravel())}
        dr.eval(self.tables)
        self.n_faces, self.n_strips = len(order), len(strips.first)

    def _row(self, key: str, k: Any) -> Any:
        return dr.gather(type(self.tables[key]), self.tables[key], k)

    def frame(self, patch: Any) -> PatchFrame:
        """The frame of a patch."""
        v = [self._row("frames", patch * 13 + k) for k in range(13)]
        axes = tuple(mi.Vector3f(*v[k : k + 3]) for k in (3, 6, 9))
        return PatchFrame(mi.Point3f(*v[:3]), axes, v[12])

    def point(self, patch: Any, u: tuple[Any, Any]) -> Point:
        """The point of a patch with coordinates u."""
        first, end = self._row("strips", patch), self._row("strips", patch + 1)
        strip = self._last_below("low_1", first, end, u[0], self.n_strips)
        face = self._last_below("ordered_low", self._row("start", strip), self._row("start", strip + 1), u[1],
                                self.n_faces)  # fmt: skip
        face = self._row("face", face)
        v = ((u[0] - self._row("low_1", strip)) / self._row("size_1", strip),
             (u[1] - self._row("low_2", face)) / self._row("size_2", face))  # fmt: skip
        return self.subject.points.on_face(face, mi.Point2f(*(dr.clip(x, 0, INSIDE) for x in v)))

    def coordinates(self, face: Any, p: Any) -> tuple[Any, Any]:
        """Coordinates in its patch of a point of a face."""
        index = self.subject.object.shape.face_indices(face)
        a, b, c = (self.subject.object.shape.vertex_position(i) for i in (index.x, index.y, index.z))
        ab, ac, ap = b - a, c - a, p - a
        n = dr.cross(ab, ac)
        square = dr.maximum(dr.squared_norm(n), 1e-38)
        weights = mi.Point2f(dr.dot(dr.cross(ap, ac), n) / square, dr.dot(dr.cross(ab, ap), n) / square)
        inside = mi.Point2f(dr.clip(weights.x, 0, 1), dr.clip(weights.y, 0, 1))
        v = mi.warp.uniform_triangle_to_square(inside)
        strip = self._row("strip", face)
        u = (self._row("low_1", strip) + self._row("size_1", strip) * dr.clip(v.x, 0, INSIDE),
             self._row("low_2", face) + self._row("size_2", face) * dr.clip(v.y, 0, INSIDE))  # fmt: skip
        return tuple(dr.clip(x, 0, INSIDE) for x in u)

    def _last_below(self, key: str, first: Any, end: Any, u: Any, n: int) -> Any:
        """The last of the entries first ... end - 1 of a table that rises that is not above u."""

        def before(i: Any) -> Any:
            i = mi.UInt32(i)
            return (i < first) | ((i + 1 < end) & (self._row(key, dr.minimum(i + 1, n - 1)) <= u))

        return mi.UInt32(dr.binary_search(0, n - 1, before))


def _axes(
    centroids: np.ndarray, normals: np.ndarray, areas: np.ndarray, patches: Patches, turn: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Centres (n, 3) and axes (n, 3, 3) of patches: two principal ones of their faces, and the mean normal.

    An axis points to where its largest component is positive in the object's own frame.
    """
    n = patches.n
    mass = np.maximum(np.bincount(patches.of_face, areas, n), 1e-30)

    def mean(values: np.ndarray) -> np.ndarray:
        flat = values.reshape(len(values), -1)
        sums = np.stack([np.bincount(patches.of_face, areas * c, n) for c in flat.T], axis=1)
        return (sums / mass[:, None]).reshape(n, *values.shape[1:])

    centres = mean(centroids)
    d = centroids - centres[patches.of_face]
    _, vectors = np.linalg.eigh(mean(d[:, :, None] * d[:, None, :]))
    normal = mean(normals)
    flat = np.linalg.norm(normal, axis=1, keepdims=True)
    normal = np.where(flat > 1e-3, normal / np.maximum(flat, 1e-30), vectors[:, :, 0])
    first = vectors[:, :, 2] @ turn.T
    strongest = np.take_along_axis(first, np.abs(first).argmax(axis=1)[:, None], 1)
    first = (first * np.where(strongest < 0, -1.0, 1.0)) @ turn
    first = first - normal * np.sum(first * normal, axis=1, keepdims=True)
    first /= np.maximum(np.linalg.norm(first, axis=1, keepdims=True), 1e-30)
    return centres, np.stack([first, np.cross(normal, first), normal], axis=1)


class _Strips(NamedTuple):
    """Strip of each face, first face number, ends of the strips of each patch, and tables by strip."""

    of_face: np.ndarray
    first: np.ndarray
    ends: np.ndarray
    floats: dict[str, np.ndarray]


def _strips(along: np.ndarray, areas: np.ndarray, patches: Patches) -> _Strips:
    """Faces of each patch, in order along its first axis, in about sqrt(faces) strips of like area."""
    n = patches.n
    faces = np.bincount(patches.of_face, minlength=n)
    order = np.lexsort((along, patches.of_face))
    of = patches.of_face[order]
    sums = np.cumsum(areas[order])
    before = np.concatenate([[0.0], sums])[np.searchsorted(of, np.arange(n))]
    middle = (sums - 0.5 * areas[order] - before[of]) / np.maximum(patches.areas[of], 1e-300)
    number = np.maximum(np.sqrt(faces).astype(int), 1)
    wanted = np.minimum((np.clip(middle, 0, 1) * number[of]).astype(int), number[of] - 1)
    keys = of.astype(np.int64) * (number.max() + 1) + wanted
    strips, first, strip = np.unique(keys, return_index=True, return_inverse=True)
    owner = of[first]
    ends = np.searchsorted(owner, np.arange(n + 1))
    mass = np.bincount(strip, areas[order], len(strips))
    upto = np.concatenate([[0.0], np.cumsum(mass)])
    low = (upto[:-1] - upto[ends[:-1]][owner]) / patches.areas[owner]
    of_face = np.empty(len(of), dtype=np.uint32)
    of_face[order] = strip
    return _Strips(of_face, first, ends, {"low_1": low, "size_1": mass / patches.areas[owner]})


def _within(order: np.ndarray, of_face: np.ndarray, areas: np.ndarray, n: int) -> tuple[np.ndarray, np.ndarray]:
    """Where the interval of each face begins in its strip, and how long it is."""
    strip, mass = of_face[order], np.bincount(of_face, areas, n)
    upto = np.concatenate([[0.0], np.cumsum(areas[order])])
    low, size = np.empty(len(order)), np.empty(len(order))
    low[order] = (upto[:-1] - upto[np.searchsorted(strip, np.arange(n))][strip]) / mass[strip]
    size[order] = areas[order] / mass[strip]
    return low, size


# ---- What the flow of a patch is told: where the exit and its first event lie as seen from the patch

N_CONTEXT = 18


def context(frame: ObjectFrame, exit: Side, patch: PatchFrame) -> list[Any]:
    """The numbers of `N_CONTEXT`.

    x_o and y_o in the frame of the patch as v / (|v| + radius), the logarithms of both distances over the radius, n_o
    and w_o in that frame, and the radius, in mean free paths, and the way to y_o, as logarithms.
    """

    def local(v: Any) -> list[Any]:
        return [dr.dot(v, axis) for axis in patch.axes]

    told: list[Any] = []
    for p in (exit.at.p, exit.event.y):
        d = p - patch.centre
        r = dr.norm(d)
        told += [*local(d / (r + patch.radius)), 0.5 * dr.log(r / patch.radius + 0.05)]
    told += [*local(exit.at.n_out), *local(exit.at.w), dr.dot(exit.at.n_out, exit.at.w)]
    told += [0.5 * dr.log(patch.radius * frame.sigma_t + 1e-3), 0.5 * dr.log(exit.event.length * frame.sigma_t + 1e-2)]
    return [*told, 1 / (1 + patch.radius * frame.sigma_t)]


def _tangents(n: Any, towards: Any) -> tuple[Any, Any]:
    """Tangents of a normal, the first towards a point as seen from there; any where that is along the normal."""
    flat = towards - n * dr.dot(towards, n)
    length = dr.norm(flat)
    s = dr.select(length > 1e-4 * dr.norm(towards), flat / dr.maximum(length, 1e-30), mi.coordinate_system(n)[0])
    return mi.Vector3f(s), mi.Vector3f(dr.cross(n, s))


def direction_square(n: Any, towards: Any, w: Any) -> tuple[Any, Any]:
    """Coordinates in [0, 1)² of a direction above a surface, uniform where it follows the cosine."""
    s, t = _tangents(n, towards)
    u = mi.warp.cosine_hemisphere_to_square(mi.Vector3f(dr.dot(w, s), dr.dot(w, t), dr.maximum(dr.dot(w, n), 0)))
    return tuple(dr.clip(v, 0, 1 - 2.0**-20) for v in u)


def from_square(n: Any, towards: Any, u: tuple[Any, Any]) -> Any:
    """The direction of coordinates u."""
    s, t = _tangents(n, towards)
    v = mi.warp.square_to_cosine_hemisphere(mi.Point2f(*u))
    return s * v.x + t * v.y + n * v.z
