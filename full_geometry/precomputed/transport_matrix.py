"""What light that is gathered at points of an object is worth where it leaves: the rows of the transport matrix.

Directions are taken apart: with the directional albedo a(mu) of the model,

    S(x_i, w_i; x_o, w_o) ~ a(w_o) q(x_i, x_o) a(w_i),    L_o(x_o, w_o) = a(w_o) B(x_o),    B_j = Σ_s t_js L_k(j,s),

L_k the mean of the incident radiance at point k, weighted by a(mu_i) mu_i. The entries s of each point j are drawn by
the distance from it, see `entries`, with directions at both ends, so that under the same light from everywhere the sum
is an unbiased estimate of what the model gives. Where the model knows its directional albedo (`alpha`), the mean
radiance c of the environment leaves by that, as in `integrators.lighting.EnvironmentMean`, and rows have but the rest
of the light to carry.

What S has beyond that depends on directions mostly as the first event does, which lies towards or away from the other
end. With w bent by the boundary, less its mean by a(mu) mu, S gets for entry and exit the factors

    1 + g.w,    g = g_n n + g_d d,    d from one end to the other,

g_n and g_d of a distance those of all pairs at that distance, by least squares over directions of entries and exits. So
light brings Σ_s t_js (L_k + g.M_k), M_k its first moment, and B a slope over w_o. These factors are divided out of t.
What is left of S, by the place on the object, is known once light is: for a few entries S is asked along directions w
of light at them, see `pairs`, and with t' for that B gets

    Σ_s (t'_js(w) - t_js (1 + g.w)) L_k,    averaged over the neighbourhood.

Textures vary over less than the distance of points. The medium at entries is that of their own places, and with the
reflectance R of the half-space at the exit

    L_o(x_o, w_o) = a(w_o) R(x_o)^e B(x_o),

e per channel with which what leaves under the same light from everywhere is smoothest: 1/2 where light comes from
further than from the next point, as models take the medium at both ends, up to 1. The shape of a varies with ln R,
linearly: light of darker media is of fewer orders, and leaves more sideways.

a(mu) = F_t(mu) (c_0 + c_1 mu + c_2 mu²) per channel is fitted to samples of all points.

What comes from afar varies slowly over exits. So entries of a point are parted into rings by their distance, and the
mean light of a ring, and the share that it has of all, are averaged over the neighbourhood, the wider the farther.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np

from full_geometry.geometry.light_points import GOLDEN, REACH, SurfacePoints
from full_geometry.geometry.points import (
    EntrySample,
    SurfacePoint,
    channel_mean,
    cosine_above,
    evaluate,
    floats,
    of_rows,
    opaque,
    wrapped,
)
from full_geometry.objects.objects import TranslucentObject
from full_geometry.precomputed.entries import PLACES, StratifiedEntries
from full_geometry.precomputed.point_pairs import EntryPairs, Rays, lit_pairs
from halfspace_sss.arrays import aligned
from halfspace_sss.interrupts import checkpoint
from halfspace_sss.physics.fresnel import F_t

PER_LENGTH = 2.0  # points over a transport mean free path
FEWEST, MOST = 1024, 8192  # points
SAMPLES = 3 * 2**17  # entries of all points,
FEWEST_ENTRIES, FEWEST_OF_PART = 48, 16  # and of a point
FITTED = 2**18
SEED = 7
COARSEST = 0.5  # transport mean free paths between places of entries; proposals draw those of denser objects,
DENSE = 8 / 3  # times as many
RINGS = 2.0, 5.0  # distances of entries that part the rings, over that of points,
STEPS = tuple(2 ** (k / 2) for k in range(12))  # and those that part the steps of g
KNOWN_ROUNDS = 16  # smoothings of what S brings over alpha,
SLOPE_ROUNDS = 2  # of the slope over w_o,
BEYOND_ROUNDS = 16  # and of what S along directions of light has beyond the matrix
LIKE_DISTANCES, LIKE_COSINES = 14, 8  # classes of pairs of points
ROUNDS = 0, 2, 8  # and how often what each brings is smoothed,
SHARE_ROUNDS = 2, 4, 8  # and its share of the row
EXITS = 8  # directions of exits of a row
LEAST, LEAST_LEANING = 0.05, 0.2  # of what weights are divided by, over its mean
R_2 = 0.7548776662466927, 0.5698402909980532
LATTICE = 128  # directions of a hemisphere


def cosine(w: mi.Vector3f, n: mi.Normal3f, n_out: mi.Normal3f) -> mi.Float:
    """Cosine of a direction to the shading normal; 0 below the surface of geometric normal n."""
    return dr.select(dr.dot(w, n) > 0, dr.abs(dr.dot(w, n_out)), 0)


@dataclass(frozen=True)
class Albedo:
    """a(mu) = F_t(mu) (c_0 + c_1 mu + c_2 mu²), c per channel, shape (channels, 3).

    Where media have textures, at an exit of the reflectance R with c + tilt (ln R - middle) for c.
    """

    c: np.ndarray
    eta: float
    tilt: np.ndarray | None = None
    middle: np.ndarray | None = None

    def __call__(self, mu: mi.Float, paint: mi.Spectrum | None = None) -> mi.Spectrum:
        # c, tilted by ln R where media have textures
        F = F_t(mu, opaque(self.eta))
        rows = [[opaque(v) for v in row] for row in self.c]
        if self.tilt is not None and paint is not None:
            x = [dr.log(dr.maximum(R, 1e-20)) - opaque(v) for R, v in zip(paint, self.middle)]
            rows = [[v + opaque(d) * each for v, d in zip(row, tilt)] for row, tilt, each in zip(rows, self.tilt, x)]
        return mi.Spectrum([F * dr.maximum(a + mu * (b + mu * c), 0) for a, b, c in rows])

    @cached_property
    def whole(self) -> np.ndarray:
        """∫ a(mu) mu dw of each channel."""
        # 2 pi ∫ a mu dmu by the midpoint rule
        mu = (np.arange(256) + 0.5) / 256
        a = np.maximum(self.c @ mu ** np.arange(3)[:, None], 0) * F_t(mu, self.eta)
        return np.maximum(2 * np.pi * (a * mu).mean(axis=1), 1e-30)

    @property
    def least(self) -> np.ndarray:
        """The least divisor of weights, per channel."""
        return (LEAST / np.pi * self.whole).astype(np.float32)


@dataclass(frozen=True, eq=False)
class Incident:
    """Radiance at points, weighted by a(mu_i) mu_i.

    Args:
        mean: (points, channels), less what is known without the matrix.
        moment: mean of L_i(w) (bent w - middle), `middle` that of `Hemispheres`, (points, channels, 3).
    """

    mean: np.ndarray
    moment: np.ndarray

    @classmethod
    def mean_of(cls, parts: Sequence[Incident]) -> Incident:
        """The mean of several."""
        return cls(*(np.mean([getattr(part, name) for part in parts], axis=0) for name in ("mean", "moment")))


def bent(w: mi.Vector3f, n_out: mi.Normal3f, eta: float | mi.Float) -> mi.Vector3f:
    """A direction outside as the boundary bends it, turned back to the outer side."""
    # Snell: mu_t² = 1 - (1 - mu²) / eta², and 0 where all is reflected (eta < 1), of weight F_t = 0
    mu = dr.dot(w, n_out)
    ratio, squared = (1 / eta, dr.rcp(eta * eta)) if isinstance(eta, mi.Float) else (opaque(1 / eta), opaque(eta**-2))
    mu_t = dr.safe_sqrt(1 - (1 - dr.minimum(dr.square(mu), 1)) * squared)
    return mi.Vector3f((w - mu * n_out) * ratio + mu_t * n_out)


class Hemispheres(NamedTuple):
    """Directions above the surface at points, by the weight a(mu) mu.

    Args:
        whole: its integral, (points, channels).
        middle: mean of directions bent by the boundary, (points, 3), for the mean of a over channels.
        covariance: of these, (points, 3, 3).
    """

    whole: np.ndarray
    middle: np.ndarray
    covariance: np.ndarray

    @classmethod
    def of(cls, points: SurfacePoints, albedo: Albedo) -> Hemispheres:
        """Means over a lattice of directions: the few that light is gathered along would be too noisy."""
        # directions w of a lattice by the cosine, of density mu / pi, so that a mu / density = pi a
        k, each = dr.arange(mi.UInt32, len(points) * LATTICE), dr.opaque(mi.UInt32, LATTICE)
        j, s = k // each, mi.Float(k % each)
        n, n_out = (dr.gather(mi.Normal3f, v, j) for v in (points.n, points.n_out))
        w, _ = cosine_above(n_out, n, mi.Point2f((s + 0.5) / LATTICE, wrapped(s * GOLDEN)))
        a = albedo(cosine(w, n, n_out)) * dr.pi

        # sums over directions of a, of a w and of a w w^T, w bent by the boundary
        weight, w = channel_mean(a), bent(w, n_out, albedo.eta)
        values = [*a, *(weight * w), *(weight * w[i] * w[k] for i in range(3) for k in range(3)), weight]
        dr.eval(values)  # once for all sums
        sums = [dr.block_sum(v, LATTICE) for v in values]
        *rows, total = (np.array(v, dtype=float) for v in sums)

        # ∫ a mu dw, the mean E[w], and the covariance E[w w^T] - E[w] E[w]^T
        whole, middle, second = np.split(np.stack(rows, axis=1), [len(rows) - 12, len(rows) - 9], axis=1)
        middle, second = (v / np.maximum(total, 1e-30)[:, None] for v in (middle, second))
        C = second.reshape(-1, 3, 3) - middle[:, :, None] * middle[:, None, :]
        return cls(np.maximum(whole / LATTICE, 1e-30), middle, C)


@dataclass(frozen=True, eq=False)
class TransportMatrix:
    """The transport matrix t_js of one object, B_j = Σ_s t_js L_k(j,s), and what its light needs beyond that.

    Args:
        points: where light is gathered and where it leaves.
        around: their hemispheres.
        entry: (points, samples) numbers of the points that entries are at.
        t: (points, samples, channels).
        ring: (points, samples) of entries, by their distance.
        toward: (points, samples, 3) direction from the entry's point to the exit; 0 where both are one.
        step: (points, samples) of g, by their distance.
        g: (steps, channels, 2) along the normal and towards the other end.
        albedo: a.
        error: standard error of the sums of rows over their mean, worst channel, root mean square.
        e: exponent of the reflectance at the exit, per channel.
        trusted: channels in which alpha is what uniform light brings.
        pairs: for which S is asked again.
        unit: t over S / a(mu_i), (points, samples, channels).
    """

    points: SurfacePoints
    around: Hemispheres
    entry: np.ndarray
    t: np.ndarray
    ring: np.ndarray
    toward: np.ndarray
    step: np.ndarray
    g: np.ndarray
    albedo: Albedo
    error: float
    e: np.ndarray
    trusted: np.ndarray
    pairs: EntryPairs
    unit: np.ndarray

    @property
    def nbytes(self) -> int:
        """Memory of all arrays of entries, but the places themselves."""
        return sum(v.nbytes for v in (self.entry, self.t, self.ring, self.toward, self.step, self.unit, self.pairs.w_o))

    @cached_property
    def _n_out(self) -> np.ndarray:
        return np.array(self.points.n_out, dtype=np.float32).T

    def __matmul__(self, L: Incident) -> np.ndarray:
        """B for incident radiance, linear in the bent w_o: constant and slope, (points, channels, 4)."""
        light = self._arriving(L)
        # B in the mean over w_o by rings, and its slope over w_o by Σ_s t_s L_s g_s
        brought = self.t * light
        slope = self._slope(brought.sum(axis=1), self._leaning(brought), SLOPE_ROUNDS)
        return self._about_middle(self._by_place(light), slope)

    def beyond(self, L: np.ndarray, rays: Rays) -> np.ndarray:
        """What S along the directions of light brings beyond 1 + g.w, as `@` returns it.
        `L`: mean of the radiance that comes along rays, (points, channels)."""
        # ---- S of a few pairs, along a direction w of light at the entry, over a(mu_i)
        lit = lit_pairs((self.t * np.take(L, self.entry, axis=0)).mean(axis=2), self.entry, rays)
        (S, mu), rows, point = self.pairs.S(lit), len(self.points), self.entry.ravel()[lit.number]
        toward, step, t, unit = (
            v.reshape(-1, *v.shape[2:])[lit.number] for v in (self.toward, self.step, self.t, self.unit)
        )
        found = unit * S / np.maximum(np.array(self.albedo(floats(mu))).T, self.albedo.least)

        # ---- t' - t (1 + g.w), times the light along w
        n, g, row = self._n_out[point], self.g[step], lit.row
        d = _bent(lit.w, n, self.albedo.eta) - self.around.middle[point]
        expected = 1 + g[:, :, 0] * (d * n).sum(axis=1)[:, None] + g[:, :, 1] * (d * toward).sum(axis=1)[:, None]
        more = (found - t * np.maximum(expected, 0)) * lit.colour * L[point] * lit.share[:, None]

        # ---- Σ over pairs of a row, and the slope over w_o likewise; averaged over the neighbourhood
        brought, upright = (row_sums(row, v, rows) for v in (more, more * g[:, :, 0]))
        aside = [row_sums(row, more * g[:, :, 1] * toward[:, k, None], rows) for k in range(3)]
        slope = self._slope(
            brought, upright[:, :, None] * self._n_out[:, None] - np.stack(aside, axis=2), BEYOND_ROUNDS
        )
        for _ in range(BEYOND_ROUNDS):
            brought = self.points.smoothed(brought)
        return self._about_middle(brought, slope)

    def _leaning(self, brought: np.ndarray) -> np.ndarray:
        """The slope over w_o of what entries bring, Σ_s t_s L_s (g_n n - g_d d), (points, channels, 3)."""
        # at the exit the other end lies along -d, d from entry to exit
        upright, aside = (brought * np.take(self.g[:, :, k], self.step, axis=0) for k in range(2))
        return upright.sum(axis=1)[:, :, None] * self._n_out[:, None] - aside.transpose(0, 2, 1) @ self.toward

    @cached_property
    def _even(self) -> np.ndarray:
        """The slope of uniform light over what it brings, (points, channels, 3)."""
        return self._leaning(self.t) / np.maximum(self.t.sum(axis=1), 1e-30)[:, :, None]

    def _slope(self, brought: np.ndarray, leaning: np.ndarray, rounds: int) -> np.ndarray:
        """The slope less that of uniform light, which has a(w_o) alone; smoothed, (points, channels, 3)."""
        slope = leaning - brought[:, :, None] * self._even
        for _ in range(rounds):
            slope = self.points.smoothed(slope)
        return slope

    def _about_middle(self, mean: np.ndarray, slope: np.ndarray) -> np.ndarray:
        """Constant and slope of what has that mean over w_o: constant = mean - slope.middle."""
        constant = mean - np.einsum("jck,jk->jc", slope, self.around.middle)
        return np.concatenate([constant[:, :, None], slope], axis=2)

    def mean(self, L: Incident) -> np.ndarray:
        """B in the mean over w_o, (points, channels)."""
        return self._by_place(self._arriving(L))

    def _arriving(self, L: Incident) -> np.ndarray:
        """The mean of L_i (1 + g.(bent w_i - middle)) of entries, (points, samples, channels)."""
        # g_n n.M of the entry's point
        upright = np.einsum("jck,jk->jc", L.moment, self._n_out)
        light = np.take(self.g[:, :, 0], self.step, axis=0) * np.take(upright, self.entry, axis=0)

        # g_d d.M, d towards the exit
        aside = np.zeros_like(light)
        for axis in range(3):
            aside += np.take(L.moment[:, :, axis], self.entry, axis=0) * self.toward[:, :, axis, None]
        light += np.take(self.g[:, :, 1], self.step, axis=0) * aside

        # and L itself
        light += np.take(L.mean, self.entry, axis=0)
        return light

    def _by_place(self, light: np.ndarray) -> np.ndarray:
        """What leaves by the light of entries, (points, channels).

        The light of a ring is the mean over its entries in the neighbourhood, the wider the farther they are; so is the
        share of the ring.
        """
        # Σ over rings of share smooth(Σ t L) / smooth(Σ t)
        share, whole = self._shares
        return (share * self._smoothed(self._by_ring(light), ROUNDS) / np.maximum(whole, 1e-30)).sum(axis=1)

    def _by_ring(self, light: np.ndarray) -> np.ndarray:
        """Σ t L of each ring, (points, rings, channels)."""
        (count, _, size), rings = light.shape, len(ROUNDS)
        # bins of (point, ring)
        at, brought = (np.arange(count)[:, None] * rings + self.ring).ravel(), self.t * light
        columns = [np.bincount(at, brought[:, :, c].ravel(), count * rings) for c in range(size)]
        return np.stack(columns, axis=1).reshape(count, rings, size)

    @cached_property
    def _shares(self) -> tuple[np.ndarray, np.ndarray]:
        """Of uniform light, (points, rings, channels): shares of the row, and what rings bring, both smoothed."""
        found = self._by_ring(np.ones_like(self.t))
        # the shares of a row keep its sum
        share = self._smoothed(found, SHARE_ROUNDS)
        share *= (found.sum(axis=1) / np.maximum(share.sum(axis=1), 1e-30))[:, None]
        return share, self._smoothed(found, ROUNDS)

    def _smoothed(self, values: np.ndarray, times: tuple[int, ...]) -> np.ndarray:
        """Values of rings, (points, rings, channels), each so many times."""
        # rings farther out vary more slowly, and are smoothed more often
        smooth = np.copy(values)
        for k, rounds in enumerate(times):
            for _ in range(rounds):
                smooth[:, k] = self.points.smoothed(smooth[:, k])
        return smooth


def count_of(obj: TranslucentObject, area: float) -> int:
    """How many points an object of this area gets: their distance is half a transport mean free path."""
    # A (2 sigma_t')²
    sigma = np.mean([float(m.sigma_t_prime) for m in obj.media])
    return int(np.clip(area * (PER_LENGTH * sigma) ** 2, FEWEST, MOST))


def transport_matrix(obj: TranslucentObject, share: float = 1.0, seed: int = SEED) -> TransportMatrix:
    """The transport matrix of an object by its model, with a share of all entries, which its proposals draw."""
    # ---- entries of each point with S mu_i over their density: by distance, or by the proposals of dense objects
    points = SurfacePoints.of(obj.geometry, count_of(obj, obj.geometry.area))
    n = max(int(share * max(SAMPLES / len(points), FEWEST_ENTRIES)), FEWEST_OF_PART)
    if places_resolve(obj):
        result = stratified(obj, points, n, seed)
    else:
        result = drawn(obj, points, int(DENSE * n) * len(points), seed)
    checkpoint()

    # ---- S without the reflectance R^e of the exit, and the sums of rows that uniform light has
    paint = None if obj.textured is None else result.paint
    e = np.zeros(result.S.shape[2], np.float32) if paint is None else _exponents(points, result)
    S = result.S / (result.paint**e)[:, None]
    trusted, whole = _rows(obj, points, result, S, paint)

    # ---- the point k(j, s) of each entry, and its distance, in rings and in steps of g
    near = np.where(result.known, result.near, np.arange(len(points), dtype=np.uint32)[:, None])
    toward, d, kind = _geometry(points, near)
    # rows beside an edge of a texture are not to be averaged with those beyond
    ring = np.digitize(d, RINGS).astype(np.uint8) if paint is None else np.zeros(d.shape, np.uint8)
    step = np.digitize(d, STEPS).astype(np.uint8)

    # ---- g by least squares, from what S has beyond a separable one
    around = Hemispheres.of(points, result.albedo)
    t = _scaled(S, whole)
    g, factors = _leanings(points, around, result, (near, t, t - _expected(result, t, kind)), (toward, step))

    # ---- t = S / (a(w_o) a(w_i) (1 + g.w_o) (1 + g.w_i)), which keeps what pairs in a like position bring
    weight = np.take(around.whole.astype(np.float32), near, axis=0)
    weight /= np.maximum(result.a, result.albedo.least) * factors[1]
    over = weight / (np.maximum(result.cosine, LEAST) * factors[0])
    before, after = (_summed(kind, v, LIKE_DISTANCES * LIKE_COSINES**2) for v in (t, t * over))
    kept = (before / np.maximum(after, 1e-30)).astype(np.float32)[kind]  # what pairs that are alike bring
    over *= kept
    S *= over
    t = _scaled(S, whole)

    # ---- standard error of a row by the spread of its terms, σ / (mean sqrt(n))
    sums, n = S.sum(axis=1, keepdims=True), S.shape[1]
    deviation = (S - sums / n).std(axis=1) / np.sqrt(n) / np.maximum(sums[:, 0].mean(axis=0) / n, 1e-30)
    error = float(np.sqrt((deviation**2).mean(axis=0)).max())

    # ---- t per S / a(mu_i), for pairs of which S is asked again
    scale = whole / np.maximum(sums[:, 0], 1e-30) / result.paint**e
    unit = weight * kept * (result.albedo.whole * scale).astype(np.float32)[:, None]
    pairs = EntryPairs(obj, points.exit_along, result.w_o, result.entries)
    return TransportMatrix(
        points=points, around=around, entry=near, t=t, ring=ring, toward=toward, step=step, g=g, albedo=result.albedo,
        error=error, e=e, trusted=trusted, pairs=pairs, unit=unit,
    )  # fmt: skip


def _scaled(S: np.ndarray, whole: np.ndarray) -> np.ndarray:
    """S scaled to rows of these sums."""
    return (S * (whole / np.maximum(S.sum(axis=1), 1e-30))[:, None]).astype(np.float32)


def _leanings(
    points: SurfacePoints, around: Hemispheres, found: DrawnEntries, weights: tuple[np.ndarray, ...],
    apart: tuple[np.ndarray, np.ndarray],
) -> tuple[np.ndarray, list[np.ndarray]]:  # fmt: skip
    """g of all steps, (steps, channels, 2), by least squares over entries, and exits, of all pairs at a distance.

    Then 1 + g.w of entries, and of exits, (points, samples, channels).

    With f the cosines of the bent w - middle to the normal and to the other end, E over directions by a(mu) mu,

        Σ_s t_s E[f f^T] g = Σ_s t_s f_s,

    where t less what is expected of separable S stands on the right.
    """
    (near, t, beyond), (toward, step), size = weights, apart, len(STEPS) + 1
    # ---- sums over pairs of A = t E[f f^T] and b = (t - expected) f, of entries and of exits alike
    n_out = np.array(points.n_out, dtype=np.float32).T
    own = np.broadcast_to(np.arange(len(n_out))[:, None], step.shape)
    A, b, cosines = np.zeros((size, t.shape[2], 2, 2)), np.zeros((size, t.shape[2], 2)), []
    for at, w, way in ((near, found.w_i, toward), (own, found.w_o, -toward)):
        n = np.take(n_out, at, axis=0)
        d = _bent(w, n, found.albedo.eta) - np.take(around.middle.astype(np.float32), at, axis=0)
        axes = n, way
        cosines.append([np.einsum("jsk,jsk->js", d, axis) for axis in axes])
        spread = [np.einsum("jsik,jsk->jsi", np.take(around.covariance, at, axis=0), axis) for axis in axes]
        for i in range(2):
            b[:, :, i] += _summed(step, beyond * cosines[-1][i][:, :, None], size)
            for k in range(2):
                A[:, :, i, k] += _summed(step, t * np.einsum("jsk,jsk->js", axes[i], spread[k])[:, :, None], size)

    # ---- (A + ridge) g = b, and the factors 1 + g.f of both ends
    A += (1e-3 * np.trace(A, axis1=2, axis2=3) + 1e-30)[:, :, None, None] * np.eye(2)
    g = np.linalg.solve(A, b[..., None])[..., 0].astype(np.float32)
    each = [np.take(g[:, :, k], step, axis=0) for k in range(2)]
    factors = [1 + sum(v * f[:, :, None] for v, f in zip(each, end)) for end in cosines]
    return g, [np.maximum(f, LEAST_LEANING) for f in factors]


def _bent(w: np.ndarray, n: np.ndarray, eta: float) -> np.ndarray:
    """`bent` of arrays (..., 3)."""
    # w / eta + (sqrt(1 - (1 - mu²) / eta²) - mu / eta) n
    mu = np.einsum("...k,...k->...", w, n)[..., None]
    return w / eta + (np.sqrt(np.maximum(1 - np.maximum(1 - mu**2, 0) / eta**2, 0)) - mu / eta) * n


def _summed(step: np.ndarray, values: np.ndarray, size: int) -> np.ndarray:
    """Sums of values of pairs, (points, samples, channels), of each step."""
    return row_sums(step.ravel(), values.reshape(-1, values.shape[2]), size)


def row_sums(row: np.ndarray, values: np.ndarray, rows: int) -> np.ndarray:
    """Sums of values (entries, channels) of each row."""
    return np.stack([np.bincount(row, v, rows) for v in values.T], axis=1)


def _geometry(points: SurfacePoints, near: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Directions from the points of entries to exits, distances over that of points, and classes of pairs.

    Pairs of one class are in a like position, by the distance and the cosines of both normals to the line between them.
    """
    # ---- the line from the exit to the entry's point, and its length in distances of points
    p, n = (np.array(v, dtype=np.float32).T for v in (points.p, points.n))
    line = np.take(p, near, axis=0) - p[:, None]
    d = np.sqrt(np.einsum("jsk,jsk->js", line, line)) * (REACH / points.h)
    scale = (REACH / points.h) / np.maximum(d, 1e-6)

    # ---- the class of a pair: by log2(1 + d) and the cosines of both normals to the line
    cosines = np.einsum("jsk,jsk->js", np.take(n, near, axis=0), line), np.einsum("jk,jsk->js", n, line)
    kind = np.minimum(2 * np.log2(1 + d), LIKE_DISTANCES - 1).astype(np.int32)
    for mu in cosines:
        step = np.clip((1 + mu * scale) * (0.5 * LIKE_COSINES), 0, LIKE_COSINES - 1)
        kind = kind * LIKE_COSINES + step.astype(np.int32)
    return line * (-scale)[:, :, None], d, kind


