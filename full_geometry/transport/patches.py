"""The surface of an object cut into patches, among which light is drawn by weights that are learnt.

Patches are clusters of faces (k-means weighted by area) over centroid and 0.4 mean free paths times the normal, so
that the two sides of something thin are apart. A network of the exit alone gives log p(patch | exit) up to a constant,
to which the log of the patch's area is added. A sample is a patch by 0.9 p + 0.1 area share and a uniform point in it:

    density(x | exit) = (0.9 p_k + 0.1 A_k / A) / A_k,    k the patch of x.

The network is asked once for all samples of an exit, and no ray is shot.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping
from copy import copy
from dataclasses import dataclass, replace
from typing import NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np

from full_geometry.geometry import mesh
from full_geometry.geometry.points import (
    CosineProposals,
    EntrySample,
    Point,
    PositionSampler,
    SurfacePoint,
    cosine_direction,
    floats,
    opaque,
    surface_point,
)
from full_geometry.objects.objects import TranslucentObject
from full_geometry.transport.features import ObjectFrame, PreparedExit, Side, first_event, side_features
from halfspace_sss.arrays import aligned
from halfspace_sss.backend import one_blas_thread
from halfspace_sss.neural.perceptron import Perceptron
from halfspace_sss.tracing.walk import generator, pass_seed

PATCHES = 512
LEARNT_SHARE = 0.9
NORMAL_LENGTH = 0.4  # mean free paths
ROUNDS = 12  # of k-means
HIGHEST = 60.0  # of a logit, for the range of float32


def mesh_faces(obj: TranslucentObject) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Centroids (n, 3), unit normals (n, 3) and areas (n,) of the faces.
    ValueError if the shape is no mesh."""
    if not mesh.has_faces(obj.geometry.shape):
        raise ValueError(f"shape must be a mesh to be cut into patches, got {obj.geometry.shape.class_name()}")
    a, b, c = mesh.face_corners(obj.geometry.shape)
    cross = np.cross(b - a, c - a)
    double = np.linalg.norm(cross, axis=1)
    return (a + b + c) / 3, cross / np.maximum(double, 1e-30)[:, None], 0.5 * double


def _places(obj: TranslucentObject, frame: ObjectFrame) -> tuple[np.ndarray, np.ndarray]:
    """What faces are clustered by, (n, 6) in the object's frame over its radius, and their areas."""
    centroids, normals, areas = mesh_faces(obj)
    turn = np.eye(3) if frame.turn is None else np.array([np.array(row).ravel() for row in frame.turn])
    radius, centre = float(np.array(frame.radius).item()), np.array(frame.centre, dtype=float).ravel()
    length = NORMAL_LENGTH / (float(np.array(frame.sigma_t).item()) * radius)
    return np.concatenate([(centroids - centre) @ turn.T / radius, length * normals @ turn.T], axis=1), areas


def cluster(
    obj: TranslucentObject, frame: ObjectFrame, n: int = PATCHES, seed: int = 0, rounds: int = ROUNDS
) -> np.ndarray:
    """Centres of at most n patches, (n, 6), in the frame of the object."""
    from scipy.spatial import cKDTree

    x, areas = _places(obj, frame)
    rng = np.random.default_rng(seed)
    n = min(n, int(np.count_nonzero(areas)))
    centres = x[rng.choice(len(x), n, replace=False, p=areas / areas.sum())]
    for _ in range(rounds):
        nearest = cKDTree(centres).query(x)[1]
        mass = np.bincount(nearest, areas, n)
        sums = np.stack([np.bincount(nearest, areas * column, n) for column in x.T], axis=1)
        centres = np.where(mass[:, None] > 0, sums / np.maximum(mass, 1e-30)[:, None], centres)
    return centres.astype(np.float32)


