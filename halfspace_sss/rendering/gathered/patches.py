"""What a model is expected to bring from each part of a surface to each other: a control variate of sampled entries.

The surface is cut into the cells of its points: a place belongs to the point of the largest weight, see `points`; on a
mesh of many faces all of a face does to that of its centroid. With the directional albedo a(mu) of the model, S mu_i
is close to

    h = a(w_o) T_jk a(w_i) mu_i / C,    C = ∫ a(mu) mu dw,    j the cell of x_o, k that of x_i,

so that with the light Phi_k = ∫∫ a(w_i) mu_i / C L_i dw_i dA_i that enters each cell

    L_o = a(w_o) Σ_k T_jk Phi_k + ∫∫ (S mu_i - h) L_i dw_i dA_i.

The first term has no noise. The second has no bias whatever T is, as samples and Phi take the same function h.
T is that of the least squares of S mu_i - h over the density of entries that the proposals draw, held to the mean of S
between places in the cells where there are few.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np

from halfspace_sss.rendering.gathered.points import SurfacePoints, uniform_entries
from halfspace_sss.rendering.gathered.transfer import Albedo, drawn
from halfspace_sss.rendering.object.points import AreaPoints, EntrySample, SurfacePoint, cosine_above, evaluate

if TYPE_CHECKING:
    from halfspace_sss.rendering.object.objects import TranslucentObject

PER_LENGTH = 1.0  # points over a transport mean free path
FEWEST, MOST = 1024, 2048  # points: 13 MB to 50 MB for three channels
SAMPLES = 2**21  # entries of all points
PLACES = 2**19  # by which the areas of cells are measured
FACES = 4  # of a mesh for each cell, from which on none is divided
PAIRS = 4  # of places for each pair of cells,
HELD = 4  # which count as so many entries
CENTROID = 5 / 9, 0.5  # of `square_to_uniform_triangle`


class TransferRow(NamedTuple):
    """The cell of an exit, and a(w_o); 0 where there is none."""

    j: mi.UInt32
    a: mi.Spectrum


@dataclass(frozen=True, eq=False)
class PatchTransfer:
    """Of one object.

    Args:
        cells: of its surface.
        T: (cells, cells, channels), from k to j, 1/(scene unit)².
        albedo: a.
        seen: share of the area whose light leaves at one exit: of uniform points so many tell of it.
        moments: of S mu_i and h over the density of entries, means over the exits of E[S h], E[h²], E[S] E[h], E[h]²,
            shape (4, channels).
    """

    cells: SurfaceCells
    T: np.ndarray
    albedo: Albedo
    seen: float
    moments: np.ndarray

    def factor(self, v: np.ndarray) -> np.ndarray:
        """Of T, that leaves the least variance in light of the relative variance v at an entry, per channel.

        The variance is (1 + v) E[(S - beta h)²] - E[S - beta h]²: in even light entries by S itself are hard to better.
        """
        both, square, means, mean = self.moments
        beta = ((1 + v) * both - means) / np.maximum((1 + v) * square - mean, 1e-30)
        return np.clip(beta, 0, 1)

    @cached_property
    def _lanes(self) -> mi.Float:
        return mi.Float(self.T.ravel())

    def row(self, out: SurfacePoint, face: mi.UInt32, active: mi.Bool) -> TransferRow:
        """Of an exit on a face."""
        mu = dr.dot(out.w, out.n_out)
        active = active & (mu > 0)
        j, result = self.cells(out.p, out.n, face, active)
        return TransferRow(j, dr.select(active & result, self.albedo(dr.maximum(mu, 0)), 0))

    def expected(self, row: TransferRow, entry: EntrySample, w_i: mi.Vector3f, active: mi.Bool) -> mi.Spectrum:
        """h, 1/((scene unit)² sr)."""
        k, result = self.cells(entry.p, entry.n, entry.face, active)
        at = row.j * dr.opaque(mi.UInt32, len(self.cells.points)) + k
        T = dr.gather(mi.Spectrum, self._lanes, at, active & result)
        return row.a * T * self.albedo.cosine(w_i, entry.n, entry.n_out)


@dataclass(frozen=True, eq=False)
class SurfaceCells:
    """Of the surface of an object.

    Args:
        points: in the middle of each.
        of_face: of each face of a mesh of many, whether there is one, and which; None for others.
    """

    points: SurfacePoints
    of_face: tuple[mi.Bool, mi.UInt32] | None

    @classmethod
    def of(cls, obj: TranslucentObject, points: SurfacePoints) -> SurfaceCells:
        """Those of points."""
        n = obj.geometry.shape.face_count() if obj.geometry.shape.is_mesh() else 0
        if n < FACES * len(points):
            return cls(points, None)
        face = dr.arange(mi.UInt32, n)
        at = AreaPoints(obj.geometry.shape).on_face(face, mi.Point2f(*CENTROID))
        k, result = points.nearest(mi.Point3f(at.p), mi.Normal3f(at.n) * obj.geometry.side(face), mi.Bool(True))
        dr.eval(k, result)
        return cls(points, (result, k))

    def __call__(self, p: mi.Point3f, n: mi.Normal3f, face: mi.UInt32, active: mi.Bool) -> tuple[mi.UInt32, mi.Bool]:
        """The cell of places with outward normals on faces, and whether there is one."""
        if self.of_face is None:
            return self.points.nearest(p, n, active)
        result, k = self.of_face
        return dr.gather(mi.UInt32, k, face, active), active & dr.gather(mi.Bool, result, face, active)


def patch_transfer(obj: TranslucentObject, count: int | None = None, samples: int = SAMPLES) -> PatchTransfer:
    """T of an object, estimated by entries that the proposals of its model draw for exits at all points."""
    sigma = np.mean([float(m.sigma_t_prime) for m in obj.media])
    count = count or int(np.clip(obj.geometry.area * (PER_LENGTH * sigma) ** 2, FEWEST, MOST))
    points = SurfacePoints.of(obj.geometry, count)
    count = len(points)
    cells = SurfaceCells.of(obj, points)
    result = drawn(obj, points, cells, samples)
    areas, places = _areas(obj, cells)
    pair = (np.arange(count)[:, None] * count + result.near)[result.known]
    across = _evaluated(obj, points, places, result.albedo)
    expects = result.a * result.cosine * result.area[:, :, None]
    n = np.bincount(pair, minlength=count**2).reshape(count, count)
    T, moments = np.empty((count, count, result.S.shape[2]), dtype=np.float32), []
    for c in range(T.shape[2]):
        S, h = result.S[result.known, c], expects[result.known, c]
        both, square = (np.bincount(pair, x, count**2).reshape(count, count) for x in (S * h, h * h))
        typical = result.a[:, :, c].mean(axis=1)[:, None] * areas  # h of a cell is drawn with its share of S
        held = HELD * np.where(n > 0, square / np.maximum(n, 1), typical**2)
        T[:, :, c] = (both + held * across[:, :, c]) / np.maximum(square + held, 1e-30)
        expected = result.known * T[np.arange(count)[:, None], result.near, c] * expects[:, :, c]
        S, S_j, h_j = result.S[:, :, c], result.S[:, :, c].mean(axis=1), expected.mean(axis=1)
        moments.append([(S * expected).mean(), (expected**2).mean(), (S_j * h_j).mean(), (h_j**2).mean()])
    flux = np.maximum(T.mean(axis=2) * areas, 0)
    flux /= np.maximum(flux.sum(axis=1, keepdims=True), 1e-30)
    seen = 1 / np.maximum((flux**2 / (areas / areas.sum())).sum(axis=1), 1.0)
    return PatchTransfer(cells, T, result.albedo, float(np.median(seen)), np.array(moments, dtype=float).T)


def _evaluated(obj: TranslucentObject, points: SurfacePoints, places: EntrySample, albedo: Albedo) -> np.ndarray:
    """T by S from places in all cells to the points, (points, points, channels)."""
    count, n = len(points), dr.width(places.p) // len(points)
    lane = dr.arange(mi.UInt32, count * n)
    j, s = lane // n, lane % n
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(9, count * n)
    out, _ = points.exit(j, sampler.next_2d())
    active, size = mi.Bool(True), dr.size_v(mi.Spectrum)
    prepared, a = obj.transport.prepare(out, active), albedo(dr.dot(out.w, out.n_out))
    values = dr.zeros(mi.Float, count * count * n * size)
    dr.eval(out, values, prepared, a)

    def step(k: mi.UInt32, sampler: mi.Sampler) -> tuple[mi.UInt32, mi.Sampler]:
        entry = places.gather(k * n + s)
        w, pdf = cosine_above(entry.n_out, entry.n, sampler.next_2d())
        at_entry = entry.facing(w)
        S = obj.transport.S(prepared, at_entry, pdf > 0) * at_entry.mu / (dr.maximum(pdf, 1e-8) * dr.maximum(a, 1e-6))
        at = ((j * count + k) * n + s) * size
        for c in range(size):
            dr.scatter(values, S[c], at + c)
        return k + 1, sampler

    dr.while_loop((mi.UInt32(0) + dr.zeros(mi.UInt32, count * n), sampler), lambda k, _: k < count, step, label="cells")
    result = np.nan_to_num(np.array(values).reshape(count, count, n, size), nan=0.0, posinf=0.0)
    return result.mean(axis=2)


def _areas(obj: TranslucentObject, cells: SurfaceCells) -> tuple[np.ndarray, EntrySample]:
    """Of all cells, and `PAIRS` places in each; the middle of those without."""
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(5, PLACES)
    at = uniform_entries(obj.geometry, sampler.next_1d(), sampler.next_2d())
    k, known = cells(at.p, at.n, at.face, mi.Bool(True))
    k = np.where(np.array(known), np.array(k), len(cells.points))
    counts = np.bincount(k, minlength=len(cells.points) + 1)[:-1]
    order = np.argsort(k, kind="stable")
    first = np.concatenate([[0], np.cumsum(counts)[:-1]])
    chosen = first[:, None] + np.arange(PAIRS) % np.maximum(counts, 1)[:, None]
    index = mi.UInt32(order[np.minimum(chosen, PLACES - 1)].ravel().astype(np.uint32))
    at = at._replace(weight=at.weight + dr.zeros(mi.Float, PLACES))
    places = at.gather(index)
    evaluate(places)
    return np.maximum(counts, 0.5) * (obj.geometry.area / PLACES), places
