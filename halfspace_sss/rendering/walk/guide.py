"""Light of small emitters that leaves an object right after an event: directions drawn about the one that hits.

Where no join can find a path (see `walk_connect`), the walk from the camera has to hit the emitter through the
refracting boundary. The direction that does so from the event v is guessed: w_0 is refracted at the normal of the
place where the last guess meets the boundary, three times. Directions are then drawn about the guess, from a narrow
lobe as wide as the emitter and from wider ones for guesses that are wrong, and weighted against those of the phase
function (balance heuristic), so that no guess has to be right.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from halfspace_sss.rendering.light.small import SmallEmitters
from halfspace_sss.rendering.surface.horizon import opposed
from halfspace_sss.rendering.surface.variants import channel_mean
from halfspace_sss.rendering.walk.connect import DEEPEST
from halfspace_sss.rendering.walk.inside import eval_phase
from halfspace_sss.rendering.walk.media import Coefficients, WalkMedia
from halfspace_sss.rendering.walk.steps import Event, draw

__all__ = ["Departure", "Guide"]

GUESSES = 3
SHARES = (0.5, 0.3, 0.2)  # of the lobes
WIDER = (131.0, 8.0)  # concentrations of the others: 5 and 20 degrees


@dataclass
class Departure:
    """A walk's last event and its way out from there, by which it left the object straight."""

    p: mi.Point3f
    along: mi.Vector3f  # direction of arrival at the event
    ahead: mi.Vector3f  # direction from it
    object: mi.Int32


@dataclass(frozen=True, eq=False)
class Guide:
    """Directions from events to small emitters.

    Args:
        scene: the Mitsuba scene.
        media: its translucent objects.
        small: its small emitters.
    """

    scene: Any
    media: WalkMedia
    small: SmallEmitters

    def _guess(self, v: Any, k: Any, which: Any, m: Coefficients, active: Any) -> tuple[Any, Any, Any]:
        """The direction from v by which an emitter sees it through the boundary, its concentration, and if any."""
        toward, small = self.small.direction(which, v)
        eta = self.media.row("eta", k)
        valid, d, w = active & small, toward, toward
        for _ in range(GUESSES):
            ray = mi.Ray3f(v, d)
            ray.maxt = DEEPEST / dr.min(m.mean_t)
            si = self.media.scene.ray_intersect(ray, mi.RayFlags.Minimal, coherent=False, active=valid)
            valid &= si.is_valid()
            n = si.n * self.media.side(k, si.prim_index)
            w, _ = self.small.direction(which, si.p)
            cosine = dr.dot(w, n)
            _, cos_t, _, eta_ti = mi.fresnel(dr.clip(cosine, 0, 1), eta)
            refracted = w * eta_ti + n * (dr.abs(cos_t) - eta_ti * cosine)
            d = dr.normalize(dr.select(cosine > 0, refracted, d))
        return d, dr.minimum(dr.square(eta) / dr.maximum(self.small.angle2(which, v), 1e-6), 1e6), valid

    def light(self, event: Event, rng: Any) -> Any:
        """An estimate of the light of small emitters that leaves from an event, per weight of the walk."""
        v, k, m = event.p, event.object, event.m
        n = len(self.small)
        which = mi.Int32(draw(n, rng))
        guess, concentration, valid = self._guess(v, k, which, m, True)
        d, pdf = _draw_lobe(guess, concentration, rng)
        ray = mi.Ray3f(v, d)
        ray.maxt = 2 * DEEPEST / dr.min(m.mean_t)
        si = self.media.scene.ray_intersect(ray, mi.RayFlags.All, coherent=False, active=valid)
        valid &= si.is_valid() & (self.media.index_of(si.shape) == k)
        si = self.media.seen(si, k, d)
        F, cos_t, eta_it, eta_ti = mi.fresnel(mi.Frame3f.cos_theta(si.wi), self.media.row("eta", k))
        w = opposed(si.to_world(mi.refract(si.wi, cos_t, eta_ti)), si.n)
        valid &= (dr.dot(d, si.n) > 0) & (dr.dot(w, si.n) > 0) & (F < 1)
        way = si.spawn_ray(w)
        outside = self.scene.ray_intersect(way, mi.RayFlags.All, coherent=False, active=valid)
        phase = eval_phase(m, dr.dot(event.along, d))
        # radiance shrinks by eta² on its way out, as the weight of the walk has when it came in
        factor = (1 - F) * dr.square(eta_ti) / (pdf / n + channel_mean(phase))
        T = self.media.transmittance(k, ray, dr.select(valid, si.t, 0), rng)
        value = phase * T * factor
        return dr.select(valid, value * self.small.along(which, way, outside, valid), 0)

    def share(self, which: Any, way: Departure, active: Any) -> Any:
        """Weight of having hit emitter `which`, if >= 0, by the phase function (balance heuristic against `light`)."""
        k, m = way.object, self.media.coefficients(way.object, way.p)
        guess, concentration, valid = self._guess(way.p, k, type(k)(dr.maximum(which, 0)), m, active & (which >= 0))
        lobes = _lobes(dr.dot(guess, way.ahead), concentration) / len(self.small)
        phase = channel_mean(eval_phase(m, dr.dot(way.along, way.ahead)))
        return phase / (phase + dr.select(active & valid, lobes, 0))


def _lobes(cosine: Any, concentration: Any) -> Any:
    """Density of the sum of lobes c e^(-c (1 - cos)) / (2 pi), 1/sr; what falls beyond cos = -1 is left out."""
    x = dr.maximum(1 - cosine, 0)
    parts = zip(SHARES, (concentration, *WIDER))
    return sum(a * c * dr.exp(-c * x) for a, c in parts) / (2 * dr.pi)


def _draw_lobe(guess: Any, concentration: Any, rng: Any) -> tuple[Any, Any]:
    """A direction about the guess, and its density."""
    u = rng.next_float32()
    c = dr.select(u < SHARES[0], concentration, dr.select(u < SHARES[0] + SHARES[1], WIDER[0], WIDER[1]))
    x = dr.minimum(-dr.log(1 - rng.next_float32()) / c, 2)
    sine = dr.safe_sqrt(x * (2 - x))
    sin_phi, cos_phi = dr.sincos(2 * dr.pi * rng.next_float32())
    d = mi.Frame3f(guess).to_world(mi.Vector3f(sine * cos_phi, sine * sin_phi, 1 - x))
    return d, _lobes(1 - x, concentration)
