"""Points of a surface that hold what varies slowly over it, and a lookup that blends those near any place.

Points are random places at a distance from each other (Poisson disks), the first of them farther apart. Between them a
value is blended with the weights

    w_j = (1 - d_j² / h²)² max(n_j.n, 0)²,    d_j < h,

d_j the distance and n_j the normal of point j, so that the two sides of something thin stay apart. A uniform grid with
cells of the size h lists for each cell all points that some place in it can reach.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy.sparse import csr_array
from scipy.spatial import cKDTree

from full_geometry.geometry.points import (
    EntrySample,
    SurfacePoint,
    area_points,
    cosine_above,
    floats,
    lifted,
    of_rows,
    opaque,
)
from full_geometry.geometry.shape import Geometry
from halfspace_sss.arrays import aligned

PER_POINT, APART = 8, 0.735  # random places for each point; least distance of points over the mean of a square lattice
COARSEST, SEED = 64, 22  # places at the largest distance; seed of places
REACH = 2.0  # h over the mean distance of points
MOST_CELLS = 2**22
LIKE = 0.2  # difference of logarithms of colours that are blended
GOLDEN = 0.6180339887498949
R_3 = (0.8191725133961645, 0.6710436067037893, 0.5497004779019703)  # of three dimensions (Roberts 2018)


def lattice(count: int, roots: Sequence[float] = R_3, shift: Sequence[float] = (0.5, 0.5, 0.5)) -> list[np.ndarray]:
    """Low-discrepancy numbers in [0, 1), `count` of each root: multiples of these, shifted."""
    return [(np.arange(1, count + 1) * r + s) % 1.0 for r, s in zip(roots, shift)]


def uniform_entries(geometry: Geometry, u_face: mi.Float, u: mi.Point2f) -> EntrySample:
    """Points uniform over the area of an object."""
    at = area_points(geometry).sample(u_face, u, mi.Bool(True))
    face = mi.UInt32(at.prim_index) + dr.zeros(mi.UInt32, dr.width(u))
    n, n_out = at.outward(geometry.side(face))
    return EntrySample(mi.Point3f(at.p), n, mi.Normal3f(n_out), opaque(geometry.area), face)


@dataclass(frozen=True, eq=False)
class SurfacePoints:
    """Points of one object, and their grid.

    Args:
        p, n, n_out, face: positions, outward geometric and shading normals, faces.
        h: radius of the lookup, scene units.
        low: corner of the grid.
        cells: of the grid along each axis.
        first: of each cell the place in `members` of its first point; one more than cells.
        members: numbers of the points, cell by cell.
        tables: h, corners, cells, and the first cell in `first`, by the number of an object, of `joined` points.
    """

    p: mi.Point3f
    n: mi.Normal3f
    n_out: mi.Normal3f
    face: mi.UInt32
    h: float
    low: np.ndarray
    cells: np.ndarray
    first: mi.UInt32
    members: mi.UInt32
    tables: tuple | None = None

    @classmethod
    def of(cls, geometry: Geometry, count: int) -> SurfacePoints:
        """`count` points of an object."""
        return cls.drawn(lambda u: uniform_entries(geometry, u[0], mi.Point2f(u[1], u[2])), geometry.area, count)

    @classmethod
    def drawn(cls, draw: Callable[[list[mi.Float]], EntrySample], area: float, count: int) -> SurfacePoints:
        """`count` points of a surface that `draw` makes of three uniform numbers each."""
        # of random places some at a distance from each other, and all others near these
        at = draw([floats(v) for v in np.random.default_rng(SEED).random((3, PER_POINT * count)).astype(np.float32)])
        spacing = float(np.sqrt(area / count))
        kept = _apart(*(np.array(v, dtype=float).T for v in (at.p, at.n)), APART * spacing)
        p, n, n_out, face = dr.gather(tuple, (at.p, at.n, at.n_out, at.face), aligned(mi.UInt32, kept))
        dr.eval(p, n, n_out, face)
        return cls(p, n, n_out, face, *_grid(np.array(p).T, REACH * spacing))

    @classmethod
    def joined(cls, parts: Sequence[SurfacePoints]) -> SurfacePoints:
        """The points of several objects, which lookups tell apart by the number of the object."""
        # lists of cells and points one after the other; of each object h, low, cells, and where its cells begin
        starts, cells, members = (np.cumsum([0, *map(int, sizes)]) for sizes in (
            (len(part) for part in parts), (dr.width(part.first) for part in parts),
            (dr.width(part.members) for part in parts),
        ))  # fmt: skip
        first = aligned(mi.UInt32, np.concatenate([np.array(part.first) + m for part, m in zip(parts, members)]))
        listed = aligned(mi.UInt32, np.concatenate([np.array(part.members) + s for part, s in zip(parts, starts)]))
        rows = [type(v)(*(dr.concat([getattr(part, name)[a] for part in parts]) for a in range(3)))
                for name, v in (("p", parts[0].p), ("n", parts[0].n), ("n_out", parts[0].n_out))]  # fmt: skip
        rows.append(dr.concat([part.face for part in parts]))
        dr.make_opaque(rows)
        h, low = mi.Float([part.h for part in parts]), of_rows(mi.Point3f, np.stack([part.low for part in parts]))
        counts = mi.Vector3i(*(mi.Int32([int(part.cells[a]) for part in parts]) for a in range(3)))
        tables = h, low, counts, mi.UInt32(cells[:-1].tolist())
        dr.make_opaque(tables)
        return cls(*rows, 0.0, np.zeros(3), np.zeros(3), first, listed, tables)

    def some(self, kept: np.ndarray) -> SurfacePoints:
        """Those of these numbers."""
        index = aligned(mi.UInt32, kept)
        p, n, n_out, face = dr.gather(tuple, (self.p, self.n, self.n_out, self.face), index)
        dr.eval(p, n, n_out, face)
        return SurfacePoints(p, n, n_out, face, *_grid(np.array(p, dtype=float).T, self.h))

    def __len__(self) -> int:
        return dr.width(self.p)

    def exit(self, k: mi.UInt32, u: mi.Point2f) -> tuple[SurfacePoint, mi.UInt32]:
        """Point k as an exit in a direction by the cosine, for a pair of uniforms, and its face."""
        n, n_out = dr.gather(mi.Normal3f, self.n, k), dr.gather(mi.Normal3f, self.n_out, k)
        return self.exit_along(k, cosine_above(n_out, n, u)[0])

    def exit_along(self, k: mi.UInt32, w: mi.Vector3f) -> tuple[SurfacePoint, mi.UInt32]:
        """Point k as an exit, and its face."""
        n, n_out = dr.gather(mi.Normal3f, self.n, k), dr.gather(mi.Normal3f, self.n_out, k)
        out = SurfacePoint(dr.gather(mi.Point3f, self.p, k), n, lifted(n_out, n, w), w, mi.Float(1))
        return out, dr.gather(mi.UInt32, self.face, k)

    def blend(
        self, values: mi.Float, size: int, p: mi.Point3f, n: mi.Normal3f, active: mi.Bool, k: mi.Int32 | None = None
    ) -> list[mi.Float]:
        """Values of all points, `size` for each, one after the other, at places with outward normals, of object k."""

        def add(j: mi.UInt32, w: mi.Float, total: list[mi.Float]) -> list[mi.Float]:
            return [dr.fma(w, dr.gather(mi.Float, values, j * size + c), v) for c, v in enumerate(total)]

        weight, total = self._near(p, n, active, [mi.Float(0)] * size, add, k)
        scale = dr.select(weight > 0, dr.rcp(dr.maximum(weight, 1e-30)), 0)
        return [v * scale for v in total]

    def smoothed(self, values: np.ndarray, paint: np.ndarray | None = None) -> np.ndarray:
        """Values (points, ...) blended at the points themselves; with `paint` (points, channels) among like colours."""
        weights = self._blending if paint is None else self._of_like(np.log(paint))
        return (weights @ values.reshape(len(self), -1)).reshape(values.shape)

    def _of_like(self, x: np.ndarray) -> csr_array:
        """The weights of all points at all points, less where x is unlike, rows of sum 1."""
        near = self._blending.tocoo()
        # times exp(-(|ln R_j - ln R_k| / LIKE)²), of the channel that differs most
        j, k = near.coords
        apart = np.abs(x[j] - x[k]).max(axis=1)
        w = csr_array((near.data * np.exp(-((apart / LIKE) ** 2)), (j, k)), shape=near.shape)
        return (w / w.sum(axis=1)[:, None]).tocsr()

    @cached_property
    def _blending(self) -> csr_array:
        """The weights of all points at all points, rows of sum 1."""
        p, n = np.array(self.p, dtype=float).T, np.array(self.n, dtype=float).T
        # (1 - d² / h²)² max(n_j.n_k, 0)² of all pairs in reach, over the sum of a row
        d = cKDTree(p).sparse_distance_matrix(cKDTree(p), self.h, output_type="coo_matrix")
        j, k = d.coords
        facing = np.maximum((n[j] * n[k]).sum(axis=1), 0)
        w = csr_array((((1 - (d.data / self.h) ** 2) * facing) ** 2, (j, k)), shape=d.shape)
        return (w / w.sum(axis=1)[:, None]).tocsr()

    def nearest(self, p: mi.Point3f, n: mi.Normal3f, active: mi.Bool) -> tuple[mi.UInt32, mi.Bool]:
        """The point of the largest weight at a place, and whether there is one."""

        def larger(j: mi.UInt32, w: mi.Float, best: tuple) -> tuple:
            result = w > best[1]
            return dr.select(result, j, best[0]), dr.select(result, w, best[1])

        _, (j, w) = self._near(p, n, active, (mi.UInt32(0), mi.Float(0)), larger)
        return j, w > 0

    def _near(
        self, p: mi.Point3f, n: mi.Normal3f, active: mi.Bool, state: object, visit: Callable, k: mi.Int32 | None = None
    ) -> tuple:
        """The sum of weights, and the state after `visit(j, w_j, state)` for all points in reach."""
        # ---- the cell of the place, and the points that it lists
        if self.tables is None:
            h, low, begin = opaque(self.h), [opaque(v) for v in self.low], None
            counts = [dr.opaque(mi.Int32, int(c)) for c in self.cells]
        else:
            h, low, counts, begin = dr.gather(tuple, self.tables, k, active)
        cell = [mi.Int32(dr.floor((p[a] - low[a]) / h)) for a in range(3)]
        valid = active
        for index, count in zip(cell, counts):
            valid = valid & (index >= 0) & (index < count)
        index = mi.UInt32(dr.select(valid, (cell[2] * counts[1] + cell[1]) * counts[0] + cell[0], 0))
        index = index if begin is None else index + begin
        begin = dr.gather(mi.UInt32, self.first, index, valid)
        end = dr.gather(mi.UInt32, self.first, index + 1, valid)

        # ---- w_j = (1 - d² / h²)² max(n_j.n, 0)² of each
        def step(i: mi.UInt32, weight: mi.Float, state: object) -> tuple:
            j = dr.gather(mi.UInt32, self.members, i)
            d2 = dr.squared_norm(dr.gather(mi.Point3f, self.p, j) - p) / (h * h)
            facing = dr.maximum(dr.dot(dr.gather(mi.Normal3f, self.n, j), n), 0)
            w = dr.square(dr.maximum(1 - d2, 0) * facing)
            return i + 1, weight + w, visit(j, w, state)

        loop = (mi.UInt32(begin), mi.Float(0), state)
        out = dr.while_loop(loop, lambda i, *_: i < end, step, label="points in reach")
        return out[1], out[2]


def _apart(p: np.ndarray, n: np.ndarray, r: float) -> np.ndarray:
    """Numbers of places (m, 3) in random order of which no two that face the same way are closer than r, and each other
    place has one that near: those of larger distances first."""
    # ---- distances 2^k r, each by 4^k times fewer places, so that all have as many in reach
    chosen = np.zeros(0, dtype=int)
    for k in range(max(int(np.log2(len(p) / COARSEST) / 2), 0), -1, -1):
        m, reach = len(p) // 4**k, r * 2**k
        left, tree = np.ones(m, dtype=bool), cKDTree(p[:m])
        left[chosen] = False
        near = cKDTree(p[chosen]).sparse_distance_matrix(tree, reach, output_type="coo_matrix")
        left[_facing(n, chosen, *near.coords)[1]] = False

        # ---- of those left each that comes before all in its reach, again until none is left
        a, b = _facing(n, np.arange(m), *tree.query_pairs(reach, output_type="ndarray").T)
        found = [chosen[:0]]
        while left.any():
            near = left[a] & left[b]
            a, b = a[near], b[near]
            later = np.zeros(m, dtype=bool)
            later[np.maximum(a, b)] = True
            first = left & ~later
            found.append(np.flatnonzero(first))
            left &= ~first
            left[b[first[a]]], left[a[first[b]]] = False, False
        chosen = np.concatenate([chosen, np.sort(np.concatenate(found))])
    return chosen


def _facing(n: np.ndarray, of: np.ndarray, a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Those of the pairs of[a], b whose normals n face the same way."""
    same = (n[of[a]] * n[b]).sum(axis=1) > 0
    return of[a][same], b[same]


