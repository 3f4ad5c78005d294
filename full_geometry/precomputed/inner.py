"""Light at scattering events inside an object, known at nodes of a grid: order 1 without a ray for each event.

With the radiance L(x, w) of light that reaches x without scattering, an event sends along d

    J(x, d) = ∫ p(d.w) L(x, w) dw = Σ_lm g^l Y_lm(d) ∫ Y_lm(w) L(x, w) dw,

p of Henyey and Greenstein (1941). Events lie where exits would have them: along refracted rays of a cosine, with the
extinction of the channels. At each node of a grid of width h the integrals of near events are fitted by the plane of
least squares, with weights Π max(1 - |x - x_n| / h, 0) over the axes; between nodes the planes are blended by the same
weights. The sum over events is kept where the weights are even.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy.sparse import csc_array, csr_array

from full_geometry.geometry.light_points import lattice, uniform_entries
from full_geometry.geometry.points import cosine_above, floats, opaque, place, refract_in, surface_point
from full_geometry.geometry.rounding import ray_from
from full_geometry.geometry.sensors import independent
from full_geometry.objects.objects import TranslucentObject
from halfspace_sss.arrays import aligned

WIDTH = 0.9  # h in mean free paths
MOST = 2**15  # nodes; h grows until there are no more
WIDEST = 1.5  # h in mean free paths, beyond which the depth of events is not resolved
LEAST = 1.0  # weight of the events of a node, below which it has no plane
RIDGE = 1e-3, 0.1  # of the covariance of events, over h²: for all, and over their weight
MOST_G, LEFT = 0.3, 0.25  # largest |g|, and of (2l + 1) |g|^l the largest that is left out


def bands(obj: TranslucentObject) -> int:
    """The largest l that phase functions of an object need."""
    # the first l whose successor (2l + 3) |g|^(l + 1) is small
    g = max(abs(float(m.g)) for m in obj.media)
    return next(n for n in range(16) if (2 * n + 3) * g ** (n + 1) < LEFT)


def has_inner_light(obj: TranslucentObject) -> bool:
    """Whether order 1 of an object can be gathered: one medium of moderate g throughout."""
    g = max(abs(float(m.g)) for m in obj.media)
    scatters = any(float(m.sigma_s) > 0 for m in obj.media)
    plain = obj.textured is None and obj.varying is None and obj.geometry.inclusions is None
    return bool(obj.low_orders) and 1 in obj.low_orders and plain and scatters and g <= MOST_G


@dataclass(frozen=True, eq=False)
class Events:
    """Places of events of an object, sorted by their cell, and the grid about them.

    Args:
        n: outward geometric normals where their rays entered.
        low: corner of the grid.
        h: its width, scene units.
        counts: of nodes along each axis.
        index: of each node its number among those that have events, or -1.
        weights: (nodes, events).
    """

    p: mi.Point3f
    n: mi.Normal3f
    low: np.ndarray
    h: float
    counts: np.ndarray
    index: mi.Int32
    weights: csr_array

    @classmethod
    def of(cls, obj: TranslucentObject, count: int) -> Events | None:
        """`count` events of an object; None where a grid of so few nodes would not resolve their depth."""
        # ---- the finest grid with at most `MOST` occupied cells
        p, n = _places(obj, count)
        x, mfp = np.array(p, dtype=float).T, 1 / np.mean([float(m.sigma_t) for m in obj.media])
        h = WIDTH * mfp
        while (cells := _occupied(x, h)) > MOST:
            h *= max((cells / MOST) ** 0.4, 1.02)
        if h > WIDEST * mfp:
            return None

        # ---- events in the order of their cells
        low = x.min(axis=0) - 0.5 * h
        counts = np.floor((x.max(axis=0) - low) / h).astype(int) + 2
        cell = np.floor((x - low) / h).astype(int)
        order = np.argsort((cell[:, 2] * counts[1] + cell[:, 1]) * counts[0] + cell[:, 0], kind="stable")
        lanes = aligned(mi.UInt32, order)
        p, n = dr.gather(mi.Point3f, p, lanes), dr.gather(mi.Normal3f, n, lanes)
        dr.eval(p, n)

        # ---- trilinear weights of the nodes about each event, and the nodes that have enough of it
        x, cell = (x[order] - low) / h, cell[order]
        weights = _weights(x - cell, cell, counts)
        kept = np.flatnonzero(weights.sum(axis=1) >= LEAST)
        index = np.full(counts.prod(), -1, dtype=np.int32)
        index[kept] = np.arange(len(kept))
        return cls(p, n, low, h, counts, aligned(mi.Int32, index), weights[kept])

    @cached_property
    def _planes(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Positions of events in h; of nodes the sums of weights, means of positions, inverse covariances."""
        # Σ w, E[x] of each node
        x = (np.array(self.p, dtype=float).T - self.low) / self.h
        whole = np.asarray(self.weights.sum(axis=1)).ravel()
        middle = (self.weights @ x) / whole[:, None]

        # C = E[x x^T] - E[x] E[x]^T, with a ridge where events are few
        i, k = (v.ravel() for v in np.indices((3, 3)))
        C = (self.weights @ (x[:, i] * x[:, k]) / whole[:, None]).reshape(-1, 3, 3)
        C -= middle[:, :, None] * middle[:, None, :]
        ridge = RIDGE[0] + RIDGE[1] / whole
        return x, whole, middle, np.linalg.inv(C + ridge[:, None, None] * np.eye(3))

    def fitted(self, values: np.ndarray) -> np.ndarray:
        """Planes (nodes, components, 4) of values (events, components): constant, and slope by position over h."""
        x, whole, middle, inverse = self._planes
        # slope = C^-1 (E[v x] - E[v] E[x]), constant = E[v] - slope.E[x]
        mean = (self.weights @ values) / whole[:, None]
        both = np.stack([self.weights @ (values * x[:, i : i + 1]) for i in range(3)], axis=2) / whole[:, None, None]
        slope = np.einsum("nci,nij->ncj", both - mean[:, :, None] * middle[:, None, :], inverse)
        constant = mean - np.einsum("nci,ni->nc", slope, middle)
        return np.concatenate([constant[:, :, None], slope], axis=2)


