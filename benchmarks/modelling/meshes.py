"""Signed distances put together from primitives, and closed meshes of their zero level."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from halfspace_sss.checks import check_count
from halfspace_sss.provenance import write_atomically

if TYPE_CHECKING:
    import mitsuba as mi

# ----------------------------------------------------------------------------------------------------
# Signed distances: primitives, how they are joined, bent and made rough; points (..., 3) in mm, y up, inside < 0.
# Most are bounds rather than distances where primitives were joined or displaced; the surface is where they are zero.


_GRADIENTS = np.array(
    [(1, 1, 0), (-1, 1, 0), (1, -1, 0), (-1, -1, 0), (1, 0, 1), (-1, 0, 1), (1, 0, -1), (-1, 0, -1), (0, 1, 1)]
    + [(0, -1, 1), (0, 1, -1), (0, -1, -1), (1, 1, 0), (-1, 1, 0), (0, -1, 1), (0, -1, -1)],
    dtype=np.float32,
)  # Perlin 2002


def length(*components: np.ndarray) -> np.ndarray:
    """Euclidean norm of a vector given by its components."""
    return np.sqrt(sum(c * c for c in components))


def smoothstep(low: float, high: float, x: np.ndarray) -> np.ndarray:
    """0 below low, 1 above high, 3 t² - 2 t³ between; falling where low > high."""
    t = np.clip((x - low) / (high - low), 0, 1)
    return t * t * (3 - 2 * t)


def ellipsoid(p: np.ndarray, radii: tuple[float, float, float]) -> np.ndarray:
    """Ellipsoid about the origin: k (k - 1) / |p / r²|, k = |p / r|; exact to first order at the surface."""
    r = np.asarray(radii)
    k = length(*np.moveaxis(p / r, -1, 0))
    gradient = length(*np.moveaxis(p / r**2, -1, 0))
    return k * (k - 1) / np.maximum(gradient, 1e-6)


def capsule(p: np.ndarray, a: np.ndarray, b: np.ndarray, radius_a: float, radius_b: float) -> np.ndarray:
    """A rod from a to b with round ends, whose radius goes from radius_a to radius_b."""
    a, along = np.asarray(a, dtype=float), np.asarray(b, dtype=float) - np.asarray(a, dtype=float)
    t = np.clip((p - a) @ along / max(float(along @ along), 1e-12), 0, 1)
    off = p - a - t[..., None] * along
    return length(*np.moveaxis(off, -1, 0)) - (radius_a + (radius_b - radius_a) * t)


def join(a: np.ndarray, b: np.ndarray, blend: float = 0.0) -> np.ndarray:
    """Union; with blend > 0 (mm) the crease is filled: min(a, b) - h²/(4 blend), h = max(blend - |a - b|, 0)."""
    distance = np.minimum(a, b)
    if blend > 0:
        distance = distance - np.maximum(blend - np.abs(a - b), 0) ** 2 / (4 * blend)
    return distance


def overlap(a: np.ndarray, b: np.ndarray, blend: float = 0.0) -> np.ndarray:
    """Intersection, its edge rounded over `blend` mm."""
    return -join(-a, -b, blend)


def cut(a: np.ndarray, b: np.ndarray, blend: float = 0.0) -> np.ndarray:
    """a without b, its edge rounded over `blend` mm."""
    return overlap(a, -b, blend)


def rotated(p: np.ndarray, axis: int, angle: float) -> np.ndarray:
    """Points turned about an axis (0 x, 1 y, 2 z) by an angle, radians, right-handed."""
    i, j = [(1, 2), (2, 0), (0, 1)][axis]
    turned, c, s = np.array(p), np.cos(angle), np.sin(angle)
    turned[..., i], turned[..., j] = c * p[..., i] - s * p[..., j], s * p[..., i] + c * p[..., j]
    return turned


def twisted(p: np.ndarray, per_mm: float) -> np.ndarray:
    """Points turned about y by an angle in proportion to their height, radians per mm."""
    angle = per_mm * p[..., 1]
    c, s = np.cos(angle), np.sin(angle)
    x, z = p[..., 0], p[..., 2]
    return np.stack([c * x - s * z, p[..., 1], s * x + c * z], axis=-1)


def _hash(i: np.ndarray, j: np.ndarray, k: np.ndarray, seed: int) -> np.ndarray:
    """Bits of a lattice point, uint32."""
    salt = np.uint32((seed * 0x27D4EB2F + 0x165667B1) & 0xFFFFFFFF)
    h = i.astype(np.uint32) * np.uint32(0x8DA6B343) ^ j.astype(np.uint32) * np.uint32(0xD8163841)
    h = (h ^ k.astype(np.uint32) * np.uint32(0xCB1AB31F)) + salt
    h = (h ^ (h >> np.uint32(15))) * np.uint32(0x2C1B3C6D)
    h = (h ^ (h >> np.uint32(12))) * np.uint32(0x297A2D39)
    return h ^ (h >> np.uint32(15))


def noise(p: np.ndarray, seed: int) -> np.ndarray:
    """Gradient noise of wavelength about 1 with values about in [-1, 1] (Perlin 2002); scale p to choose the size."""
    corner = np.floor(p)
    f = (p - corner).astype(np.float32)
    lattice = corner.astype(np.int64)
    fade = f * f * f * (f * (f * 6 - 15) + 10)
    total = np.zeros(p.shape[:-1], np.float32)
    for corner_index in range(8):
        d = np.array([corner_index & 1, corner_index >> 1 & 1, corner_index >> 2 & 1])
        gradient = _GRADIENTS[_hash(*np.moveaxis(lattice + d, -1, 0), seed) & np.uint32(15)]
        weight = np.prod(np.where(d, fade, 1 - fade), axis=-1)
        total += weight * np.sum(gradient * (f - d.astype(np.float32)), axis=-1)
    return total


def fbm(p: np.ndarray, seed: int, octaves: int = 3) -> np.ndarray:
    """Sum over k of 2^-k noise(2^k p), k < octaves."""
    return sum(0.5**k * noise(p * 2**k, seed + 7919 * k) for k in range(octaves))


def ridges(p: np.ndarray, seed: int, octaves: int = 2) -> np.ndarray:
    """1 on the sheets where fbm is zero, falling to 0 away from them: 1 - |fbm|, at least 0."""
    return np.clip(1 - np.abs(fbm(p, seed, octaves)), 0, 1)


def ring_noise(angle: np.ndarray, seed: int) -> np.ndarray:
    """Smooth periodic noise of an angle (radians) in [-1, 1]: the first four harmonics with random phase."""
    rng, waves = np.random.default_rng([seed, 11]), 4
    amplitude, phase = rng.uniform(0.4, 1, waves) / np.arange(1, waves + 1), rng.uniform(0, 2 * np.pi, waves)
    harmonics = (a * np.sin((k + 1) * angle + c) for k, (a, c) in enumerate(zip(amplitude, phase)))
    return sum(harmonics) / amplitude.sum()


def cells(p: np.ndarray, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Distance to the nearest and to the second nearest of random points, one per unit cube, and the nearest's number.
    The number is in [0, 1) (Worley 1996)."""
    lattice = np.floor(p).astype(np.int64)
    first, second = np.full((2, *p.shape[:-1]), np.inf)
    number = np.zeros(p.shape[:-1])
    for d in np.ndindex(3, 3, 3):
        at = np.moveaxis(lattice + np.array(d) - 1, -1, 0)
        bits = [_hash(*at, seed + 101 * axis) for axis in range(3)]
        jitter = np.stack([b.astype(np.float64) / 2**32 for b in bits], axis=-1)
        r = length(*np.moveaxis(np.moveaxis(at, 0, -1) + jitter - p, -1, 0))
        number = np.where(r < first, bits[0] / 2**32, number)
        second = np.minimum(second, np.maximum(first, r))
        first = np.minimum(first, r)
    return first, second, number


