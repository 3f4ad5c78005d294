"""Light of small emitters inside objects: connections with light subpaths, directions to emitters, inner lights.

Three strategies find what random walks from the camera rarely hit through a refracting boundary:

- `SubpathConnections`: a light subpath from an emitter enters the object and is connected with an event of the walk;
- `EmitterDirections`: from an event, directions about the one that is refracted towards an emitter, through smooth and
  rough boundaries;
- `InnerLights`: delta lights in the medium of an object, sampled at events and surfaces there.

Paths of connections. A path inside an object has scattering events v_1 ... v_n from the camera's side. An edge
v_k v_{k+1} is straight if nothing reflects between them. A path with a straight edge is split at the last one: v_k is
an event of the walk from the camera, v_{k+1} lies on a ray of the light subpath. The ray enters from an emitter, or it
follows a reflection at the boundary. Between its events the light subpath is reflected at least once, for else an edge
nearer to the emitter would be straight. So connections find each path from a small emitter with a straight edge in one
way. Every other path is left to walks from the camera: no straight edge, one event or none, light that other surfaces
reflect, emitters that look large from v_k, or directions at a large angle to w_0.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi
import numpy as np

from full_geometry.geometry.points import channel_mean, floats, opaque, opposed, sided
from full_geometry.geometry.rounding import before, blocked, place_bound, ray_from
from full_geometry.geometry.shape import pointer_numbers
from full_geometry.objects.small_emitters import SmallEmitters, spread
from full_geometry.walk.emission import towards
from full_geometry.walk.media import Coefficients, WalkMedia, WalkMedium, interaction_of, ray_of
from full_geometry.walk.random_walk import Event, Walk, draw, eval_phase, fly, free_path, pick, start_walk, turn
from full_geometry.walk.scores import Score, phase_score

# ---- Connections with light subpaths --------------------------------------------------------------------------------
#
# The entering ray is sampled through a point a of the plane through p = v_k across the direction w_0 to the emitter,
# near the place where a plane boundary would refract light towards p, and a point of the emitter seen from a. Flux
# through the plane is L |w.w_0| dA dw. On the ray at distance t the event has the density
# D / (dtheta (D² + (t - t_0)²)) (equiangular sampling, Kulla and Fajardo 2012), with D the distance of p from the ray,
# so that 1/|p - q|² cancels; the density of a, e^(-r) / r, makes up for 1/D.

DEEPEST = 12.0  # mean free paths up to which the boundary in front of an event is looked for
STEEPEST = 0.5  # least cosine of a ray with w_0
# Rates of fall about the sampled point, in 1/mfp: as light does around an event below a flat boundary, and one that
# falls no faster than any light at the least cosine, so that weights stay bounded.
RATES = (1.0, 0.4)
LEAST_PROMISE = 0.1  # of an event far below the boundary: light may enter nearer on another side


@dataclass
class EmitterSample:
    """An emitter as seen from an event, and where its light enters towards the event."""

    emitter: mi.UInt32
    w_0: mi.Vector3f  # direction to it
    shift: mi.Vector3f  # from the event to the middle of the points a, across w_0
    depth: mi.Float  # of the event below the boundary


@dataclass
class LightSubpath:
    """Loop variables of a walk from an emitter."""

    walk: Walk
    lit: mi.Bool  # whether its ray comes from an emitter or a reflection, so that it may be connected with the event
    fresh: mi.Bool  # whether the ray begins there, rather than at a null collision
    L: mi.Spectrum  # light of the connections so far
    score: Score | tuple[()]  # of the walk, where derivatives are asked for
    slopes: Score | tuple[()]  # light of each connection times its score


@dataclass(frozen=True, eq=False)
class SubpathConnections:
    """Connections of events with light subpaths of small emitters.
    `share`: probability of a light subpath at an event near the boundary. `scored`: whether light comes with its
    slopes."""

    scene: mi.Scene
    media: WalkMedia
    small: SmallEmitters
    share: float
    scored: bool = False

    def covers(self, k: mi.Int32, y: mi.Point3f, w: mi.Vector3f, pivot: mi.Point3f) -> mi.Bool:
        """Whether connections at `pivot` find light from the point y of emitter k along -w; no emitter has k < 0.
        The line must cross the plane through the pivot steeply on its way from the emitter."""
        # |w.w_0| > `STEEPEST`, from an emitter that looks small and is on the other side of the plane
        near = dr.maximum(k, 0)
        w_0, small = self.small.direction(near, pivot)
        cosine = dr.dot(w, w_0)
        ahead = self.small.distant(near) | (dr.dot(y - pivot, w_0) * cosine > 0)
        return (k >= 0) & small & (dr.abs(cosine) > STEEPEST) & ahead

    def light(self, event: Event, rng: mi.PCG32) -> tuple[mi.Spectrum, Score | tuple[()], mi.PCG32]:
        """Light of connections at an event per weight of the walk from the camera, its slopes, and the generator."""
        # ---- one of n emitters, and with the probability share * promise a light subpath from it
        n = len(self.small)
        which = draw(n, rng)
        w_0, small = self.small.direction(which, event.p)
        sample, survive = self._sample_emitter(which, w_0, event)
        chosen = small & (rng.next_float32() < self.share * survive)
        lanes = dr.width(event.p)
        L, slopes = mi.Spectrum(0) + dr.zeros(mi.Spectrum, lanes), Score.sums(lanes) if self.scored else ()

        # ---- L n / (share promise)
        state = (rng, L, slopes, event, sample)
        rng, L, slopes, *_ = dr.if_stmt(state, chosen, self._enter, lambda *state: state, label="connection")
        factor = n / (self.share * survive)
        return L * factor, slopes and slopes * factor, rng

    def _sample_emitter(self, which: mi.UInt32, w_0: mi.Vector3f, event: Event) -> tuple[EmitterSample, mi.Float]:
        """Where light of an emitter enters towards an event, and the probability to look for it, (0, 1]."""
        # ---- the boundary between the event and the emitter, its normal n and its distance
        p, k, m = event.p, event.object, event.m
        ray = mi.Ray3f(p, w_0)
        ray.maxt = DEEPEST / dr.min(m.mean_t)
        si = self.media.instance_scene.intersect(self.media.scene, ray, mi.RayFlags.Minimal)
        n = si.n * self.media.side(k, si.prim_index)
        facing = si.is_valid() & (dr.dot(n, w_0) > 0)
        far = dr.select(si.is_valid(), si.t, ray.maxt)

        # ---- where a plane boundary would refract its light towards p: along w_0 / eta + n (cos_t - cos / eta)
        _, cos_t, _, eta_ti = mi.fresnel(dr.select(facing, dr.dot(n, w_0), 1), self.media.row("eta", k))
        back = w_0 * eta_ti + n * (dr.abs(cos_t) - eta_ti * dr.dot(n, w_0))  # from p to where the light enters
        entry = back * (dr.dot(n, w_0) * far / dr.maximum(dr.abs(cos_t), 1e-3))
        shift = dr.select(facing, entry - w_0 * dr.dot(entry, w_0), 0)
        depth = dr.select(facing, dr.minimum(dr.norm(entry), far), far)

        # ---- the deeper, the less light: a probability of exp(-sigma_t depth / 2)
        promise = dr.maximum(dr.exp(-0.5 * dr.min(m.mean_t) * depth), LEAST_PROMISE)
        return EmitterSample(which, w_0, mi.Vector3f(shift), depth), promise

    def _enter(
        self, rng: mi.PCG32, L: mi.Spectrum, slopes: Score | tuple[()], event: Event, sample: EmitterSample
    ) -> tuple:
        """Sample a ray of light, refract it into the object and follow it."""
        # ---- a ray from the emitter through a point a of the plane: flux L |w.w_0| / (p(a) p(w))
        k, m = event.object, event.m
        at, density = _draw_across(event, sample, rng)
        which = sample.emitter
        w, distance, light = self.small.sample(which, at, mi.Point2f(rng.next_float32(), rng.next_float32()))
        flux = light * (dr.abs(dr.dot(w, sample.w_0)) / density)
        distant = self.small.distant(which)
        near = distance - before(at.p + w * distance, distance, self.small.rounding(which))
        away = dr.select(distant, opaque(4 * dr.norm(self.scene.bbox().extents())), near)
        way = mi.Ray3f(mi.Point3f(at.p + w * away), -w)
        si = self.media.instance_scene.intersect(self.scene, way, mi.RayFlags.All)
        steep = dr.abs(dr.dot(w, sample.w_0)) > STEEPEST
        enters = si.is_valid() & (dr.max(light) > 0) & steep & (self.media.index_of(si) == mi.Int32(k))

        # ---- refraction at the boundary: flux *= (1 - F) and by how much the ray is widened there
        si = self.media.face_outwards(si, dr.select(enters, mi.Int32(k), -1), -w)
        si.wi = dr.select(mi.Frame3f.cos_theta(si.wi) < 0, -si.wi, si.wi)  # below its horizon, see `geometry.points`
        F, cos_t, _, eta_ti = mi.fresnel(mi.Frame3f.cos_theta(si.wi), self.media.row("eta", k))
        d = si.to_world(mi.refract(si.wi, cos_t, eta_ti))
        enters &= (dr.dot(si.n, w) > 0) & (mi.Frame3f.cos_theta(si.wi) > 0) & (dr.dot(si.n, d) < 0)
        # shading normals bend the ray, geometric ones hold its width
        bend = dr.dot(d, si.n) * mi.Frame3f.cos_theta(si.wi) / (dr.dot(d, si.sh_frame.n) * dr.dot(w, si.n))
        weight = dr.select(enters, flux * ((1 - F) * bend) * self.media.tint(k, si, reflects=False), 0)
        enters &= dr.max(weight) > 0

        # ---- the walk from there, with the medium of the walk from the camera
        walk = start_walk(mi.Point3f(si.p), d, rng, event.medium)
        walk = replace(walk, off=self.media.clear(k, si.n, d), alive=enters, object=k, weight=weight,
                       channel=draw(len(m.sigma_t), rng))  # fmt: skip
        score = Score.zeros(dr.width(event.p)) if self.scored else ()
        state = (LightSubpath(walk, mi.Bool(enters), mi.Bool(enters), L, score, slopes), event)
        s, event = dr.while_loop(state, lambda s, event: s.walk.alive, self._follow, label="light")
        return s.walk.rng, s.L, s.slopes, event, sample

    def _follow(self, s: LightSubpath, event: Event) -> tuple[LightSubpath, Event]:
        """One flight of the light subpath, and a connection on its ray if that may have one."""
        # ---- an event q at the distance t on the ray, of density D / (dtheta (D² + (t - t_0)²)), and its connection
        media, walk, rng = self.media, s.walk, s.walk.rng
        m = media.coefficients(event.object, walk.o, event.medium)
        connectable = s.lit & s.fresh
        t, over = _on_ray(walk, event, rng.next_float32())
        t = dr.select(connectable, t, 0)
        flight = free_path(m, walk.channel, rng.next_float32())
        ray = walk.ray(dr.maximum(t, flight))
        hit = media.scene.ray_intersect_preliminary(ray, coherent=False)
        reach = walk.reach(hit.t)
        light, extra = self._connect(walk, event, t, dr.select(connectable & (t < reach), over, 0))
        L, slopes = s.L + light, s.slopes and s.slopes + (s.score + extra) * light

        # ---- free flight, to a scattering event after which the subpath must reflect, or to the boundary
        u, p = None, mi.Point3f(walk.o + walk.d * flight)
        if media.varies:
            m, u = media.coefficients(event.object, p, event.medium), rng.next_float32()
        ended = fly(m, walk.weight, walk.density, walk.channel, flight, reach, u)

        # ---- scattered by the phase function; no connection until it has been reflected
        u = mi.Point2f(rng.next_float32(), rng.next_float32())
        turned, weight, density = turn(m, ended.weight, ended.density, walk.channel, walk.d, u, media.same_g)
        scattered = replace(walk, alive=walk.alive & s.lit, o=p, d=turned, weight=weight,
                            density=density, off=media.behind(event.object, turned))  # fmt: skip

        # ---- or on after a null collision, or reflected at the boundary
        walk = replace(walk, weight=ended.weight, density=ended.density)
        if media.varies:
            on = walk.alive & (~ended.null | media.box.contains(p))
            off = dr.select(ended.null, media.behind(event.object, walk.d), walk.off)
            walk = replace(walk, alive=on, o=dr.select(ended.null, p, walk.o), off=off)
        state = (walk, ~ended.scatters & s.lit, ray, hit)
        walk, lit, *_ = dr.if_stmt(state, ~(ended.scatters | ended.null), self._reflect, lambda *state: state)
        scattered.rng = walk.rng

        # ---- n, d and d log p / dg of the subpath so far, for derivatives
        score = s.score and s.score + Score(
            dr.select(ended.scatters, mi.Float(1), 0), dr.minimum(flight, reach),
            dr.select(ended.scatters, phase_score(m.g, dr.dot(s.walk.d, turned)), 0))  # fmt: skip
        return LightSubpath(dr.select(ended.scatters, scattered, walk), lit, ~ended.null, L, score, slopes), event

    def _connect(self, walk: Walk, event: Event, t: mi.Float, over: mi.Float) -> tuple[mi.Spectrum, Score | tuple[()]]:
        """Light of a connection at the distance t on a ray of light, and its score after that of the subpath.
        `over` is one over the density of t."""
        # ---- weight sigma_s(q) p(cos_p) p(cos_q) / density of t; |p - q|² has cancelled
        media, q = self.media, mi.Point3f(walk.o + walk.d * t)
        e, between = media.row("rounding", event.object), event.p - q
        to_p = mi.Ray3f(q, dr.normalize(between))
        to_p.maxt = dr.norm(between)
        at_q = media.coefficients(event.object, q, event.medium)
        cosines = dr.dot(event.along, -to_p.d), dr.dot(to_p.d, walk.d)
        phases = eval_phase(event.m, cosines[0]) * eval_phase(event.m, cosines[1])
        value = dr.select(over > 0, walk.weight * at_q.sigma_s * phases * over, 0)
        bright = dr.max(value) > 0

        # ---- visibility between both events, clear of what rounding has put beyond the boundary
        clear = mi.Ray3f(mi.Point3f(q + to_p.d * e), to_p.d)
        clear.maxt = to_p.maxt - 2 * e
        bright &= ~blocked(media.scene, clear, bright)

        # ---- transmittance along the ray to q and from q to p
        to_q, medium = mi.Ray3f(walk.o, walk.d), event.medium
        T = media.transmittance(event.object, to_q, dr.select(bright, t, 0), walk.rng, medium)
        T *= media.transmittance(event.object, to_p, dr.select(bright, to_p.maxt, 0), walk.rng, medium)
        light = dr.select(bright, value * T, 0)
        if not self.scored:
            return light, ()
        turns = phase_score(event.m.g, cosines[0]) + phase_score(event.m.g, cosines[1])
        return light, Score(mi.Float(1), dr.select(bright, t + to_p.maxt, 0), dr.select(bright, turns, 0))

    def _reflect(self, walk: Walk, lit: mi.Bool, ray: mi.Ray3f, hit: mi.PreliminaryIntersection3f) -> tuple:
        """Reflection at the boundary from inside with the probability of its reflectance, after which a ray is lit."""
        # ---- the mirrored direction, and its reflectance F
        k, d = mi.Int32(walk.object), walk.d
        si = self.media.instance_scene.interaction(hit, ray, mi.RayFlags.All)
        si = self.media.seen(si, k, d)
        F, _, _, _ = mi.fresnel(mi.Frame3f.cos_theta(si.wi), self.media.row("eta", k))
        new, _ = sided(si, mi.reflect(si.wi))
        passes = (self.media.met(si, k) != k) | (dr.dot(si.n, d) < 0)  # as of `Walker`
        new = dr.select(passes, d, new)

        # ---- reflected with the probability F, else the subpath ends
        inside = (dr.dot(si.n, new) < 0) & (walk.rng.next_float32() < F)
        o, off = self.media.depart(si, new, mi.Bool(True))
        weight = walk.weight * dr.select(passes, 1, self.media.tint(k, si, reflects=True))
        walk = replace(walk, o=o, d=new, off=off, alive=walk.alive & (passes | inside), weight=weight)
        return walk, lit | ~passes, ray, hit


def _draw_across(event: Event, sample: EmitterSample, rng: mi.PCG32) -> tuple[mi.Interaction3f, mi.Float]:
    """A point of the plane across w_0 through the event, and its density per area."""
    # the distance r by c exp(-c r), of one of two rates and of one of the channels; density / (2 pi r) per area
    sigma_t = event.m.mean_t
    wide = sigma_t * dr.rsqrt(1 + sigma_t * sample.depth)
    rate = dr.select(rng.next_float32() < 0.5, RATES[0], RATES[1]) * pick(wide, draw(len(wide), rng))
    r = dr.maximum(-dr.log(1 - rng.next_float32()) / rate, 1e-20)
    density = sum(channel_mean(c * wide * dr.exp(-c * wide * r)) for c in RATES) / (len(RATES) * 2 * dr.pi * r)
    sin_phi, cos_phi = dr.sincos(2 * dr.pi * rng.next_float32())
    s, t = mi.coordinate_system(sample.w_0)
    return interaction_of(event.p + sample.shift + (s * cos_phi + t * sin_phi) * r, event.medium), density


def _on_ray(walk: Walk, event: Event, u: mi.Float) -> tuple[mi.Float, mi.Float]:
    """Distance of an event q on a ray of light, and 1 / (its density |p - q|²)."""
    # equiangular: theta uniform between the start of the ray and its end, t = t_0 + D tan(theta)
    v = event.p - walk.o
    t_0 = dr.dot(v, walk.d)
    D = dr.maximum(dr.norm(v - walk.d * t_0), 1e-9 * dr.norm(v) + 1e-30)
    start = dr.atan2(-t_0, D)
    width = 0.5 * dr.pi - start
    t = dr.maximum(t_0 + D * dr.tan(start + u * width), 0)
    return t, dr.select(dr.isfinite(t), width / D, 0)


def find_connections(
    scene: mi.Scene, media: WalkMedia, small: SmallEmitters | None, share: float, scored: bool = False
) -> SubpathConnections | None:
    """Connections with the small emitters of a scene; None without any, or without an object of smooth boundary.
    Where nothing refracts, `straight_light` needs none."""
    if small is None or share == 0 or not media.any_refracts:
        return None
    if media.inner is not None and not np.array(media.inner.tables["alone"]).any():
        return None
    return SubpathConnections(scene, media, small, share, scored)


# ---- Directions from events to emitters -----------------------------------------------------------------------------
#
# Where no connection finds a path, the walk from the camera has to hit the emitter through the refracting boundary.
# The direction from the event v that does so is guessed: w_0 is refracted at the normal of the place where the last
# guess meets the boundary, three times. Directions are then sampled about the guess, from a narrow lobe as wide as the
# emitter and from wider ones for guesses that are wrong. They are weighted against those of the phase function by the
# balance heuristic, so that no guess has to be right.
#
# A rough boundary refracts a direction d to a lobe of directions w. Light of an emitter j is estimated along d by
# next-event estimation and by sampling the BSDF at the boundary, both together without bias, and so by both with the
# weight p(d) / (p(d) + q_j(d)), p the phase function and q_j the lobes about its guess; the rest of 1 is the weight of
# directions d by q_j, with w by the emitter or by the BSDF (one-sample model of the balance heuristic).

GUESSES = 3
SHARES = (0.5, 0.3, 0.2)  # of the lobes
WIDER = (131.0, 8.0)  # concentrations of the others: 5 and 20 degrees


@dataclass
class Departure:
    """A walk's last event and its straight way out of the object from there."""

    p: mi.Point3f
    along: mi.Vector3f  # direction of arrival at the event
    ahead: mi.Vector3f  # direction from it
    object: mi.Int32


