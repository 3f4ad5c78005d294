"""The inside of an object near its surface, in cubes, with the moments of the part of each cube that is inside.

Light that has not scattered reaches a few mean free paths deep. Bricks of 4³ cells of edge h are therefore kept where
the surface is nearer than that, and a table of all bricks tells which: an object of hundreds of mean free paths has as
many cells as its surface is large. Bricks beyond the first few mean free paths have 2³ cells of edge 2 h.

The inside is that of the surface without the shapes that lie in it, and without what of larger priority overlaps it. A
cell that one of these surfaces cuts holds a part of it only. A function on the cells that is linear in each, least
squares over the inside, needs the moments of that part,

    m_jk = ∫_inside x_j x_k dx / h³,    x = (1, x, y, z),

x from the centre of the cell in units of its edge. Cells whose part is too small for a fit of their own share that of a
neighbour.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy.ndimage import distance_transform_cdt, label

from full_geometry.geometry.points import EntrySample, floats, of_rows, opaque
from full_geometry.walk.media import WalkMedia
from halfspace_sss.arrays import aligned

BRICK = 4  # cells along its edge: its 64 cells are the bits of a number
MOST_BRICKS, MOST_SLOTS = 2**24, 5 * 2**18  # of one object: h grows until it has no more
POINTS = 6, 24  # of the surface, for each h² of it, that find the bricks and the cells it cuts
MOST_MET, STEP = 64, 1e-2  # surfaces that a ray tells apart, and how far apart they are, over the distance of rays
MARGIN = 0.25  # of h, by which a point of the surface reaches into the next cells
COLUMNS = 7, 4  # along each edge of a cell: their square measures its inside; the latter of FINE cells and more
FINE, AT_ONCE = 2**15, 2**14
RAYS = 2**20  # at once
SMALLEST = 0.25  # part of a cell, below which it shares the fit of a neighbour
RIDGE = 0.02  # of the variance of a whole cell, added to that of the inside: slopes of a sliver are unknown
PAIRS = ((0, 0), (0, 1), (0, 2), (0, 3), (1, 1), (2, 2), (3, 3), (1, 2), (1, 3), (2, 3))  # of the moments
SurfaceParts = Callable[[float], Iterator[EntrySample]]
PLACES = [np.arange(BRICK**3) // BRICK**a % BRICK for a in range(3)]  # of the cells of a brick along x, y, z


@dataclass(frozen=True, eq=False)
class CellIndex:
    """Which cell holds a point.
    `brick`: of each brick twice the place of its cells in `slot`, one more where they are coarse; -1 without cells.
    `slot`: of each cell of these bricks its number among those that hold a part of the inside, or -1."""

    brick: mi.Int32
    slot: mi.Int32

    def find(
        self, x: mi.Point3f, first: mi.Int32, counts: mi.Vector3i, active: mi.Bool | bool = True
    ) -> tuple[mi.Int32, mi.Vector3f, mi.Float, mi.Bool]:
        """Slot, place from the centre of the cell in units of its edge, 1 / edge, and whether there is a cell.
        `x`: points from the corner of a grid, in units of h. `first`: number of its first brick. `counts`: of bricks
        along its axes."""
        # ---- the brick
        whole = mi.Vector3i(dr.floor(x / BRICK))
        held = active & dr.all((whole >= 0) & (whole < counts))
        entry = dr.gather(mi.Int32, self.brick, first + (whole.z * counts.y + whole.y) * counts.x + whole.x, held)
        held &= entry >= 0

        # ---- the cell in it, whose edge is 1 or 2
        coarse = (entry & 1) == 1
        n, scale = dr.select(coarse, mi.Int32(BRICK // 2), BRICK), dr.select(coarse, mi.Float(0.5), 1)
        y = (x - BRICK * mi.Vector3f(whole)) * scale
        cell = dr.clip(mi.Vector3i(y), 0, n - 1)
        slot = dr.gather(mi.Int32, self.slot, (entry >> 1) + (cell.z * n + cell.y) * n + cell.x, held)
        return slot, mi.Vector3f(y) - (mi.Vector3f(cell) + 0.5), scale, held & (slot >= 0)


@dataclass(frozen=True, eq=False)
class InsideCells:
    """The cells of one object.

    Args:
        low: corner of the grid, scene units.
        h: edge of a cell, scene units.
        counts: bricks along each axis.
        index: of the cells; `first` of the grid is 0.
        slots: number of the cells that hold a part of the inside.
        cut: (cut,) slots of the cells that the surface cuts; all others are whole.
        place: (cut,) of each of them the place in `cut` of the cell whose fit it shares, its own for most.
        offset: of each the way from the centre of that one, in units of h.
        solve: (cut, 4, 4) in a row, coefficients of its fit from the moments ∫ f x_j dx / h³ of all that share it.
        chord: mean chord 4 V / A of the object, scene units.
    """

    low: np.ndarray
    h: float
    counts: np.ndarray
    index: CellIndex
    slots: int
    cut: mi.UInt32
    place: mi.UInt32
    offset: mi.Vector3f
    solve: mi.Float
    chord: float

    @classmethod
    def of(
        cls, media: WalkMedia, k: int, points: SurfaceParts, box: tuple[np.ndarray, np.ndarray], h: float,
        depths: tuple[float, float], chord: float,
    ) -> InsideCells:  # fmt: skip
        """The cells of object k.

        Args:
            points: so many uniform over its surface for each square of a scene unit, part by part.
            box: its least and largest coordinates.
            h: edge of a cell, from `cell_edge`.
            depths: below the surface, beyond which cells are coarse, and beyond which there are none, scene units.
            chord: mean chord of the object, scene units.
        """
        # ---- bricks that surfaces cut and those near the own, and cells of the former that they cut
        counts = brick_counts(box, h)
        low = 0.5 * (box[0] + box[1]) - 0.5 * BRICK * counts * h
        held = partial(_points_held, media, k, box)
        outer, inner = (_crossed_bricks(each, low, h, counts) for each in (points, held))
        surface = outer | inner
        lit = surface if media.overlaps else outer  # light enters from what overlaps, too
        apart = distance_transform_cdt(~lit.reshape(counts[::-1]), "chessboard").ravel()
        near, far = (np.ceil(min(depth / (BRICK * h), 1e6)) for depth in depths)
        bricks = np.flatnonzero(surface & (apart <= far))
        axes = _crossed_cells((points, held), low, h, counts, bricks)

        # ---- what of them is inside; of the cut cells by measurement
        inside, whole = _inside(media, k, (surface, bricks, axes >= 0), low, h, counts)
        whole &= apart <= far
        row, bit = np.nonzero(axes >= 0)
        cells = _cells_of(bricks[row], bit, counts)
        moments = _measure(media, k, cells, low, axes[row, bit], h)
        row, bit, cells, moments = (v[moments[:, 0, 0] > 1e-6] for v in (row, bit, cells, moments))
        inside[row, bit] = True

        # ---- number them, and fit the cut ones
        used = inside.any(axis=1)
        fine = whole & (apart <= near)
        fine[bricks[used]] = True
        fine, coarse = np.flatnonzero(fine), np.flatnonzero(whole & (apart > near))
        held = np.ones((len(fine), BRICK**3), dtype=bool)
        at = np.searchsorted(fine, bricks)
        held[at[used]] = inside[used]
        index, slot, slots = _numbered(held, fine, coarse, len(surface))
        place, offset = _parents(cells, moments[:, 0, 0], BRICK * counts)
        return cls(
            low=low, h=h, counts=counts, index=index, slots=slots,
            cut=aligned(mi.UInt32, slot[at[row], bit]), place=aligned(mi.UInt32, place),
            offset=of_rows(mi.Vector3f, offset), solve=floats(_solutions(moments, place, offset)), chord=chord,
        )  # fmt: skip

    def share(self, sums: mi.Float, n: int, moments: bool = False) -> None:
        """Give cells that share a fit the sum over all of them.
        `sums`: (slots, n) in a row, of each cell; changed in place. `n`: numbers of a cell, fours. `moments`: whether
        these are ∫ f (1, x, y, z) dx about the centre of each; the sums are about that of the cell whose fit is
        shared."""
        for first in range(0, n, 4):
            # ---- four sums by the cell whose fit is shared, moments about the centre of that
            start = self.cut * n + dr.opaque(mi.UInt32, first)
            rows = [dr.gather(mi.Float, sums, start + i) for i in range(4)]
            if moments:
                rows[1:] = (row + by * rows[0] for row, by in zip(rows[1:], self.offset))
            total = [dr.zeros(mi.Float, dr.width(self.cut)) for _ in rows]
            for target, row in zip(total, rows):
                dr.scatter_add(target, row, self.place)
            dr.eval(total)
            del rows, row  # which read the sums: they would be copied

            # ---- given back to each
            for i, target in enumerate(total):
                dr.scatter(sums, dr.gather(mi.Float, target, self.place), start + i)
            dr.eval(sums)

    def fit(self, D: mi.Float) -> None:
        """Put the fit of cut cells where their moments are, as such moments as a whole cell of this fit has.
        Those of whole cells stay: `UnscatteredLight` takes the mean from D_0 and slopes from 12 / (1 + RIDGE) D_j. `D`:
        (slots, channels, 4) in a row, ∫ f x_j dx of each cell, shared by those of one fit; changed in place."""
        n = len(mi.Spectrum(0))
        A = [dr.gather(mi.Vector4f, self.solve, 4 * dr.arange(mi.UInt32, dr.width(self.cut)) + i) for i in range(4)]
        found = []
        for c in range(n):
            b = dr.gather(mi.Vector4f, D, self.cut * n + c)
            value, *slopes = (dr.dot(row, b) for row in A)
            found.append(mi.Vector4f(value, *(v * ((1 + RIDGE) / 12) for v in slopes)))
        dr.eval(found)
        del b, value, slopes  # which read D: it would be copied
        for c, row in enumerate(found):
            dr.scatter(D, row, self.cut * n + c)
        dr.eval(D)


def brick_counts(box: tuple[np.ndarray, np.ndarray], h: float) -> np.ndarray:
    """Bricks of a grid along its axes, with a rim of more than a cell around the box."""
    return np.ceil(((box[1] - box[0]) / h + 2 * MARGIN + 2) / BRICK).astype(int)


def cell_edge(
    box: tuple[np.ndarray, np.ndarray], extent: tuple[float, float], h: float, depths: tuple[float, float]
) -> float:
    """h, or the least edge of cells that gives an object at most MOST_BRICKS and MOST_SLOTS.
    `box`: its least and largest coordinates. `extent`: its area and volume. `h`: edge that is wanted. `depths`: as in
    `InsideCells.of`."""
    # cells of the box, else fine and coarse ones below the surface: half of the bricks that it cuts, and those near
    area, volume = extent
    while True:
        if np.prod(brick_counts(box, h)) <= MOST_BRICKS:
            if np.prod((box[1] - box[0]) / h) <= MOST_SLOTS:
                return h
            near, far = (np.ceil(min(depth / (BRICK * h), 1e6)) for depth in depths)
            layers = 1 + BRICK * (0.5 + near) + BRICK * (far - near) / 8
            if min(area / h**2 * layers, volume / h**3) <= MOST_SLOTS:
                return h
        h *= 1.05


def _inside(
    media: WalkMedia, k: int, crossed: tuple[np.ndarray, np.ndarray, np.ndarray], low: np.ndarray, h: float,
    counts: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """Which cells are inside as a whole, (bricks that the surface cuts, 64), and which of all bricks.
    `crossed`: which bricks the surface may cut, their numbers, and which of their cells, (bricks, 64)."""
    # ---- cells and bricks between the crossed ones are inside or outside all together: a ray from one of them tells
    surface, bricks, cut = crossed
    rows, parts = _connected(~cut)
    beyond, n = label(~surface.reshape(counts[::-1]))
    beyond, one = beyond.ravel(), np.zeros(n + 1, dtype=int)
    one[beyond] = np.arange(len(beyond))
    lowest = np.log2((parts & (~parts + np.uint64(1))).astype(float)).astype(int)
    middles = [_cells_of(bricks[rows], lowest, counts) + 0.5, _cells_of(one[1:], 0 * one[1:], counts) + 0.5 * BRICK]
    starts = _starts_inside(media, k, _points(np.concatenate(middles), low, h))

    # ---- those, and all with them
    cells = np.zeros(len(bricks), dtype=np.uint64)
    found = starts[: len(rows)]
    np.bitwise_or.at(cells, rows[found], parts[found])
    return _flags(cells), np.concatenate([[False], starts[len(rows) :]])[beyond]


def _bits(flags: np.ndarray) -> np.ndarray:
    """The bits of n numbers from (n, 64) flags."""
    return np.packbits(flags, axis=1, bitorder="little").view("<u8").ravel().astype(np.uint64)


def _flags(bits: np.ndarray) -> np.ndarray:
    """(n, 64) flags from the bits of n numbers."""
    return np.unpackbits(bits.astype("<u8").view(np.uint8).reshape(-1, 8), axis=1, bitorder="little").astype(bool)


def _connected(free: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The parts of bricks whose free cells touch by their faces: the place of the brick of each, and its cells as bits.
    `free`: (bricks, 64) which cells are free."""
    left, rows, parts = _bits(free), np.arange(len(free)), []
    edges = [(np.uint64(4**a), _bits((P < 3)[None])[0], _bits((P > 0)[None])[0]) for a, P in enumerate(PLACES)]
    places = []
    while len(rows := rows[left[rows] != 0]):
        # ---- fill from the lowest free cell, as long as any brick has more to fill
        room = left[rows]
        part = room & (~room + np.uint64(1))
        while True:
            grown = part.copy()
            for step, up, down in edges:
                grown |= ((part & up) << step) | ((part & down) >> step)
            grown &= room
            if (grown == part).all():
                break
            part = grown
        left[rows] &= ~part
        places.append(rows)
        parts.append(part)
    return np.concatenate([*places, np.empty(0, int)]), np.concatenate([*parts, np.empty(0, np.uint64)])