# ---- Surfaces of signed distances as watertight triangle meshes, for Mitsuba and as PLY files ------

LEAST_RESOLUTION = 8
COARSE = 4  # cells of the first look in one of the grid
CHUNK = 2**18  # points at a time
LEAST_VALUE = 0.02  # of a cell: corners nearer to the surface are moved off it, where triangles would degenerate
SMALLEST = 30.0  # cells of volume: pieces below are left out
Distance = Callable[[np.ndarray], np.ndarray]


@dataclass(frozen=True)
class Box:
    """An axis-aligned box, mm."""

    low: tuple[float, float, float]
    high: tuple[float, float, float]

    def cell(self, resolution: int) -> float:
        """Edge of the cubes of a grid with `resolution` of them along the longest side, mm."""
        check_count("resolution", resolution, LEAST_RESOLUTION)
        return max(np.subtract(self.high, self.low)) / resolution

    def counts(self, cell: float) -> np.ndarray:
        """Cubes of that edge that cover the box along x, y and z."""
        return np.ceil(np.subtract(self.high, self.low) / cell - 1e-9).astype(int)


@dataclass(frozen=True, eq=False)
class Mesh:
    """A closed surface of triangles. `vertices`: (n, 3), mm. `faces`: (m, 3) indices, counterclockwise seen from
    outside. ValueError if an edge is not shared by two faces that run along it in opposite directions, a triangle has
    no area, or the volume is not above 0, which faces wound inwards give."""

    vertices: np.ndarray
    faces: np.ndarray

    def __post_init__(self) -> None:
        edges = np.concatenate([self.faces[:, [0, 1]], self.faces[:, [1, 2]], self.faces[:, [2, 0]]])
        keys = edges[:, 0] * len(self.vertices) + edges[:, 1]
        back = edges[:, 1] * len(self.vertices) + edges[:, 0]
        if len(np.unique(keys)) != len(keys) or not np.array_equal(np.sort(keys), np.sort(back)):
            lost = int((~np.isin(keys, back)).sum() + len(keys) - len(np.unique(keys)))
            raise ValueError(f"mesh must share each edge between two faces wound alike, got {lost} edges that are not")
        smallest = self.areas.min() if len(self.faces) else 0.0
        if not smallest > 0:
            raise ValueError(f"areas of triangles must be > 0, got {smallest}")
        if not self.volume > 0:
            raise ValueError(f"volume must be > 0, as it is where faces are wound outwards, got {self.volume}")

    @property
    def areas(self) -> np.ndarray:
        a, b, c = np.moveaxis(self.vertices[self.faces], 1, 0)
        return 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)

    @property
    def volume(self) -> float:
        """The volume that the surface encloses, mm³: the sum of a.(b x c) / 6."""
        a, b, c = np.moveaxis(self.vertices[self.faces], 1, 0)
        return float(np.einsum("ij,ij->", a, np.cross(b, c)) / 6)

    def mitsuba(self, name: str) -> mi.Mesh:
        """The mesh as a diffuse shape of Mitsuba, with smooth normals.
        Normals by libigl: Mitsuba adds them up in the order of its threads, which differs in the last bit."""
        import igl
        import mitsuba as mi

        from full_geometry.geometry.mesh import fill, set_vertex_normals

        mesh = mi.Mesh(name, len(self.vertices), len(self.faces), has_vertex_normals=True)
        fill(mesh, self.vertices, self.faces)
        normals = igl.per_vertex_normals(self.vertices, self.faces, igl.PER_VERTEX_NORMALS_WEIGHTING_TYPE_ANGLE)
        set_vertex_normals(mesh, normals)
        return mesh

    def write_ply(self, path: str | os.PathLike[str]) -> Path:
        """Write the mesh as a binary PLY file, whole or not at all; the same mesh gives the same bytes."""
        header = (
            "ply\nformat binary_little_endian 1.0\ncomment lengths in mm\n"
            f"element vertex {len(self.vertices)}\nproperty float x\nproperty float y\nproperty float z\n"
            f"element face {len(self.faces)}\nproperty list uchar int vertex_indices\nend_header\n"
        )
        rows = np.empty(len(self.faces), dtype=[("n", "u1"), ("v", "<i4", 3)])
        rows["n"], rows["v"] = 3, self.faces
        content = header.encode() + self.vertices.astype("<f4").tobytes() + rows.tobytes()
        write_atomically(Path(path), content)
        return Path(path)


