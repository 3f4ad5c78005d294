"""Faces, positions, normals and texture coordinates of Mitsuba's meshes.

All other files ask here, as Mitsuba 3.10 gives the parameters of meshes other names and turns the faces of a mesh with
`flip_normals` when it loads them; `tests/rendering/test_mesh.py` says what to change then.
"""

from __future__ import annotations

from collections.abc import Iterator

import mitsuba as mi
import numpy as np

POSITIONS, NORMALS, TEXCOORDS, FACES = "vertex_positions", "vertex_normals", "vertex_texcoords", "faces"
GEOMETRY = (POSITIONS, NORMALS, FACES)  # parameters that say where a mesh is


def has_faces(shape: mi.Shape) -> bool:
    """Whether a shape is a mesh with faces that can be read."""
    return FACES in mi.traverse(shape)


def face_vertices(shape: mi.Shape) -> np.ndarray:
    """The numbers of the vertices of each face, shape (faces, 3)."""
    return np.array(mi.traverse(shape)[FACES]).reshape(-1, 3)


def vertex_positions(shape: mi.Shape) -> np.ndarray:
    """The positions of the vertices, shape (vertices, 3), float32."""
    return np.array(mi.traverse(shape)[POSITIONS]).reshape(-1, 3)


def face_corners(shape: mi.Shape, dtype: type = float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The positions of the first, second and third corner of each face, shapes (faces, 3)."""
    a, b, c = vertex_positions(shape).astype(dtype)[face_vertices(shape)].transpose(1, 0, 2)
    return a, b, c


def vertex_normals(shape: mi.Shape) -> np.ndarray:
    """The normals of the vertices, shape (vertices, 3), float32."""
    return np.array(mi.traverse(shape)[NORMALS]).reshape(-1, 3)


def bend_of_normals(mesh: mi.Shape) -> float:
    """How far normals of vertices are from those of the faces about them, radians: mean over corners, by area."""
    if not mesh.has_vertex_normals():
        return 0.0
    a, b, c = face_corners(mesh)
    n, m = np.cross(b - a, c - a), vertex_normals(mesh)[face_vertices(mesh)]
    area = np.linalg.norm(n, axis=1)
    size = area[:, None] * np.linalg.norm(m, axis=2)
    cosines = np.abs(np.einsum("fi,fki->fk", n, m)) / np.where(size > 0, size, 1)
    angles = np.where(size > 0, np.arccos(np.minimum(cosines, 1)), 0)
    return float(angles.mean(axis=1) @ area / max(area.sum(), np.finfo(float).tiny))


def set_vertex_normals(mesh: mi.Mesh, normals: np.ndarray) -> None:
    """Replace the normals of the vertices by others, shape (vertices, 3)."""
    parameters = mi.traverse(mesh)
    parameters[NORMALS] = mi.Float(normals.ravel().astype(np.float32))
    parameters.update()


def fill(mesh: mi.Mesh, positions: np.ndarray, faces: np.ndarray) -> None:
    """Set positions of vertices, shape (vertices, 3), and their numbers at faces, shape (faces, 3), of a new mesh."""
    parameters = mi.traverse(mesh)
    parameters[POSITIONS] = positions.astype(np.float32).ravel()
    parameters[FACES] = faces.astype(np.uint32).ravel()
    parameters.update()


def is_flipped(shape: mi.Shape) -> bool:
    """Whether Mitsuba turns the normals of a shape to the other side, as `flip_normals` asks."""
    return shape.has_flipped_normals()


def attributes(shape: mi.Shape) -> Iterator[tuple[str, np.ndarray]]:
    """Texture coordinates and attributes of vertices and faces, in the order of their names."""
    for key, value in sorted(mi.traverse(shape).items()):
        if key.startswith(("vertex_", "face_")) and key not in (POSITIONS, NORMALS, "vertex_count"):
            yield key, np.array(value)


def vertices_of(mesh: mi.Mesh, face: mi.UInt32, active: mi.Bool | bool = True) -> mi.Vector3u:
    """The numbers of the vertices of a face in each lane."""
    return mesh.face_indices(face, active)


def positions_at(mesh: mi.Mesh, vertices: mi.Vector3u, active: mi.Bool | bool = True) -> list[mi.Point3f]:
    """The positions of three vertices in each lane."""
    return [mesh.vertex_position(i, active) for i in vertices]


def normals_at(mesh: mi.Mesh, vertices: mi.Vector3u, active: mi.Bool | bool = True) -> list[mi.Normal3f]:
    """The normals of three vertices in each lane."""
    return [mesh.vertex_normal(i, active) for i in vertices]


def texcoords_at(mesh: mi.Mesh, vertices: mi.Vector3u, active: mi.Bool | bool = True) -> list[mi.Point2f]:
    """The texture coordinates of three vertices in each lane."""
    return [mesh.vertex_texcoord(i, active) for i in vertices]