def _expected(found: DrawnEntries, t: np.ndarray, kind: np.ndarray) -> np.ndarray:
    """t if S were separable, and its dependence on positions the same for all pairs that are alike."""
    # a(w_i) a(w_o) over the density, times the mean of t over that in each class, scaled to the sums of rows
    expected = found.cosine * found.a
    count = LIKE_DISTANCES * LIKE_COSINES**2
    for c in range(t.shape[2]):
        whole, even = (np.bincount(kind.ravel(), v[:, :, c].ravel(), count) for v in (t, expected))
        expected[:, :, c] *= np.take((whole / np.maximum(even, 1e-30)).astype(np.float32), kind)
    expected *= t.sum(axis=1, keepdims=True) / np.maximum(expected.sum(axis=1, keepdims=True), 1e-30)
    return expected


def _exponents(points: SurfacePoints, found: DrawnEntries) -> np.ndarray:
    """e of each channel, by what reflectance and light of points are over those of their neighbours."""
    # slope of ln(light) over ln R, both less the mean of their neighbours
    light = found.S.sum(axis=1) / np.maximum(found.a.sum(axis=1), 1e-30)
    x, y = (v - points.smoothed(v) for v in (np.log(found.paint), np.log(np.maximum(light, 1e-30))))
    return np.clip((x * y).sum(axis=0) / np.maximum((x * x).sum(axis=0), 1e-12), 0, 1).astype(np.float32)


