"""Light of small emitters by joins: a walk from the camera and one from an emitter meet inside the object.

A path inside an object has scattering events v_1 ... v_n from the camera's side. An edge v_k v_{k+1} is straight if
nothing reflects between them. A path with a straight edge is split at the last one, v_k v_{k+1}: v_k is an event of
the walk from the camera, v_{k+1} lies on a ray of light. That ray enters from an emitter, or it follows a reflection
at the boundary; between its events the walk from the light is reflected at least once, for else an edge nearer to
the emitter would be straight. Thus each path from a small emitter with a straight edge is found by joins in one way,
and every other path (no straight edge, one event or none, light that other surfaces reflect) by walks from the
camera. Those also find what comes from emitters that look large from v_k, or at a large angle to w_0, where aiming is
no good.

The entering ray is aimed: a point a on the plane through p = v_k across the direction w_0 to the emitter, near the
place where a plane boundary would refract light towards p, and a point of the emitter seen from a. Flux through the
plane is L |w.w_0| dA dw. On the ray at distance t the event has the density D / (dtheta (D² + (t - t_0)²)) (Kulla and
Fajardo 2012), with D the distance of p from the ray, so that 1/|p - q|² cancels; the density of a, e^(-r) / r, makes up
for 1/D.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from halfspace_sss.rendering.light.small import SmallEmitters
from halfspace_sss.rendering.surface.horizon import sided
from halfspace_sss.rendering.surface.variants import channel_mean
from halfspace_sss.rendering.walk.inside import eval_phase, fly, free_path, pick, turn
from halfspace_sss.rendering.walk.media import WalkMedia
from halfspace_sss.rendering.walk.steps import Event, Walk, draw, start_walk

__all__ = ["DEEPEST", "Joins", "find_joins"]

DEEPEST = 12.0  # mean free paths up to which the boundary in front of an event is looked for
STEEPEST = 0.5  # least cosine of a ray with w_0
# Rates of fall about the aimed point, in 1/mfp: as light does around an event below a flat boundary, and one that
# falls no faster than any light at the least cosine, so that weights stay bounded.
RATES = (1.0, 0.4)
LEAST_PROMISE = 0.1  # of an event far below the boundary: light may enter nearer on another side


@dataclass
class Aim:
    """How a ray of light is aimed at an event."""

    emitter: mi.UInt32
    w_0: mi.Vector3f  # direction to it
    shift: mi.Vector3f  # from the event to the place aimed at, across w_0
    depth: mi.Float  # of the event below the boundary


@dataclass
class LightWalk:
    """State of a walk from an emitter."""

    walk: Walk
    lit: mi.Bool  # whether its ray comes from an emitter or a reflection, so that it may be joined to the event
    fresh: mi.Bool  # whether it begins there, rather than at a null collision
    L: mi.Spectrum  # what the joins so far bring


@dataclass(frozen=True, eq=False)
class Joins:
    """How light of small emitters is found by joins.

    Args:
        scene: the Mitsuba scene.
        media: its translucent objects.
        small: its small emitters.
        share: probability of a join at an event near the boundary.
    """

    scene: Any
    media: WalkMedia
    small: SmallEmitters
    share: float

    def covers(self, k: Any, y: Any, w: Any, pivot: Any) -> Any:
        """Whether joins at `pivot` find light that arrives from the point y of emitter k along -w; none has k < 0.

        The line must cross the plane through the pivot steeply on its way from the emitter.
        """
        near = dr.maximum(k, 0)
        w_0, small = self.small.direction(near, pivot)
        cosine = dr.dot(w, w_0)
        ahead = self.small.distant(near) | (dr.dot(y - pivot, w_0) * cosine > 0)
        return (k >= 0) & small & (dr.abs(cosine) > STEEPEST) & ahead

    def light(self, event: Event, rng: Any) -> tuple[Any, Any]:
        """An estimate of what joins at an event bring per weight of the walk from the camera, and the generator."""
        n = len(self.small)
        which = draw(n, rng)
        w_0, small = self.small.direction(which, event.p)
        aim, survive = self._aim(which, w_0, event)
        chosen = small & (rng.next_float32() < self.share * survive)
        L = mi.Spectrum(0) + dr.zeros(mi.Spectrum, dr.width(event.p))
        rng, L, *_ = dr.if_stmt((rng, L, event, aim), chosen, self._enter, lambda *state: state, label="join")
        return L * (n / (self.share * survive)), rng

    def _aim(self, which: Any, w_0: Any, event: Event) -> tuple[Aim, Any]:
        """Where to aim so that light gets to an event, and how promising that is, (0, 1]."""
        p, k, m = event.p, event.object, event.m
        ray = mi.Ray3f(p, w_0)
        ray.maxt = DEEPEST / dr.min(m.mean_t)
        si = self.media.scene.ray_intersect(ray, mi.RayFlags.Minimal, coherent=False)
        n = si.n * self.media.side(k, si.prim_index)
        facing = si.is_valid() & (dr.dot(n, w_0) > 0)
        far = dr.select(si.is_valid(), si.t, ray.maxt)
        _, cos_t, _, eta_ti = mi.fresnel(dr.select(facing, dr.dot(n, w_0), 1), self.media.row("eta", k))
        back = w_0 * eta_ti + n * (dr.abs(cos_t) - eta_ti * dr.dot(n, w_0))  # from p to where the light enters
        entry = back * (dr.dot(n, w_0) * far / dr.maximum(dr.abs(cos_t), 1e-3))
        shift = dr.select(facing, entry - w_0 * dr.dot(entry, w_0), 0)
        depth = dr.select(facing, dr.minimum(dr.norm(entry), far), far)
        promise = dr.maximum(dr.exp(-0.5 * dr.min(m.mean_t) * depth), LEAST_PROMISE)
        return Aim(which, w_0, mi.Vector3f(shift), depth), promise

    def _enter(self, rng: Any, L: Any, event: Event, aim: Aim) -> tuple:
        """Aim a ray of light, refract it into the object and follow it."""
        k, m = event.object, event.m
        at, density = _draw_across(event, aim, rng)
        which = aim.emitter
        w, distance, light = self.small.sample(which, at, mi.Point2f(rng.next_float32(), rng.next_float32()))
        flux = light * (dr.abs(dr.dot(w, aim.w_0)) / density)
        distant = self.small.distant(which)
        away = dr.select(distant, 4 * dr.norm(self.scene.bbox().extents()), distance * (1 - 1e-4))
        si = self.scene.ray_intersect(mi.Ray3f(mi.Point3f(at.p + w * away), -w), mi.RayFlags.All, coherent=False)
        steep = dr.abs(dr.dot(w, aim.w_0)) > STEEPEST
        enters = si.is_valid() & (dr.max(light) > 0) & steep & (self.media.index_of(si.shape) == mi.Int32(k))
        si = self.media.face_outwards(si, dr.select(enters, mi.Int32(k), -1), -w)
        si.wi = dr.select(mi.Frame3f.cos_theta(si.wi) < 0, -si.wi, si.wi)  # below its horizon, see `surface.horizon`
        F, cos_t, _, eta_ti = mi.fresnel(mi.Frame3f.cos_theta(si.wi), self.media.row("eta", k))
        d = si.to_world(mi.refract(si.wi, cos_t, eta_ti))
        enters &= (dr.dot(si.n, w) > 0) & (mi.Frame3f.cos_theta(si.wi) > 0) & (dr.dot(si.n, d) < 0)
        # shading normals bend the ray, geometric ones hold its width
        bend = dr.dot(d, si.n) * mi.Frame3f.cos_theta(si.wi) / (dr.dot(d, si.sh_frame.n) * dr.dot(w, si.n))
        weight = dr.select(enters, flux * ((1 - F) * bend), 0)
        enters &= dr.max(weight) > 0
        walk = start_walk(mi.Point3f(si.p), d, rng)
        walk = replace(walk, skip=self.media.clear(k, si.n, d), alive=enters, object=k, weight=weight,
                       channel=draw(len(m.sigma_t), rng))  # fmt: skip
        state = (LightWalk(walk, mi.Bool(enters), mi.Bool(enters), L), event)
        s, event = dr.while_loop(state, lambda s, event: s.walk.alive, self._follow, label="light")
        return s.walk.rng, s.L, event, aim

    def _follow(self, s: LightWalk, event: Event) -> tuple[LightWalk, Event]:
        """One flight of the walk from the light, and a join on its ray if that may have one."""
        media, walk, rng = self.media, s.walk, s.walk.rng
        m = media.coefficients(event.object, walk.o)
        joinable = s.lit & s.fresh
        t, over = _on_ray(walk, event, rng.next_float32())
        t = dr.select(joinable, t, 0)
        flight = free_path(m, walk.channel, rng.next_float32())
        ray = walk.ray(dr.maximum(t, flight))
        hit = media.scene.ray_intersect_preliminary(ray, coherent=False)
        reach = hit.t + walk.skip
        L = s.L + self._joined(walk, event, t, dr.select(joinable & (t < reach), over, 0))
        u, p = None, mi.Point3f(walk.o + walk.d * flight)
        if media.varies:
            m, u = media.coefficients(event.object, p), rng.next_float32()
        ended = fly(m, walk.weight, walk.density, walk.channel, flight, reach, u)
        u = mi.Point2f(rng.next_float32(), rng.next_float32())
        turned, weight, density = turn(m, ended.weight, ended.density, walk.channel, walk.d, u, media.same_g)
        scattered = replace(walk, alive=walk.alive & s.lit, o=p, d=turned, skip=mi.Float(0), weight=weight,
                            density=density)  # fmt: skip
        walk = replace(walk, weight=ended.weight, density=ended.density)
        if media.varies:
            on = walk.alive & (~ended.null | media.box.contains(p))
            skip = dr.select(ended.null, 0, walk.skip)
            walk = replace(walk, alive=on, o=dr.select(ended.null, p, walk.o), skip=skip)
        collided = ended.scatters | ended.null
        walk, *_ = dr.if_stmt((walk, ray, hit), ~collided, self._reflect, lambda *state: state)
        scattered.rng = walk.rng
        lit = ~ended.scatters & (s.lit | ~collided)
        return LightWalk(dr.select(ended.scatters, scattered, walk), lit, ~ended.null, L), event

    def _joined(self, walk: Walk, event: Event, t: Any, over: Any) -> Any:
        """What a join at the distance t on a ray of light brings; `over` is one over its density."""
        media, q = self.media, mi.Point3f(walk.o + walk.d * t)
        to_p = mi.Ray3f(q, dr.normalize(event.p - q))
        to_p.maxt = dr.norm(event.p - q)
        at_q = media.coefficients(event.object, q)
        phases = eval_phase(event.m, dr.dot(event.along, -to_p.d)) * eval_phase(event.m, dr.dot(to_p.d, walk.d))
        value = dr.select(over > 0, walk.weight * at_q.sigma_s * phases * over, 0)
        bright = dr.max(value) > 0
        bright &= ~media.scene.ray_test(to_p, False, bright)
        T = media.transmittance(event.object, mi.Ray3f(walk.o, walk.d), dr.select(bright, t, 0), walk.rng)
        T *= media.transmittance(event.object, to_p, dr.select(bright, to_p.maxt, 0), walk.rng)
        return dr.select(bright, value * T, 0)

    def _reflect(self, walk: Walk, ray: Any, hit: Any) -> tuple:
        """Reflection at the boundary from inside with the probability of its reflectance."""
        k, d = mi.Int32(walk.object), walk.d
        si = hit.compute_surface_interaction(ray)
        si = self.media.seen(si, k, d)
        F, _, _, _ = mi.fresnel(mi.Frame3f.cos_theta(si.wi), self.media.row("eta", k))
        new, _ = sided(si, mi.reflect(si.wi))
        met = self.media.met(si.shape, k)
        foreign = met != k  # an object that overlaps: the ray goes on behind it
        new = dr.select(foreign, d, new)
        inside = (dr.dot(si.n, d) > 0) & (dr.dot(si.n, new) < 0) & (walk.rng.next_float32() < F)
        o, skip = mi.Point3f(si.p), self.media.clear(met, si.n, new)
        walk = replace(walk, o=o, d=new, skip=skip, alive=walk.alive & (foreign | inside))
        return walk, ray, hit


def _draw_across(event: Event, aim: Aim, rng: Any) -> tuple[Any, Any]:
    """A point of the plane across w_0 through the event, and its density per area."""
    sigma_t = event.m.mean_t
    wide = sigma_t * dr.rsqrt(1 + sigma_t * aim.depth)
    rate = dr.select(rng.next_float32() < 0.5, RATES[0], RATES[1]) * pick(wide, draw(len(wide), rng))
    r = dr.maximum(-dr.log(1 - rng.next_float32()) / rate, 1e-20)
    density = sum(channel_mean(c * wide * dr.exp(-c * wide * r)) for c in RATES) / (len(RATES) * 2 * dr.pi * r)
    sin_phi, cos_phi = dr.sincos(2 * dr.pi * rng.next_float32())
    s, t = mi.coordinate_system(aim.w_0)
    at = dr.zeros(mi.Interaction3f)
    at.p = mi.Point3f(event.p + aim.shift + (s * cos_phi + t * sin_phi) * r)
    return at, density


def _on_ray(walk: Walk, event: Event, u: Any) -> tuple[Any, Any]:
    """Distance of an event q on a ray of light, and 1 / (its density |p - q|²)."""
    v = event.p - walk.o
    t_0 = dr.dot(v, walk.d)
    D = dr.maximum(dr.norm(v - walk.d * t_0), 1e-9)
    start = dr.atan2(-t_0, D)
    width = 0.5 * dr.pi - start
    t = dr.maximum(t_0 + D * dr.tan(start + u * width), 0)
    return t, dr.select(dr.isfinite(t), width / D, 0)


def find_joins(scene: Any, media: WalkMedia, small: SmallEmitters | None, share: float) -> Joins | None:
    """Joins with the small emitters of a scene; None without any, or without an object whose boundary is smooth."""
    if small is None or not media.objects or media.all_rough or share == 0:
        return None
    if media.inner is not None and not np.array(media.inner.tables["alone"]).any():
        return None
    return Joins(scene, media, small, share)