def _grid(p: np.ndarray, h: float) -> tuple[float, np.ndarray, np.ndarray, mi.UInt32, mi.UInt32]:
    """h, corner, cells, and the lists of points by cell; h grows where the grid would be too fine for its memory."""
    while True:
        low = p.min(axis=0) - 1.01 * h
        cells = np.maximum(np.ceil((p.max(axis=0) + 1.01 * h - low) / h).astype(int), 1)
        if cells.prod() <= MOST_CELLS:
            break
        h *= 1.26
    # each point is listed by all cells of the 27 about it that come nearer than h
    own = np.floor((p - low) / h).astype(int)
    place, point = [], []
    for dz in (-1, 0, 1):
        for dy in (-1, 0, 1):
            for dx in (-1, 0, 1):
                cell = own + (dx, dy, dz)
                near = low + (cell + np.clip((p - low) / h - cell, 0, 1)) * h  # of the cell, to the point
                kept = ((cell >= 0) & (cell < cells)).all(axis=1) & (((near - p) ** 2).sum(axis=1) < h * h)
                place.append((cell[kept, 2] * cells[1] + cell[kept, 1]) * cells[0] + cell[kept, 0])
                point.append(np.flatnonzero(kept))

    # lists one after the other, and where that of each cell begins
    place, point = np.concatenate(place), np.concatenate(point)
    order = np.argsort(place, kind="stable")
    first = np.searchsorted(place[order], np.arange(cells.prod() + 1))
    return h, low, cells, aligned(mi.UInt32, first), aligned(mi.UInt32, point[order])