@dataclass(frozen=True, eq=False)
class EmitterDirections:
    """Directions from events to small emitters.
    `scene`: the Mitsuba scene. `media`: its translucent objects. `small`: its small emitters. `alpha`: mean roughness
    of the boundary by object, 0 of a smooth one. `scored`: whether light comes with its slopes."""

    scene: mi.Scene
    media: WalkMedia
    small: SmallEmitters
    alpha: mi.Float
    scored: bool = False

    def leads(self, k: mi.Int32) -> mi.Bool:
        """Whether directions lead through the boundary of object k: refracting, and nothing inside."""
        return self.media.connects(k) | self.media.scatters_at(k)

    def _guess(
        self, v: mi.Point3f, k: mi.Int32, which: mi.Int32, m: Coefficients, active: mi.Bool
    ) -> tuple[mi.Vector3f, mi.Float, mi.Bool]:
        """The direction from v by which an emitter sees it through the boundary, its concentration, and if any."""
        # ---- iterate: w to the emitter from where the last guess meets the boundary, refracted there
        toward, small = self.small.direction(which, v)
        eta = self.media.row("eta", k)
        valid, d, w = active & small, toward, toward
        for _ in range(GUESSES):
            ray = mi.Ray3f(v, d)
            ray.maxt = DEEPEST / dr.min(m.mean_t)
            si = self.media.instance_scene.intersect(self.media.scene, ray, mi.RayFlags.Minimal, active=valid)
            valid &= si.is_valid()
            n = si.n * self.media.side(k, si.prim_index)
            w, _ = self.small.direction(which, si.p)
            cosine = dr.dot(w, n)
            _, cos_t, _, eta_ti = mi.fresnel(dr.clip(cosine, 0, 1), eta)
            refracted = w * eta_ti + n * (dr.abs(cos_t) - eta_ti * cosine)
            d = dr.normalize(dr.select(cosine > 0, refracted, d))

        # ---- a lobe as wide as the emitter is seen inside: concentration eta² / (angle² + ((eta - 1) alpha)²)
        width2 = self.small.angle2(which, v) + self._lobe2(k)
        return d, dr.minimum(dr.square(eta) / dr.maximum(width2, 1e-6), 1e6), valid

    def _lobe2(self, k: mi.Int32) -> mi.Float:
        """Square of the angle over which the boundary of object k spreads a direction outside: ((eta - 1) alpha)²."""
        alpha = dr.gather(mi.Float, self.alpha, self.media.place_of(k))
        return dr.square((self.media.row("eta", k) - 1) * alpha)

    def light(
        self, event: Event, rng: mi.PCG32, left: Callable[[mi.Vector3f], mi.Spectrum] | None = None
    ) -> tuple[mi.Spectrum, Score | tuple[()]]:
        """An estimate of the light of small emitters that leaves from an event, per weight of the walk; its slopes.
        `left`: the share of light along a direction that counts; all by default."""
        # ---- one of n emitters, and a direction d about the guessed one
        v, k, m = event.p, event.object, event.m
        n = len(self.small)
        which = mi.Int32(draw(n, rng))
        guess, concentration, valid = self._guess(v, k, which, m, True)
        d, pdf = _draw_lobe(guess, concentration, rng)

        # ---- where it meets the boundary
        ray = ray_of(v, d, event.medium)
        ray.maxt = 2 * DEEPEST / dr.min(m.mean_t)
        si = self.media.instance_scene.intersect(self.media.scene, ray, mi.RayFlags.All, active=valid)
        valid &= si.is_valid() & (self.media.index_of(si) == k)
        si = self.media.seen(si, k, d)
        valid &= dr.dot(d, si.n) > 0

        # ---- p(cos) T L_i over the mixture density of lobes and phase function (balance heuristic)
        phase = eval_phase(m, dr.dot(event.along, d))
        T = self.media.transmittance(k, ray, dr.select(valid, si.t, 0), rng, event.medium)
        value = dr.select(valid, phase * T / (pdf / n + channel_mean(phase)), 0)
        arriving = self._through_smooth(which, k, si, d, valid & self.media.connects(k))
        if self.media.any_rough:
            choice, u = rng.next_float32(), mi.Point2f(rng.next_float32(), rng.next_float32())
            state = (arriving, which, k, si, choice, u)
            rough = valid & self.media.scatters_at(k)
            arriving, *_ = dr.if_stmt(state, rough, self._through_rough, lambda *state: state, label="rough")
        light = value * arriving if left is None else value * arriving * left(d)
        if not self.scored:
            return light, ()
        cosine = dr.dot(event.along, d)
        return light, Score(mi.Float(0), dr.select(valid, si.t, 0), phase_score(m.g, cosine)) * light

    def _through_smooth(
        self, which: mi.Int32, k: mi.Int32, si: mi.SurfaceInteraction3f, d: mi.Vector3f, active: mi.Bool
    ) -> mi.Spectrum:
        """L_i along d inside of an emitter that is seen through the smooth boundary of object k at `si`."""
        # (1 - F) L / eta² where d leaves the object, refracted to w: radiance shrinks by eta² on its way out, as the
        # weight of the walk has when it came in
        F, cos_t, eta_it, eta_ti = mi.fresnel(mi.Frame3f.cos_theta(si.wi), self.media.row("eta", k))
        w = opposed(si.to_world(mi.refract(si.wi, cos_t, eta_ti)), si.n)
        active = active & (dr.dot(w, si.n) > 0) & (F < 1)
        way = ray_from(si, w, self.media.instance_scene.rounding(si))
        outside = self.media.instance_scene.intersect(self.scene, way, mi.RayFlags.All, active=active)
        L = self.small.along(which, way, outside, active) * self.media.tint(k, si, reflects=False)
        return dr.select(active, (1 - F) * dr.square(eta_ti) * L, 0)

    def _through_rough(
        self, arriving: mi.Spectrum, which: mi.Int32, k: mi.Int32, si: mi.SurfaceInteraction3f, choice: mi.Float,
        u: mi.Point2f,
    ) -> tuple:  # fmt: skip
        """An estimate of L_i inside of an emitter that is seen through the rough boundary of object k at `si`."""
        # ---- w by the BSDF with the probability q, the larger the emitter beside the lobe of w, else by the emitter
        boundary, angle2 = self.media.boundary(k), self.small.angle2(which, si.p)
        delta = mi.UInt32(which) < self.small.n_delta
        q = dr.select(delta, 0, angle2 / (angle2 + self._lobe2(k)))
        by_bsdf = choice < q
        w, distance, E = self.small.sample(which, si, u)
        bs, _ = boundary.sample(mi.BSDFContext(), si, choice / dr.maximum(q, 1e-6), u, by_bsdf)
        refracted = (bs.pdf > 0) & (bs.wo.z * mi.Frame3f.cos_theta(si.wi) < 0)
        w = dr.select(by_bsdf, sided(si, bs.wo)[0], w)
        active = (~by_bsdf | refracted) & (dr.dot(w, si.n) > 0)

        # ---- f(w) |cos| L_e / (q p_f + (1 - q) p_j), of a delta light f E if nothing hides it
        way = ray_from(si, w, self.media.instance_scene.rounding(si))
        met = self.media.instance_scene.intersect(self.scene, way, mi.RayFlags.All, active=active)
        value, p_f = towards(si, boundary, w, active, True)
        p_j = self.small.pdf(which, si, w, met, active)
        L = self.small.along(which, way, met, active & ~delta) / dr.maximum(q * p_f + (1 - q) * p_j, 1e-20)
        hidden = met.is_valid() & (met.t < distance - before(si.p + w * distance, distance))
        return value * dr.select(delta, dr.select(hidden, 0, E), L), which, k, si, choice, u

    def share(self, which: mi.Int32, way: Departure, active: mi.Bool, medium: WalkMedium | tuple[()] = ()) -> mi.Float:
        """Weight of having hit emitter `which`, if >= 0, by the phase function (balance heuristic against `light`)."""
        # p_phase / (p_phase + p_lobes)
        k, m = way.object, self.media.coefficients(way.object, way.p, medium)
        guess, concentration, valid = self._guess(way.p, k, type(k)(dr.maximum(which, 0)), m, active & (which >= 0))
        lobes = _lobes(dr.dot(guess, way.ahead), concentration) / len(self.small)
        phase = channel_mean(eval_phase(m, dr.dot(way.along, way.ahead)))
        return phase / (phase + dr.select(active & valid, lobes, 0))


