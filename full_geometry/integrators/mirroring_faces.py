"""Where faces of meshes mirror small emitters towards a camera, however small the reflection is."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from full_geometry.geometry import mesh
from full_geometry.geometry.points import of_rows
from full_geometry.objects.small_emitters import SmallEmitters
from full_geometry.precomputed.lit_points import to_world
from full_geometry.walk.media import WalkMedia

TINY = 1 / 4  # pixels of a reflection that rays through pixels and their neighbours miss
CURVED, LEVELS = 0.2, 9  # part of the spread of mirrored directions of a face that is not linear; times it is divided
CLEAR = 1e-3  # of the way to the camera, which begins so far off a face and ends so far before the camera
AT_ONCE = 2**16  # faces
CAMERAS = "PerspectiveCamera", "ThinLensCamera"


def mirroring_faces(scene: mi.Scene, media: WalkMedia, small: SmallEmitters | None, sensor: mi.Sensor) -> np.ndarray:
    """Corners of triangles in the image that hold reflections of less than TINY pixels, (n, 3, 2), pixels.
    Smooth objects that are meshes have some, seen by a perspective camera. What hides a corner hides all."""
    found = [np.empty((0, 3, 2))]
    if small is None or sensor.class_name() not in CAMERAS:
        return found[0]
    eye = np.array(sensor.world_transform().translation(), dtype=float).ravel()
    for k, kind in enumerate(media.instance_table.kind):
        shape = media.instance_table.shapes[kind]
        if not mesh.has_faces(shape) or bool(np.array(media.row("rough", mi.Int32(k)))[0]):
            continue
        faces, vertices = mesh.face_vertices(shape), _vertices(shape, to_world(media, k))
        for first in range(0, len(faces), AT_ONCE):
            # ---- faces in the image, which may mirror
            p, n = (v[faces[first : first + AT_ONCE]] if len(v) else v for v in vertices)
            a, b, c = np.moveaxis(_projected(sensor, p)[0], 1, 0)
            area = 0.5 * np.abs((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0])
            if len(n) == 0:
                n = np.broadcast_to(np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0])[:, None], p.shape)
            p, n, area = (v[area > 0] for v in (p, n, area))
            triangles = [_mirroring(small, number, eye, p, n, area) for number in range(small.n_delta, len(small))]
            triangles = np.concatenate([p[:0], *triangles])
            if len(triangles) == 0:
                continue

            # ---- their triangles that nothing is before
            place, way = _projected(sensor, triangles)
            o = of_rows(mi.Point3f, triangles.reshape(-1, 3)) + CLEAR * way
            hidden = np.array(scene.ray_test(mi.Ray3f(o, way, 1 - 2 * CLEAR, 0.0, []))).reshape(-1, 3).any(axis=1)
            found.append(place[~hidden & np.isfinite(place).all(axis=(1, 2))])
    return np.concatenate(found)


def _projected(sensor: mi.Sensor, p: np.ndarray) -> tuple[np.ndarray, mi.Vector3f]:
    """Where corners (n, 3, 3) are in the image, (n, 3, 2) in pixels, NaN outside, and the ways from them to the camera,
    one after the other."""
    at = dr.zeros(mi.Interaction3f, 3 * len(p))
    at.p = of_rows(mi.Point3f, p.reshape(-1, 3))
    ds, _ = sensor.sample_direction(at, mi.Point2f(0.5))
    return np.array(dr.select(ds.pdf > 0, ds.uv, dr.nan)).T.reshape(-1, 3, 2), ds.d * ds.dist


def _mirroring(
    small: SmallEmitters, number: int, eye: np.ndarray, p: np.ndarray, n: np.ndarray, area: np.ndarray
) -> np.ndarray:
    """Corners of triangles on faces that mirror an emitter towards the camera in less than TINY pixels, (n, 3, 3).
    `p`, `n`: corners of the faces and their normals, (faces, 3, 3). `area`: that they have in the image, pixels.

    A point x with the normal n mirrors the direction r = d - 2 (d.n) n, d from the camera. It misses the direction w to
    the emitter by e = r - (r.w) w, and mirrors this where that is shorter than its radius. Between the corners of a
    face e is linear but for a part of its spread. Faces with the rim of an emitter are divided into four until their
    spread is below the radius.
    """
    k, found = dr.opaque(mi.UInt32, number), [p[:0]]
    for level in range(LEVELS + 1):
        if len(p) == 0:
            break
        # ---- e of the corners, and the radius
        d = p - eye
        d /= np.linalg.norm(d, axis=-1, keepdims=True)
        m = n / np.maximum(np.linalg.norm(n, axis=-1, keepdims=True), 1e-30)
        r, at = d - 2 * (d * m).sum(axis=-1, keepdims=True) * m, of_rows(mi.Point3f, p.reshape(-1, 3))
        zero = dr.zeros(mi.Float, dr.width(at))
        w = np.array(small.direction(k, at)[0] + zero).T.reshape(p.shape)
        radius = np.array(dr.sqrt(small.angle2(k, at)) + zero).reshape(-1, 3).max(axis=1)
        cosine = (r * w).sum(axis=-1, keepdims=True)
        e = r - cosine * w

        # ---- the faces where it is shorter: none whose first corner is farther off than e spreads
        spread, curved = np.linalg.norm(e - np.roll(e, 1, axis=1), axis=-1).max(axis=1), CURVED / 2**level
        near = np.linalg.norm(e[:, 0], axis=-1) < radius + (1 + curved) * spread
        near &= cosine.max(axis=(1, 2)) > 0
        p, n, e, radius, spread = (v[near] for v in (p, n, e, radius, spread))
        b, size = _nearest(e), np.linalg.norm(e, axis=-1).max(axis=1)
        meets = np.linalg.norm(np.einsum("fi,fix->fx", b, e), axis=1) < radius + curved * spread
        if level == 0:  # of the face it takes the share of pi radius² in the area of e
            of_e = 0.5 * np.linalg.norm(np.cross(e[:, 1] - e[:, 0], e[:, 2] - e[:, 0]), axis=1)
            meets &= area[near] * np.minimum(np.pi * radius**2 / np.maximum(of_e, 1e-30), 1) < TINY
        whole = (np.minimum(size, spread) < radius) | (level == LEVELS)
        found.append(p[meets & whole])
        p, n = (_quarters(v[meets & ~whole]) for v in (p, n))
    return np.concatenate(found)


def _quarters(x: np.ndarray) -> np.ndarray:
    """The four parts of triangles by the middles of their edges: corners (4 n, 3, 3) from (n, 3, 3)."""
    a, b, c = x[:, 0], x[:, 1], x[:, 2]
    ab, bc, ca = 0.5 * (a + b), 0.5 * (b + c), 0.5 * (c + a)
    return np.concatenate([np.stack(part, axis=1) for part in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))])


def _vertices(shape: mi.Shape, to_world: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Vertices of a mesh in the world, (n, 3), and their normals there, (0, 3) where faces show their own."""
    p, n = mesh.vertex_positions(shape), np.empty((0, 3), dtype=np.float32)
    if shape.has_vertex_normals():
        n = mesh.vertex_normals(shape) @ np.linalg.inv(to_world[:3, :3])
    return p @ to_world[:3, :3].T + to_world[:3, 3], n