def _occupied(x: np.ndarray, h: float) -> int:
    """How many cells of a width have places in them."""
    # cells as one number of three times 21 bits
    i, j, k = np.floor((x - x.min(axis=0)) / h).astype(np.int64).T
    return len(np.unique((i << 42) | (j << 21) | k))


def _places(obj: TranslucentObject, count: int) -> tuple[mi.Point3f, mi.Normal3f]:
    """Events along rays that are refracted inwards, and normals where they enter."""
    k = dr.arange(mi.UInt32, count)
    u = lattice(count)
    order = np.argsort(u[0])  # by faces: rays of neighbours meet the same part of the surface
    u = [floats(v[order]) for v in u]
    sampler = independent(11, count)

    # rays that enter uniformly over the surface, by the cosine, refracted inwards
    entry = uniform_entries(obj.geometry, u[0], mi.Point2f(u[1], u[2]))
    w, _ = cosine_above(entry.n_out, entry.n, sampler.next_2d())
    d, _, valid = refract_in(surface_point(entry.p, entry.n, entry.n_out, w), obj.eta)
    d = dr.select(valid, d, -entry.n)
    ray = ray_from(place(entry.p, entry.n), d, obj.geometry.clearance)
    wall = obj.geometry.scene.ray_intersect_preliminary(ray, False, True)
    length = dr.select(wall.is_valid(), wall.t, opaque(obj.geometry.rounding))

    # s = -ln(1 - u (1 - exp(-sigma_t length))) / sigma_t, for the channels in turn
    sigma = mi.Float(0)
    for c, medium in enumerate(obj.media):
        sigma = dr.select(k % len(obj.media) == c, opaque(medium.sigma_t), sigma)
    s = -dr.log(1 - sampler.next_1d() * (1 - dr.exp(-sigma * length))) / sigma
    p, n = mi.Point3f(entry.p + d * dr.minimum(s, length)), mi.Normal3f(entry.n)
    dr.eval(p, n)
    return p, n


