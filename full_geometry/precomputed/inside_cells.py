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
from scipy.ndimage import distance_transform_cdt, label

from full_geometry.geometry.points import EntrySample, opaque
from full_geometry.walk.media import WalkMedia
from halfspace_sss.tracing.walk import generator, pass_seed

MOST_CELLS = 2**23  # of the grid: h grows until it has no more
POINTS = 24  # of the surface, for each h² of it, that find the cells it cuts
MARGIN = 0.25  # of h, by which such a point reaches into the next cells
COLUMNS = 7  # along each edge of a cell: COLUMNS² measure its inside
SMALLEST = 0.25  # part of a cell, below which it shares the fit of a neighbour
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
        slots: number of the cells that hold one.
        cut: (cut,) slots of the cells that the surface cuts; all others are whole.
        place: (cut,) of each of them the place in `cut` of the cell whose fit it shares, its own for most.
        offset: (cut, 3) its centre from that of this cell, in units of h.
        moments: (cut, 4, 4) m_jk of its inside, about its centre.
    """

    low: np.ndarray
    h: float
    counts: np.ndarray
    slot: mi.Int32
    slots: int
    cut: np.ndarray
    place: np.ndarray
    offset: np.ndarray
    moments: np.ndarray

    @classmethod
    def of(
        cls, media: WalkMedia, k: int, points: EntrySample, box: tuple[np.ndarray, np.ndarray], h: float, depth: float
    ) -> InsideCells:
        """The cells of object k.

        Args:
            media: the objects.
            k: number of the object.
            points: uniform over its surface, at least POINTS for each h².
            box: its least and largest coordinates.
            h: edge of a cell; larger where the grid would have more than MOST_CELLS.
            depth: below the surface, beyond which cells hold nothing, scene units.
        """
        h = grid_edge(box, h)
        # lay the grid around the box, with an empty rim
        counts = np.ceil((box[1] - box[0]) / h + 2 * MARGIN).astype(int) + 2
        low = 0.5 * (box[0] + box[1]) - 0.5 * counts * h
        axes = _crossed(points, low, h, counts)
        cut = axes >= 0

        # cells between cut ones are inside or outside all together: a ray from one of them tells
        parts, n = label(~cut.reshape(counts[::-1]))
        parts, one = parts.ravel(), np.zeros(n + 1, dtype=int)
        one[parts] = np.arange(len(parts))
        whole = _starts_inside(media, k, _centres(one, low, h, counts))
        whole[0] = False  # the cut ones
        inside = whole[parts]

        # measure the inside of the cut cells, and drop those that hold none of it
        cells = np.flatnonzero(cut)
        moments = _measure(media, k, cells, axes[cells], low, h, counts)
        kept = moments[:, 0, 0] > 1e-6
        cells, moments = cells[kept], moments[kept]

        # whole cells within the depth that light reaches
        if inside.any():
            apart = distance_transform_cdt(~cut.reshape(counts[::-1]), "chessboard").ravel()
            inside &= (apart - 1) * h < depth

        # number the cells that hold a part of the inside
        inside[cells] = True
        held = np.flatnonzero(inside)
        slot = np.full(counts.prod(), -1, dtype=np.int32)
        slot[held] = np.arange(len(held))
        place, offset = _parents(cells, moments[:, 0, 0], counts)
        return cls(
            low=low, h=h, counts=counts, slot=mi.Int32(slot), slots=len(held), cut=slot[cells], place=place,
            offset=offset, moments=moments,
        )  # fmt: skip

    def fit(self, D: np.ndarray) -> np.ndarray:
        """The fit of least squares over the inside: the value at the centre of each cell and its slopes by units of h.

        Args:
            D: (slots, channels, 4) ∫ f x_j dx / h³ over the inside of each cell, x about its centre.

        Returns:
            Coefficients of 1, x, y, z, of the same shape.
        """
        # ---- whole cells: the mean, and slopes by the variance 1/12
        result = D * np.array([1, *[12 / (1 + RIDGE)] * 3], dtype=D.dtype)

        # ---- sums over the cells that share a fit, about the centre of their parent
        rows, parent, offset = self.cut, self.place, self.offset
        shift = np.tile(np.eye(4), (len(rows), 1, 1))
        shift[:, 1:, 0] = offset
        M, b = shift @ self.moments @ shift.transpose(0, 2, 1), np.einsum("sij,scj->sci", shift, D[rows])
        M, b = (_added(values, parent) for values in (M, b))

        # ---- the mean, and slopes about the centroid
        V, x = M[:, :1, 0], M[:, 1:, 0] / M[:, :1, 0]
        C = M[:, 1:, 1:] / V[:, :, None] - x[:, :, None] * x[:, None, :] + RIDGE / 12 * np.eye(3)
        mean = b[:, :, 0] / V
        slopes = (b[:, :, 1:] / V[:, :, None] - mean[:, :, None] * x[:, None]) @ _inverse(C)
        value = mean - np.einsum("scj,sj->sc", slopes, x)

        # ---- of each cell that of its parent, about its own centre
        value, slopes = value[parent], slopes[parent]
        value = value + np.einsum("scj,sj->sc", slopes, offset)
        result[rows] = np.concatenate([value[:, :, None], slopes], axis=2)
        return result

    def shared(self, values: np.ndarray) -> np.ndarray:
        """(slots, ...) values, of each cell the sum over all that share its fit."""
        result = values.copy()
        result[self.cut] = _added(values[self.cut], self.place)[self.place]
        return result


def _inverse(C: np.ndarray) -> np.ndarray:
    """Of symmetric matrices (n, 3, 3), by cofactors: the same bits on every processor."""
    rows = np.stack([np.cross(C[:, 1], C[:, 2]), np.cross(C[:, 2], C[:, 0]), np.cross(C[:, 0], C[:, 1])], axis=1)
    return rows / (C[:, 0] * rows[:, 0]).sum(axis=1)[:, None, None]


def _added(values: np.ndarray, parent: np.ndarray) -> np.ndarray:
    """With the values of cells that share the fit of another added to its own."""
    total, shares = values.copy(), parent != np.arange(len(parent))
    np.add.at(total, parent[shares], values[shares])
    return total


def grid_edge(box: tuple[np.ndarray, np.ndarray], h: float) -> float:
    """h, or the least edge of cells whose grid has at most MOST_CELLS."""
    size = box[1] - box[0]
    while np.prod(np.ceil(size / h + 2 * MARGIN) + 2) > MOST_CELLS:
        h *= 1.05
    return h


def _crossed(points: EntrySample, low: np.ndarray, h: float, counts: np.ndarray) -> np.ndarray:
    """The axis nearest to the normal of the surface in each cell that it may cut, -1 of others: points reach it."""
    n_cells = int(counts.prod())
    squares = [dr.zeros(mi.Float, n_cells) for _ in range(3)]
    x = [(points.p[a] - opaque(low[a])) * opaque(1 / h) for a in range(3)]
    n = [dr.opaque(mi.Int32, int(c)) for c in counts]
    for corner in range(8):
        cell = [mi.Int32(dr.floor(v + (MARGIN if corner >> a & 1 else -MARGIN))) for a, v in enumerate(x)]
        ok = mi.Bool(True)
        for c, most in zip(cell, n):
            ok &= (c >= 0) & (c < most)
        for a in range(3):
            dr.scatter_add(squares[a], dr.square(points.n[a]), (cell[2] * n[1] + cell[1]) * n[0] + cell[0], ok)
    dr.eval(squares)
    x, y, z = (np.array(v) for v in squares)
    axis = np.where(x >= np.maximum(y, z), 0, np.where(y >= z, 1, 2)).astype(np.int8)
    axis[x + y + z == 0] = -1
    return axis


def _centres(cells: np.ndarray, low: np.ndarray, h: float, counts: np.ndarray) -> mi.Point3f:
    z, rest = np.divmod(cells, counts[1] * counts[0])
    y, x = np.divmod(rest, counts[0])
    return mi.Point3f(*(low[a] + (v + 0.5) * h for a, v in enumerate((x, y, z))))


def _own_hit(media: WalkMedia, k: mi.Int32, ray: mi.Ray3f) -> tuple[mi.Float, mi.Bool, mi.Bool]:
    """Distance to the surface of object k along a ray, whether it is met, and whether the ray leaves the object."""

    def nearer(t: mi.Float, found: mi.Bool, leaves: mi.Bool, going: mi.Bool) -> tuple:
        si = media.instance_scene.intersect(
            media.scene, mi.Ray3f(ray.o + ray.d * t, ray.d), mi.RayFlags.Minimal, active=going
        )
        hit = going & si.is_valid()
        own = hit & (media.met(si, k) == k)
        out = dr.dot(si.n, ray.d) * media.side(k, si.prim_index) > 0
        step = media.row("rounding", k)
        t = dr.select(hit, t + si.t + dr.select(own, 0, step), t)
        return t, found | own, dr.select(own, out, leaves), hit & ~own

    lanes = dr.width(ray.o)
    start = (
        dr.zeros(mi.Float, lanes),
        dr.full(mi.Bool, False, lanes),
        dr.full(mi.Bool, False, lanes),
        dr.full(mi.Bool, True, lanes),
    )
    t, found, leaves, _ = dr.while_loop(start, lambda t, f, o, going: going, nearer, label="own surface")
    return t, found, leaves


def _starts_inside(media: WalkMedia, k: int, p: mi.Point3f) -> np.ndarray:
    """Whether points away from the surface of object k are inside it: most of three rays leave it first."""
    # three rays along the axes, slightly turned so that none runs in a face; most votes win over an unlucky edge
    votes = 0
    for axis in range(3):
        d = dr.normalize(mi.Vector3f(*(1.0 if a == axis else 0.0137 * (a + 1) for a in range(3))))
        number = dr.full(mi.Int32, k, dr.width(p))
        _, found, leaves = _own_hit(media, number, mi.Ray3f(p, d + dr.zeros(mi.Vector3f, dr.width(p))))
        votes = votes + np.array(found & leaves).astype(int)
    return votes >= 2


def _measure(
    media: WalkMedia, k: int, cells: np.ndarray, axes: np.ndarray, low: np.ndarray, h: float, counts: np.ndarray
) -> np.ndarray:
    """Moments (cells, 4, 4) of the inside of cells, from columns at jittered places.

    They run along the axis nearest to the normal of the surface, in which they are exact: what is left of their noise
    would make light, divided by the volume of a small part, too bright in the mean.
    """
    n = len(cells)
    centre = _centres(cells, low, h, counts)
    number, edge, axis = dr.full(mi.Int32, k, n), opaque(h), mi.UInt32(axes.astype(np.uint32))
    d = mi.Vector3f(*(dr.select(axis == a, mi.Float(1), 0) for a in range(3)))
    rng = generator(mi, n, pass_seed(k))
    total = dr.opaque(mi.UInt32, COLUMNS**2)

    def column(i: mi.UInt32, rng: mi.PCG32, sums: list[mi.Float]) -> tuple:
        # ---- a column through the cell
        u = (mi.Float(i % COLUMNS) + rng.next_float32()) / COLUMNS - 0.5
        v = (mi.Float(i // COLUMNS) + rng.next_float32()) / COLUMNS - 0.5
        across = dr.select(
            axis == 0, mi.Vector3f(0, u, v), dr.select(axis == 1, mi.Vector3f(v, 0, u), mi.Vector3f(u, v, 0))
        )
        start = across - 0.5 * d

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
    square = np.empty((n, 4, 4))
    for (i, j), values in zip(PAIRS, sums):
        square[:, i, j] = square[:, j, i] = np.array(values, dtype=float) / COLUMNS**2
    return square


def _parents(cells: np.ndarray, volume: np.ndarray, counts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Of each cut cell the one whose fit it shares, for a small one its largest neighbour, and the way from there."""
    parent, offset = np.arange(len(cells)), np.zeros((len(cells), 3))
    small = np.flatnonzero(volume < SMALLEST)
    strides, best = np.array([1, counts[0], counts[0] * counts[1]]), np.full(len(small), SMALLEST)
    for axis in range(3):
        for step in (-1, 1):
            # the grid has an empty rim, so that no neighbour of an inner cell lies across its end
            other = np.searchsorted(cells, cells[small] + step * strides[axis]).clip(max=len(cells) - 1)
            size = np.where(cells[other] == cells[small] + step * strides[axis], volume[other], 0)
            better = size > best
            best[better], parent[small[better]] = size[better], other[better]
            offset[small[better]] = -step * (np.arange(3) == axis)
    return parent, offset