def find_directions(
    scene: mi.Scene, media: WalkMedia, small: SmallEmitters | None, share: float, scored: bool = False
) -> EmitterDirections | None:
    """Directions to the small emitters of a scene; None without any, where no boundary refracts, or where boundaries
    are rough alone and every emitter looks large from all objects.
    `share`, `scored`: as of `SubpathConnections`; without connections there are no directions."""
    if small is None or share == 0 or not (media.any_refracts or media.any_rough):
        return None
    if not (media.any_refracts or media.instance_table.repeated):
        centres = np.array([np.ravel(obj.shape.bbox().center()) for obj in media.objects])
        if not small.some_small(mi.Point3f(*map(floats, centres.T))):
            return None
    alpha = mi.Float([_roughness(media.boundaries[kind]) for kind in media.instance_table.kind])
    dr.make_opaque(alpha)
    return EmitterDirections(scene, media, small, alpha, scored)


def _roughness(boundary: mi.BSDF) -> float:
    """The mean of alpha over directions and textures; 0 of a smooth boundary."""
    parameters = mi.traverse(boundary)
    keys = [key for key in parameters.keys() if key.startswith("alpha") and not key.endswith("to_uv")]
    values = [np.mean(np.array(parameters[key])) for key in keys]
    return float(np.mean(values)) if values else 0.0