class RowUniforms:
    """Uniform numbers of n lanes for each row: lattices in an order of their own, shifted for each row.

    Args:
        row, k: of each lane, and its number in the row.
        rows, n: how many rows, and lanes of each.
        seed: of orders and shifts.
    """

    def __init__(self, row: mi.UInt32, k: mi.UInt32, rows: int, n: int, seed: int) -> None:
        self._row, self._k, self._rows, self._n, self._rng = row, k, rows, n, np.random.default_rng(seed)

    def next_1d(self, active: mi.Bool = True) -> mi.Float:
        """The next number of each lane."""
        return self._lattice(self._rng.permutation(self._n) / self._n)(self._row, self._k)

    def next_2d(self, active: mi.Bool = True) -> mi.Point2f:
        """The next pair."""
        return mi.Point2f(*(one(self._row, self._k) for one in self.pair()))

    def pair(self) -> list[Lattice]:
        """The next pair, for any row and place in it."""
        # the R2 sequence of Roberts in a random order
        order = self._rng.permutation(self._n)
        return [self._lattice(order * r % 1.0) for r in R_2]

    def _lattice(self, u: np.ndarray) -> Lattice:
        return Lattice(*map(floats, (u, self._rng.random(self._rows))))


class Lattice(NamedTuple):
    """Numbers of each place in a row, and the shift of each row."""

    u: mi.Float
    shift: mi.Float

    def __call__(self, row: mi.UInt32, k: mi.UInt32) -> mi.Float:
        """Number k of a row."""
        return wrapped(dr.gather(mi.Float, self.u, k) + dr.gather(mi.Float, self.shift, row))


