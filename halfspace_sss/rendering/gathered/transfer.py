"""What light that is gathered at points of an object is worth where it leaves: the rows of a transfer matrix.

Directions are taken apart: with the directional albedo a(mu) of the model,

    S(x_i, w_i; x_o, w_o) ~ a(w_o) q(x_i, x_o) a(w_i),    L_o(x_o, w_o) = a(w_o) B(x_o),    B_j = Σ_s t_js L_k(j,s),

L_k the mean of the incident radiance at point k, weighted by a(mu_i) mu_i. Of each point j the entries s are drawn by
the proposals of the model, with directions at both ends, so that under the same light from everywhere the sum is an
unbiased estimate of what the model gives. Where the model knows its directional albedo there (`alpha`), the row is
normalised by that.

Textures vary over less than the distance of points. The medium at entries is that of their own places, and with the
reflectance R of the half-space at the exit

    L_o(x_o, w_o) = a(w_o) R(x_o)^e B(x_o),

e per channel with which what leaves under the same light from everywhere is smoothest: 1/2 where light comes from
further than from the next point, as models take the medium at both ends, up to 1.

a(mu) = F_t(mu) (c_0 + c_1 mu + c_2 mu²) per channel is fitted to samples of all points.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np

from halfspace_sss.physics.fresnel import F_t
from halfspace_sss.rendering.gathered.points import SurfacePoints
from halfspace_sss.rendering.object.points import SurfacePoint, opaque

if TYPE_CHECKING:
    from collections.abc import Callable

    from halfspace_sss.rendering.object.objects import TranslucentObject

PER_LENGTH = 2.0  # points over a transport mean free path
FEWEST, MOST = 1024, 8192  # points
SAMPLES = 2**21  # entries of all points
FITTED = 2**18
SEED = 7
SMOOTHINGS = 8  # of what directions bring
BLOCK = 64  # rows
R_2 = 0.7548776662466927, 0.5698402909980532


def cosine(w: mi.Vector3f, n: mi.Normal3f, n_out: mi.Normal3f) -> mi.Float:
    """Of a direction to the shading normal; 0 below the surface of geometric normal n."""
    return dr.select(dr.dot(w, n) > 0, dr.abs(dr.dot(w, n_out)), 0)


@dataclass(frozen=True)
class Albedo:
    """a(mu) = F_t(mu) (c_0 + c_1 mu + c_2 mu²), c per channel, shape (channels, 3)."""

    c: np.ndarray
    eta: float

    def __call__(self, mu: mi.Float) -> mi.Spectrum:
        F = F_t(mu, opaque(self.eta))
        rows = [[opaque(v) for v in row] for row in self.c]
        return mi.Spectrum([F * dr.maximum(a + mu * (b + mu * c), 0) for a, b, c in rows])

    def cosine(self, w: mi.Vector3f, n: mi.Normal3f, n_out: mi.Normal3f) -> mi.Spectrum:
        """a(mu) mu / ∫ a(mu) mu dw of a direction above a surface of geometric normal n, mu the cosine to n_out."""
        mu = cosine(w, n, n_out)
        return self(mu) * mu * mi.Spectrum([opaque(1 / v) for v in self.whole])

    @cached_property
    def whole(self) -> np.ndarray:
        """∫ a(mu) mu dw of each channel."""
        mu = (np.arange(256) + 0.5) / 256
        a = np.maximum(self.c @ mu ** np.arange(3)[:, None], 0) * F_t(mu, self.eta)
        return np.maximum(2 * np.pi * (a * mu).mean(axis=1), 1e-30)


@dataclass(frozen=True, eq=False)
class Incident:
    """Radiance at points, linear in its direction: L_i(w) = mean + slope.(w - middle), as weighted by a(mu) mu.

    Args:
        mean: (points, channels).
        slope: (points, channels, 3).
        middle: (points, 3).
    """

    mean: np.ndarray
    slope: np.ndarray
    middle: np.ndarray

    @classmethod
    def mean_of(cls, parts: list[Incident]) -> Incident:
        """The mean of several, about the mean of their middles."""
        middle = np.mean([part.middle for part in parts], axis=0)
        means = [part.mean + np.einsum("jck,jk->jc", part.slope, middle - part.middle) for part in parts]
        return cls(np.mean(means, axis=0), np.mean([part.slope for part in parts], axis=0), middle)


@dataclass(frozen=True, eq=False)
class Transfer:
    """Of one object.

    Args:
        points: where light is gathered and where it leaves.
        entry: (points, samples) numbers of the points that entries are at.
        t: (points, samples, channels).
        w_i: (points, samples, 3) directions of entries.
        d_o: (points, samples, 3) directions of exits less their `middle`, (points, 3), both weighted by a.
        inverse: (points, 3, 3) of the covariance of d_o.
        albedo: a.
        error: standard error of the sums of rows over their mean, worst channel, root mean square.
        e: exponent of the reflectance at the exit, per channel.
    """

    points: SurfacePoints
    entry: np.ndarray
    t: np.ndarray
    w_i: np.ndarray
    d_o: np.ndarray
    middle: np.ndarray
    inverse: np.ndarray
    albedo: Albedo
    error: float
    e: np.ndarray

    @property
    def nbytes(self) -> int:
        """Memory of all arrays of entries."""
        return sum(v.nbytes for v in (self.entry, self.t, self.w_i, self.d_o, self.middle, self.inverse))

    @cached_property
    def _even(self) -> tuple[np.ndarray, np.ndarray]:
        """Of uniform light, what leaves (points, channels), and its sum over d_o, (points, channels, 3)."""
        return np.maximum(self.t.sum(axis=1), 1e-30), self.t.transpose(0, 2, 1) @ self.d_o

    def by_place(self, L: Incident) -> np.ndarray:
        """What leaves by the means of the light at the places of entries, (points, channels)."""
        found = np.empty_like(L.mean)
        for rows in self._blocks:
            found[rows] = np.einsum("jsc,jsc->jc", self.t[rows], np.take(L.mean, self.entry[rows], axis=0))
        return found

    @property
    def _blocks(self) -> list[slice]:
        """Rows that fit into the cache of a core together."""
        return [slice(k, k + BLOCK) for k in range(0, len(self.entry), BLOCK)]

    def __matmul__(self, L: Incident) -> np.ndarray:
        """B for incident radiance, linear in w_o: constant and slope, (points, channels, 4).

        What the directions w_i and w_o of single entries bring varies slowly over the surface, and was most of the
        noise: it is averaged over a wider neighbourhood than B is blended from.
        """
        constant = L.mean - np.einsum("kci,ki->kc", L.slope, L.middle)
        axes = [np.ascontiguousarray(L.slope[:, :, axis]) for axis in range(3)]
        B, slope = np.empty_like(L.mean), np.empty_like(L.slope)
        for rows in self._blocks:
            entry, w_i = self.entry[rows], self.w_i[rows]
            arriving = np.take(constant, entry, axis=0)
            for axis, along in enumerate(axes):
                arriving += np.take(along, entry, axis=0) * w_i[:, :, axis, None]
            arriving *= self.t[rows]
            B[rows] = arriving.sum(axis=1)
            slope[rows] = arriving.transpose(0, 2, 1) @ self.d_o[rows]
        slope -= self._even[1] * (B / self._even[0])[:, :, None]  # 0 in uniform light, where a(w_o) is all
        slope = np.einsum("jck,jki->jci", slope, self.inverse)
        by_place = self.by_place(L)
        by_direction = np.concatenate([(B - by_place)[:, :, None], slope], axis=2)
        for _ in range(SMOOTHINGS):
            by_direction = self.points.smoothed(by_direction)
        first, slope = by_direction[:, :, 0], by_direction[:, :, 1:]
        return np.concatenate([(by_place + first - np.einsum("jck,jk->jc", slope, self.middle))[:, :, None], slope], 2)


def count_of(obj: TranslucentObject) -> int:
    """How many points an object gets: so many that their distance is half a transport mean free path."""
    sigma = np.mean([float(m.sigma_t_prime) for m in obj.media])
    return int(np.clip(obj.geometry.area * (PER_LENGTH * sigma) ** 2, FEWEST, MOST))


def transfer(obj: TranslucentObject, count: int | None = None, samples: int = SAMPLES, seed: int = SEED) -> Transfer:
    """The transfer of an object, by its model and the proposals of that."""
    points = SurfacePoints.of(obj.geometry, count or count_of(obj))
    each = max(samples // len(points), 16)
    result = drawn(obj, points, lambda p, n, _, active: points.nearest(p, n, active), each, seed)
    e = _exponents(points, result)
    paint = None if obj.textured is None else result.paint
    t, error = _rows(points, result.S / (result.paint**e)[:, None], (_trusted(obj), paint), result.a)
    near = np.where(result.known, result.near, np.arange(len(points), dtype=np.uint32)[:, None])
    centred = _centred(result.w_o, result.a.mean(axis=2))
    return Transfer(points, near, t, result.w_i, *centred, result.albedo, error, e)


def _exponents(points: SurfacePoints, found: DrawnEntries) -> np.ndarray:
    """e of each channel, by what reflectance and light of points are over those of their neighbours."""
    light = found.S.sum(axis=1) / np.maximum(found.a.sum(axis=1), 1e-30)
    x, y = (v - points.smoothed(v) for v in (np.log(found.paint), np.log(np.maximum(light, 1e-30))))
    return np.clip((x * y).sum(axis=0) / np.maximum((x * x).sum(axis=0), 1e-12), 0, 1).astype(np.float32)


class DrawnEntries(NamedTuple):
    """Entries that the proposals draw for exits at points: n for each, in arrays (points, n) and more.

    Args:
        S: S mu_i over the density, per channel.
        h: a(mu_i) mu_i / ∫ a(mu) mu dw over the density, per channel.
        near, known: the point that the entry is nearest to, and whether there is one.
        w_i, w_o: directions.
        a: directional albedo at the exit, per channel.
        albedo: fitted to them.
        paint: reflectance of the medium at the point, per channel, where media have textures; else 1.
    """

    S: np.ndarray
    h: np.ndarray
    near: np.ndarray
    known: np.ndarray
    w_i: np.ndarray
    w_o: np.ndarray
    a: np.ndarray
    albedo: Albedo
    paint: np.ndarray


def drawn(obj: TranslucentObject, points: SurfacePoints, cell: Callable, n: int, seed: int = SEED) -> DrawnEntries:
    """n entries for each point; `cell` of position, outward normal, face and mask says which they are near."""
    k = dr.arange(mi.UInt32, len(points) * n)
    j, s = k // n, k % n
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(seed, dr.width(k))
    shift, active = sampler.next_2d(), mi.Bool(True)
    jitter = dr.gather(mi.Point2f, shift, j * n)
    u = [dr.fma(mi.Float(s), r, x) for r, x in zip(R_2, (jitter.x, jitter.y))]
    out, face = points.exit(j, mi.Point2f(*(x - dr.floor(x) for x in u)))
    out = obj.knowing(out, face)
    S, inverse, entry, w_i = _sample(obj, out, face, sampler, active)
    near, known = cell(entry.p, entry.n, entry.face, entry.weight > 0)
    mu, mu_i = dr.dot(out.w, out.n_out), cosine(w_i, entry.n, entry.n_out)
    paint = mi.Spectrum(1) if obj.textured is None else obj.transport.paint(out)
    dr.eval(S, inverse, near, known, mu, mu_i, w_i, paint)
    shape = (len(points), n)
    S = np.array(S, dtype=np.float32).reshape(-1, *shape).transpose(1, 2, 0)
    S = np.nan_to_num(S, nan=0.0, posinf=0.0, neginf=0.0)
    albedo = _fitted(obj, np.array(mu), S.reshape(-1, S.shape[2]))
    a = np.array(albedo(mu)).T.reshape(S.shape)
    h = np.array(albedo(mu_i) * (mu_i * inverse)).T.reshape(S.shape) / albedo.whole.astype(np.float32)
    w_i, w_o = (np.array(w, dtype=np.float32).T.reshape(*shape, 3) for w in (w_i, out.w))
    paint = np.broadcast_to(np.array(paint), (S.shape[2], len(mu)))[:, ::n].T
    near, known = (np.array(v).reshape(shape) for v in (near, known))
    return DrawnEntries(S, h, near, known, w_i, w_o, a, albedo, np.maximum(paint, 1e-20))


def _centred(w: np.ndarray, a: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Directions less their mean by the weights a, the mean, and the inverse of their covariance."""
    a = a / a.sum(axis=1, keepdims=True)
    middle = np.einsum("js,jsi->ji", a, w)
    d = w - middle[:, None]
    return d, middle, np.linalg.inv(np.einsum("js,jsi,jsk->jik", a, d, d) + 1e-3 * np.eye(3))