def _lobes(cosine: mi.Float, concentration: mi.Float) -> mi.Float:
    """Density of the sum of lobes c e^(-c (1 - cos)) / (2 pi), 1/sr; what falls beyond cos = -1 is left out."""
    x = dr.maximum(1 - cosine, 0)
    parts = zip(SHARES, (concentration, *WIDER))
    return sum(a * c * dr.exp(-c * x) for a, c in parts) / (2 * dr.pi)


def _draw_lobe(guess: mi.Vector3f, concentration: mi.Float, rng: mi.PCG32) -> tuple[mi.Vector3f, mi.Float]:
    """A direction about the guess, and its density."""
    # 1 - cos by c exp(-c (1 - cos)) of one of the lobes, phi uniform
    u = rng.next_float32()
    c = dr.select(u < SHARES[0], concentration, dr.select(u < SHARES[0] + SHARES[1], WIDER[0], WIDER[1]))
    x = dr.minimum(-dr.log(1 - rng.next_float32()) / c, 2)
    sine = dr.safe_sqrt(x * (2 - x))
    sin_phi, cos_phi = dr.sincos(2 * dr.pi * rng.next_float32())
    d = mi.Frame3f(guess).to_world(mi.Vector3f(sine * cos_phi, sine * sin_phi, 1 - x))
    return d, _lobes(1 - x, concentration)


