"""A smooth field over a surface from noisy residuals, by local regressions of several widths.

Residuals r_s at places of points j in directions w_s are fitted by r = a(w) C_j . Y(w), Y the
polynomials of w up to the second degree, of its cosine up to the third (`directional`), and of the reflectance of what
is painted (`painted`). Channels whose factors a are not alike are fitted apart. About each of K centres the
weighted least squares

    min Σ_j W_cj Σ_s a_s (r_s / a_s - beta . phi_js)²,    phi = ((x_j - x_c) / h, G_j - G_c, Y(w_s)),

G a feature of points that C may follow, as light that was gathered there, W_cj = (1 - d² / h²)² max(n_c.n_j, 0)². The
weight a keeps the sum of the residuals about each centre. The fits of all centres in reach are blended by the same
weights W_cj. Before the levels, all residuals are fitted by (1, G) times the polynomials of the cosine: there
models err alike everywhere. Level 0 is one fit of all points, each further level has four times as many centres as the
one before and fits what the coarser ones leave. C is the first fit Z and what each level adds,

    C = Z + Σ_l kappa_l d^(l),    kappa_l = (S[d_1 d_2] - DOUBT S[(d_1 - d_2)² / 4]) / S[(d_1 + d_2)² / 4],

d_1 and d_2 of two independent halves of the residuals, S a mean over the neighbourhood: the Wiener filter, as
E[d_1 d_2] is the square of the field alone, less a part of the noise that is left in S. The mean over
directions and what d has beyond it have a kappa each. So finer levels come in as residuals become many. The mean
squared error

    ((1 - kappa)² + 1) S[d_1 d_2] of the finest level + (C_1 - C_2)² / 4

is what the filter takes away, finer detail as if each further level had half the power of the one before, and the
noise of the mean of C_1 and C_2. Moon et al. (2014) and Bitterli et al. (2016) regress so over pixels.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.sparse import csr_array
from scipy.spatial import cKDTree

FIRST_CENTRES, FACTOR = 16, 4
REACH = 2.0  # h over the mean distance of centres
RIDGE = 0.001  # of the sum of weights, on all but the constant; features are of the order of one
NOISE = 20.0  # more of it for each residual: their variance over that of coefficients
TERMS, ZONAL = 12, 3  # of `directional`, and the last of them, which are of the cosine alone
LEAST_OF_LEVEL = 24  # residuals for each centre of a level, on average
DOUBT = 0.3  # of the noise: that much of it may be left in S[d_1 d_2], a mean over few centres
FINER = 1.0  # power of detail that no level has, over that of the finest level


def directional(x: Any, y: Any, z: Any, mu: Any) -> list[Any]:
    """Y of a direction of cosine mu: 1, x, y, z, x² - z², y² - z², xy, xz, yz, t, t², t³, of any arrays.
    t = (mu - .85) / .15 is of the normal at each place, as on fingers normals turn by more than places can follow.
    Directions inside that refraction reaches have a mu of .7 to 1, for an index of 1.4."""
    t = (mu - 0.85) * (1 / 0.15)
    return [x * 0 + 1, x, y, z, x * x - z * z, y * y - z * z, x * y, x * z, y * z, t, t * t, t * t * t]


def painted(R: Any) -> list[Any]:
    """Further terms, of the reflectance R at each place, which textures change faster than places can follow: R, R²."""
    return [R, R * R]


@dataclass(frozen=True)
class ResidualSums:
    """Sums over the residuals of each point.
    `number`: of residuals, (points,). `a`: Σ a Y Y^T, (points, terms, terms). `r`: Σ a Y r / a, (points, terms,
    channels)."""

    number: np.ndarray
    a: np.ndarray
    r: np.ndarray

    @classmethod
    def zeros(cls, points: int, channels: int, terms: int) -> ResidualSums:
        """Sums of no residuals."""
        return cls(np.zeros(points), np.zeros((points, terms, terms)), np.zeros((points, terms, channels)))

    @classmethod
    def of(cls, point: np.ndarray, Y: np.ndarray, a: np.ndarray, r: np.ndarray, points: int) -> ResidualSums:
        """Sums of residuals r (n, channels) in directions of Y (n, terms) at points; factors a (n, channels) > 0."""
        # a is the mean over the channels, so that all have the same weights
        weight, (n, terms) = a.mean(axis=1), Y.shape
        outer = (weight[:, None, None] * Y[:, :, None] * Y[:, None, :]).reshape(n, terms * terms)
        right = ((weight[:, None] * r / a)[:, None, :] * Y[:, :, None]).reshape(n, terms * r.shape[1])
        at = csr_array((np.ones(n), (point, np.arange(n))), shape=(points, n))
        number = np.bincount(point, minlength=points).astype(float)
        return cls(number, (at @ outer).reshape(points, terms, terms), (at @ right).reshape(points, terms, -1))

    def __add__(self, other: ResidualSums) -> ResidualSums:
        return ResidualSums(*(getattr(self, name) + getattr(other, name) for name in ("number", "a", "r")))


def size_of(p: np.ndarray) -> float:
    """The diagonal of the bounding box of points."""
    return float(np.linalg.norm(np.ptp(p, axis=0))) or 1.0


@dataclass(frozen=True)
class Level:
    """Centres and the weights of all points about each: one centre without weights for the coarsest level.
    `centre`: number of the point of each centre. `h`: reach. `size`: of the object, the unit of places of features.
    `weights`: (centres, points)."""

    centre: np.ndarray
    h: float
    size: float
    weights: csr_array

    @classmethod
    def whole(cls, p: np.ndarray) -> Level:
        """All points about the first, alike."""
        return cls(np.zeros(1, dtype=int), size_of(p), size_of(p), csr_array(np.ones((1, len(p)))))

    @classmethod
    def of(cls, p: np.ndarray, n: np.ndarray, area: float, count: int) -> Level:
        """The first `count` points as centres: the first of all are as far apart as so many can be."""
        h = REACH * float(np.sqrt(area / count))
        d = cKDTree(p[:count]).sparse_distance_matrix(cKDTree(p), h, output_type="coo_matrix")
        c, j = d.coords
        w = np.square((1 - (d.data / h) ** 2) * np.maximum((n[c] * n[j]).sum(axis=1), 0))
        return cls(np.arange(count), h, size_of(p), csr_array((w, (c, j)), shape=(count, len(p))))

    def fitted(self, features: np.ndarray, sums: ResidualSums) -> np.ndarray:
        """C at all points, (points, terms, channels); 0 where no centre is in reach.
        `features`: (points, 1 + U), 1 and x / size and G of each point. `sums`: of the residuals."""
        # ---- moments about each centre, of phi = (1, u, Y): Σ_j W_cj Σ_s a phi phi^T and Σ_j W_cj Σ_s a phi r / a
        N, U = features.shape
        more, W = sums.a.shape[1] - 1, self.weights
        D = U + more
        ones, w = sums.a[:, 0, 0], sums.a[:, 0, 1:]
        uu = ones[:, None, None] * features[:, :, None] * features[:, None, :]
        uw = features[:, :, None] * w[:, None, :]
        ur = features[:, :, None] * sums.r[:, None, 0]
        K = len(self.centre)
        M, v = np.empty((K, D, D)), np.empty((K, D, sums.r.shape[2]))
        M[:, :U, :U] = (W @ uu.reshape(N, -1)).reshape(K, U, U)
        M[:, :U, U:] = (W @ uw.reshape(N, -1)).reshape(K, U, more)
        M[:, U:, :U] = np.swapaxes(M[:, :U, U:], 1, 2)
        M[:, U:, U:] = (W @ sums.a[:, 1:, 1:].reshape(N, -1)).reshape(K, more, more)
        v[:, :U] = (W @ ur.reshape(N, -1)).reshape(K, U, -1)
        v[:, U:] = (W @ sums.r[:, 1:].reshape(N, -1)).reshape(K, more, -1)

        # ---- features less those of the centre, places over h: phi_c = T phi
        T = np.tile(np.eye(D), (K, 1, 1))
        scale = np.array([*[self.size / self.h] * 3, *[1.0] * (U - 4)])
        T[:, 1:U, 0] = -scale * features[self.centre, 1:]
        T[:, range(1, U), range(1, U)] = scale

        # ---- beta = (M + ridge)^-1 v, of phi again; centres without residuals have 0
        M, v = T @ M @ np.swapaxes(T, 1, 2), T @ v
        whole = M[:, 0, 0]
        ridge = RIDGE + NOISE / np.maximum(W @ sums.number, 1)
        M += (np.where(whole > 0, whole, 1) * ridge)[:, None, None] * np.diag([1e-6] + [1.0] * (D - 1))
        beta = np.swapaxes(T, 1, 2) @ np.linalg.solve(M, v)

        # ---- C_j = Σ_c W_cj (beta.phi_j) / Σ_c W_cj
        known = W.T * (whole > 0)
        total = np.asarray(known.sum(axis=1)).ravel()
        beta = (known @ beta.reshape(K, -1)).reshape(N, D, -1) / np.maximum(total, 1e-30)[:, None, None]
        constant = (features[:, :, None] * beta[:, :U]).sum(axis=1, keepdims=True)
        return np.concatenate([constant, beta[:, U:]], axis=1)

    def averaged(self, x: np.ndarray) -> np.ndarray:
        """The mean of a value of points (points,) over the neighbourhood: to the centres and back."""
        W = self.weights
        means = (W @ x) / np.maximum(W.sum(axis=1), 1e-30)
        total = np.maximum(W.sum(axis=0), 1e-30)
        return (W.T @ means) / total


def levels(p: np.ndarray, n: np.ndarray, area: float, residuals: float) -> list[Level]:
    """The levels that so many residuals serve, from the coarsest on."""
    found, count = [Level.whole(p)], FIRST_CENTRES
    while count <= min(len(p), residuals / LEAST_OF_LEVEL):
        found.append(Level.of(p, n, area, count))
        count *= FACTOR
    return found


class _Directions:
    """Directions of the residuals of each point, by which fields are compared; where it has none they are not.
    `a`: Σ a Y Y^T of points, (points, terms, terms)."""

    def __init__(self, a: np.ndarray) -> None:
        self._moments = a / np.maximum(a[:, :1, :1], 1e-30)

    def mean(self, C: np.ndarray) -> np.ndarray:
        """The mean of fields (points, terms, channels) over directions, (points, channels)."""
        return (self._moments[:, 0, :, None] * C).sum(axis=1)

    def powers(self, C: np.ndarray, D: np.ndarray) -> list[np.ndarray]:
        """The product of two fields: of their means over directions, and of what they have beyond; (points,) each."""
        means = (self.mean(C) * self.mean(D)).sum(axis=1)
        return [means, (self._moments * (C @ np.swapaxes(D, 1, 2))).sum(axis=(1, 2)) - means]

    def scaled(self, C: np.ndarray, kappa: list[np.ndarray]) -> np.ndarray:
        """A field whose mean over directions, and what it has beyond, are scaled by two factors (points,)."""
        result = kappa[1][:, None, None] * C
        result[:, 0] += (kappa[0] - kappa[1])[:, None] * self.mean(C)
        return result


def _zonal(G: np.ndarray, sums: ResidualSums) -> np.ndarray:
    """The field (1, G) (1, t, t², t³, R, R²) that fits all residuals best, (points, terms, channels)."""
    # (Σ F^T a F) beta = Σ F^T r, of F = (1, G) times some of the terms
    of, F = [0, *range(TERMS - ZONAL, sums.a.shape[1])], np.column_stack([np.ones(len(G)), G])
    size = len(of) * F.shape[1]
    M = np.einsum("ju,jv,jab->uavb", F, F, sums.a[:, of][:, :, of]).reshape(size, size)
    v = np.einsum("ju,jac->uac", F, sums.r[:, of]).reshape(size, -1)
    beta = np.linalg.solve(M + 1e-9 * max(float(M[0, 0]), 1e-30) * np.eye(size), v)
    C = np.zeros_like(sums.r)
    C[:, of] = np.einsum("ju,uac->jac", F, beta.reshape(F.shape[1], len(of), -1))
    return C


def smooth_field(
    of: list[Level], p: np.ndarray, G: np.ndarray, halves: tuple[ResidualSums, ResidualSums]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """C (points, channels, terms), its mean over directions (points, channels), 0 where no residuals are, and its mean
    squared error (points,), the sum over channels.
    `of`: levels. `p`: positions (points, 3). `G`: a feature (points,), of the order of one. `halves`: independent
    residuals."""
    # ---- one fit of all points by the cosine, then what each level adds, filtered
    directions = _Directions(halves[0].a + halves[1].a)
    features = np.column_stack([np.ones(len(p)), (p - p.mean(axis=0)) / size_of(p), G])
    C, lost = [_zonal(G, half) for half in halves], np.zeros(len(p))
    for k, level in enumerate(of):
        left = [replace(half, r=half.r - half.a @ C_half) for half, C_half in zip(halves, C)]
        d = [level.fitted(features, half) for half in left]
        wide, mean = of[max(k - 2, 0)], 0.5 * (d[0] + d[1])
        signal = [wide.averaged(v) for v in directions.powers(*d)]
        power = [wide.averaged(v) for v in directions.powers(mean, mean)]
        doubt = [DOUBT * np.maximum(v - np.maximum(s, 0), 0) for s, v in zip(signal, power)]
        kappa = [np.clip((s - x) / np.maximum(v, 1e-30), 0, 1) for s, v, x in zip(signal, power, doubt)]
        d = [directions.scaled(more, kappa) for more in d]
        lost = sum(((1 - x) ** 2 + FINER) * s for x, s in zip(kappa, signal))
        C = [C_half + more for C_half, more in zip(C, d)]

    # ---- squared error: what the filter loses, finer detail, and the noise of the mean of both halves
    lost -= min(float(lost.mean()), 0)  # S < 0 counts, for its mean to have no bias, as far as that is positive
    apart, result = C[0] - C[1], 0.5 * (C[0] + C[1])
    error = lost + 0.25 * np.maximum(sum(directions.powers(apart, apart)), 0)
    return np.moveaxis(result, 1, 2), directions.mean(result), error