class Patches:
    """Faces by patch, and uniform points of a patch.
    `centres`: from `cluster`, of this object or of the one that was trained."""

    def __init__(self, obj: TranslucentObject, frame: ObjectFrame, centres: np.ndarray) -> None:
        from scipy.spatial import cKDTree

        x, areas = _places(obj, frame)
        self.object, self.points, self.n = obj, obj.points, len(centres)
        self.of_face = cKDTree(centres).query(x)[1].astype(np.uint32)
        self.areas = np.bincount(self.of_face, areas, self.n)
        order = np.argsort(self.of_face, kind="stable")
        ends = np.searchsorted(self.of_face[order], np.arange(self.n + 1))
        # areas summed within each patch alone: over the whole mesh float32 would lose the small faces
        sums = np.cumsum(areas[order])
        first = np.concatenate([[0.0], sums])[ends[:-1]]
        within = (sums - np.repeat(first, np.diff(ends))).astype(np.float32)
        self.tables = {
            "patch": aligned(mi.UInt32, self.of_face), "face": aligned(mi.UInt32, order), "within": floats(within),
            "start": aligned(mi.UInt32, ends), "area": floats(self.areas),
            "share": floats(self.areas / self.areas.sum()),
            "upto": floats(np.cumsum(self.areas / self.areas.sum())),
        }  # fmt: skip
        dr.eval(self.tables)

    def row(self, key: str, k: mi.UInt32) -> mi.Float | mi.UInt32:
        return dr.gather(type(self.tables[key]), self.tables[key], k)

    def point(self, patch: mi.UInt32, u_face: mi.Float, u: mi.Point2f) -> Point:
        low, high = self.row("start", patch), self.row("start", patch + 1)
        goal = u_face * self.row("area", patch)

        def before(i: mi.UInt32) -> mi.Bool:
            i = mi.UInt32(i)
            return (i < low) | ((i + 1 < high) & (self.row("within", i) <= goal))

        k = dr.binary_search(0, len(self.of_face), before)
        return self.points.on_face(self.row("face", mi.UInt32(k)), u)


class PatchWeights(NamedTuple):
    """Sums of the learnt weights of an exit up to each patch, in memory of the lane, and the last of them."""

    cumulative: dr.Local | _CumulativeRow
    total: mi.Float


@dataclass(frozen=True, eq=False)
class PatchSampler:
    """Points of entry by learnt weights of patches.
    `patches`: of its surface. `weights`: V_k (outputs, inputs) and c_k of the layers; the last has one output for each
    patch."""

    frame: ObjectFrame
    patches: Patches
    weights: Mapping[str, np.ndarray]

    @functools.cached_property
    def _network(self) -> Perceptron:
        """Layers with the log of the areas in the last bias."""
        last, areas = f"c_{len(self.weights) // 2 - 1}", self.patches.areas
        shares = np.log(np.maximum(areas / areas.sum(), 1e-30)).astype(np.float32)
        return Perceptron.named(
            {**self.weights, last: self.weights[last].astype(np.float32) + shares}, "V", "c", looped=True
        )

    def prepare(self, exit: Side) -> PatchWeights:
        """Weights of all patches for an exit."""
        sums = dr.alloc_local(mi.Float, self.patches.n)
        for k, logit in enumerate(self._network(side_features(self.frame, exit))):
            sums[mi.UInt32(k)] = dr.minimum(logit, HIGHEST)

        def add(k: mi.UInt32, total: mi.Float, sums: dr.Local) -> tuple:
            total = total + dr.exp(sums[k])
            sums[k] = total
            return k + 1, total, sums

        state = (mi.UInt32(0), mi.Float(0), sums)
        _, total, sums = dr.while_loop(state, lambda k, *_: k < self.patches.n, add, label="patch weights")
        return PatchWeights(sums, total)

    def sample(self, exit: PatchWeights, u_patch: mi.Float, u_face: mi.Float, u: mi.Point2f) -> tuple[Point, mi.Float]:
        """A point of entry and its density, 1/(scene unit)², for uniform numbers u_patch, u_face and the pair u."""
        patch, density = self.patch(exit, u_patch)
        return self.patches.point(patch, u_face, u), density

    def patch(self, exit: PatchWeights, u: mi.Float) -> tuple[mi.UInt32, mi.Float]:
        """A patch for a uniform number, and the density of uniform points in a patch that is drawn so."""
        learnt, last = u < LEARNT_SHARE, self.patches.n - 1
        u_1, u_2 = u / LEARNT_SHARE * exit.total, (u - LEARNT_SHARE) / (1 - LEARNT_SHARE)
        by_weight = dr.binary_search(0, last, lambda i: exit.cumulative[mi.UInt32(i)] <= u_1)
        by_area = dr.binary_search(0, last, lambda i: self.patches.row("upto", mi.UInt32(i)) <= u_2)
        patch = dr.select(learnt, mi.UInt32(by_weight), mi.UInt32(by_area))
        return patch, self._share(exit, patch) / self.patches.row("area", patch)

    def density(self, exit: PatchWeights, face: mi.UInt32) -> mi.Float:
        """Density of `sample` on a face, 1/(scene unit)²."""
        patch = self.patches.row("patch", face)
        return self._share(exit, patch) / self.patches.row("area", patch)

    def _share(self, exit: PatchWeights, patch: mi.UInt32) -> mi.Float:
        before = dr.select(patch > 0, exit.cumulative[dr.maximum(patch, 1) - 1], mi.Float(0))
        learnt = (exit.cumulative[patch] - before) / exit.total
        return LEARNT_SHARE * learnt + (1 - LEARNT_SHARE) * self.patches.row("share", patch)