def _numbered(held: np.ndarray, fine: np.ndarray, coarse: np.ndarray, bricks: int) -> tuple[CellIndex, np.ndarray, int]:
    """Cells by number, their slots in fine bricks, and how many slots there are.
    `held`: (fine, 64) which cells of these bricks hold a part of the inside. `fine`, `coarse`: numbers of these bricks.
    `bricks`: number of all."""
    slot = np.where(held, np.cumsum(held, dtype=np.int32).reshape(held.shape) - 1, -1)
    n, last = int(np.count_nonzero(held)), (BRICK // 2) ** 3
    brick = np.full(bricks, -1, dtype=np.int32)
    brick[fine] = 2 * BRICK**3 * np.arange(len(fine))
    brick[coarse] = 2 * (slot.size + last * np.arange(len(coarse))) + 1
    slots = n + last * len(coarse)
    cells = np.concatenate([slot.ravel(), np.arange(n, slots, dtype=np.int32)])
    return CellIndex(aligned(mi.Int32, brick), aligned(mi.Int32, cells)), slot, slots


def _solutions(moments: np.ndarray, place: np.ndarray, offset: np.ndarray) -> np.ndarray:
    """Least squares over the inside, (cut, 4, 4): from moments of f its value at the centre and its slopes by h.
    `moments`: (cut, 4, 4) m_jk of the inside of cells. `place`, `offset`: of the cell whose fit each shares, and the
    way from its centre."""
    # ---- moments of all that share a fit, about the centre of that cell
    shares = np.flatnonzero(place != np.arange(len(place)))
    shift = np.tile(np.eye(4, dtype=np.float32), (len(shares), 1, 1))
    shift[:, 1:, 0] = offset[shares]
    moved = shift @ moments[shares] @ shift.transpose(0, 2, 1)
    np.add.at(moments, place[shares], moved)

    # ---- slopes about the centroid, C^-1 (b / V - x b_0 / V), and the value at the centre; by parts, to save memory
    # a small part that shares no fit, as at a tip, has hardly a slope: its ridge grows as it gets smaller
    result, ridge = np.empty_like(moments), np.float32(RIDGE / 12) * np.eye(3, dtype=np.float32)
    for start in range(0, len(moments), AT_ONCE):
        M, A = (values[start : start + AT_ONCE] for values in (moments, result))
        V, x = M[:, :1, 0], M[:, 1:, 0] / M[:, :1, 0]
        C = M[:, 1:, 1:] / V[:, :, None] - x[:, :, None] * x[:, None, :]
        C += ridge * np.maximum(SMALLEST / V[:, :, None], 1)
        A[:, 1:, 1:] = _inverse(C) / V[:, :, None]
        A[:, 1:, 0] = -np.einsum("sij,sj->si", A[:, 1:, 1:], x)
        A[:, 0] = -np.einsum("sj,sjk->sk", x, A[:, 1:])
        A[:, 0, 0] += 1 / V[:, 0]

    # ---- of each cell that of the one whose fit it shares, about its own centre
    result[shares] = result[place[shares]]
    result[shares, 0] += np.einsum("sj,sjk->sk", offset[shares], result[shares, 1:])
    return result


def _inverse(C: np.ndarray) -> np.ndarray:
    """Of symmetric matrices (n, 3, 3), by cofactors: the same bits on every processor."""
    rows = np.stack([np.cross(C[:, 1], C[:, 2]), np.cross(C[:, 2], C[:, 0]), np.cross(C[:, 0], C[:, 1])], axis=1)
    return rows / (C[:, 0] * rows[:, 0]).sum(axis=1)[:, None, None]


def _points_held(media: WalkMedia, k: int, box: tuple[np.ndarray, np.ndarray], density: float) -> Iterator[EntrySample]:
    """Points of the surfaces of shapes in object k, of this density across three axes: where rays meet them."""
    if media.holes is None:
        return
    size, root, low = box[1] - box[0], math.sqrt(density), mi.Point3f(*(opaque(v) for v in box[0]))
    for axis in range(3):
        # ---- a lattice of rays along the axis, part by part
        n, m = (math.ceil(size[(axis + a) % 3] * root) for a in (1, 2))
        for first in range(0, n * m, RAYS):
            i, across = dr.arange(mi.UInt32, min(RAYS, n * m - first)), dr.opaque(mi.UInt32, n)
            i += dr.opaque(mi.UInt32, first)
            place = mi.Float(0), *((mi.Float(v) + 0.5) * opaque(1 / root) for v in (i % across, i // across))
            o = mi.Point3f(*(place[(a - axis) % 3] for a in range(3))) + low
            d = mi.Vector3f(*(opaque(float(a == axis)) for a in range(3)))

            # ---- all that they meet inside the box; evaluated step by step, so that one kernel is that of all
            going, end = dr.opaque(mi.Bool, True, dr.width(i)), opaque(box[1][axis])
            for _ in range(MOST_MET):
                dr.eval(o)
                si = media.instance_scene.intersect(media.inner.scene, mi.Ray3f(o, d), mi.RayFlags.Minimal, going)
                going &= si.is_valid() & (dr.dot(si.p, d) < end)
                held = going & _bounds(media, dr.opaque(mi.Int32, k), si)
                p, n_met = dr.select(held, si.p, low - opaque(np.max(size))), mi.Normal3f(si.n)
                o = dr.select(going, si.p + d * opaque(STEP / root), o)
                dr.eval(p, n_met, o, going)
                if not dr.any(going):
                    break
                yield EntrySample(p, n_met, n_met, mi.Float(1), mi.UInt32(0))


def _crossed_bricks(points: SurfaceParts, low: np.ndarray, h: float, counts: np.ndarray) -> np.ndarray:
    """Which bricks the surface may cut: points reach them."""
    crossed = dr.zeros(mi.Bool, int(counts.prod()))
    for part in points(POINTS[0] / h**2):
        for _, brick, ok in _reached(part, low, h, counts):
            dr.scatter(crossed, True, brick, ok)
        dr.eval(crossed)
    return np.array(crossed)


def _crossed_cells(
    points: tuple[SurfaceParts, ...], low: np.ndarray, h: float, counts: np.ndarray, bricks: np.ndarray
) -> np.ndarray:
    """The axis nearest to a normal in each cell of bricks, (bricks, 64); -1 where no point reaches.
    It is that of the point whose normal is nearest to an axis."""
    place = np.full(int(counts.prod()), -1, dtype=np.int32)
    place[bricks] = np.arange(len(bricks))
    place, best = aligned(mi.Int32, place), dr.zeros(mi.UInt32, BRICK**3 * len(bricks))
    for part in itertools.chain.from_iterable(each(POINTS[1] / h**2) for each in points):
        n = dr.abs(part.n)
        axis = dr.select(n.x >= dr.maximum(n.y, n.z), mi.UInt32(0), dr.select(n.y >= n.z, mi.UInt32(1), 2))
        rank = 4 * mi.UInt32(2**20 * dr.max(n)) + axis + 1
        for cell, brick, ok in _reached(part, low, h, counts):
            within = ((cell.z % BRICK) * BRICK + cell.y % BRICK) * BRICK + cell.x % BRICK
            row = dr.gather(mi.Int32, place, brick, ok)
            ok &= row >= 0
            dr.scatter_reduce(dr.ReduceOp.Max, best, rank, mi.UInt32(row * BRICK**3 + within), ok)
        dr.eval(best)
    return (np.array(best) % 4).astype(np.int8).reshape(-1, BRICK**3) - 1


def _reached(
    points: EntrySample, low: np.ndarray, h: float, counts: np.ndarray
) -> Iterator[tuple[mi.Vector3i, mi.UInt32, mi.Bool]]:
    """Cells within MARGIN of points, from the corner of the grid, their bricks, and whether the grid has them."""
    x = (points.p - mi.Point3f(*(opaque(v) for v in low))) * opaque(1 / h)
    n = mi.Vector3i(*(dr.opaque(mi.Int32, int(c)) for c in counts))
    for corner in range(8):
        margin = mi.Vector3f(*(opaque(MARGIN if corner >> a & 1 else -MARGIN) for a in range(3)))
        cell = mi.Vector3i(dr.floor(x + margin))
        brick = cell // BRICK
        yield cell, mi.UInt32((brick.z * n.y + brick.y) * n.x + brick.x), dr.all((cell >= 0) & (brick < n))


def _cells_of(bricks: np.ndarray, cell: np.ndarray, counts: np.ndarray) -> np.ndarray:
    """Places of cells (n, 3), by the number of their brick and of the cell in it."""
    z, rest = np.divmod(bricks, counts[1] * counts[0])
    y, x = np.divmod(rest, counts[0])
    return np.stack([BRICK * v + P[cell] for v, P in zip((x, y, z), PLACES)], axis=1)


def _points(x: np.ndarray, low: np.ndarray, h: float) -> mi.Point3f:
    """Points at places of the grid, (n, 3) in units of h."""
    return of_rows(mi.Point3f, low + h * x)


def _bounds(media: WalkMedia, k: mi.Int32, si: mi.SurfaceInteraction3f) -> mi.Bool:
    """Whether what a ray has met is a shape in object k, or may overlap that."""
    held = media.inner.around(si) == k
    if not media.overlaps:
        return held
    of, number = media.inner.priorities, media.inner.priorities.instance_table.number(si, si.is_valid())
    return held | (of.bit_of(number) != 0) & (number != k)


def _ahead(media: WalkMedia, k: mi.Int32, ray: mi.Ray3f) -> tuple[mi.Float, mi.Bool, mi.Bool]:
    """Distance to the next surface that bounds the inside of object k along a ray, whether there is one, and whether
    the ray is inside up to there: the next boundary of the object lets it out, and none of a shape in it, or of what
    has a larger priority, does."""
    scene = (media.inner or media).scene

    def nearer(
        t: mi.Float, first: mi.Float, inside: mi.Bool, met: mi.UInt32, around: mi.UInt32, seen: mi.UInt32,
        going: mi.Bool,
    ) -> tuple:  # fmt: skip
        # ---- the next surface; its first meeting with the object, bit 1 of `met`, tells whether it was in there
        here = mi.Ray3f(ray.o + ray.d * t, ray.d)
        si = media.instance_scene.intersect(scene, here, mi.RayFlags.Minimal, active=going)
        hit, along, t = going & si.is_valid(), dr.dot(si.n, ray.d), t + si.t
        bounds = own = hit & (media.met(si, k) == k)
        inside &= ~own | (met & 1 != 0) | (along * media.side(k, si.prim_index) > 0)
        met |= dr.select(own, mi.UInt32(1), 0)

        # ---- that with a closed shape in it, bit 2, tells whether it was not
        last = own
        if media.inner is not None:
            held = hit & (media.inner.around(si) == k)
            number = media.inner.instance_table.number(si, hit)
            side = dr.gather(mi.Float, media.holes.side, dr.maximum(number, 0), held)
            if media.overlaps:
                # ---- that with each thing that overlaps tells whether it was in there
                of = media.inner.priorities
                bit = of.bit_of(of.instance_table.number(si, hit), hit)
                outwards = media.face_outwards(si, media.index_of(si, hit), ray.d)
                around |= dr.select(dr.dot(outwards.n, ray.d) > 0, bit & ~seen, 0)
                seen, held = seen | bit, held & (bit == 0)
                bounds |= bit != 0
            inside &= ~held | (met & 2 != 0) | (along * side <= 0)
            met |= dr.select(held & (side != 0), mi.UInt32(2), 0)
            bounds, last = bounds | held, mi.Bool(False) if media.overlaps else met == 3
        first = dr.select(bounds & ~dr.isfinite(first), t, first)
        return dr.select(hit, t + media.row("rounding", k), t), first, inside, met, around, seen, hit & ~last

    lanes = dr.width(ray.o)
    t, first, yes = dr.zeros(mi.Float, lanes), dr.full(mi.Float, dr.inf, lanes), dr.full(mi.Bool, True, lanes)
    state = t, first, yes, *(dr.zeros(mi.UInt32, lanes) for _ in range(3)), mi.Bool(yes)
    _, first, inside, met, around, _, _ = dr.while_loop(state, lambda *s: s[-1], nearer, label="surfaces ahead")
    inside &= met & 1 != 0
    if media.overlaps:
        own = media.inner.priorities.bit_of(k)
        inside &= (own == 0) | (around >> 1 < own)  # its bit is the highest
    return first, dr.isfinite(first), inside


def _starts_inside(media: WalkMedia, k: int, p: mi.Point3f) -> np.ndarray:
    """Whether points away from the surface of object k are inside it: most of three rays leave it first."""
    # three rays along the axes, slightly turned so that none runs in a face; most votes win over an unlucky edge
    votes = 0
    for axis in range(3):
        d = dr.normalize(mi.Vector3f(*(opaque(1.0 if a == axis else 0.0137 * (a + 1)) for a in range(3))))
        number = dr.opaque(mi.Int32, k, dr.width(p))
        _, _, inside = _ahead(media, number, mi.Ray3f(p, d + dr.zeros(mi.Vector3f, dr.width(p))))
        votes = votes + np.array(inside).astype(int)
    return votes >= 2


def _measure(
    media: WalkMedia, k: int, cells: np.ndarray, low: np.ndarray, axes: np.ndarray, h: float
) -> np.ndarray:  # fmt: skip
    """Moments (cells, 4, 4) of the inside of cells, from columns at jittered places.
    They run along the axis nearest to the normal of the surface, in which they are exact: what is left of their noise
    would make light, divided by the volume of a small part, too bright in the mean."""
    n = len(axes)
    across_cell = COLUMNS[n >= FINE]
    number, edge, axis = dr.opaque(mi.Int32, k, n), opaque(h), aligned(mi.UInt32, axes)
    centre = _points(cells + 0.5, low, h)
    d = mi.Vector3f(*(dr.select(axis == a, mi.Float(1), 0) for a in range(3)))
    # by the place of a cell, not by its number: rounding may add cells, and all others keep their columns
    place = mi.Vector3u(*(aligned(mi.UInt32, axis) for axis in cells.T))
    rng = mi.PCG32(initstate=mi.UInt64(place.x) + (mi.UInt64(place.y) << 20) + (mi.UInt64(place.z) << 40), initseq=k)
    total, side = (dr.opaque(mi.UInt32, v) for v in (across_cell**2, across_cell))

    def column(i: mi.UInt32, rng: mi.PCG32, sums: list[mi.Float]) -> tuple:
        # ---- a column through the cell
        u = (mi.Float(i % side) + rng.next_float32()) / mi.Float(side) - 0.5
        v = (mi.Float(i // side) + rng.next_float32()) / mi.Float(side) - 0.5
        across = dr.select(
            axis == 0, mi.Vector3f(0, u, v), dr.select(axis == 1, mi.Vector3f(v, 0, u), mi.Vector3f(u, v, 0))
        )
        start = across - 0.5 * d

        # ---- its segments inside: the next surface tells where one ends, and on which side it was
        def segment(begin: mi.Float, sums: list[mi.Float]) -> tuple:
            ray = mi.Ray3f(centre + (start + d * begin) * edge, d)
            t, found, inside = _ahead(media, number, ray)
            end = dr.select(found, dr.minimum(begin + t / edge, 1), 1)
            length = dr.select(inside, end - begin, 0)
            # Simpson's rule is exact for products of two coordinates
            at = [start + d * x for x in (begin, 0.5 * (begin + end), end)]
            values = []
            for i, j in PAIRS:
                f = [(1 if i == 0 else p[i - 1]) * (1 if j == 0 else p[j - 1]) for p in at]
                values.append((f[0] + 4 * f[1] + f[2]) / 6)
            sums = [dr.fma(length, value, each) for each, value in zip(sums, values)]
            step = media.row("rounding", number) / edge
            return dr.select(found, begin + t / edge + step, 2), sums

        _, sums = dr.while_loop((mi.Float(0), sums), lambda begin, sums: begin < 1, segment, label="segments")
        return i + 1, rng, sums

    state = (dr.zeros(mi.UInt32, n), rng, [dr.zeros(mi.Float, n) for _ in PAIRS])
    _, _, sums = dr.while_loop(state, lambda i, rng, sums: i < total, column, label="columns")
    dr.eval(sums)
    square = np.empty((n, 4, 4), dtype=np.float32)
    for (i, j), values in zip(PAIRS, sums):
        square[:, i, j] = square[:, j, i] = np.array(values) / across_cell**2
    return square


def _parents(cells: np.ndarray, volume: np.ndarray, counts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Of each cut cell the one whose fit it shares, for a small one its largest neighbour, and the way from there."""
    # ---- cells by their number in the grid, which has an empty rim: no neighbour of one lies across its end
    strides = np.array([1, counts[0], counts[0] * counts[1]])
    number = cells @ strides
    order = np.argsort(number)
    ordered = number[order]
    parent, offset = np.arange(len(cells)), np.zeros((len(cells), 3), dtype=np.float32)
    small = np.flatnonzero(volume < SMALLEST)

    # ---- the largest of six, else of all 26 around it
    around = np.array([step for step in itertools.product((-1, 0, 1), repeat=3) if any(step)])
    for steps in (around[np.abs(around).sum(axis=1) == 1], around):
        best = np.full(len(small), SMALLEST)
        for step in steps:
            wanted = number[small] + step @ strides
            at = np.searchsorted(ordered, wanted).clip(max=len(cells) - 1)
            size = np.where(ordered[at] == wanted, volume[order[at]], 0)
            better = size > best
            best[better], parent[small[better]] = size[better], order[at[better]]
            offset[small[better]] = -step
        small = small[parent[small] == small]
    return parent, offset
