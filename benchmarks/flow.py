"""A flow inside patches: splines, the conditional flow, its sampler of entries; in Dr.Jit, with exact densities."""

from __future__ import annotations

import functools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np

from full_geometry.geometry.mesh import positions_at, vertices_of
from full_geometry.geometry.points import CosineProposals, EntrySample, Point, SurfacePoint, opaque, turned
from full_geometry.objects.objects import TranslucentObject
from full_geometry.transport.features import ObjectFrame, PreparedExit, Side
from full_geometry.transport.patches import Patches, PatchSampler, PatchTable, PatchWeights, mesh_faces
from halfspace_sss.arrays import Lanes
from halfspace_sss.neural.perceptron import Perceptron, relu

# ---- The square [0, 1)² laid onto each patch of a surface, so that equal areas stay equal ----------
# A patch has two axes, the principal ones of its faces. Along the first its faces are put together to strips; u_1
# chooses
# the strip and u_2 the face in the strip, both by area, in the order of the axes; what is left of both is a point of
# the
# face. The map can be inverted, and the density of uniform (u_1, u_2) is one over the area of the patch.


INSIDE = 1.0 - 2.0**-20  # largest coordinate


class PatchFrame(NamedTuple):
    """Centre, two axes and normal of a patch, and its radius: sqrt of its area over pi. Scene units."""

    centre: Lanes
    axes: tuple[Lanes, Lanes, Lanes]
    radius: Lanes


class Chart:
    """Points of patches by coordinates, and coordinates of points.

    Args:
        obj: the object.
        frame: of the object; the axes of patches turn with it.
        patches: of its surface.
    """

    def __init__(self, obj: TranslucentObject, frame: ObjectFrame, patches: Patches) -> None:
        self.object = obj
        centroids, normals, areas = mesh_faces(obj)
        turn = np.eye(3) if frame.turn is None else np.array([np.array(row).ravel() for row in frame.turn])
        centres, axes = _axes(centroids, normals * obj.geometry.sign, areas, patches, turn)
        along, across = (np.einsum("fi,fi->f", centroids - centres[patches.of_face], axes[patches.of_face, k])
                         for k in (0, 1))  # fmt: skip
        strips = _strips(along, areas, patches)
        order = np.lexsort((across, strips.of_face))
        self.tables = {name: mi.Float(v.astype(np.float32)) for name, v in strips.floats.items()}
        low, high = _within(order, strips.of_face, areas, len(strips.first))
        self.tables |= {"low_2": mi.Float(low.astype(np.float32)), "size_2": mi.Float(high.astype(np.float32))}
        ordered = low[order].astype(np.float32)
        ends = np.searchsorted(strips.of_face[order], np.arange(len(strips.first) + 1))
        self.tables |= {"ordered_low": mi.Float(ordered), "face": mi.UInt32(order.astype(np.uint32))}
        self.tables |= {"start": mi.UInt32(ends.astype(np.uint32)), "strip": mi.UInt32(strips.of_face)}
        self.tables |= {"strips": mi.UInt32(strips.ends.astype(np.uint32))}
        radius = np.sqrt(patches.areas / np.pi)
        values = np.concatenate([centres, axes.reshape(-1, 9), radius[:, None]], axis=1)
        self.tables |= {"frames": mi.Float(values.astype(np.float32).ravel())}
        dr.eval(self.tables)
        self.n_faces, self.n_strips = len(order), len(strips.first)

    def _row(self, key: str, k: Lanes) -> Lanes:
        return dr.gather(type(self.tables[key]), self.tables[key], k)

    def frame(self, patch: Lanes) -> PatchFrame:
        """The frame of a patch."""
        v = [self._row("frames", patch * 13 + k) for k in range(13)]
        axes = tuple(mi.Vector3f(*v[k : k + 3]) for k in (3, 6, 9))
        return PatchFrame(mi.Point3f(*v[:3]), axes, v[12])

    def point(self, patch: Lanes, u: tuple[Lanes, Lanes]) -> Point:
        """The point of a patch with coordinates u."""
        first, end = self._row("strips", patch), self._row("strips", patch + 1)
        strip = self._last_below("low_1", first, end, u[0], self.n_strips)
        face = self._last_below("ordered_low", self._row("start", strip), self._row("start", strip + 1), u[1],
                                self.n_faces)  # fmt: skip
        face = self._row("face", face)
        v = ((u[0] - self._row("low_1", strip)) / self._row("size_1", strip),
             (u[1] - self._row("low_2", face)) / self._row("size_2", face))  # fmt: skip
        return self.object.points.on_face(face, mi.Point2f(*(dr.clip(x, 0, INSIDE) for x in v)))

    def coordinates(self, face: Lanes, p: Lanes) -> tuple[Lanes, Lanes]:
        """Coordinates in its patch of a point of a face."""
        a, b, c = positions_at(self.object.geometry.shape, vertices_of(self.object.geometry.shape, face))
        ab, ac, ap = b - a, c - a, p - a
        n = dr.cross(ab, ac)
        square = dr.maximum(dr.squared_norm(n), 1e-38)
        weights = mi.Point2f(dr.dot(dr.cross(ap, ac), n) / square, dr.dot(dr.cross(ab, ap), n) / square)
        inside = mi.Point2f(dr.clip(weights.x, 0, 1), dr.clip(weights.y, 0, 1))
        v = mi.warp.uniform_triangle_to_square(inside)
        strip = self._row("strip", face)
        u = (self._row("low_1", strip) + self._row("size_1", strip) * dr.clip(v.x, 0, INSIDE),
             self._row("low_2", face) + self._row("size_2", face) * dr.clip(v.y, 0, INSIDE))  # fmt: skip
        return tuple(dr.clip(x, 0, INSIDE) for x in u)

    def _last_below(self, key: str, first: Lanes, end: Lanes, u: Lanes, n: int) -> Lanes:
        """The last of the entries first ... end - 1 of a table that rises that is not above u."""

        def before(i: Lanes) -> Lanes:
            i = mi.UInt32(i)
            return (i < first) | ((i + 1 < end) & (self._row(key, dr.minimum(i + 1, n - 1)) <= u))

        return mi.UInt32(dr.binary_search(0, n - 1, before))


