"""Features of an exit, an entry and the pair of them, with the first scattering event of each.

One definition in Dr.Jit, for training data and for rendering. Lengths and positions are over half the diagonal of the
object, in its own frame; logarithms of lengths are in mean free paths of the mean over channels.

The first scattering event inside, without randomness. From (x, w): refract, go to the boundary, lose the part that
Fresnel lets out, reflect, until nothing is left or 32 times: thin things lead light by total reflection. Segments k of
length l_k from o_k along d_k are reached with the weight v_k: v_0 = 1, v_{k+1} = v_k exp(-sigma_t l_k) F_k, and

    P = sum_k v_k (1 - exp(-sigma_t l_k)),    P y = sum_k v_k ∫_0^{l_k} sigma_t exp(-sigma_t s) (o_k + s d_k) ds.

P is the probability to be scattered or absorbed before leaving; on a plane it is 1. What is still inside after the last
reflection is left out. Where a segment meets something inside the object, all of v_k ends there and counts in P.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy.ndimage import gaussian_filter

from full_geometry.geometry import mesh
from full_geometry.geometry.points import SurfacePoint, channel_mean, lifted, mirrored, opaque, refract_in, turned
from full_geometry.objects.objects import TranslucentObject
from full_geometry.surface.varying import grid_values
from full_geometry.walk.media import walk_media
from halfspace_sss.arrays import library
from halfspace_sss.backend import one_blas_thread
from halfspace_sss.neural.perceptron import Perceptron
from halfspace_sss.physics import fresnel
from halfspace_sss.tracing.walk import generator, pass_seed

Lanes = "mi.Float | np.ndarray | torch.Tensor"
REFLECTIONS = 32
NEGLIGIBLE = 1e-3  # weight of what is still inside
CELLS, FIRST_CELL = 12, 0.25  # of a march; the first one in mean free paths


class FirstEvent(NamedTuple):
    """P per channel; y and the mean length of the way there, means over channels weighted by P; both per channel.
    Also `local`: of a medium that varies logarithms of its coefficients where light enters and at y, of one with
    textures those of the exit."""

    P: mi.Spectrum
    y: mi.Point3f
    length: mi.Float
    ys: list[mi.Point3f]
    lengths: mi.Spectrum
    local: tuple[mi.Float, ...] = ()


def flight(
    obj: TranslucentObject, o: mi.Point3f, d: mi.Vector3f, length: mi.Float, sigma_t: mi.Spectrum
) -> tuple[mi.Spectrum, mi.Spectrum]:
    """exp(-∫ sigma_t) over a length from o along d, and ∫ s sigma_t exp(-∫ sigma_t) ds, per channel.
    A medium that varies is marched in cells that grow from a part of a mean free path on, each homogeneous."""

    def add(
        sigma_t: mi.Spectrum, T: mi.Spectrum, inner: mi.Spectrum, s: mi.Float, h: mi.Float
    ) -> tuple[mi.Spectrum, mi.Spectrum]:
        through = dr.minimum(dr.exp(-sigma_t * h), 1)
        mean = dr.maximum((1 - through) / dr.maximum(sigma_t, 1e-20) - h * through, 0)  # rounding, of short ways
        return T * through, inner + T * (mean + s * (1 - through))

    T, inner = mi.Spectrum(1), mi.Spectrum(0)
    if obj.varying is None:
        return add(sigma_t, T, inner, mi.Float(0), length)
    h = dr.minimum(length / CELLS, FIRST_CELL / dr.max(sigma_t))
    growth = _growth(length / h)

    def cell(k: mi.UInt32, s: mi.Float, h: mi.Float, T: mi.Spectrum, inner: mi.Spectrum) -> tuple:
        sigma_t = walk_media(obj).heterogeneous.sigma_t(mi.UInt32(0), o + d * (s + 0.5 * h))
        T, inner = add(sigma_t, T, inner, s, h)
        return k + 1, s + h, h * growth, T, inner

    state = (mi.UInt32(0), mi.Float(0), h, T, inner)
    return dr.while_loop(state, lambda k, *_: k < CELLS, cell, label="march")[3:]


def _growth(ratio: mi.Float) -> mi.Float:
    """q with 1 + q + ... + q^(CELLS-1) = ratio >= CELLS, by a few steps of Newton on its logarithm."""
    x = dr.maximum(dr.log(ratio) / CELLS, 1e-3)
    for _ in range(5):
        top, bottom = dr.exp(CELLS * x) - 1, dr.exp(x) - 1
        f = dr.log(top / bottom) - dr.log(ratio)
        slope = CELLS * (top + 1) / top - (bottom + 1) / bottom
        x = dr.maximum(x - f / slope, 1e-4)
    return dr.exp(x)


LEAST_RATIO = 1e-3  # in logarithms of what varies


def _varying_channels(obj: TranslucentObject) -> tuple[int, int]:
    """Channels in which extinction and albedo vary in space."""
    volumes = (None, None) if obj.varying is None else (obj.varying.density, obj.varying.albedo_volume)
    n_t, n_albedo = (0 if volume is None else grid_values(volume).shape[-1] for volume in volumes)
    return n_t, n_albedo


def n_local(obj: TranslucentObject) -> int:
    if obj.textured is not None:
        return len(obj.media) * (2 - len({"albedo", "sigma_t"}.intersection(obj.textured.constants)))
    return 2 * sum(_varying_channels(obj))


def local(obj: TranslucentObject, at: SurfacePoint, y: mi.Point3f) -> tuple[mi.Float, ...]:
    """What varies, of the point `at` and of its y: log of sigma_t over its mean, and half the log of 1 - albedo."""
    if obj.textured is not None:
        ratio, lost = at.medium.sigma_t / obj.sigma_t, 1 - at.medium.albedo
        kinds = {"sigma_t": dr.log(ratio + LEAST_RATIO), "albedo": 0.5 * dr.log(lost + LEAST_RATIO)}
        return tuple(v for name, values in kinds.items() if name not in obj.textured.constants for v in values)
    return () if obj.varying is None else (*_varied(obj, at.p), *_varied(obj, y))


def _varied(obj: TranslucentObject, p: mi.Point3f) -> tuple[mi.Float, ...]:
    n_t, n_albedo = _varying_channels(obj)
    sigma_t, sigma_s = walk_media(obj).heterogeneous.coefficients(mi.UInt32(0), p)
    ratio, albedo = sigma_t / obj.sigma_t, sigma_s / dr.maximum(sigma_t, 1e-20)
    return (
        *(dr.log(ratio[c] + LEAST_RATIO) for c in range(n_t)),
        *(0.5 * dr.log(1 - albedo[c] + LEAST_RATIO) for c in range(n_albedo)),
    )


def first_event(obj: TranslucentObject, at: SurfacePoint, active: mi.Bool = True) -> FirstEvent:
    """The first event of light that goes in or out along w at a point of the surface."""
    sigma_t = obj.sigma_t if obj.textured is None else at.medium.sigma_t
    eta, sign = obj.eta, opaque(obj.geometry.sign)
    media, inclusions = walk_media(obj), obj.geometry.inclusions
    d, _, valid = refract_in(at, eta)
    flags = mi.RayFlags.Minimal | mi.RayFlags.ShadingFrame

    def step(
        k: mi.UInt32, o: mi.Point3f, d: mi.Vector3f, off: mi.Vector3f, v: mi.Spectrum, way: mi.Float, sums: tuple,
        active: mi.Bool,
    ) -> tuple:  # fmt: skip
        P, moments, length = sums
        si = obj.geometry.ray_intersect(mi.Ray3f(mi.Point3f(o + off), d), flags, False, active)
        l = dr.select(si.is_valid(), dr.maximum(si.t + dr.dot(off, d), 0), 1e4 / dr.min(sigma_t))  # noqa: E741
        l, met = (l, mi.Bool(False)) if inclusions is None else inclusions.reach(o, d, l, active)  # noqa: E741
        through, inner = flight(obj, o, d, l, sigma_t)
        through, inner = dr.select(met, 0, through), dr.select(met, inner + through * l, inner)
        part, inner = v * (1 - through), v * inner
        moments = [moment + (o * a + d * b) for moment, a, b in zip(moments, part, inner)]
        length = length + part * way + inner
        n_face = si.n * sign
        n = lifted(turned(si.sh_frame.n, si.n) * sign, n_face, d)
        c = dr.dot(d, n)
        v = v * through * mi.fresnel(dr.abs(c), dr.select(c > 0, 1 / eta, eta))[0]
        onward = -mirrored(n * (2 * c) - d, n_face)
        goes_on = ~met & si.is_valid() & (c > 0) & (dr.max(v) > NEGLIGIBLE) & (k < REFLECTIONS)
        off, onward = media.clear(mi.UInt32(0), si.n, onward), mi.Vector3f(onward)
        return k + 1, mi.Point3f(si.p), onward, off, v, way + l, (P + part, moments, length), active & goes_on

    state = (
        mi.UInt32(0), mi.Point3f(at.p), d, media.clear(mi.UInt32(0), at.n, d), mi.Spectrum(1), mi.Float(0),
        (mi.Spectrum(0), [mi.Vector3f(0) for _ in obj.media], mi.Spectrum(0)), valid & active,
    )  # fmt: skip
    P, moments, length = dr.while_loop(state, lambda *s: s[-1], step, label="first event")[-2]
    total, each = dr.maximum(channel_mean(P), 1e-20), dr.maximum(P, 1e-20)
    y = dr.select(channel_mean(P) > 0, mi.Point3f(sum(moments) / (len(moments) * total)), at.p)
    ys = [dr.select(p > 0, mi.Point3f(moment / e), at.p) for moment, p, e in zip(moments, P, each)]
    return FirstEvent(P, y, channel_mean(length) / total, ys, length / each, local(obj, at, y))


# ----------------------------------------------------------------------------------------------------
# How much of an object surrounds a point: what the network of one object is told of fins, rims and folds.
# For some widths s the share of a Gaussian ball that lies inside of the object, and for one of them its slope,
#
#     O_s(p) = ∫ inside(q) exp(-|p - q|² / 2s²) / (2 pi s²)^(3/2) dq,    s grad O_s(p),
#
# from a grid in the frame of the object, interpolated linearly. Widths say nearly the same, and what sets them apart,
# how the surface bends, is small: over random points of the surface, and apart from these over their first events, the
# fields have mean 0, spread 1 and no correlation, turned by C^(-1/2) of their covariance C.

POINT, EVENT = 0, 1  # kinds of places: of the surface, and of first events

WIDTHS, SLOPED = (0.5, 1.0, 2.0, 4.0), 1  # mean free paths, or cells where those are larger; which has a slope
FIELDS = len(WIDTHS) + 3
CELL, MOST = 0.3, 96  # mean free paths; cells along the longest side
MARGIN = 0.02  # of that side, around the object
TRUNCATED = 3.0  # standard deviations
LEAST_SPREAD = 5e-3
POINTS, SEED = 8192, 11  # of the surface, that the covariance is taken over
RAYS = ((0.013, 0.027, 1.0), (1.0, 0.021, -0.017), (-0.015, -1.0, 0.031))  # along no axis: faces often are


@dataclass(frozen=True, eq=False)
class Surroundings:
    """The fields of one object. `textures`: their values, turned for points and for first events. `low`, `scale`: of a
    position in the frame, that turn it into one of a texture: (q - low) scale. `turns`: (2, fields, fields + 1),
    C^(-1/2) and -C^(-1/2) of the mean for points and for first events."""

    textures: tuple[mi.Texture3f, mi.Texture3f]
    low: mi.Point3f
    scale: mi.Vector3f
    turns: np.ndarray

    def __call__(self, q: mi.Vector3f, kind: int) -> list[mi.Float]:
        """Of a position in the frame, a `POINT` or an `EVENT`."""
        return self.textures[kind].eval((mi.Point3f(q) - self.low) * self.scale)


def surroundings(obj: TranslucentObject, frame: ObjectFrame, turns: np.ndarray | None = None) -> Surroundings:
    """The fields of an object.
    `frame`: a `ObjectFrame` of its features. `turns`: those of training; by default made from random points."""
    low, high = _bounds(obj, frame)
    longest = float((high - low).max())
    low, high = low - MARGIN * longest, high + MARGIN * longest
    path = 1 / float(np.array(frame.sigma_t * frame.radius).ravel()[0])
    cell = max(CELL * path, longest / MOST)
    cells = np.maximum(np.ceil((high - low) / cell).astype(int), 2)
    values = _fields(solid(obj, frame, low, cell, cells), max(path / cell, 1.0))
    places = mi.Point3f(*map(opaque, low)), mi.Vector3f(*map(opaque, 1 / (cell * cells)))

    def turned(turns: np.ndarray) -> Surroundings:
        every = (values @ turn[:, :-1].T + turn[:, -1] for turn in turns.astype(np.float32))
        textures = (mi.Texture3f(mi.TensorXf(v), use_accel=False, wrap_mode=dr.WrapMode.Clamp) for v in every)
        return Surroundings(tuple(textures), *places, turns)

    straight = np.eye(FIELDS, FIELDS + 1, dtype=np.float32)
    return turned(_turns(obj, frame, turned(np.stack([straight] * 2))) if turns is None else turns)


def _turns(obj: TranslucentObject, frame: ObjectFrame, fields: Surroundings) -> np.ndarray:
    """C^(-1/2) of the fields over random points and over their first events, with what takes their means off."""
    at = obj.random_points(generator(mi, POINTS, pass_seed(SEED)))
    turns = []
    for kind, place in ((POINT, at.p), (EVENT, first_event(obj, at).y)):
        values = fields(frame.position(place), kind)
        dr.eval(values)
        values = np.stack([v.numpy() for v in values]).astype(float)
        with one_blas_thread():
            spread, axes = np.linalg.eigh(np.cov(values))
            turn = (axes / np.sqrt(np.maximum(spread, 0) + LEAST_SPREAD**2)) @ axes.T
            turns.append(np.column_stack([turn, -turn @ values.mean(axis=1)]))
    return np.array(turns, dtype=np.float32)


def solid(obj: TranslucentObject, frame: ObjectFrame, low: np.ndarray, cell: float, cells: np.ndarray) -> np.ndarray:
    """1 where the middle of a cell lies inside, (z, y, x): where most of three rays meet the surface from within."""
    nx, ny, _ = (int(n) for n in cells)
    k = dr.arange(mi.UInt32, int(np.prod(cells)))
    index = (k % nx, (k // nx) % ny, k // (nx * ny))
    q = [opaque(a) + opaque(cell) * (mi.Float(i) + 0.5) for a, i in zip(low, index)]
    votes = mi.UInt32(0)
    for ray in RAYS:
        p, d = frame.back(mi.Vector3f(*q), dr.normalize(mi.Vector3f(*ray)))
        si = obj.geometry.ray_intersect(mi.Ray3f(p, d), mi.RayFlags.All)
        votes += dr.select(si.is_valid() & (dr.dot(d, si.n) * opaque(obj.geometry.sign) > 0), mi.UInt32(1), 0)
    return (votes >= 2).numpy().astype(np.float32).reshape(cells[::-1])


def _fields(inside: np.ndarray, path: float) -> np.ndarray:
    """All fields, (z, y, x, fields), for widths over `path` cells."""
    balls = [gaussian_filter(inside, s * path, mode="constant", truncate=TRUNCATED) for s in WIDTHS]
    slope = np.gradient(balls[SLOPED])[::-1]
    return np.stack([*balls, *(WIDTHS[SLOPED] * path * part for part in slope)], axis=-1)


def _bounds(obj: TranslucentObject, frame: ObjectFrame) -> tuple[np.ndarray, np.ndarray]:
    """Of the object in its frame."""
    if mesh.has_faces(obj.geometry.shape):
        corners = mi.Point3f(mesh.vertex_positions(obj.geometry.shape).T)
    else:
        box = obj.geometry.shape.bbox()
        low, high = (np.array(v, dtype=np.float32).ravel() for v in (box.min, box.max))
        corners = mi.Point3f(np.where(np.indices((2, 2, 2)).reshape(3, 8) > 0, high[:, None], low[:, None]))
    q = np.array(frame.position(corners)).reshape(3, -1).astype(float)
    return q.min(axis=1), q.max(axis=1)


OCTAVES = 2
PAIR = 21  # numbers of a pair before those of each channel
LEAST_P, LEAST_LENGTH = 1e-3, 1e-2
POSITION, DIRECTION = 3 * (1 + 2 * OCTAVES), 3  # numbers of a point with its octaves, and of a direction
MU = 2 * (POSITION + DIRECTION)  # place among the features of a side, of two points and two directions, of mu,
P_0 = MU + 2  # after mu and the log of a length, of the first channel of P


class Side(NamedTuple):
    """Exit or entry: its point and its first event."""

    at: SurfacePoint
    event: FirstEvent


def entered(at: SurfacePoint, exit: SurfacePoint) -> SurfacePoint:
    """An entry of light that leaves at an exit, whose medium walks have all the way where media have textures."""
    return at._replace(medium=exit.medium)


@dataclass(frozen=True, eq=False)
class ObjectFrame:
    """The object's own frame and scales.

    Args:
        centre: of the object, scene units.
        radius: half the diagonal of its bounding box, scene units.
        sigma_t: 1/(scene unit), geometric mean over channels.
        each: 1/(scene unit), sigma_t of each channel.
        turn: 3 x 3 rows that turn world directions into the frame; None where it is the identity.
        around: how much of the object surrounds a position in the frame.
    """

    centre: mi.Point3f
    radius: mi.Float
    sigma_t: mi.Float
    each: tuple[mi.Float, ...]
    turn: list[mi.Vector3f] | None = None
    around: Surroundings | None = None

    def position(self, p: mi.Point3f) -> mi.Vector3f:
        """In the frame, of order one."""
        return self.direction(p - self.centre) / self.radius

    def direction(self, w: mi.Vector3f) -> mi.Vector3f:
        return mi.Vector3f(w) if self.turn is None else mi.Vector3f(*(dr.dot(row, w) for row in self.turn))

    def back(self, q: mi.Vector3f, d: mi.Vector3f) -> tuple[mi.Point3f, mi.Vector3f]:
        """A position and a direction of the frame in the world."""
        q, d = (v if self.turn is None else sum(row * x for row, x in zip(self.turn, v)) for v in (q, d))
        return mi.Point3f(self.centre + mi.Vector3f(q) * self.radius), mi.Vector3f(d)


def n_side(channels: int, local: int = 0) -> int:
    """Number of features of a side; `local` of them are what varies."""
    return P_0 + channels + local + 2 * FIELDS


def n_pair(channels: int) -> int:
    """Number of features of a pair beside those of its sides."""
    return PAIR + channels


class Terms(NamedTuple):
    """Products of two of (1, features of a side): all features, and those of two that are no octaves.
    `heads`: places of the first factors among (1, features), no octaves. `rows`, `cols`: of each product the first
    factor among the heads, and the second among (1, features)."""

    heads: np.ndarray
    rows: np.ndarray
    cols: np.ndarray

    @classmethod
    def of(cls, n: int) -> Terms:
        octaves = np.r_[3:POSITION, POSITION + 3 : 2 * POSITION]
        heads = np.concatenate([[0], 1 + np.setdiff1d(np.arange(n), octaves)])
        rows, cols = np.triu_indices(len(heads) - 1)
        rows, cols = np.append(np.zeros(n + 1, int), 1 + rows), np.append(np.arange(n + 1), heads[1:][cols])
        return cls(heads, rows, cols)

    def matrix(self, numbers: np.ndarray) -> np.ndarray:
        """Numbers (..., products) as matrices (..., heads, 1 + features)."""
        symmetric = np.zeros((*numbers.shape[:-1], len(self.heads), int(self.cols.max()) + 1), numbers.dtype)
        symmetric[..., self.rows, self.cols] = numbers
        return symmetric


class Quadratic:
    """h = l . x + x_h . Q x_h of an end, x = (1, features), x_h those of them that are no octaves.
    `numbers`: (outputs, products) of `Terms`. `n`: features of a side."""

    def __init__(self, numbers: np.ndarray, n: int) -> None:
        terms = Terms.of(n)
        matrix, self.heads = terms.matrix(numbers.astype(np.float32)), terms.heads[1:]
        line, square = matrix[:, 0], matrix[:, 1:, self.heads].reshape(-1, len(self.heads))
        self._line = Perceptron([line[:, 1:]], [line[:, 0]], looped=True)
        self._square = Perceptron([square], [np.zeros(len(square), np.float32)], looped=True)

    def __call__(self, columns: list[mi.Float]) -> list[mi.Float]:
        heads = [columns[k - 1] for k in self.heads]
        y = self._square(heads)
        rows = (y[k : k + len(heads)] for k in range(0, len(y), len(heads)))
        return [sum((a * b for a, b in zip(heads, row)), first) for row, first in zip(rows, self._line(columns))]


def _octaves(x: mi.Vector3f) -> list[mi.Float]:
    columns = list(x)
    for k in range(OCTAVES):
        for component in x:
            columns += dr.sincos(math.pi * 2**k * component)
    return columns


def side_features(frame: ObjectFrame, side: Side) -> list[mi.Float]:
    """Position and y with two octaves of sine and cosine, normal, w, mu, log of the way to y, log P, what varies, and
    how much of the object surrounds the position and y.
    """
    at, event = side.at, side.event
    n, w = frame.direction(at.n_out), frame.direction(at.w)
    p, y = frame.position(at.p), frame.position(event.y)
    return [
        *_octaves(p), *_octaves(y), *n, *w, dr.dot(n, w),
        _log(frame.sigma_t, event.length), *(0.5 * dr.log(P + LEAST_P) for P in event.P), *event.local,
        *frame.around(p, POINT), *frame.around(y, EVENT),
    ]  # fmt: skip


def entering(columns: Sequence[Lanes], eta: Lanes | float, channels: int) -> tuple[list[Lanes], list[Lanes]]:
    """F_t(mu), and F_t(mu) P, per channel: the shares of light along w that enter, and are scattered or absorbed.
    `columns`: features of a side, of NumPy, torch or Dr.Jit. `eta`: relative index."""
    lib, mu = library(columns[MU]), columns[MU]
    F_t = fresnel.F_t(lib.maximum(mu, 0 * mu), eta)
    P = [lib.exp(2 * columns[P_0 + c]) - LEAST_P for c in range(channels)]
    return [F_t] * channels, [F_t * lib.maximum(p, 0 * mu) for p in P]


def pair_features(frame: ObjectFrame, exit: Side, entry: Side) -> list[mi.Float]:
    """x_i - x_o as direction and length, log r, log |y_i - y_o|, dot products of directions and normals, and what the
    surface at one end says of y at the other: its depth below the plane there, its distance from the point, and the
    cosine between the way to y and the way on to the other y; log of the distance between the two y of each channel.
    """
    o, i = exit.at, entry.at
    d = i.p - o.p
    r = dr.norm(d)
    d = d / dr.maximum(r, 1e-6 * frame.radius)
    between = entry.event.y - exit.event.y
    gap = dr.norm(between)
    between = between / dr.maximum(gap, 1e-6 * frame.radius)
    return [
        *frame.direction(d), r / frame.radius, _log(frame.sigma_t, r), _log(frame.sigma_t, gap), gap / frame.radius,
        dr.dot(o.n_out, i.n_out), dr.dot(o.w, i.w), dr.dot(o.n_out, d), dr.dot(i.n_out, d), dr.dot(o.w, d),
        dr.dot(i.w, d), dr.dot(o.n_out, i.w), dr.dot(i.n_out, o.w),
        _depth(frame, i, exit.event.y), _depth(frame, o, entry.event.y),
        _log(frame.sigma_t, dr.norm(exit.event.y - i.p)), _log(frame.sigma_t, dr.norm(entry.event.y - o.p)),
        _cosine(frame, exit, between), _cosine(frame, entry, -between),
        *(_log(t, dr.norm(a - b)) for t, a, b in zip(frame.each, exit.event.ys, entry.event.ys)),
    ]  # fmt: skip


def _log(sigma_t: mi.Float, length: mi.Float) -> mi.Float:
    return 0.5 * dr.log(length * sigma_t + LEAST_LENGTH)


def _depth(frame: ObjectFrame, at: SurfacePoint, y: mi.Point3f) -> mi.Float:
    """t/(1 + |t|) of the depth t below the plane of a point, in mean free paths."""
    t = dr.dot(at.n_out, at.p - y) * frame.sigma_t
    return t / (1 + dr.abs(t))


def _cosine(frame: ObjectFrame, side: Side, onward: mi.Vector3f) -> mi.Float:
    """Between the way from a point to its y and a direction."""
    way = side.event.y - side.at.p
    return dr.dot(way, onward) / dr.maximum(dr.norm(way), 1e-6 * frame.radius)


def reverse(n: int, channels: int) -> tuple[np.ndarray, np.ndarray]:
    """Order and signs that turn the features of (exit, entry, pair), n of each side, into those of the way back."""
    pair = np.arange(n_pair(channels))
    pair[:PAIR] = np.array([0, 1, 2, 3, 4, 5, 6, 7, 8, 10, 9, 12, 11, 14, 13, 16, 15, 18, 17, 20, 19])
    signs = np.ones(2 * n + n_pair(channels), dtype=np.float32)
    signs[2 * n + np.array([0, 1, 2, 9, 10, 11, 12])] = -1
    return np.concatenate([np.arange(n, 2 * n), np.arange(n), 2 * n + pair]), signs


class PreparedExit(NamedTuple):
    """What is done once for all entries of an exit: its end of the start, its share of the first layer, and h."""

    side: Side
    hidden: list[mi.Float]
    h: Sequence[mi.Float] = ()
