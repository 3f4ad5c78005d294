"""The inside of an object on a grid of cubes, with the moments of the part of each cube that is inside.

A cube of edge h that the surface cuts holds a part of the inside only. A function on the cells that is linear in each,
least squares over the inside, needs the moments of that part,

    m_jk = ∫_inside x_j x_k dx / h³,    x = (1, x, y, z),

x from the centre of the cell in units of h. Cells whose part is too small for a fit of their own share that of a
neighbour.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy.ndimage import label

from halfspace_sss.rendering.object.points import opaque
from halfspace_sss.rendering.walk.media import WalkMedia
from halfspace_sss.tracing.walk import generator, pass_seed

MOST_CELLS = 2**23  # of the grid: h grows until it has no more
POINTS = 24  # of the surface, for each h² of it, that find the cells it cuts
MARGIN = 0.25  # of h, by which such a point reaches into the next cells
COLUMNS = 4  # along each edge of a cell: COLUMNS² along each axis measure its inside
SMALLEST = 0.15  # part of a cell, below which it shares the fit of a neighbour
RIDGE = 0.02  # of the variance of a whole cell, added to that of the inside: slopes of a sliver are unknown
PAIRS = ((0, 0), (0, 1), (0, 2), (0, 3), (1, 1), (2, 2), (3, 3), (1, 2), (1, 3), (2, 3))  # of the moments


@dataclass(frozen=True, eq=False)
class InsideCells:
    """The cells of one object.

    Args:
        low: corner of the grid, scene units.
        h: edge of a cell, scene units.
        counts: cells along each axis.
        slot: of each cell its place among those that hold a part of the inside, -1 of the others.
        parent: (slots,) the slot whose fit it shares, its own for most.
        offset: (slots, 3) centre of the cell, from that of the parent, in units of h.
        moments: (slots, 4, 4) of the inside of the cell, about its centre.
    """

    low: np.ndarray
    h: float
    counts: np.ndarray
    slot: mi.Int32
    parent: np.ndarray
    offset: np.ndarray
    moments: np.ndarray

    def __len__(self) -> int:
        return len(self.parent)

    @property
    def volume(self) -> float:
        """Of the inside, scene units cubed."""
        return float(self.moments[:, 0, 0].sum()) * self.h**3

    @classmethod
    def of(cls, media: WalkMedia, k: int, points: mi.Point3f, box: tuple[np.ndarray, np.ndarray], h: float) -> InsideCells:
        """The cells of object k.

        Args:
            media: the objects.
            k: number of the object.
            points: uniform over its surface, at least POINTS for each h².
            box: its least and largest coordinates.
            h: edge of a cell; larger where the grid would have more than MOST_CELLS.
        """
        h = grid_edge(box, h)
        counts = np.ceil((box[1] - box[0]) / h + 2 * MARGIN).astype(int) + 1
        low = 0.5 * (box[0] + box[1]) - 0.5 * counts * h
        cut = _cut(points, low, h, counts)

        # cells between cut ones are inside or outside all together: a ray from one of them tells
        parts, n = label(~cut.reshape(counts[::-1]))
        parts = parts.ravel()
        ids, first = np.unique(parts, return_index=True)
        whole = np.zeros(n + 1, dtype=bool)
        whole[ids] = _starts_inside(media, k, _centres(first, low, h, counts), h)
        whole[0] = False  # the cut ones
        inside = whole[parts]

        cells = np.flatnonzero(cut)
        measured = _measure(media, k, cells, low, h, counts)
        kept = measured[:, 0] > 1e-6
        cells, measured = cells[kept], measured[kept]
        full = np.flatnonzero(inside)
        order = np.argsort(np.concatenate([cells, full]), kind="stable")
        held = np.concatenate([cells, full])[order]
        of_full = [1.0, 0, 0, 0, 1 / 12, 1 / 12, 1 / 12, 0, 0, 0]
        moments = np.concatenate([measured, np.tile(of_full, (len(full), 1))])[order]
        slot = np.full(counts.prod(), -1, dtype=np.int32)
        slot[held] = np.arange(len(held))
        parent, offset = _parents(slot, held, moments[:, 0], counts)
        square = np.empty((len(held), 4, 4))
        for column, (i, j) in enumerate(PAIRS):
            square[:, i, j] = square[:, j, i] = moments[:, column]
        return cls(low, h, counts, mi.Int32(slot), parent, offset, square)

    def fit(self, D: np.ndarray) -> np.ndarray:
        """Of least squares over the inside, the value at the centre of each cell and its slopes by units of h.

        Args:
            D: (slots, ..., 4) ∫ f x_j dx / h³ over the inside of each cell, x about its centre.

        Returns:
            Coefficients of 1, x, y, z, of the same shape.
        """
        # ---- sums of D and of the moments over the cells that share a fit, about the centre of the parent
        shift = np.tile(np.eye(4), (len(self), 1, 1))
        shift[:, 1:, 0] = self.offset
        M, b = shift @ self.moments @ shift.transpose(0, 2, 1), np.einsum("sij,s...j->s...i", shift, D)
        own = self.parent == np.arange(len(self))
        M, b = (_added(values, self.parent, own) for values in (M, b))

        # ---- the mean, and slopes about the centroid
        V, x = M[:, 0, 0], M[:, 0, 1:] / M[:, 0, 0, None]
        C = M[:, 1:, 1:] / V[:, None, None] - x[:, :, None] * x[:, None, :] + RIDGE / 12 * np.eye(3)
        mean = b[..., 0] / V.reshape(-1, *[1] * (b.ndim - 2))
        about = b[..., 1:] / V.reshape(-1, *[1] * (b.ndim - 1)) - mean[..., None] * _spread(x, b.ndim)
        slopes = np.einsum("sij,s...j->s...i", np.linalg.inv(C), about)
        value = mean - (slopes * _spread(x, b.ndim)).sum(axis=-1)

        # ---- of each cell that of its parent, about its own centre
        value, slopes = value[self.parent], slopes[self.parent]
        value = value + (slopes * _spread(self.offset, b.ndim)).sum(axis=-1)
        return np.concatenate([value[..., None], slopes], axis=-1)


def _spread(x: np.ndarray, ndim: int) -> np.ndarray:
    """(slots, 3) with axes of length 1 between."""
    return x.reshape(len(x), *[1] * (ndim - 2), 3)


def _added(values: np.ndarray, parent: np.ndarray, own: np.ndarray) -> np.ndarray:
    """With the values of cells that share the fit of another added to its own."""
    total = values.copy()
    np.add.at(total, parent[~own], values[~own])
    return total


def grid_edge(box: tuple[np.ndarray, np.ndarray], h: float) -> float:
    """h, or the least edge of cells by which a grid has no more than MOST_CELLS."""
    size = box[1] - box[0]
    while np.prod(np.ceil(size / h + 2 * MARGIN) + 1) > MOST_CELLS:
        h *= 1.05
    return h


def _cut(points: mi.Point3f, low: np.ndarray, h: float, counts: np.ndarray) -> np.ndarray:
    """Whether the surface may cut a cell: those that points of it reach."""
    cut = dr.zeros(mi.Bool, int(counts.prod()))
    x = [(points[a] - opaque(low[a])) * opaque(1 / h) for a in range(3)]
    n = [dr.opaque(mi.Int32, int(c)) for c in counts]
    for corner in range(8):
        cell = [mi.Int32(dr.floor(v + (MARGIN if corner >> a & 1 else -MARGIN))) for a, v in enumerate(x)]
        ok = mi.Bool(True)
        for c, most in zip(cell, n):
            ok &= (c >= 0) & (c < most)
        dr.scatter(cut, mi.Bool(True), (cell[2] * n[1] + cell[1]) * n[0] + cell[0], ok)
    return np.array(cut)


def _centres(cells: np.ndarray, low: np.ndarray, h: float, counts: np.ndarray) -> mi.Point3f:
    z, rest = np.divmod(cells, counts[1] * counts[0])
    y, x = np.divmod(rest, counts[0])
    return mi.Point3f(*(low[a] + (v + 0.5) * h for a, v in enumerate((x, y, z))))


def _own_hit(media: WalkMedia, k: mi.Int32, ray: mi.Ray3f) -> tuple[mi.Float, mi.Bool, mi.Bool]:
    """Distance to the surface of object k along a ray, whether it is met, and whether the ray leaves the object there."""

    def nearer(t: mi.Float, found: mi.Bool, leaves: mi.Bool, going: mi.Bool) -> tuple:
        si = media.sight.intersect(media.scene, mi.Ray3f(ray.o + ray.d * t, ray.d), mi.RayFlags.Minimal, active=going)
        hit = going & si.is_valid()
        own = hit & (media.met(si, k) == k)
        out = dr.dot(si.n, ray.d) * media.side(k, si.prim_index) > 0
        step = media.row("rounding", k)
        t = dr.select(hit, t + si.t + dr.select(own, 0, step), t)
        return t, found | own, dr.select(own, out, leaves), hit & ~own

    lanes = dr.width(ray.o)
    start = (dr.zeros(mi.Float, lanes), dr.full(mi.Bool, False, lanes), dr.full(mi.Bool, False, lanes), dr.full(mi.Bool, True, lanes))
    t, found, leaves, _ = dr.while_loop(start, lambda t, f, o, going: going, nearer, label="own surface")
    return t, found, leaves


def _starts_inside(media: WalkMedia, k: int, p: mi.Point3f, h: float) -> np.ndarray:
    """Whether points away from the surface of object k are inside it: most of three rays leave it first."""
    votes = 0
    for axis in range(3):
        d = dr.normalize(mi.Vector3f(*(1.0 if a == axis else 0.0137 * (a + 1) for a in range(3))))
        number = dr.full(mi.Int32, k, dr.width(p))
        _, found, leaves = _own_hit(media, number, mi.Ray3f(p, d + dr.zeros(mi.Vector3f, dr.width(p))))
        votes = votes + np.array(found & leaves).astype(int)
    return votes >= 2


def _measure(media: WalkMedia, k: int, cells: np.ndarray, low: np.ndarray, h: float, counts: np.ndarray) -> np.ndarray:
    """Moments of the inside of cells, in the order of PAIRS, from columns at jittered places along the three axes."""
    n = len(cells)
    if n == 0:
        return np.zeros((0, len(PAIRS)))
    centre = _centres(cells, low, h, counts)
    number, edge = dr.full(mi.Int32, k, n), opaque(h)
    rng = generator(mi, n, pass_seed(k))
    total = dr.opaque(mi.UInt32, 3 * COLUMNS**2)

    def column(i: mi.UInt32, rng: mi.PCG32, sums: list[mi.Float]) -> tuple:
        # ---- a column through the cell
        axis, place = i // COLUMNS**2, i % COLUMNS**2
        u = (mi.Float(place % COLUMNS) + rng.next_float32()) / COLUMNS - 0.5
        v = (mi.Float(place // COLUMNS) + rng.next_float32()) / COLUMNS - 0.5
        start = mi.Vector3f(
            dr.select(axis == 0, -0.5, u), dr.select(axis == 1, -0.5, dr.select(axis == 0, u, v)), dr.select(axis == 2, -0.5, v)
        )
        d = mi.Vector3f(*(dr.select(axis == a, mi.Float(1), 0) for a in range(3)))

        # ---- its segments inside: the next surface tells where one ends, and on which side it was
        def segment(begin: mi.Float, sums: list[mi.Float]) -> tuple:
            ray = mi.Ray3f(centre + (start + d * begin) * edge, d)
            t, found, leaves = _own_hit(media, number, ray)
            end = dr.select(found, dr.minimum(begin + t / edge, 1), 1)
            length = dr.select(found & leaves, end - begin, 0)
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
    return np.array(sums, dtype=float).T / (3 * COLUMNS**2)


def _parents(slot: np.ndarray, held: np.ndarray, volume: np.ndarray, counts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Of each slot the one whose fit it shares, the largest neighbour of a small one, and the way from there."""
    parent, offset = np.arange(len(held)), np.zeros((len(held), 3))
    small = np.flatnonzero(volume < SMALLEST)
    z, rest = np.divmod(held[small], counts[1] * counts[0])
    y, x = np.divmod(rest, counts[0])
    place, best = np.stack([x, y, z], axis=1), np.full(len(small), SMALLEST)
    for axis in range(3):
        for step in (-1, 1):
            to = place + step * (np.arange(3) == axis)
            ok = ((to >= 0) & (to < counts)).all(axis=1)
            other = np.where(ok, slot[np.where(ok, (to[:, 2] * counts[1] + to[:, 1]) * counts[0] + to[:, 0], 0)], -1)
            size = np.where(other >= 0, volume[other], 0)
            better = size > best
            best[better], parent[small[better]] = size[better], other[better]
            offset[small[better]] = 0
            offset[small[better], axis] = -step
    return parent, offset
