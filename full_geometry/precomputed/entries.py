"""Places where light may enter, for exits at all points of a surface at once: what a transport matrix is summed over.

Uniform places of the surface are put in an order along it. Those for an exit at x are drawn in proportion to

    f(|x_k - x|),    f the radial density of the model,

by one uniform number for all of them, at even steps along the cumulative sum (systematic sampling, Madow and Madow
1944): no part of the order has more than one more or fewer than it should. Far places are summed by groups of points,
nearer ones by the point that they belong to, the nearest one by one.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from full_geometry.geometry.light_points import GOLDEN, REACH, SurfacePoints, lattice, uniform_entries
from full_geometry.geometry.points import EntrySample, PositionSampler, evaluate, floats, opaque
from halfspace_sss.arrays import aligned

PLACES = 2**17
ROOTS = 2**0.5, 3**0.5, 5**0.5  # of their lattice: by that of the points they would be in step with all of these
GROUP = 16  # points, whose places are one where their middle is farther
FAR = 3.0  # than times their radius
NEAR = 1.2  # distances of points: places of a point that is nearer are drawn one by one
CLOSEST = 0.3  # distances of places: f is no larger


@dataclass(frozen=True, eq=False)
class StratifiedEntries:
    """Places for exits at points, as many for each.
    `places`: of the surface. `point`: to which each belongs. `chosen`: the place of each entry, exit by exit, in the
    order along the surface. `weight`: the inverse of the density of each entry, (scene unit)²."""

    places: EntrySample
    point: mi.UInt32
    chosen: mi.UInt32
    weight: mi.Float

    @classmethod
    def of(cls, positions: PositionSampler, points: SurfacePoints, number: int, seed: int) -> StratifiedEntries:
        """`number` for each point, by the radial density of a sampler."""
        # ---- places in the order of their points, and the tree over them
        rng, count, order = np.random.default_rng(seed), len(points), _order(points)
        rank = np.empty(count, dtype=np.int64)
        rank[order] = np.arange(count)
        places, point = _places(positions, points, rank, rng)
        tree = _Tree.of_places(positions, points, order, places, rank[np.array(point)])
        own = mi.UInt32(positions.geometry.piece(points.face, mi.Bool(True)))
        size, n = dr.opaque(mi.UInt32, dr.width(point)), dr.opaque(mi.UInt32, number)

        # ---- W = Σ_k f(|x_k - x|) for the exit x of each point
        def add(k: mi.UInt32, total: mi.Float) -> tuple[mi.UInt32, mi.Float]:
            f, end = tree.item(k, points.p, own)
            return end, dr.fma(f, mi.Float(end - k), total)

        start = dr.zeros(mi.UInt32, count)
        _, whole = dr.while_loop((start, mi.Float(0)), lambda k, _: k < size, add, label="sum over places")

        # ---- entry s is where the cumulative sum passes (s + shift) W / n; its weight is W A / (f N)
        shift = np.empty(count, dtype=np.float32)  # neighbours have places between those of each other
        shift[order] = (np.arange(count) * GOLDEN + rng.random()) % 1.0
        shift, lanes = floats(shift), dr.arange(mi.UInt32, count) * n
        chosen, weight = dr.zeros(mi.UInt32, count * number), dr.zeros(mi.Float, count * number)
        dr.eval(whole, chosen, weight)
        step, area = whole / mi.Float(n), opaque(positions.geometry.area / PLACES)

        def choose(k: mi.UInt32, s: mi.UInt32, total: mi.Float) -> tuple[mi.UInt32, mi.UInt32, mi.Float]:
            f, end = tree.item(k, points.p, own)
            more, ahead, inverse = f * mi.Float(end - k), (mi.Float(s) + shift) * step - total, 1 / dr.maximum(f, 1e-30)
            # within this item of even f, else on to the next one
            here = (ahead < more) | (end == size)
            within = dr.clip(ahead * inverse, 0, mi.Float(end - k - 1))
            dr.scatter(chosen, k + mi.UInt32(within), lanes + s, here)
            dr.scatter(weight, dr.select(f > 0, whole * area * inverse, 0), lanes + s, here)
            return dr.select(here, k, end), dr.select(here, s + 1, s), dr.select(here, total, total + more)

        state = (dr.zeros(mi.UInt32, count), mi.UInt32(0), mi.Float(0))
        dr.while_loop(state, lambda k, s, _: s < n, choose, label="choice of places")
        dr.eval(chosen, weight)
        return cls(places, point, chosen, weight)

    def __call__(self, k: mi.UInt32) -> EntrySample:
        """Entry k of all."""
        weight = dr.gather(mi.Float, self.weight, k)
        return self.places.gather(dr.gather(mi.UInt32, self.chosen, k))._replace(weight=weight)

    @property
    def near(self) -> np.ndarray:
        """The point to which the place of each entry belongs."""
        return np.array(self.point)[np.array(self.chosen)]


def _order(points: SurfacePoints) -> np.ndarray:
    """Points by groups, along a tree of halves."""
    p = np.array(points.p).T

    # cut across the longest side, to whole groups
    def halved(part: np.ndarray) -> list[np.ndarray]:
        part = part[np.argsort(p[part, np.ptp(p[part], axis=0).argmax()])]
        if len(part) <= GROUP:
            return [part]
        half = (len(part) + GROUP) // (2 * GROUP) * GROUP
        return [*halved(part[:half]), *halved(part[half:])]

    return np.concatenate(halved(np.arange(len(p))))


def _places(
    positions: PositionSampler, points: SurfacePoints, rank: np.ndarray, rng: np.random.Generator
) -> tuple[EntrySample, mi.UInt32]:
    """Uniform places in the order of their points, of that rank, and those."""
    u = [floats(np.minimum(v, 1 - 2**-24)) for v in lattice(PLACES, ROOTS, rng.random(3))]

    # uniform places, and the point that each belongs to
    at = uniform_entries(positions.geometry, u[0], mi.Point2f(u[1], u[2]))
    at = at._replace(weight=at.weight + dr.zeros(mi.Float, PLACES))
    point, known = (np.array(v) for v in points.nearest(at.p, at.n, mi.Bool(True)))
    # those that a point is in reach of, point by point
    kept = np.flatnonzero(known)
    kept = kept[np.argsort(rank[point[kept]], kind="stable")]
    places = at.gather(aligned(mi.UInt32, kept))
    evaluate(places)
    return places, aligned(mi.UInt32, point[kept])


@dataclass(frozen=True, eq=False)
class _Tree:
    """Groups, points and places in order.

    Args:
        positions: whose density is wanted.
        of: of each place the numbers of its group and its point, and the places where these end.
        groups, points, places: positions, and the squared distance within which there is more to look at.
        piece: of the surface, of each place.
        closest: squared distance.
    """

    positions: PositionSampler
    of: mi.UInt32
    groups: mi.Float
    points: mi.Float
    places: mi.Float
    piece: mi.UInt32
    closest: mi.Float

    @classmethod
    def of_places(
        cls,
        positions: PositionSampler,
        points: SurfacePoints,
        order: np.ndarray,
        places: EntrySample,
        point: np.ndarray,
    ) -> _Tree:
        """The tree of places; `point` is the rank of the point of each."""
        # ---- middles and radii of groups; a group of several pieces of the surface is always divided
        p, of_point, group = np.array(points.p).T[order], np.arange(len(order)) // GROUP, point // GROUP
        n = np.bincount(of_point)
        middle = np.stack([np.bincount(of_point, x) / n for x in p.T], axis=1)
        apart, radius = np.linalg.norm(p - middle[of_point], axis=1), np.zeros(len(n))
        np.maximum.at(radius, of_point, apart)
        piece = positions.geometry.piece(places.face, mi.Bool(True)) + dr.zeros(mi.UInt32, len(point))
        number = np.array(piece)
        first = np.searchsorted(group, np.arange(len(n)))[group]
        radius[group[number != number[first]]] = 1e15

        # ---- where groups and points end in the order of places
        ends = [np.searchsorted(v, v, side="right") for v in (group, point)]

        def packed(x: np.ndarray, within: np.ndarray | float) -> mi.Float:
            fourth = np.broadcast_to(within, len(x))
            return floats(np.column_stack([x, fourth]))

        return cls(
            positions,
            aligned(mi.UInt32, np.column_stack([group, point, *ends])),
            packed(middle, (FAR * radius) ** 2),
            packed(p, (NEAR * points.h / REACH) ** 2),
            packed(np.array(places.p).T, 0.0),
            piece,
            opaque(CLOSEST**2 * positions.geometry.area / PLACES),
        )

    def item(self, k: mi.UInt32, x: mi.Point3f, piece: mi.UInt32) -> tuple[mi.Float, mi.UInt32]:
        """f of the places from k on for an exit at x of a piece, and the end of those of which it is that."""
        of, here = dr.gather(mi.Vector4u, self.of, k), mi.Bool(True)
        # the group where it is far, else the point, else the place: the last level whose middle is not near enough
        d, end = mi.Float(0), of.z
        for level, index, last in ((self.groups, of.x, of.z), (self.points, of.y, of.w), (self.places, k, k + 1)):
            v = dr.gather(mi.Vector4f, level, index, here)
            apart = dr.squared_norm(mi.Point3f(v.x, v.y, v.z) - x)
            d, end = dr.select(here, apart, d), dr.select(here, last, end)
            here &= apart <= v.w

        # the radial density f there; 0 of places on another piece of the surface
        f = self.positions.table.pdf(dr.sqrt(dr.maximum(d, self.closest)))
        return dr.select(dr.gather(mi.UInt32, self.piece, k) == piece, f, 0), end
