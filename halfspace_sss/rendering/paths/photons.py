"""What leaves an object by walks from where light arrives: gathered light without a model of S.

Photons enter at the points of the object, in proportion to the light that was gathered along each direction there, and
walk until they leave. S is reciprocal, so that a walk from x_i against w_i has at its exit (x_o, w_o) the throughput T
with E[T f(x_o, w_o)] = ∫∫ S f mu_o dw_o dA_o. With the power Φ of each photon and the area A_j of what is nearest to
point j,

    B_j = Σ Φ T / (A_j ∫ a(mu) mu dw),    L_o(x_o, w_o) = a(w_o) B(x_o),

summed over exits nearest to j. a(mu) = F_t(mu) (c_0 + c_1 mu + c_2 mu²) is fitted to all exits, and B gets a slope over
the bent w_o, along the surface, by their first moment. Sums over exits are averaged over the neighbourhood, the wider
the farther photons have come from: the density estimate of Jensen's photon map (1996), over points that stay.

What objects send to each other, and to themselves, comes by a dipole for a few photons, then by these.
Unlike a transfer, walks are those of one light: other lights ask for new ones. Emission inside objects is left out.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np

from halfspace_sss.physics.fresnel import F_t
from halfspace_sss.rendering.gathered.points import REACH, SurfacePoints, lattice, uniform_entries
from halfspace_sss.rendering.gathered.transfer import RINGS, ROUNDS, Albedo, Hemispheres, bent, count_of, row_sums
from halfspace_sss.rendering.object.half_space import half_space_model
from halfspace_sss.rendering.object.points import ObjectModel, SurfacePoint, TransportAround
from halfspace_sss.rendering.object.registry import PATH_TRACED
from halfspace_sss.rendering.walk.media import media_within
from halfspace_sss.rendering.walk.random_walk import exits

if TYPE_CHECKING:
    from halfspace_sss.rendering.gathered.pairs import Rays
    from halfspace_sss.rendering.object.objects import TranslucentObject
    from halfspace_sss.rendering.object.settings import Settings

BETWEEN = "better_dipole"  # for light between objects, before photons bring it
PASS = 2**20  # photons at a time
PLACES = 2**20  # by which areas of points are measured
BINS = 64  # of cosines of exits
SLOPE_ROUNDS = 12  # smoothings of the slope over w_o


@dataclass(frozen=True, eq=False)
class WalkedTransport(TransportAround):
    """Stands for S where walks from the light take its place; a dipole in what objects first send to each other."""

    alpha = None

    def prepare(self, at: SurfacePoint, active: mi.Bool = True) -> Any:
        return self.transport.prepare(at, active)

    def S(self, exit: Any, at: SurfacePoint, active: mi.Bool = True) -> mi.Spectrum:
        return self.transport.S(exit, at, active)


def walked_model(obj: TranslucentObject, settings: Settings) -> ObjectModel:
    """For light that is gathered.

    Raises:
        ValueError: light is not gathered: the integrator `translucent_walk` samples walks.
    """
    if settings.light != "gathered":
        raise ValueError(
            f"light must be gathered for the model {PATH_TRACED!r} of object {obj.geometry.name}, got "
            f"{settings.light}: the integrator translucent_walk samples walks"
        )
    transport, proposals, entries = half_space_model(BETWEEN, obj.geometry, obj.media, settings)
    return ObjectModel(WalkedTransport(transport), proposals, entries)


@dataclass(frozen=True, eq=False)
class WalkedPoints:
    """Points of an object with the area that is nearest to each, where light arrives and photons leave.

    Args:
        object: of them.
        points: of its surface.
        area: of each, scene units squared.
        albedo: 1: by it light is gathered as irradiance.
        around: hemispheres for that.
    """

    object: TranslucentObject
    points: SurfacePoints
    area: np.ndarray
    albedo: Albedo
    around: Hemispheres

    @classmethod
    def of(cls, obj: TranslucentObject) -> WalkedPoints:
        """As many points as a transfer has."""
        points = SurfacePoints.of(obj.geometry, count_of(obj))
        u = [mi.Float(v.astype(np.float32)) for v in lattice(PLACES)]
        at = uniform_entries(obj.geometry, u[0], mi.Point2f(u[1], u[2]))
        near, known = (np.array(v) for v in points.nearest(at.p, at.n, mi.Bool(True)))
        area = np.bincount(near[known], minlength=len(points)) * (float(obj.geometry.area) / known.sum())
        even = Albedo(np.eye(3)[[0] * dr.size_v(mi.Spectrum)], 1.0)
        return cls(obj, points, area, even, Hemispheres.of(points, even))


class Leaving(NamedTuple):
    """What photons tell of an object.

    Args:
        albedo: a(mu), for the light that they carried.
        B: constant and slope over the bent w_o, (points, channels, 4).
        error: standard error of B over its mean.
    """

    albedo: Albedo
    B: np.ndarray
    error: float


def leaving(here: WalkedPoints, rays: Rays, count: int, seed: int) -> Leaving:
    """What photons of gathered light tell.

    Args:
        here: points of the object.
        rays: to these, with all light that arrives.
        count: photons, `PASS` at a time, so that memory is that of a pass.
        seed: of the photons.
    """
    points, eta = here.points, float(here.object.media[0].eta)
    passes = max(round(count / PASS), 1)
    left = _left(here, rays, count // passes, (seed, 0))
    albedo = _fitted(left, eta)
    around = Hemispheres.of(points, albedo)
    sums, first = _deposited(left, around, len(points))
    for k in range(1, passes):
        more = _deposited(_left(here, rays, count // passes, (seed, k)), around, len(points))
        sums, first = sums + more[0], first + more[1]
    over = here.area[:, None] * around.whole * passes
    halves = [_density(points, 2 * half, over) for half in sums]
    mean = 0.5 * (halves[0] + halves[1])
    error = float(np.sqrt(((halves[0] - halves[1]) ** 2).mean()) / 2 / max(float(mean.mean()), 1e-30))
    slope = _slope(points, around, first, over)
    constant = mean - np.einsum("jck,jk->jc", slope, around.middle)
    return Leaving(albedo, np.concatenate([constant[:, :, None], slope], axis=2), error)


class _LeftAt(NamedTuple):
    """Where photons leave.

    Args:
        near: point nearest to each.
        ring: of the distance that it has come.
        mu, w: cosine, and direction bent by the boundary.
        flux: (photons, channels).
    """

    near: np.ndarray
    ring: np.ndarray
    mu: np.ndarray
    w: np.ndarray
    flux: np.ndarray


def _left(here: WalkedPoints, rays: Rays, count: int, seed: tuple[int, ...]) -> _LeftAt:
    points, eta = here.points, float(here.object.media[0].eta)
    start, entered, power = _photons(here, rays, count, seed)
    found = exits(media_within(here.object), 0, start, (*seed, 19), 2)
    near, known = points.nearest(found.at.p, found.at.n, found.left)
    mu, w = dr.dot(found.at.w, found.at.n_out), bent(found.at.w, found.at.n_out, eta)
    kept = known & found.left & (mu > 0)
    dr.eval(near, kept, mu, w)
    left, T = np.flatnonzero(np.array(kept)), np.array(found.T, dtype=np.float32).T.reshape(count, -1)
    near, mu, w = np.array(near)[left], np.array(mu)[left], np.array(w).T[left]
    p = np.array(points.p, dtype=np.float32).T
    apart = np.linalg.norm(p[entered[left]] - p[near], axis=1) * (REACH / points.h)
    return _LeftAt(near, np.digitize(apart, RINGS), mu, w, power[left] * T[left])


def _deposited(left: _LeftAt, around: Hemispheres, rows: int) -> tuple[np.ndarray, np.ndarray]:
    """Sums of flux by half, ring and point, (2, rings, points, channels), and first moments (points, channels, 3)."""
    kinds, half = len(ROUNDS), np.arange(len(left.near)) % 2
    sums = row_sums((half * kinds + left.ring) * rows + left.near, left.flux, 2 * kinds * rows)
    about = left.w - around.middle[left.near]
    first = [row_sums(left.near, left.flux * about[:, k, None], rows) for k in range(3)]
    return sums.reshape(2, kinds, rows, -1), np.stack(first, axis=2)


def _photons(
    here: WalkedPoints, rays: Rays, count: int, seed: tuple[int, ...]
) -> tuple[SurfacePoint, np.ndarray, np.ndarray]:
    """Where photons enter and against which directions, their points, and their power, (photons, channels)."""
    light = (rays.light * here.area[:, None, None]).reshape(-1, rays.light.shape[2])
    whole = np.cumsum(light.mean(axis=1), dtype=float)
    if not whole[-1] > 0:
        whole = np.arange(1.0, len(light) + 1)  # photons without power
    rng = np.random.default_rng((*seed, 18))
    k = np.searchsorted(whole, (np.arange(count) + rng.random()) / count * whole[-1], "right").clip(0, len(light) - 1)
    k = rng.permutation(k)  # halves of the photons are then alike
    power = light[k] * (whole[-1] / count / np.maximum(light[k].mean(axis=1), 1e-30))[:, None]
    entered = k // rays.light.shape[1]
    w = mi.Vector3f(rays.w.reshape(-1, 3)[k].T.astype(np.float32))
    start, _ = here.points.exit_along(mi.UInt32(entered.astype(np.uint32)), w)
    return start, entered, power.astype(np.float32)


def _fitted(left: _LeftAt, eta: float) -> Albedo:
    """a(mu) by least squares over a histogram of what leaves, which is as a(mu) mu."""
    at = (np.arange(BINS) + 0.5) / BINS
    basis = (F_t(at, eta) * at)[:, None] * at[:, None] ** np.arange(3)
    seen = row_sums(np.minimum((left.mu * BINS).astype(int), BINS - 1), left.flux, BINS)
    dark = ~(seen.sum(axis=0) > 0)
    seen = np.where(dark, seen.sum(axis=1, keepdims=True) + basis[:, :1] * dark.all(), seen)
    return Albedo(np.linalg.lstsq(basis, seen / seen.mean(axis=0), rcond=None)[0].T, eta)


def _density(points: SurfacePoints, sums: np.ndarray, over: np.ndarray) -> np.ndarray:
    """B of points, (points, channels): of each ring averaged over its neighbourhood, as is the area."""
    B = np.zeros_like(over)
    for flux, rounds in zip(sums, ROUNDS):
        area = over
        for _ in range(rounds):
            flux, area = points.smoothed(flux), points.smoothed(area)
        B += flux / np.maximum(area, 1e-30)
    return B


def _slope(points: SurfacePoints, around: Hemispheres, first: np.ndarray, over: np.ndarray) -> np.ndarray:
    """Of B over the bent w_o, (points, channels, 3), by the first moments of exits, along the surface.

    Upwards w_o varies little once it is bent: a(mu) is all there.
    """
    for _ in range(SLOPE_ROUNDS):
        first, over = points.smoothed(first), points.smoothed(over)
    n = np.array(points.n_out, dtype=float).T[:, None]
    C, upright = around.covariance, np.einsum("jik,jai,jak->j", around.covariance, n, n)
    spread = 0.5 * (np.trace(C, axis1=1, axis2=2) - upright)
    return (first - (first * n).sum(axis=2, keepdims=True) * n) / (spread[:, None] * np.maximum(over, 1e-30))[..., None]