class DrawnEntries(NamedTuple):
    """Entries that are drawn for exits at points: n for each, in arrays (points, n) and more.

    Args:
        S: S mu_i over the density, per channel.
        cosine: a(mu_i) mu_i / ∫ a(mu) mu dw over the density of directions, per channel.
        near, known: the point that the entry is nearest to, and whether there is one.
        w_i, w_o: directions.
        a: directional albedo at the exit, per channel.
        albedo: fitted to them.
        paint: reflectance of the medium at the point, per channel, where media have textures; else 1.
        entries: given their numbers.
        exits: of a point, which entries have in turn.
    """

    S: np.ndarray
    cosine: np.ndarray
    near: np.ndarray
    known: np.ndarray
    w_i: np.ndarray
    w_o: np.ndarray
    a: np.ndarray
    albedo: Albedo
    paint: np.ndarray
    entries: Callable[[mi.UInt32], EntrySample]
    exits: int


class _Brought(NamedTuple):
    """S mu_i of entries over their density, the direction of incidence, its cosine, and that over its density."""

    S: mi.Spectrum
    w_i: mi.Vector3f
    mu_i: mi.Float
    over: mi.Float


def places_resolve(obj: TranslucentObject) -> bool:
    """Whether S of an object varies little from one of the places of `entries` to the next."""
    # distance of places in transport mean free paths
    sigma = max(float(np.max(m.sigma_t_prime)) for m in obj.media)
    return sigma * float(np.sqrt(obj.geometry.area / PLACES)) < COARSEST