def _axes(
    centroids: np.ndarray, normals: np.ndarray, areas: np.ndarray, patches: Patches, turn: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Centres (n, 3) and axes (n, 3, 3) of patches: two principal ones of their faces, and the mean normal.

    An axis points to where its largest component is positive in the object's own frame.
    """
    n = patches.n
    mass = np.maximum(np.bincount(patches.of_face, areas, n), 1e-30)

    def mean(values: np.ndarray) -> np.ndarray:
        flat = values.reshape(len(values), -1)
        sums = np.stack([np.bincount(patches.of_face, areas * c, n) for c in flat.T], axis=1)
        return (sums / mass[:, None]).reshape(n, *values.shape[1:])

    centres = mean(centroids)
    d = centroids - centres[patches.of_face]
    _, vectors = np.linalg.eigh(mean(d[:, :, None] * d[:, None, :]))
    normal = mean(normals)
    flat = np.linalg.norm(normal, axis=1, keepdims=True)
    normal = np.where(flat > 1e-3, normal / np.maximum(flat, 1e-30), vectors[:, :, 0])
    first = vectors[:, :, 2] @ turn.T
    strongest = np.take_along_axis(first, np.abs(first).argmax(axis=1)[:, None], 1)
    first = (first * np.where(strongest < 0, -1.0, 1.0)) @ turn
    first = first - normal * np.sum(first * normal, axis=1, keepdims=True)
    first /= np.maximum(np.linalg.norm(first, axis=1, keepdims=True), 1e-30)
    return centres, np.stack([first, np.cross(normal, first), normal], axis=1)


class _Strips(NamedTuple):
    """Strip of each face, first face number, ends of the strips of each patch, and tables by strip."""

    of_face: np.ndarray
    first: np.ndarray
    ends: np.ndarray
    floats: dict[str, np.ndarray]


def _strips(along: np.ndarray, areas: np.ndarray, patches: Patches) -> _Strips:
    """Faces of each patch, in order along its first axis, in about sqrt(faces) strips of like area."""
    n = patches.n
    faces = np.bincount(patches.of_face, minlength=n)
    order = np.lexsort((along, patches.of_face))
    of = patches.of_face[order]
    sums = np.cumsum(areas[order])
    before = np.concatenate([[0.0], sums])[np.searchsorted(of, np.arange(n))]
    middle = (sums - 0.5 * areas[order] - before[of]) / np.maximum(patches.areas[of], 1e-300)
    number = np.maximum(np.sqrt(faces).astype(int), 1)
    wanted = np.minimum((np.clip(middle, 0, 1) * number[of]).astype(int), number[of] - 1)
    keys = of.astype(np.int64) * (number.max() + 1) + wanted
    strips, first, strip = np.unique(keys, return_index=True, return_inverse=True)
    owner = of[first]
    ends = np.searchsorted(owner, np.arange(n + 1))
    mass = np.bincount(strip, areas[order], len(strips))
    upto = np.concatenate([[0.0], np.cumsum(mass)])
    low = (upto[:-1] - upto[ends[:-1]][owner]) / patches.areas[owner]
    of_face = np.empty(len(of), dtype=np.uint32)
    of_face[order] = strip
    return _Strips(of_face, first, ends, {"low_1": low, "size_1": mass / patches.areas[owner]})


def _within(order: np.ndarray, of_face: np.ndarray, areas: np.ndarray, n: int) -> tuple[np.ndarray, np.ndarray]:
    """Where the interval of each face begins in its strip, and how long it is."""
    strip, mass = of_face[order], np.bincount(of_face, areas, n)
    upto = np.concatenate([[0.0], np.cumsum(areas[order])])
    low, size = np.empty(len(order)), np.empty(len(order))
    low[order] = (upto[:-1] - upto[np.searchsorted(strip, np.arange(n))][strip]) / mass[strip]
    size[order] = areas[order] / mass[strip]
    return low, size


# ---- What the flow of a patch is told: where the exit and its first event lie as seen from the patch

N_CONTEXT = 18


def context(frame: ObjectFrame, exit: Side, patch: PatchFrame) -> list[Lanes]:
    """The numbers of `N_CONTEXT`.

    x_o and y_o in the frame of the patch as v / (|v| + radius), the logarithms of both distances over the radius, n_o
    and w_o in that frame, and the radius, in mean free paths, and the way to y_o, as logarithms.
    """

    def local(v: Lanes) -> list[Lanes]:
        return [dr.dot(v, axis) for axis in patch.axes]

    told: list[Lanes] = []
    for p in (exit.at.p, exit.event.y):
        d = p - patch.centre
        r = dr.norm(d)
        told += [*local(d / (r + patch.radius)), 0.5 * dr.log(r / patch.radius + 0.05)]
    told += [*local(exit.at.n_out), *local(exit.at.w), dr.dot(exit.at.n_out, exit.at.w)]
    told += [0.5 * dr.log(patch.radius * frame.sigma_t + 1e-3), 0.5 * dr.log(exit.event.length * frame.sigma_t + 1e-2)]
    return [*told, 1 / (1 + patch.radius * frame.sigma_t)]


def _tangents(n: Lanes, towards: Lanes) -> tuple[Lanes, Lanes]:
    """Tangents of a normal, the first towards a point as seen from there; any where that is along the normal."""
    flat = towards - n * dr.dot(towards, n)
    length = dr.norm(flat)
    s = dr.select(length > 1e-4 * dr.norm(towards), flat / dr.maximum(length, 1e-30), mi.coordinate_system(n)[0])
    return mi.Vector3f(s), mi.Vector3f(dr.cross(n, s))


def direction_square(n: Lanes, towards: Lanes, w: Lanes) -> tuple[Lanes, Lanes]:
    """Coordinates in [0, 1)² of a direction above a surface, uniform where it follows the cosine."""
    s, t = _tangents(n, towards)
    u = mi.warp.cosine_hemisphere_to_square(mi.Vector3f(dr.dot(w, s), dr.dot(w, t), dr.maximum(dr.dot(w, n), 0)))
    return tuple(dr.clip(v, 0, 1 - 2.0**-20) for v in u)


# ----------------------------------------------------------------------------------------------------
# Monotonic rational-quadratic splines of [-1, 1] onto itself, in Dr.Jit (Durkan, Bekasov, Murray, Papamakarios 2019).
# K bins with widths, heights and K - 1 slopes between them; slopes are 1 at both ends. The numbers are bounded as zuko
# bounds them: with l = -log(least), a/(1 + 2|a|/l) before the softmax of widths and heights, a/(1 + |a|/l) as logarithm
# of a slope, so that no slope leaves [least, 1/least].


BINS = 8
LEAST_SLOPE = 1e-2
PARAMETERS = 3 * BINS - 1


class _Bin(NamedTuple):
    """Ends of a bin in x and y, and the slopes at both."""

    x: Lanes
    y: Lanes
    dx: Lanes
    dy: Lanes
    d: Lanes
    d_next: Lanes


class Spline:
    """One spline for each lane.

    Args:
        raw: 3 K - 1 numbers of a network: widths, heights, slopes.
    """

    def __init__(self, raw: Sequence[Lanes]) -> None:
        bound = -math.log(LEAST_SLOPE)
        slopes = [dr.exp(a / (1 + dr.abs(a) / bound)) for a in raw[2 * BINS :]]
        self.widths, self.heights = (_shares(part, bound) for part in (raw[:BINS], raw[BINS : 2 * BINS]))
        self.slopes = [1.0, *slopes, 1.0]

    def _bin(self, at: Lanes, by_y: bool) -> _Bin:
        """The bin in which x, or y, lies."""
        bin = _Bin(*map(mi.Float, (-1, -1, self.widths[0], self.heights[0], self.slopes[0], self.slopes[1])))
        x, y = mi.Float(-1), mi.Float(-1)
        for k in range(1, BINS):
            x, y = x + self.widths[k - 1], y + self.heights[k - 1]
            here = _Bin(x, y, self.widths[k], self.heights[k], self.slopes[k], self.slopes[k + 1])
            beyond = at >= (y if by_y else x)
            bin = _Bin(*(dr.select(beyond, a, b) for a, b in zip(here, bin)))
        return bin

    def forward(self, x: Lanes) -> tuple[Lanes, Lanes]:
        """y and dy/dx."""
        b = self._bin(x, False)
        z = dr.clip((x - b.x) / b.dx, 0, 1)
        return b.y + b.dy * _rational(b, z), _slope(b, z)

    def inverse(self, y: Lanes) -> tuple[Lanes, Lanes]:
        """x and dy/dx there."""
        b = self._bin(y, True)
        s, t = b.dy / b.dx, dr.clip((y - b.y) / b.dy, 0, 1)
        bend = t * (b.d + b.d_next - 2 * s)
        p, q, c = s - b.d + bend, b.d - bend, -s * t
        z = dr.clip(2 * c / (-q - dr.safe_sqrt(q * q - 4 * p * c)), 0, 1)
        return b.x + z * b.dx, _slope(b, z)


def _shares(raw: Sequence[Lanes], bound: float) -> list[Lanes]:
    """2 softmax of bounded numbers."""
    logits = [dr.exp(a / (1 + 2 * dr.abs(a) / bound)) for a in raw]
    scale = 2 / sum(logits)
    return [v * scale for v in logits]


def _rational(b: _Bin, z: Lanes) -> Lanes:
    s = b.dy / b.dx
    return (s * z * z + b.d * z * (1 - z)) / (s + (b.d + b.d_next - 2 * s) * z * (1 - z))


def _slope(b: _Bin, z: Lanes) -> Lanes:
    s = b.dy / b.dx
    over = s + (b.d + b.d_next - 2 * s) * z * (1 - z)
    return s * s * (2 * s * z * (1 - z) + b.d * (1 - z) * (1 - z) + b.d_next * z * z) / (over * over)


# ----------------------------------------------------------------------------------------------------
# A masked autoregressive flow of splines over [0, 1)^d given a context, evaluated in Dr.Jit with trained weights.
# z_j = s_j(x_j; network(x_1 ... x_{j-1}, context)), z uniform: p(x | context) = prod_j ds_j/dx_j. The hidden layers are
# masked, so one evaluation of the network gives the density, and d of them a sample.


@dataclass(frozen=True, eq=False)
class ConditionalFlow:
    """The flow.

    Args:
        n: its dimensions d.
        weights: F_k (outputs, inputs) and h_k of the layers, masks multiplied in; inputs are d coordinates and the
            context, outputs 3 K - 1 numbers for each coordinate.
    """

    n: int
    weights: Mapping[str, np.ndarray]

    @functools.cached_property
    def _network(self) -> Perceptron:
        return Perceptron.named(self.weights, "F", "h", activation=relu, looped=True)

    def _splines(self, x: Sequence[Lanes], context: Sequence[Lanes]) -> list[Lanes]:
        return self._network([*x, *context])

    def _spline(self, raw: list[Lanes], j: int) -> Spline:
        return Spline(raw[j * PARAMETERS : (j + 1) * PARAMETERS])

    def sample(self, context: Sequence[Lanes], u: Sequence[Lanes]) -> tuple[list[Lanes], Lanes]:
        """x in [0, 1)^d for d uniform numbers, and its density."""
        x, density = [0.0] * self.n, 1.0
        for j in range(self.n):
            spline = self._spline(self._splines(x, context), j)
            x[j], slope = spline.inverse(2 * u[j] - 1)
            density = density * slope
        return [0.5 * (v + 1) for v in x], density

    def density(self, context: Sequence[Lanes], x: Sequence[Lanes]) -> Lanes:
        """Of x in [0, 1)^d."""
        inner, density = [2 * v - 1 for v in x], 1.0
        raw = self._splines(inner, context)
        for j in range(self.n):
            density = density * self._spline(raw, j).forward(inner[j])[1]
        return density


# ---- Entries by learnt patches and, within the patch, by a flow ------------------------------------


@dataclass(frozen=True, eq=False)
class FlowSampler:
    """density(x | exit) = (share of the patch of x) / A_k p(u | exit, patch), u the coordinates of x in the patch.

    Args:
        patches: weights of the patches.
        chart: their coordinates.
        flow: of two dimensions.
    """

    patches: PatchSampler
    chart: Chart
    flow: ConditionalFlow

    @property
    def frame(self) -> ObjectFrame:
        """Of the object."""
        return self.patches.frame

    def sample(self, exit: Side, weights: PatchWeights, u_patch: Lanes, u: tuple[Lanes, Lanes]) -> tuple[Point, Lanes]:
        """A point of entry and its density, 1/(scene unit)²."""
        patch, of_patch = self.patches.patch(weights, u_patch)
        told = context(self.frame, exit, self.chart.frame(patch))
        x, density = self.flow.sample(told, u)
        return self.chart.point(patch, tuple(x)), of_patch * density

    def density(self, exit: Side, weights: PatchWeights, face: Lanes, p: Lanes) -> Lanes:
        """Density of `sample` at a point of a face, 1/(scene unit)²."""
        patch = self.patches.patches.row("patch", face)
        told = context(self.frame, exit, self.chart.frame(patch))
        return self.patches.density(weights, face) * self.flow.density(told, self.chart.coordinates(face, p))


class _FlowOfExit(NamedTuple):
    side: Side
    weights: PatchWeights | None


@dataclass(frozen=True, eq=False)
class FlowProposals(CosineProposals):
    """The proposals of a flow; directions by the cosine.

    Args:
        sampler: of the points.
        sign: that turns geometric normals outwards.
        table: of the weights of patches by the face of an exit; without it the network is asked for each exit.
    """

    sampler: FlowSampler
    sign: float
    table: PatchTable | None = None

    def prepare(self, out: SurfacePoint, prepared: PreparedExit, active: Lanes) -> _FlowOfExit:
        weights = self.sampler.patches.prepare(prepared.side) if self.table is None else None
        return _FlowOfExit(prepared.side, weights)

    def sample(
        self, out: SurfacePoint, prim_index: Lanes, prepared: _FlowOfExit, sampler: mi.Sampler, active: Lanes
    ) -> EntrySample:
        u = sampler.next_1d(), tuple(sampler.next_2d())
        weights = prepared.weights if self.table is None else self.table.weights(prim_index)
        at, density = self.sampler.sample(prepared.side, weights, *u)
        n_out = turned(at.n_shading, at.n) * opaque(self.sign)
        weight = dr.select(active & (density > 0), 1 / density, 0)
        n = mi.Normal3f(at.n * opaque(self.sign))
        return EntrySample(mi.Point3f(at.p), n, mi.Normal3f(n_out), weight, mi.UInt32(at.prim_index))