def _nearest(x: np.ndarray) -> np.ndarray:
    """Barycentric coordinates of the point of triangles that is nearest to 0, (n, 3). `x`: corners, (n, 3, 3)."""
    # ---- of each edge, then of the whole where that has one
    best, size = np.zeros(x.shape[:2]), np.full(len(x), np.inf)
    for i, j in ((0, 1), (1, 2), (2, 0)):
        edge = x[:, j] - x[:, i]
        t = (-(x[:, i] * edge).sum(axis=1) / np.maximum((edge**2).sum(axis=1), 1e-30)).clip(0, 1)
        distance = np.linalg.norm(x[:, i] + t[:, None] * edge, axis=1)
        nearer = distance < size
        size[nearer], best[nearer] = distance[nearer], 0
        best[nearer, i], best[nearer, j] = 1 - t[nearer], t[nearer]
    u, v = x[:, 1] - x[:, 0], x[:, 2] - x[:, 0]
    uu, uv, vv, xu, xv = ((a * b).sum(axis=1) for a, b in ((u, u), (u, v), (v, v), (x[:, 0], u), (x[:, 0], v)))
    whole = np.maximum(uu * vv - uv**2, 1e-30)
    s, t = (uv * xv - vv * xu) / whole, (uv * xu - uu * xv) / whole
    inside = (s >= 0) & (t >= 0) & (s + t <= 1)
    best[inside] = np.stack([1 - s - t, s, t], axis=1)[inside]
    return best