def _weights(f: np.ndarray, cell: np.ndarray, counts: np.ndarray) -> csr_array:
    """Weights (all nodes, events) for places f in their cells."""
    # corner (i, j, k) has Π f or 1 - f over the axes
    rows, values, along = [], [], ((1 - f).T, f.T)
    for i, j, k in np.ndindex(2, 2, 2):
        rows.append(((cell[:, 2] + k) * counts[1] + cell[:, 1] + j) * counts[0] + cell[:, 0] + i)
        values.append(along[i][0] * along[j][1] * along[k][2])
    of_events = (np.stack(v, axis=1).ravel() for v in (values, rows))
    return csc_array((*of_events, 8 * np.arange(len(f) + 1)), shape=(int(counts.prod()), len(f))).tocsr()


@dataclass(frozen=True, eq=False)
class InnerLight:
    """J of an object in the light of a scene.
    `events`: its grid. `planes`: (nodes, bands, channels, 4), one after the other. `bands`: largest l. `g`: of each
    channel."""

    events: Events
    planes: mi.Float
    bands: int
    g: tuple[float, ...]

    @classmethod
    def of(cls, obj: TranslucentObject, events: Events, values: np.ndarray) -> InnerLight:
        """Inner light from ∫ Y_lm(w) L dw at events, (events, bands, channels)."""
        planes = events.fitted(values.reshape(len(values), -1))
        g = tuple(float(m.g) for m in obj.media)
        return cls(events, floats(planes), bands(obj), g)

    def __call__(self, p: mi.Point3f, d: mi.Vector3f, active: mi.Bool) -> mi.Spectrum:
        """J(p, d), 0 where no event was near."""
        size, number = dr.size_v(mi.Spectrum), (self.bands + 1) ** 2
        grid = self.events
        # ---- the cell, and the place in it
        x = [(p[a] - opaque(grid.low[a])) * opaque(1 / grid.h) for a in range(3)]
        cell, counts = [mi.Int32(dr.floor(v)) for v in x], [dr.opaque(mi.Int32, int(n)) for n in grid.counts]
        f, homogeneous = [v - mi.Float(c) for v, c in zip(x, cell)], mi.Vector4f(1, *x)
        total, whole = [mi.Float(0)] * (size * number), mi.Float(0)

        # ---- Σ over corners of the trilinear weight times the plane of that node
        for corner in np.ndindex(2, 2, 2):
            at = [c + k for c, k in zip(cell, corner)]
            inside = active
            for i, n in zip(at, counts):
                inside = inside & (i >= 0) & (i < n)
            node = dr.gather(mi.Int32, grid.index, (at[2] * counts[1] + at[1]) * counts[0] + at[0], inside)
            known = inside & (node >= 0)
            w = mi.Float(1)
            for v, k in zip(f, corner):
                w = w * (v if k else 1 - v)
            w = dr.select(known, w, 0)
            whole = whole + w
            for b in range(size * number):
                plane = dr.gather(mi.Vector4f, self.planes, node * (size * number) + b, known)
                total[b] = dr.fma(w, dr.dot(plane, homogeneous), total[b])

        # ---- J = Σ_lm g^l Y_lm(d) times these
        scale = dr.select(whole > 0, dr.rcp(dr.maximum(whole, 1e-30)), 0)
        Y, J = dr.sh_eval(d, self.bands), []
        for c in range(size):
            orders = [n for n in range(self.bands + 1) for _ in range(2 * n + 1)]
            parts = [total[b * size + c] * Y[b] * opaque(self.g[c] ** n) for b, n in enumerate(orders)]
            J.append(dr.maximum(sum(parts[1:], parts[0]) * scale, 0))
        return mi.Spectrum(J)