def _sample(obj: TranslucentObject, out: SurfacePoint, face: mi.UInt32, sampler: mi.Sampler, active: mi.Bool) -> tuple:
    """S mu_i over the density of an entry and its direction, the inverse of that, and both."""
    prepared = obj.transport.prepare(out, active)
    where = obj.proposals.prepare(out, prepared, active)
    entry = obj.proposals.sample(out, face, where, sampler, active)
    active = active & (entry.weight > 0)
    w_i, pdf = obj.proposals.sample_direction(entry, out, sampler.next_2d())
    at = entry.facing(w_i)
    inverse = dr.select(active & (pdf > 0), entry.weight / dr.maximum(pdf, 1e-8), 0)
    S = obj.transport.S(prepared, at, active & (pdf > 0)) * (at.mu * inverse)
    return mi.Spectrum(dr.select(active & (pdf > 0), S, 0)), inverse, entry, mi.Vector3f(w_i)


def _trusted(obj: TranslucentObject) -> np.ndarray:
    """The channels in which the model knows its directional albedo at every exit."""
    if obj.transport.alpha is None:
        return np.zeros(dr.size_v(mi.Spectrum), dtype=bool)
    return np.ravel(np.array(obj.transport.alpha.known[1])) > 0


def _fitted(obj: TranslucentObject, mu: np.ndarray, S: np.ndarray) -> Albedo:
    """a(mu), by least squares over samples, of which `FITTED` are enough."""
    step = max(len(mu) // FITTED, 1)
    mu, S, eta = mu[::step], S[::step], float(obj.media[0].eta)
    basis = F_t(mu.astype(float), eta)[:, None] * mu[:, None] ** np.arange(3)
    normal = basis.T @ basis + 1e-9 * len(mu) * np.eye(3)
    return Albedo(np.linalg.solve(normal, basis.T @ S.astype(float)).T, eta)


def _rows(
    points: SurfacePoints, S: np.ndarray, known: tuple[np.ndarray, np.ndarray | None], a: np.ndarray
) -> tuple[np.ndarray, float]:
    """t of all rows: S over a at the exit, both summed over the directions of a row; and the error of the sums.

    A row has the sum 1 where alpha is the directional albedo, and that of its neighbours of like colour elsewhere.
    """
    n, (trusted, paint) = S.shape[1], known
    sums = S.sum(axis=1, keepdims=True)
    even = sums / np.maximum(a.sum(axis=1, keepdims=True), 1e-30)
    even = points.smoothed(points.smoothed(even, paint), paint)
    t = S * (np.where(trusted, 1, even) / np.maximum(sums, 1e-30))
    deviation = (S - sums / n).std(axis=1) / np.sqrt(n) / np.maximum(sums[:, 0].mean(axis=0) / n, 1e-30)
    return t.astype(np.float32), float(np.sqrt((deviation**2).mean(axis=0)).max())
