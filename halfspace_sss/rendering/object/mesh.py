"""The faces of a mesh: which hang together, to which sides they point, and whether they exist twice."""

from __future__ import annotations

import warnings
from dataclasses import dataclass

import mitsuba as mi
import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

__all__ = ["Faces", "check_copies", "face_normals_agree", "faces_of"]

MOST_COPIES = 1e-3  # share of the area in faces that exist twice, by which light may then be wrong
CREASES = 0.01  # of the corners whose vertex normal may be on the other side of the face, as at sharp edges


@dataclass(frozen=True, eq=False)
class Faces:
    """The connected faces of a mesh.

    Args:
        corners: integer array (n, 3), the places of the corners of each face; equal where positions are.
        normals: array (n, 3), normal times area of each face, by its winding.
        pieces: integer array (n,), the connected piece of each face, over shared positions; over shared edges where
            faces point to both sides.
        sides: array (n,) of 1 and -1, by which normals of each piece have to be multiplied to point to one side; None
            where they do.
    """

    corners: np.ndarray
    normals: np.ndarray
    pieces: np.ndarray
    sides: np.ndarray | None


def faces_of(shape: mi.Shape, name: str) -> Faces | None:
    """The faces of a shape that is a mesh; None for others.

    Raises:
        ValueError: a surface of the mesh, called `name`, has one side only, as a Möbius strip has.
    """

    parameters = mi.traverse(shape)
    if "faces" not in parameters:
        return None
    faces = np.array(parameters["faces"]).reshape(-1, 3)
    positions = np.array(parameters["vertex_positions"], dtype=float).reshape(-1, 3)
    _, place = np.unique(positions, axis=0, return_inverse=True)
    corners = place.reshape(-1)[faces]
    a, b, c = positions[faces].transpose(1, 0, 2)
    normals = 0.5 * np.cross(b - a, c - a)
    first, second, same = _neighbours(corners, np.linalg.norm(normals, axis=1) > 0)
    if same.all():
        return Faces(corners, normals, _pieces(corners), None)
    pieces, sides = _turned(len(faces), first, second, same, name)
    return Faces(corners, normals, pieces, sides)


def check_copies(faces: Faces, name: str) -> None:
    """Refuse a mesh whose faces exist twice, in either winding: light would enter by both.

    Raises:
        ValueError: more than `MOST_COPIES` of the area is in copies of other faces.
    """
    corners = np.sort(faces.corners, axis=1)
    order = np.lexsort(corners.T)
    copies = np.zeros(len(corners), dtype=bool)
    copies[order[1:]] = (np.diff(corners[order], axis=0) == 0).all(axis=1)
    area = np.linalg.norm(faces.normals, axis=1)
    share = area[copies].sum() / max(area.sum(), np.finfo(float).tiny)
    if share > MOST_COPIES:
        raise ValueError(
            f"faces of object {name} must exist once, got {int(copies.sum())} of {len(copies)} that are copies of "
            f"others, {100 * share:.3g} % of the area: remove one of each two"
        )


def face_normals_agree(shape: mi.Shape, faces: Faces, name: str) -> None:
    """Warn that faces were turned, and make vertex normals anew that were averaged over faces of both sides."""

    parameters = mi.traverse(shape)
    turned = int(min((faces.sides < 0).sum(), (faces.sides > 0).sum()))
    more = ""
    if shape.has_vertex_normals():
        vertex = np.array(parameters["faces"]).reshape(-1, 3)
        positions = np.array(parameters["vertex_positions"], dtype=float).reshape(-1, 3)
        normals = faces.normals * faces.sides[:, None]
        known = np.array(parameters["vertex_normals"], dtype=float).reshape(-1, 3)
        above = float((np.einsum("fkx,fx->fk", known[vertex], normals) > 0).mean())
        if min(above, 1 - above) > CREASES:
            new = _vertex_normals(positions, vertex, normals)
            parameters["vertex_normals"] = mi.Float(new.ravel().astype(np.float32))
            parameters.update()
            more = ", and vertex normals were made anew"
    warnings.warn(
        f"faces of object {name} point to both sides: {turned} of {len(faces.sides)} were turned{more}",
        stacklevel=3,
    )


def _vertex_normals(positions: np.ndarray, vertex: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Means of the normals of faces about each vertex, by their angles there, as Mitsuba makes them."""

    def unit(v: np.ndarray) -> np.ndarray:
        return v / np.maximum(np.linalg.norm(v, axis=-1, keepdims=True), np.finfo(float).tiny)

    corners, found = positions[vertex], np.zeros_like(positions)
    for k in range(3):
        a, b = (unit(corners[:, (k + j) % 3] - corners[:, k]) for j in (1, 2))
        angle = 2 * np.arctan2(np.linalg.norm(a - b, axis=1), np.linalg.norm(a + b, axis=1))
        np.add.at(found, vertex[:, k], angle[:, None] * unit(normals))
    return unit(found)


def _neighbours(corners: np.ndarray, solid: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Pairs of faces that share an edge which no third one has, and whether they run along it in opposite ways.

    Faces without area, which are not `solid`, have no side to agree with.
    """
    start, end = corners.ravel(), np.roll(corners, -1, axis=1).ravel()
    face = np.repeat(np.arange(len(corners)), 3)
    low, high = np.minimum(start, end), np.maximum(start, end)
    order = np.lexsort((high, low))
    low, high = low[order], high[order]
    new = np.ones(len(order) + 1, dtype=bool)
    new[1:-1] = (np.diff(low) != 0) | (np.diff(high) != 0)
    edge = np.flatnonzero(new)
    pair = order[edge[:-1][(np.diff(edge) == 2) & (low[edge[:-1]] != high[edge[:-1]])][:, None] + [0, 1]]
    pair = pair[solid[face[pair]].all(axis=1)]
    return face[pair[:, 0]], face[pair[:, 1]], start[pair[:, 0]] != start[pair[:, 1]]


def _pieces(corners: np.ndarray) -> np.ndarray:
    ends = np.concatenate([corners[:, :2], corners[:, 1:]])
    graph = coo_array((np.ones(len(ends)), (ends[:, 0], ends[:, 1])), shape=(corners.max() + 1,) * 2)
    return connected_components(graph, directed=False)[1][corners[:, 0]]


def _turned(n: int, first: np.ndarray, second: np.ndarray, same: np.ndarray, name: str) -> tuple:
    """Pieces over shared edges, and the sides by which their faces agree.

    In a graph of two nodes for each face, one for each side, an edge of the mesh joins the sides that agree. Both sides
    of a piece are components of it; where they are one, the surface has one side only.
    """
    other = np.where(same, 0, n)
    ends = np.concatenate([first, first + n]), np.concatenate([second + other, second + n - other])
    graph = coo_array((np.ones(2 * len(first)), ends), shape=(2 * n, 2 * n))
    label = connected_components(graph, directed=False)[1]
    if (label[:n] == label[n:]).any():
        raise ValueError(f"faces of object {name} point to both sides: they must have two sides, got a one-sided strip")
    least = np.minimum(label[:n], label[n:])
    return np.unique(least, return_inverse=True)[1].reshape(-1), np.where(label[:n] == least, 1.0, -1.0)
