"""Signed distances put together from primitives, closed meshes of their zero level, and random shapes of them."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from halfspace_sss.checks import check_choice, check_count
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


# --------------------------------------------------------------------------------------------------
# Random shapes by a seed: signed distances put together at random and meshed. Lengths are of the order of one.
#
# Families of training and those that are held out share no generator.


Made = tuple[Distance, Box]
Family = Callable[[np.random.Generator], Made]


def margin(low: np.ndarray, high: np.ndarray) -> Box:
    """The box from low to high with a margin of 6 % of its longest side."""
    low, high = np.asarray(low, float), np.asarray(high, float)
    wide = 0.06 * float((high - low).max())
    return Box(tuple((low - wide).tolist()), tuple((high + wide).tolist()))


def turned_points(p: np.ndarray, angles: np.ndarray) -> np.ndarray:
    for axis, angle in enumerate(angles):
        p = rotated(p, axis, angle)
    return p


def box(p: np.ndarray, half: np.ndarray, rounding: float = 0.0) -> np.ndarray:
    """Distance to a box about the origin with half its sides, edges rounded."""
    q = np.abs(p) - (np.asarray(half) - rounding)
    return length(*np.moveaxis(np.maximum(q, 0), -1, 0)) + np.minimum(q.max(axis=-1), 0) - rounding


def blobs(rng: np.random.Generator) -> Made:
    """Ellipsoids and rods that are blended."""
    n, blend = int(rng.integers(1, 6)), rng.uniform(0.01, 0.3)
    centres, radii = rng.normal(0, 0.4, (n, 3)), np.exp(rng.uniform(np.log(0.12), np.log(0.6), (n, 3)))
    angles = rng.uniform(-np.pi, np.pi, (n, 3))
    rods = rng.normal(0, 0.6, (int(rng.integers(0, 3)), 2, 3))
    thin = rng.uniform(0.06, 0.25, (len(rods), 2))

    def distance(p: np.ndarray) -> np.ndarray:
        d = np.full(p.shape[:-1], 10.0)
        for c, r, a in zip(centres, radii, angles):
            d = join(d, ellipsoid(turned_points(p - c, a), tuple(r)), blend)
        for (a, b), (r_a, r_b) in zip(rods, thin):
            d = join(d, capsule(p, a, b, r_a, r_b), blend)
        return d

    points = np.concatenate([centres - radii.max(1, keepdims=True), centres + radii.max(1, keepdims=True)])
    ends = rods.reshape(-1, 3)
    points = np.concatenate([points, ends - 0.3, ends + 0.3])
    return distance, margin(points.min(0) - blend, points.max(0) + blend)


def boxes(rng: np.random.Generator) -> Made:
    """Boxes put together or cut out of the first, with edges from sharp to round."""
    n, blend = int(rng.integers(1, 5)), float(rng.choice([0.0, 0.0, rng.uniform(0.02, 0.2)]))
    halves = np.exp(rng.uniform(np.log(0.1), np.log(0.7), (n, 3)))
    centres, angles = rng.normal(0, 0.35, (n, 3)), rng.uniform(-0.6, 0.6, (n, 3))
    away, rounding = rng.random(n) < 0.35, float(rng.choice([0.0, rng.uniform(0, 0.09)]))
    centres[0], away[0] = 0, False

    def distance(p: np.ndarray) -> np.ndarray:
        d = np.full(p.shape[:-1], 10.0)
        for c, h, a, gone in zip(centres, halves, angles, away):
            part = box(turned_points(p - c, a), h, min(rounding, 0.9 * h.min()))
            d = cut(d, part, blend) if gone else join(d, part, blend)
        return d

    reach = np.linalg.norm(halves, axis=1, keepdims=True)
    return distance, margin((centres - reach).min(0) - blend, (centres + reach).max(0) + blend)


def sheets(rng: np.random.Generator) -> Made:
    """A thin plate, wavy, of uneven thickness, with a rim."""
    half, thick = rng.uniform(0.4, 1.0, 2), np.exp(rng.uniform(np.log(0.035), np.log(0.2)))
    waves, phase, high = rng.uniform(0.5, 4, 2), rng.uniform(0, 6, 2), rng.uniform(0, 0.2)
    uneven, seed, taper = rng.uniform(0, 0.4), int(rng.integers(1, 10**6)), rng.uniform(0, 0.6)

    def distance(p: np.ndarray) -> np.ndarray:
        x, y, z = np.moveaxis(p, -1, 0)
        middle = high * (np.sin(waves[0] * x + phase[0]) + np.sin(waves[1] * y + phase[1]))
        wide = thick * (1 + uneven * fbm(2 * p, seed, 2)) * (1 - taper * np.clip(x / half[0] * 0.5 + 0.5, 0, 1))
        slope = 1 + high * waves.max()
        off = np.stack([x, y, (z - middle) / slope], axis=-1)
        return box(off, np.array([half[0], half[1], thick]), 0.9 * thick) + 0.5 * (thick - wide)

    reach = (half[0], half[1], 2 * high + 2.5 * thick)
    return distance, margin(-np.array(reach), np.array(reach))


def shells(rng: np.random.Generator) -> Made:
    """A bowl: an ellipsoid hollowed out and opened by a plane."""
    radii, thick = rng.uniform(0.4, 0.8, 3), np.exp(rng.uniform(np.log(0.035), np.log(0.2)))
    level, tilt, blend = rng.uniform(-0.4, 0.5), rng.uniform(-np.pi, np.pi, 3), rng.uniform(0.0, 0.05)

    def distance(p: np.ndarray) -> np.ndarray:
        outer = ellipsoid(p, tuple(radii))
        hollow = np.abs(outer + thick) - thick
        return overlap(hollow, turned_points(p, tilt)[..., 2] - level * radii.min(), blend)

    return distance, margin(-radii - blend, radii + blend)


def ribbons(rng: np.random.Generator) -> Made:
    """A twisted bar of any section, straight or bent."""
    wide, thick = rng.uniform(0.12, 0.5), np.exp(rng.uniform(np.log(0.04), np.log(0.25)))
    turns, bend, tall = rng.uniform(-3, 3), rng.uniform(0, 0.4), rng.uniform(0.5, 1.0)
    phase = rng.uniform(0, 6)

    def distance(p: np.ndarray) -> np.ndarray:
        q = np.array(p)
        q[..., 0] -= bend * np.sin(2 * p[..., 1] + phase)
        q = twisted(q, turns)
        slope = np.sqrt(1 + (turns * wide) ** 2 + (2 * bend) ** 2)
        return box(q, np.array([wide, tall, thick]), 0.5 * min(thick, wide)) / slope

    reach = np.array([wide + thick + bend, tall, wide + thick])
    return distance, margin(-reach, reach)


def tori(rng: np.random.Generator) -> Made:
    """One or two rings, with a ball in it or not."""
    n, blend = int(rng.integers(1, 3)), rng.uniform(0.0, 0.15)
    major = rng.uniform(0.35, 0.7, n)
    minor = np.exp(rng.uniform(np.log(0.06), np.log(0.3), n))
    angles, centres = rng.uniform(-np.pi, np.pi, (n, 3)), rng.normal(0, 0.2, (n, 3))
    ball = rng.uniform(0.15, 0.5) if rng.random() < 0.4 else 0.0

    def distance(p: np.ndarray) -> np.ndarray:
        d = length(*np.moveaxis(p, -1, 0)) - ball if ball else np.full(p.shape[:-1], 10.0)
        for R, r, a, c in zip(major, minor, angles, centres):
            x, y, z = np.moveaxis(turned_points(p - c, a), -1, 0)
            d = join(d, length(length(x, y) - R, z) - r, blend)
        return d

    reach = (np.abs(centres) + (major + minor)[:, None]).max(0) + blend
    return distance, margin(-np.maximum(reach, ball), np.maximum(reach, ball))


def combs(rng: np.random.Generator) -> Made:
    """A base with teeth: rods that taper, close to each other."""
    n, high = int(rng.integers(3, 9)), rng.uniform(0.3, 0.9)
    base = np.array([rng.uniform(0.5, 0.9), rng.uniform(0.06, 0.25), rng.uniform(0.1, 0.35)])
    feet = np.stack([rng.uniform(-1, 1, n) * base[0] * 0.85, np.zeros(n), rng.uniform(-1, 1, n) * base[2] * 0.7], -1)
    tips = feet + np.stack([rng.normal(0, 0.12, n), high * rng.uniform(0.5, 1, n), rng.normal(0, 0.12, n)], -1)
    radii = np.stack([rng.uniform(0.05, 0.16, n), rng.uniform(0.03, 0.1, n)], -1)
    blend = rng.uniform(0, 0.1)

    def distance(p: np.ndarray) -> np.ndarray:
        d = box(p, base, 0.8 * base.min())
        for foot, tip, (a, b) in zip(feet, tips, radii):
            d = join(d, capsule(p, foot, tip, a, b), blend)
        return d

    points = np.concatenate([feet - 0.2, tips + 0.2, tips - 0.2, [base, -base]])
    return distance, margin(points.min(0) - blend, points.max(0) + blend)


def rocks(rng: np.random.Generator) -> Made:
    """An ellipsoid made rough, cut or with holes."""
    radii, seed = rng.uniform(0.3, 0.9, 3), int(rng.integers(1, 10**6))
    waves, rough = rng.uniform(1.5, 5), rng.uniform(0.02, 0.3)
    holes = rng.normal(0, 0.45, (int(rng.integers(0, 4)), 3))
    sizes = rng.uniform(0.1, 0.35, len(holes))

    def distance(p: np.ndarray) -> np.ndarray:
        d = (ellipsoid(p, tuple(radii)) + rough * radii.min() * fbm(waves * p, seed, 3)) / (1 + rough)
        for c, r in zip(holes, sizes):
            d = cut(d, length(*np.moveaxis(p - c, -1, 0)) - r, 0.03)
        return d

    return distance, margin(-radii - rough, radii + rough)


TRAINING: dict[str, Family] = {f.__name__: f for f in (blobs, boxes, sheets, shells, ribbons, tori, combs, rocks)}
TRIES = 8


def make_shape(family: str, seed: int, resolution: int = 48, families: Mapping[str, Family] = TRAINING) -> Mesh:
    """A random shape of a family.
    `family`: its name in `families`. `seed`: whole number >= 0. `resolution`: grid cubes along its longest side, >= 8.
    `families`: generators by name. ValueError if an argument is out of range, or no shape of that family came out in
    eight tries."""
    check_choice("family", family, tuple(families))
    check_count("seed", seed, 0)
    check_count("resolution", resolution, 8)
    refusal: ValueError | None = None
    for k in range(TRIES):
        distance, box = families[family](np.random.default_rng([seed, k]))
        try:
            return surface(distance, box, resolution)
        except ValueError as error:
            refusal = error
    raise ValueError(f"seed must give a shape of the family {family!r}, got {seed!r}: {refusal}")