# ----------------------------------------------------------------------------------------------------
# Weights of patches tabulated over the exits: looked up by the face of an exit, where the network would be asked.
# The surface is cut into cells, finer than patches; of each the learnt weights are averaged over random exits in it.
# The density stays exact, as samples are drawn by the table itself. Against the network at every exit the variance
# rises by a fifth at most, and of the time of an exit most goes.

CELLS = 4096
EXITS = 4  # of a cell


@dataclass(frozen=True, eq=False)
class _CumulativeRow:
    """The cumulative weights of a cell, as a lane asks for them."""

    table: mi.Float
    start: mi.UInt32

    def __getitem__(self, k: mi.UInt32) -> mi.Float:
        return dr.gather(type(self.table), self.table, self.start + k)


class WeightTable:
    """Weights of exits or cells, looked up by their number.
    `weights`: of all patches, (exits, patches)."""

    def __init__(self, weights: np.ndarray) -> None:
        rows = np.cumsum(weights, axis=1).astype(np.float32)
        self.n, self.table, self.last = rows.shape[1], mi.Float(rows.ravel()), mi.Float(rows[:, -1].copy())

    @classmethod
    def of(cls, sampler: PatchSampler, exits: SurfacePoint) -> WeightTable:
        """Ask the network of a sampler once for each of given exits."""
        return cls(_weights(sampler, Side(exits, first_event(sampler.patches.object, exits)), dr.width(exits.p)))

    def weights(self, k: mi.UInt32) -> PatchWeights:
        return PatchWeights(_CumulativeRow(self.table, k * self.n), dr.gather(type(self.last), self.last, k))


class PatchTable:
    """The table of an object.
    `sampler`: whose network is asked, once. `cells`: at most so many."""

    def __init__(self, sampler: PatchSampler, cells: int = CELLS) -> None:
        obj, n = sampler.patches.object, len(sampler.patches.of_face)
        of_face = np.arange(n, dtype=np.uint32)
        if n > cells:
            centres = cluster(obj, sampler.frame, cells, seed=1, rounds=1)
            parts = Patches(obj, sampler.frame, centres)
            of_face, n = parts.of_face, cells
        faces = mi.UInt32(of_face)
        total = 0.0
        for k in range(EXITS):
            rng = generator(mi, n, pass_seed(51, k))
            u_face, u = rng.next_float32(), mi.Point2f(rng.next_float32(), rng.next_float32())
            cell = dr.arange(mi.UInt32, n)
            at = obj.points.on_face(cell, u) if n == len(of_face) else parts.point(cell, u_face, u)
            normal, n_out = at.outward(obj.geometry.sign)
            exit = surface_point(at.p, normal, n_out, cosine_direction(n_out, normal, rng))
            exit = obj.knowing(exit, mi.UInt32(at.prim_index))
            total = total + _weights(sampler, Side(exit, first_event(obj, exit)), n)
        self.cells, self.of_face = WeightTable(total / EXITS), faces
        dr.eval(self.cells.table, self.of_face, self.cells.last)

    def lit(self, brightness: np.ndarray) -> PatchTable:
        result = copy(self)
        rows = np.array(self.cells.table).reshape(-1, self.cells.n)
        result.cells = WeightTable(np.diff(rows, axis=1, prepend=0) * brightness)
        return result

    def weights(self, face: mi.UInt32) -> PatchWeights:
        return self.cells.weights(dr.gather(type(self.of_face), self.of_face, face))