# ---- Delta lights inside objects ------------------------------------------------------------------------------------
#
# The irradiance I / d² of a light is unbounded at events close to it. Within a radius r below a mean free path it is
# even, which keeps all light and blurs it by r:
#
#     E(d) = I / d² for d > r,    3 I / r² (1 + sigma_t r / 4) for d < r,
#
#     ∫_0^r E(d) e^(-sigma_t d) d² dd = I ∫_0^r e^(-sigma_t d) dd    to the order (sigma_t r)³.
#
# After reflection or refraction at a smooth boundary no event sees a light; it is spread over a cone
# (`objects.small_emitters`).

NEAREST = 0.2  # mean free paths, r
CONE = 0.15  # radius of the cone, radians; light that a medium scatters beside it hides more


@dataclass(frozen=True, eq=False)
class InnerLights:
    """The delta lights inside objects.
    `media`: the objects. `emitters`: the lights. `tables`: of each, what Dr.Jit's registry calls it, `pointer`, and the
    object `around` it. `blur`: scale of the cone; 0 leaves its light out."""

    media: WalkMedia
    emitters: list[mi.Emitter]
    tables: dict[str, mi.UInt32 | mi.Int32]
    blur: float

    @classmethod
    def of(cls, media: WalkMedia, blur: float = 1.0) -> InnerLights | None:
        """Those of the objects of a scene; None if there are none."""
        if media.inner is None or not media.inner.lights:
            return None
        emitters, around = zip(*media.inner.lights)
        tables = {"pointer": mi.UInt32(pointer_numbers(map(mi.EmitterPtr, emitters))), "around": mi.Int32(around)}
        dr.make_opaque(tables)
        return cls(media, list(emitters), tables, blur)

    def _drawn(self, k: mi.Int32, rng: mi.PCG32, active: mi.Bool) -> tuple[mi.Emitter | mi.EmitterPtr, mi.Bool]:
        """One of the lights, and whether it is in object k."""
        which = draw(len(self.emitters), rng)
        here = active & (dr.gather(mi.Int32, self.tables["around"], which) == k)
        if len(self.emitters) == 1:
            return self.emitters[0], here
        return dr.reinterpret_array(mi.EmitterPtr, dr.gather(mi.UInt32, self.tables["pointer"], which)), here

    def light(
        self, k: mi.Int32, at: mi.Interaction3f, rng: mi.PCG32, active: mi.Bool, medium: WalkMedium | tuple[()] = ()
    ) -> tuple:
        """The direction to a light from an interaction in object k, and its irradiance across, over its probability."""
        # one of n lights, n E
        emitter, here = self._drawn(k, rng, active)
        ds, E = emitter.sample_direction(at, mi.Point2f(0.5), here)
        lit = here & (ds.pdf > 0) & (dr.max(E) > 0)
        ray = ray_from(at, ds.d, place_bound(at.p))

        # E(d) d² / I: 3 d² / r² (1 + sigma_t r / 4) within r, 1 beyond; times the transmittance
        sigma_t = medium.sigma_t if medium else self.media.spectrum("sigma_t", k)
        r = NEAREST / dr.max(sigma_t)
        near = dr.select(ds.dist < r, 3 * dr.square(ds.dist / r) * (1 + 0.25 * r * sigma_t), 1)
        return ds.d, dr.select(
            lit, self._passed(k, ray, ds.dist, rng, lit, medium) * E * (near * len(self.emitters)), 0
        )

    def spread(
        self, k: mi.Int32, ray: mi.Ray3f, rng: mi.PCG32, active: mi.Bool, medium: WalkMedium | tuple[()] = ()
    ) -> mi.Spectrum:
        """Radiance of a light along a ray in object k, spread over a wide cone, over its probability."""
        # n E / Ω within the cone, times the transmittance to the light
        emitter, here = self._drawn(k, rng, active)
        L = spread(self.media.inner.scene, emitter, ray, opaque(CONE * self.blur), here)
        at = dr.zeros(mi.Interaction3f)
        at.p = ray.o
        ds, _ = emitter.sample_direction(at, mi.Point2f(0.5), here)
        lit = here & (dr.max(L) > 0)
        T = self.media.transmittance(k, ray, dr.select(lit, ds.dist, 0), rng, medium)
        return dr.select(lit, T * L * len(self.emitters), 0)

    def _passed(
        self,
        k: mi.Int32,
        ray: mi.Ray3f,
        distance: mi.Float,
        rng: mi.PCG32,
        active: mi.Bool,
        medium: WalkMedium | tuple[()],
    ) -> mi.Spectrum:
        """The transmittance of what is between: 0 behind any surface."""
        shadow = mi.Ray3f(ray)
        shadow.maxt = distance - before(ray.o + ray.d * distance, distance)
        clear = active & ~blocked(self.media.inner.scene, shadow, active)
        return dr.select(clear, self.media.transmittance(k, ray, dr.select(clear, distance, 0), rng, medium), 0)
