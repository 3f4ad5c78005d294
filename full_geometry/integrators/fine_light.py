"""Light of spots and projectors that has detail finer than the points of an object, kept by its flux.

At a point of an object gathered light is known for that place alone: a laser that lights one point, or none, would be
too bright, or lost. So the light of such an emitter at point k is its mean over the places that are nearest to it, A_k,

    L_k = 1 / (A_k n) Σ_s a(mu_s) mu_s E_s / p_s,

E_s the irradiance across the ray at the place s of density p_s: uniform places, or where few of these are lit those
that rays of the emitter meet. Between points B is blended with weights S, which blurs detail of a few distances. So at
the points there is the approximate inverse of that (Van Cittert 1931),

    B_(m+1) = B_m + B - S B_m,    B_0 = B.

What leaves has the flux Σ_k A_k W_k ρ_k L_k, W = ∫ a(mu) mu dw and ρ the sums of rows, as the transport is reciprocal:
B is scaled to that, since few entries are at one point.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from typing import NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np

from full_geometry.geometry.instances import InstanceScene
from full_geometry.geometry.light_points import lattice, uniform_entries
from full_geometry.geometry.points import floats, place, turned
from full_geometry.geometry.rounding import blocked
from full_geometry.objects.objects import TranslucentObject
from full_geometry.precomputed.transport_matrix import Incident, TransportMatrix, bent, cosine

COUNT = 2**18  # places, and rays of an emitter
KINDS = ("SpotLight", "Projector")
ROOTS = (0.8566748838545029, 0.7338918566271260, 0.6287067210378087, 0.5385972572236101)  # of four dimensions
UNEVEN = 0.1  # mean difference of light at points from that of their surroundings, over its mean, that makes it fine
BLURRED = 0.05  # likewise of that of their surroundings from what is blended of it
SHARPENINGS = 2  # of what leaves: more brings little contrast, and noise of the transport matrix
LIT = 2**12  # places in effect, below which rays of the emitter take their place
LOST = 0.5  # root mean square of detail below the distance of points, over that of the light, which is told


class _Light(NamedTuple):
    """Light at places: number of the nearest point, a mu E / (n p) and a mu E by channel, and its bent direction."""

    near: np.ndarray
    value: np.ndarray
    square: np.ndarray
    w: np.ndarray


@dataclass(frozen=True)
class FineLight:
    """What emitters with fine detail bring to the points of an object.
    `emitters`: which; what is gathered at the points leaves them out. `incident`: radiance of them all. `area`: of the
    surface nearest to each point."""

    emitters: list[mi.Emitter]
    incident: Incident
    area: np.ndarray

    def leaving(self, T: TransportMatrix, scaled: bool) -> np.ndarray:
        """B of that light as `T @` returns it, sharpened, and `scaled` to its flux."""
        # B_(m+1) = B_m + B - S B_m of the mean over w_o
        B, mean = T @ self.incident, T.mean(self.incident)
        sharp = mean
        for _ in range(SHARPENINGS):
            sharp = sharp + mean - T.points.smoothed(sharp)
        B[:, :, 0] += sharp - mean

        # the flux Σ A W B is Σ A W ρ L
        if scaled:
            weight = self.area[:, None] * T.around.whole
            wanted = (weight * T.t.sum(axis=1) * self.incident.mean).sum(axis=0)
            B *= (wanted / np.maximum((weight * sharp).sum(axis=0), 1e-30))[:, None]
        return B


def fine_light(
    scene: mi.Scene, instance_scene: InstanceScene, obj: TranslucentObject, T: TransportMatrix
) -> FineLight | None:
    """The light of spots and projectors that differs about points from that at or between them; None without any."""
    emitters = [e for e in scene.emitters() if e.class_name() in KINDS]
    if not emitters:
        return None
    n, count = COUNT, len(T.points)
    u = [floats(v) for v in lattice(n)]
    places = uniform_entries(obj.geometry, u[0], mi.Point2f(u[1], u[2]))
    near = np.array(T.points.nearest(places.p, places.n, mi.Bool(True))[0])
    area = obj.geometry.area / n * np.maximum(np.bincount(near, minlength=count), 0.5)
    view, around, chosen, mean, moment = (scene, instance_scene, obj, T), T.around, [], 0.0, 0.0
    for emitter in emitters:
        # the mean of light about points, by uniform places or rays of the emitter
        brought, w = _arriving(view, (places.p, places.n, places.n_out), emitter)
        light = _Light(near, brought * (obj.geometry.area / n), brought, w)
        power = brought.sum(axis=1)
        if power.sum() ** 2 < LIT * (power**2).sum() or not power.any():
            light = _by_rays(view, emitter)
        sums = np.stack([np.bincount(light.near, v, count) for v in light.value.T], axis=1) / area[:, None]
        if not sums.any():
            continue

        # it is fine where that differs from the light at the points, or from what is blended between them
        here, _ = _arriving(view, (T.points.p, T.points.n, T.points.n_out), emitter)
        kinds = (sums - here, UNEVEN), (sums - T.points.smoothed(sums), BLURRED)
        if all((area[:, None] * abs(d)).sum() < least * (area[:, None] * sums).sum() for d, least in kinds):
            continue
        lost = 1 - (area[:, None] * sums**2).sum() / max((light.value * light.square).sum(), 1e-30)
        if lost > LOST**2:
            _warn(emitter, obj, T, lost)
        d = light.w - around.middle[light.near]
        first = [[np.bincount(light.near, v * d[:, k], count) for k in range(3)] for v in light.value.T]
        chosen.append(emitter)
        mean = mean + sums / around.whole
        moment = moment + np.array(first).transpose(2, 0, 1) / (area[:, None] * around.whole)[:, :, None]
    if not chosen:
        return None
    return FineLight(chosen, Incident(np.float32(mean), np.float32(moment)), area)


def _warn(emitter: mi.Emitter, obj: TranslucentObject, T: TransportMatrix, lost: float) -> None:
    apart = np.sqrt(obj.geometry.area / len(T.points))
    warnings.warn(
        f"light of emitter '{emitter.id()}' has detail finer than the points of gathered light on object "
        f"{obj.geometry.name}, {apart:.2g} scene units apart: {np.sqrt(lost):.0%} of its contrast is lost, its flux "
        'is kept; light="sampled" keeps both',
        stacklevel=2,
    )


def _arriving(view: tuple, at: tuple, emitter: mi.Emitter) -> tuple[np.ndarray, np.ndarray]:
    """a(mu) mu E of an emitter at places of a surface, (places, channels), and the direction, bent."""
    (scene, instance_scene, obj, T), (p, n, n_out) = view, at
    here = place(p, n)
    ds, light = emitter.sample_direction(here, mi.Point2f(0.5), True)
    mu = cosine(ds.d, n, n_out)
    on = (ds.pdf > 0) & (mu > 0)
    on &= ~blocked(scene, instance_scene.ray_to_emitter(here, ds, obj.geometry.clearance), on)
    return _taken(T, dr.select(on, mu * light, 0), mu, ds.d, n_out)


def _by_rays(view: tuple, emitter: mi.Emitter) -> _Light:
    """The light at places that rays of an emitter meet."""
    scene, instance_scene, obj, T = view
    u = [floats(v) for v in lattice(COUNT, roots=ROOTS, shift=[0.5] * 4)]
    ray, flux = emitter.sample_ray(0.0, 0.5, mi.Point2f(u[0], u[1]), mi.Point2f(u[2], u[3]), True)
    si = instance_scene.intersect(scene, ray, mi.RayFlags.All, False, True)
    on = si.is_valid() & (si.shape == mi.ShapePtr(obj.geometry.shape))
    side = obj.geometry.side(si.prim_index, on)
    n, n_out = mi.Normal3f(si.n * side), mi.Normal3f(turned(si.sh_frame.n, si.n) * side)
    mu, across = cosine(-ray.d, n, n_out), dr.dot(-ray.d, n)
    on &= across > 0
    near, known = T.points.nearest(si.p, n, on)
    value, w = _taken(T, dr.select(on & known, flux * (mu / dr.maximum(across, 1e-6)), 0), mu, -ray.d, n_out)
    square, _ = _arriving(view, (si.p, n, n_out), emitter)
    return _Light(np.array(near), value / COUNT, square, w)


def _taken(T: TransportMatrix, light: mi.Spectrum, mu: mi.Float, w: mi.Vector3f, n_out: mi.Normal3f) -> tuple:
    value, w = T.albedo(mu) * light, bent(w, n_out, T.albedo.eta)
    dr.eval(value, w)
    return np.array(value, dtype=float).T, np.array(w, dtype=float).T