def _weights(sampler: PatchSampler, exit: Side, n: int) -> np.ndarray:
    """Weights of all patches for n exits, (n, patches), rows of sum 1."""
    columns = side_features(sampler.frame, exit)
    dr.eval(columns)
    x = np.stack([np.broadcast_to(c.numpy(), n) for c in columns])
    depth = len(sampler.weights) // 2
    with one_blas_thread():  # or entries would depend on how many there are
        for k in range(depth):
            W, b = (sampler.weights[f"{name}_{k}"].astype(np.float32) for name in ("V", "c"))
            x = W @ x + b[:, None]
            if k < depth - 1:
                x = x * np.clip(x / 6 + 0.5, 0, 1)
    areas = sampler.patches.areas
    log_share = np.log(np.maximum(areas / areas.sum(), 1e-30))
    weights = np.exp(np.minimum(x + log_share[:, None].astype(np.float32), HIGHEST))
    return (weights / weights.sum(axis=0)).T


# ----------------------------------------------------------------------------------------------------
# Entries of an object drawn by learnt weights of patches, and by probes for what patches do not resolve.

AREA_SHARE = 0.75  # of the candidates for entries without patches that are uniform over the area


class _PatchesOfExit(NamedTuple):
    """Of an exit: the weights of patches, and the axes of probes."""

    weights: PatchWeights | None
    axes: tuple[mi.Vector3f, mi.Vector3f, mi.Vector3f]


@dataclass(frozen=True, eq=False)
class LearntProposals(CosineProposals):
    """Entries by learnt weights of patches, a share of them by probes, with the density of both (balance heuristic).

    Args:
        patches: their sampler.
        positions: probes and uniform points.
        patch_share: of the entries, (0, 1]; 1 shoots no ray.
        sign: that turns geometric normals outwards.
        table: of the weights by the face of an exit; without it the network is asked for each exit.
    """

    patches: PatchSampler
    positions: PositionSampler
    patch_share: float
    sign: float
    table: PatchTable | None = None

    def lit(self, brightness: np.ndarray) -> LearntProposals:
        table, parts = self.table, self.patches.patches
        if table is not None:
            areas = self.positions.points.areas
            mass = np.bincount(parts.of_face, areas * brightness, parts.n) / np.maximum(parts.areas, 1e-30)
            table = table.lit(mass)
        positions = replace(self.positions, points=self.positions.points.lit(brightness))
        return replace(self, positions=positions, table=table)

    def prepare(self, out: SurfacePoint, prepared: PreparedExit, active: mi.Bool) -> _PatchesOfExit:
        weights = self.patches.prepare(prepared.side) if self.table is None else None
        return _PatchesOfExit(weights, (out.n_out, *mi.coordinate_system(out.n_out)))

    def sample(
        self, out: SurfacePoint, prim_index: mi.UInt32, prepared: _PatchesOfExit, sampler: mi.Sampler, active: mi.Bool
    ) -> EntrySample:
        by_patch = active & (sampler.next_1d() < opaque(self.patch_share))
        weights = prepared.weights if self.table is None else self.table.weights(prim_index)
        at, _ = self.patches.sample(weights, sampler.next_1d(), sampler.next_1d(), sampler.next_2d())
        n, n_out = at.outward(opaque(self.sign))
        entry = EntrySample(mi.Point3f(at.p), n, n_out, mi.Float(1), mi.UInt32(at.prim_index))
        if self.patch_share < 1:
            probed = self.positions.sample(out, prim_index, sampler, active & ~by_patch)
            entry = EntrySample(*(dr.select(by_patch, a, b) for a, b in zip(entry[:5], probed)))
        learnt = self.patches.density(weights, entry.face)
        if self.patch_share == 1:
            return entry._replace(weight=dr.select(by_patch, 1 / learnt, 0))
        near = self.positions.density(entry.p, entry.n, entry.face, out, prepared.axes)
        share = opaque(self.patch_share)
        # of a probe the weight is that of one hit among all, 1/density on average
        scale = dr.select(by_patch, 1, near) / (share * learnt + (1 - share) * near)
        return entry._replace(weight=dr.select(active, entry.weight * scale, 0))