def surface(distance: Distance, box: Box, resolution: int) -> Mesh:
    """The surface distance = 0 by marching cubes (Lorensen and Cline 1987, in libigl).

    The distance is first looked at on a grid four times as coarse and again where that leaves the surface near, so the
    work grows with the area of the surface. Pieces and bubbles of less than 30 cells are left out.

    Args:
        distance: of points (n, 3), mm, < 0 inside; about a distance: it must not change faster than twice one.
        box: holds the surface.
        resolution: cubes along the longest side of the box, >= 8.

    Raises:
        ValueError: the resolution is too small, the surface reaches the edge of the box or is empty, or the mesh is not
            closed.
    """
    import igl

    cell = box.cell(resolution)
    coarse = -(-box.counts(cell) // COARSE)
    counts = COARSE * coarse + 1
    points = _lattice(box.low, cell, counts)
    values = _values(distance, points, box.low, cell, coarse, counts)
    inner = values.reshape(counts[::-1])[1:-1, 1:-1, 1:-1]
    if (values <= 0).sum() != (inner <= 0).sum():
        raise ValueError(f"box must hold the surface, which reaches the edge of {box}")
    vertices, faces, _ = igl.marching_cubes(values, points, *(int(n) for n in counts), 0.0)
    if len(faces) == 0:
        raise ValueError(f"box must hold a surface, got none in {box} at resolution {resolution}")
    # libigl winds faces towards rising values or against, by the order of the grid's axes
    a, b, c = np.moveaxis(vertices[faces], 1, 0)
    if np.einsum("ij,ij->", a, np.cross(b, c)) < 0:
        faces = faces[:, ::-1]
    return Mesh(*_without_crumbs(vertices, np.ascontiguousarray(faces), SMALLEST * cell**3))


def _without_crumbs(vertices: np.ndarray, faces: np.ndarray, least: float) -> tuple[np.ndarray, np.ndarray]:
    """The mesh without its pieces, or bubbles inside, whose volume is below `least`, mm³."""
    import igl

    pieces, label, _ = igl.connected_components(igl.adjacency_matrix(faces))
    a, b, c = np.moveaxis(vertices[faces], 1, 0)
    volume = np.bincount(label[faces[:, 0]], np.einsum("ij,ij->i", a, np.cross(b, c)) / 6, minlength=pieces)
    faces = faces[np.abs(volume)[label[faces[:, 0]]] >= least]
    used, number = np.unique(faces, return_inverse=True)
    return vertices[used], number.reshape(-1, 3)


def _lattice(low: tuple[float, float, float], step: float, counts: np.ndarray) -> np.ndarray:
    """Corners of a grid, x fastest, (n, 3)."""
    x, y, z = (start + step * np.arange(n) for start, n in zip(low, counts))
    return np.stack(np.broadcast_arrays(x[None, None], y[None, :, None], z[:, None, None]), axis=-1).reshape(-1, 3)


def _values(
    distance: Distance, points: np.ndarray, low: tuple, cell: float, coarse: np.ndarray, counts: np.ndarray
) -> np.ndarray:
    """The distance at the corners of the fine grid, exact near the surface, interpolated far from it."""
    from scipy.ndimage import map_coordinates

    first = in_chunks(distance, _lattice(low, COARSE * cell, coarse + 1)).reshape((coarse + 1)[::-1])
    at = np.meshgrid(*(np.arange(n) / COARSE for n in counts[::-1]), indexing="ij")
    values = map_coordinates(first, at, order=1).ravel()
    near = np.abs(values) < np.sqrt(3) * COARSE * cell
    values[near] = in_chunks(distance, points[near])
    least = LEAST_VALUE * cell
    return np.where(np.abs(values) < least, np.where(values < 0, -least, least), values)


def in_chunks(function: Callable[[np.ndarray], np.ndarray], points: np.ndarray) -> np.ndarray:
    """The function of many points, some at a time."""
    parts = [function(points[k : k + CHUNK]) for k in range(0, max(len(points), 1), CHUNK)]
    return np.concatenate(parts).astype(np.float64)