def drawn(obj: TranslucentObject, points: SurfacePoints, samples: int, seed: int) -> DrawnEntries:
    """Entries drawn by the proposals, as many for each point."""
    n = samples // len(points)
    k = dr.arange(mi.UInt32, len(points) * n)
    each = dr.opaque(mi.UInt32, n)  # kernels are those of other numbers of points too
    j, active = k // each, mi.Bool(True)
    sampler = RowUniforms(j, k % each, len(points), n, seed)
    # ---- an exit at each point in a direction by the cosine, and an entry by the proposals
    out, face = points.exit(j, sampler.next_2d())
    out = obj.knowing(out, face)
    prepared = obj.transport.prepare(out, active)
    entry = obj.proposals.sample(out, face, obj.proposals.prepare(out, prepared, active), sampler, active)

    # ---- S mu_i over the densities, and the point that the entry is nearest to
    brought = _brought(obj, prepared, out, entry, sampler.next_2d())
    near, known = points.nearest(entry.p, entry.n, entry.weight > 0)
    paint = _paint(obj, out)
    evaluate(brought, near, known, out, paint)
    places = [np.array(v).reshape(len(points), n) for v in (near, known)]
    return _collected(obj, brought, places, out, paint, entry.gather)


def stratified(obj: TranslucentObject, points: SurfacePoints, n: int, seed: int) -> DrawnEntries:
    """About n entries for each point, by their distance from it; those of one exit share what S asks of that."""
    # ---- `EXITS` exits of each point, with all that S asks of an exit
    n //= EXITS
    each, exits, size = dr.opaque(mi.UInt32, n), dr.opaque(mi.UInt32, EXITS), dr.size_v(mi.Spectrum)
    rows, n = len(points), EXITS * n
    lane = dr.arange(mi.UInt32, rows * EXITS)
    j, k = lane // exits, lane % exits
    out, face = points.exit(j, RowUniforms(j, k, rows, EXITS, seed).next_2d())
    out = obj.knowing(out, face)
    prepared, paint = obj.transport.prepare(out, mi.Bool(True)), _paint(obj, out)

    # ---- entries in proportion to the radial density of the model
    entries = StratifiedEntries.of(obj.proposals.positions, points, n, seed)
    u = RowUniforms(j, k, rows, n, seed + 1).pair()
    S, w_i, mu_i, over = (dr.zeros(mi.Float, c * rows * n) for c in (size, 3, 1, 1))
    evaluate(out, paint, u, S, w_i, mu_i, over)

    def step(i: mi.UInt32) -> tuple[mi.UInt32]:
        # entry s of row j, by the exit k = s mod EXITS
        s = i * exits + k
        entry = entries(j * each * exits + s)
        if obj.textured is not None:
            entry = entry._replace(medium=obj.textured.at_point(obj.geometry, entry.p, entry.n, entry.face))
        brought = _brought(obj, prepared, out, entry, mi.Point2f(*(one(j, s) for one in u)))
        for target, value in zip((S, w_i, mu_i, over), brought):
            dr.scatter(target, value, j * each * exits + s)
        return (i + 1,)

    dr.while_loop((mi.UInt32(0) + dr.zeros(mi.UInt32, rows * EXITS),), lambda i: i < each, step, label="entries")
    dr.eval(S, w_i, mu_i, over)
    near, weight = (np.array(v).reshape(rows, n) for v in (entries.near, entries.weight))
    brought = _Brought(dr.unravel(mi.Spectrum, S), dr.unravel(mi.Vector3f, w_i), mu_i, over)
    return _collected(obj, brought, [near, weight > 0], out, paint, entries)


def _paint(obj: TranslucentObject, out: SurfacePoint) -> mi.Spectrum:
    """The reflectance at exits, where media have textures; else 1."""
    return dr.zeros(mi.Spectrum, dr.width(out.p)) + (1 if obj.textured is None else obj.transport.paint(out))


def _brought(
    obj: TranslucentObject, prepared: object, out: SurfacePoint, entry: EntrySample, u: mi.Point2f
) -> _Brought:
    """S mu_i / (p(w_i) p(x_i)) of entries, along directions w_i for pairs of uniform numbers."""
    w_i, pdf = obj.proposals.sample_direction(entry, out, u)
    active = (entry.weight > 0) & (pdf > 0)
    over = dr.select(active, 1 / dr.maximum(pdf, 1e-8), 0)
    at = entry.facing(mi.Vector3f(w_i))
    S = obj.transport.S(prepared, at, active) * (at.mu * over * entry.weight)
    mu_i = cosine(at.w, entry.n, entry.n_out)
    return _Brought(mi.Spectrum(dr.select(active, S, 0)), at.w, mi.Float(mu_i), mi.Float(mu_i * over))


def _collected(
    obj: TranslucentObject, brought: _Brought, places: list[np.ndarray], out: SurfacePoint, paint: mi.Spectrum,
    entries: Callable[[mi.UInt32], EntrySample],
) -> DrawnEntries:  # fmt: skip
    """Arrays of entries, of which some share an exit: near and known of each, and what it brought."""
    near, known = places
    count, n = near.shape

    def of_entries(v: mi.Float | mi.Vector3f | mi.Spectrum) -> np.ndarray:
        """(points, entries, channels) of values of exits, which entries have in turn."""
        v = np.atleast_2d(np.array(v, dtype=np.float32)).T
        v = v.reshape(count, 1, -1, v.shape[1])
        return np.broadcast_to(v, (count, n // v.shape[2], *v.shape[2:])).reshape(count, n, -1)

    # ---- S, cosines and reflectance, (points, entries, channels)
    S = np.array(brought.S, dtype=np.float32).T.reshape(count, n, -1)
    S = np.nan_to_num(S, copy=False, nan=0.0, posinf=0.0, neginf=0.0)
    mu = dr.dot(out.w, out.n_out)
    mu_o, w_o = of_entries(mu), of_entries(out.w)
    R = np.array(paint, dtype=np.float32).T.reshape(count, -1, S.shape[2])[:, 0]

    # ---- a(mu) fitted to S, and a mu_i over the density of directions at entries
    albedo = _fitted(obj, mu_o.ravel(), S.reshape(-1, S.shape[2]))
    if obj.textured is not None:
        albedo = _tilted(albedo, mu_o[:, :, 0], S, R)
    a = of_entries(mi.Spectrum(albedo(mu, paint)))
    cosine = np.array(albedo(brought.mu_i) * brought.over).T.reshape(S.shape) / albedo.whole.astype(np.float32)
    w_i, exits = np.array(brought.w_i, dtype=np.float32).T.reshape(count, n, 3), dr.width(out.w) // count
    return DrawnEntries(
        S=S, cosine=cosine, near=near, known=known, w_i=w_i, w_o=w_o, a=a, albedo=albedo, paint=np.maximum(R, 1e-20),
        entries=entries, exits=exits,
    )  # fmt: skip


def _fitted(obj: TranslucentObject, mu: np.ndarray, S: np.ndarray) -> Albedo:
    """a(mu), by least squares over samples, of which `FITTED` are enough."""
    # normal equations of the basis F_t(mu) mu^k, k = 0, 1, 2
    step = max(len(mu) // FITTED, 1)
    mu, S, eta = mu[::step], S[::step], float(obj.media[0].eta)
    basis = F_t(mu.astype(float), eta)[:, None] * mu[:, None] ** np.arange(3)
    normal = basis.T @ basis + 1e-9 * len(mu) * np.eye(3)
    return Albedo(np.linalg.solve(normal, basis.T @ S.astype(float)).T, eta)


def _tilted(albedo: Albedo, mu: np.ndarray, S: np.ndarray, paint: np.ndarray) -> Albedo:
    """a(mu) with c that varies with the reflectance: by least squares over S of points, (points, samples, channels)."""
    # x = ln R, and S of each point scaled to the sum that a without tilt gives
    step, x = max(mu.size // FITTED, 1), np.log(np.maximum(paint, 1e-20))
    even = np.array(albedo(floats(mu))).T.reshape(S.shape).sum(axis=1) / np.maximum(S.sum(axis=1), 1e-30)
    mu, y = mu[:, ::step].astype(float), S[:, ::step] * even[:, None]
    powers, middle = F_t(mu, albedo.eta)[:, :, None] * mu[:, :, None] ** np.arange(3), x.mean(axis=0)

    # normal equations of the basis F_t(mu) mu^k and (x - middle) F_t(mu) mu^k
    found = []
    for k in range(len(albedo.c)):
        basis = np.concatenate([powers, powers * (x[:, k] - middle[k])[:, None, None]], axis=2).reshape(-1, 6)
        normal = basis.T @ basis + 1e-9 * len(basis) * np.eye(6)
        found.append(np.linalg.solve(normal, basis.T @ y[:, :, k].ravel()))
    c = np.stack(found)
    return Albedo(c[:, :3], albedo.eta, c[:, 3:], middle)


def _rows(
    obj: TranslucentObject, points: SurfacePoints, found: DrawnEntries, S: np.ndarray, paint: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray]:
    """Channels in which the model knows its directional albedo at every exit, and sums of rows, (points, channels).

    The sum is that of S over those of alpha, or of a where that is not known, for the directions of a row. They are
    means over neighbours, of like colour where a is fitted.
    """
    # Σ S / Σ a over the directions of a row
    even = S.mean(axis=1) / np.maximum(found.a.mean(axis=1), 1e-30)
    even = points.smoothed(points.smoothed(even, paint), paint)
    if obj.transport.alpha is None:
        return np.zeros(even.shape[1], dtype=bool), even

    # Σ S / Σ alpha, smoothed more, as alpha has the detail
    j = aligned(mi.UInt32, np.repeat(np.arange(len(points)), found.exits))
    out, face = points.exit_along(j, of_rows(mi.Vector3f, found.w_o[:, : found.exits].reshape(-1, 3)))
    alpha = np.array(obj.transport.alpha(obj.knowing(out, face), mi.Bool(True))[1], dtype=np.float32)
    known = found.S.mean(axis=1) / np.maximum(alpha.T.reshape(len(points), found.exits, -1).mean(axis=1), 1e-30)
    for _ in range(KNOWN_ROUNDS):
        known = points.smoothed(known)

    # in the channels where alpha may stand for uniform light
    trusted = np.ravel(np.array(obj.transport.alpha.known[1])) > 0
    return trusted, np.where(trusted, known, even)
