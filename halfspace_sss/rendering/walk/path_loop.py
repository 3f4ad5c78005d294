"""Paths through a scene with translucent objects, as one symbolic loop whose lanes begin a new path when one ends."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi

from halfspace_sss.rendering.light.small_emitters import NARROW, WIDE, SmallEmitters
from halfspace_sss.rendering.surface.horizon import sided
from halfspace_sss.rendering.walk.emitter_connections import Departure, Guide, Joins, Lamps
from halfspace_sss.rendering.walk.exits import FirstExits, FirstExitVisitor, Watched
from halfspace_sss.rendering.walk.media import WalkMedia
from halfspace_sss.rendering.walk.random_walk import (
    OUTSIDE,
    Crossing,
    Event,
    Walk,
    Walker,
    draw,
    eval_phase,
    sample_bsdf,
    start_walk,
)
from halfspace_sss.tracing.walk import generator, pass_seed

__all__ = ["Light", "LightVisitor", "PathTracer", "power_heuristic", "start_light"]


# ---- Light gathered along a path -----------------------------------------------------------------------------------


@dataclass
class Light:
    """What a path has gathered, and what weighs the next emitter that it meets."""

    L: mi.Spectrum  # radiance
    last: mi.Point3f  # vertex that the ray comes from
    pdf: mi.Float  # density of the ray's direction there, 1/sr
    delta: mi.Bool  # whether that direction was the only one
    straight: mi.Bool  # nothing has reflected since the last event
    joined: mi.Bool  # there was a straight edge: joins find what small emitters send along this path
    pivot: mi.Point3f  # the event at the end of that edge
    guided: mi.Bool  # the guide looked for small emitters from the last event, and nothing has reflected since
    departure: Departure  # from the last event
    scattered: mi.Bool  # whether a vertex has scattered into a solid angle: delta lights then are no longer hidden


@dataclass(frozen=True, eq=False)
class LightVisitor:
    """Light gathered at the events and boundaries of walks.

    Args:
        scene: the Mitsuba scene.
        media: its translucent objects.
        small: its small emitters, if there are any.
        joins: how light of small emitters enters objects, if it is looked for.
        guide: how it leaves them where joins cannot find it.
        lamps: delta lights inside objects, if there are any.
    """

    scene: Any
    media: WalkMedia
    small: SmallEmitters | None
    joins: Joins | None
    guide: Guide | None
    lamps: Lamps | None = None

    def event(self, walk: Walk, record: Light, event: Event) -> tuple[Walk, Light]:
        record = replace(record, scattered=mi.Bool(True))
        if self.lamps is not None:
            at = dr.zeros(mi.Interaction3f)
            at.p = event.p
            d, E = self.lamps.light(walk.object, at, walk.rng, True)
            record = replace(record, L=record.L + walk.weight * eval_phase(event.m, dr.dot(event.along, d)) * E)
        if self.joins is None:
            return walk, record
        smooth = self.media.connects(walk.object)
        edge = record.straight & smooth & (walk.order > 0)  # this event ends one
        joined = record.joined | edge
        record = replace(record, joined=joined, pivot=dr.select(edge, event.p, record.pivot))
        joins = smooth & (walk.order + 2 <= self.media.row("most", walk.object))
        walk, record, _ = dr.if_stmt((walk, record, event), joins, self._join, _same_state, label="joins")
        guided = smooth & ~joined & self.media.counts(walk.object, walk.order + 1)
        record = replace(record, straight=mi.Bool(True), guided=guided)
        walk, record, _ = dr.if_stmt((walk, record, event), guided, self._guide, _same_state, label="guide")
        departure = Departure(event.p, event.along, record.departure.ahead, walk.object)
        return walk, replace(record, departure=departure)

    def _join(self, walk: Walk, record: Light, event: Event) -> tuple[Walk, Light, Event]:
        light, rng = self.joins.light(event, walk.rng)
        return replace(walk, rng=rng), replace(record, L=record.L + walk.weight * light), event

    def _guide(self, walk: Walk, record: Light, event: Event) -> tuple[Walk, Light, Event]:
        light = self.guide.light(event, walk.rng)
        return walk, replace(record, L=record.L + walk.weight * light), event

    def boundary(self, walk: Walk, record: Light, si: Any, active: Any) -> tuple[Walk, Light]:
        if not self.media.any_rough:
            return walk, record
        light = self.sampled_emitter(walk, si, self.media.boundary(walk.object), active)
        return walk, replace(record, L=record.L + light)

    def surface(self, walk: Walk, record: Light, si: Any, bsdf: Any, k: Any) -> tuple[Walk, Light]:
        """Light that the surface emits, of which nothing was sampled, and of the lamps that light it."""
        emitter = si.emitter(self.scene)
        shines = si.is_valid() & (k != walk.object) & (emitter != None)  # noqa: E711
        L = record.L + dr.select(shines, walk.weight * emitter.eval(si, shines), 0)
        if self.lamps is not None:
            lit = (k < 0) & mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth)
            d, E = self.lamps.light(walk.object, si, walk.rng, lit)
            L = L + dr.select(lit, walk.weight * bsdf.eval(mi.BSDFContext(), si, si.to_local(d), lit) * E, 0)
        return walk, replace(record, L=L)

    def crossing(self, walk: Walk, record: Light, crossing: Crossing) -> tuple[Walk, Light]:
        record = replace(record, last=crossing.si.p, pdf=crossing.pdf, delta=crossing.delta)
        if self.media.inner is not None:
            sampled = (self.media.index_of(crossing.si.shape) < 0) & ~crossing.delta
            record = replace(record, delta=crossing.delta | ~crossing.leaves, scattered=record.scattered | sampled,
                             L=record.L + self.spread_lamps(walk, record.scattered & ~sampled))  # fmt: skip
        if self.joins is None:
            return walk, record
        straight = record.straight & crossing.leaves
        departure = replace(record.departure, ahead=crossing.along)
        return walk, replace(record, straight=straight, guided=record.guided & straight, departure=departure)

    def met_emitter(self, walk: Walk, record: Light, si: Any, active: Any) -> Any:
        """Light of an emitter that the ray meets, weighted against sampling it from the last vertex."""
        emitter = si.emitter(self.scene)
        active = active & (emitter != None)  # noqa: E711
        last = dr.zeros(mi.Interaction3f)
        last.p = record.last
        ds = mi.DirectionSample3f(self.scene, si, last)
        sampled = active & ~record.delta
        pdf = dr.select(sampled, self.scene.pdf_emitter_direction(last, ds, sampled), 0)
        share = dr.select(record.delta, 1, power_heuristic(record.pdf, pdf))
        if self.joins is not None and self.small.some_met:
            which = self.small.index_of(emitter, walk.d)
            active &= ~(record.joined & self.joins.covers(which, si.p, walk.d, record.pivot))
            guided = active & record.guided
            state = (which, record.departure, share, guided)
            _, _, share, _ = dr.if_stmt(state, guided, self._against_guide, lambda *state: state)
        return dr.select(active, walk.weight * emitter.eval(si, active) * share, 0)

    def _against_guide(self, which: Any, departure: Departure, share: Any, guided: Any) -> tuple:
        return which, departure, self.guide.share(which, departure, guided), guided

    def spread_lights(self, walk: Walk, record: Light, active: Any) -> Any:
        """Light of a delta light whose cone holds the ray, where neither emitter sampling nor joins find it."""
        if self.small is None or self.small.n_delta == 0:
            return mi.Spectrum(0)
        n = self.small.n_delta
        which = mi.Int32(draw(n, walk.rng)) if n > 1 else dr.zeros(mi.Int32, dr.width(walk.o))
        active = active & record.scattered & record.delta
        guided = mi.Bool(False)
        if self.joins is not None:
            w_0, _ = self.small.direction(which, walk.o)
            lamp = walk.o + w_0 * dr.norm(self.scene.bbox().extents())
            active &= ~(record.joined & self.joins.covers(which, lamp, w_0, record.pivot))
            guided = active & record.guided
        radius = dr.select(guided, NARROW, WIDE)
        ray = mi.Ray3f(walk.o, walk.d)
        L = self.small.spread(which, ray, radius, active)
        if self.joins is not None:
            guided &= dr.max(L) > 0
            state = (which, record.departure, mi.Float(1), guided)
            _, _, share, _ = dr.if_stmt(state, guided, self._against_guide, lambda *state: state)
            L = L * share
        return dr.select(active, walk.weight * L * n, 0)

    def spread_lamps(self, walk: Walk, active: Any) -> Any:
        """Light of a lamp inside an object whose cone holds the ray, from a vertex that it was not sampled at."""
        if self.lamps is None:
            return mi.Spectrum(0)
        ray = mi.Ray3f(walk.o + walk.d * walk.skip, walk.d)
        active = active & walk.alive & (walk.object >= 0)
        return dr.select(active, walk.weight * self.lamps.spread(walk.object, ray, walk.rng, active), 0)

    def sampled_emitter(self, walk: Walk, si: Any, bsdf: Any, active: Any, outwards: Any = True) -> Any:
        """Light of a sampled emitter by the surface at `si`; by a boundary only from its outer side."""
        rng = walk.rng
        u = mi.Point2f(rng.next_float32(), rng.next_float32())
        active = active & mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth)
        ds, light = self.scene.sample_emitter_direction(si, u, True, active)
        active &= (ds.pdf > 0) & (~mi.Bool(outwards) | (dr.dot(ds.d, si.n) > 0))
        wo = si.to_local(ds.d)
        below = outwards & (wo.z < 0)  # comes from inside by the opposite direction, and is not mirrored
        active &= ~below | (mi.Frame3f.cos_theta(si.wi) < 0)
        value, pdf = bsdf.eval_pdf(mi.BSDFContext(), si, dr.select(below, -wo, wo), active)
        share = dr.select(ds.delta, 1, power_heuristic(ds.pdf, pdf))
        return dr.select(active, walk.weight * value * light * share, 0)


def _same_state(*state: Any) -> tuple:
    return state


def start_light(lanes: int) -> Light:
    """Of a path that begins at the camera."""

    def full(kind: type, value: Any) -> Any:
        return dr.full(kind, value, lanes)

    point, along = full(mi.Point3f, 0), full(mi.Vector3f, 0)
    return Light(
        L=full(mi.Spectrum, 0), last=point, pdf=full(mi.Float, 1), delta=full(mi.Bool, True),
        straight=full(mi.Bool, False), joined=full(mi.Bool, False), pivot=mi.Point3f(point),
        guided=full(mi.Bool, False),
        departure=Departure(mi.Point3f(point), along, mi.Vector3f(along), full(mi.Int32, 0)),
        scattered=full(mi.Bool, False),
    )  # fmt: skip


def power_heuristic(a: Any, b: Any) -> Any:
    """Weight of a sample of density a against another of density b: a² / (a² + b²)."""
    share = dr.square(a) / (dr.square(a) + dr.square(b))
    return dr.select(dr.isfinite(share), share, 0)


@dataclass
class Path:
    """State of a path from the camera."""

    index: mi.UInt32  # which ray it began with
    walk: Walk  # the ray it is on, outside or inside an object
    light: Light  # what it has gathered
    seen: mi.Bool  # whether its first ray hit anything
    depth: mi.UInt32  # vertices on surfaces seen from outside


@dataclass(frozen=True, eq=False)
class PathTracer:
    """What every path needs.

    Args:
        visitor: how light is gathered; it knows the scene and its objects.
        max_depth: most vertices on surfaces seen from outside; what happens inside an object does not count.
        rr_depth: vertices outside after which roulette may end a path.
        hide_emitters: whether the camera sees no emitters.
    """

    visitor: LightVisitor
    max_depth: int
    rr_depth: int
    hide_emitters: bool

    def trace(self, rays: Any, lanes: int, seed: tuple[int, ...], exits: FirstExits | None = None) -> tuple[Any, Any]:
        """Radiance along each ray, and whether it hits anything; `exits`, if given, stores the first exits."""
        n = dr.width(rays)
        dr.eval(rays)
        lanes = min(lanes, n)
        L, seen = dr.zeros(mi.Spectrum, n), dr.zeros(mi.Bool, n)
        dr.eval(L, seen)
        walker = Walker(self.visitor.media, FirstExitVisitor(self.visitor, exits) if exits else self.visitor)
        total, step = (dr.opaque(mi.UInt32, v) for v in (n, lanes))  # kernels then serve images of any size

        def inside(p: Path) -> Path:
            record = Watched(p.light, p.index, p.depth == 1) if exits else p.light
            walk, record = walker.step(p.walk, record)
            return replace(p, walk=walk, light=record.record if exits else record)

        def renew(p: Path) -> Path:
            dr.scatter(L, p.light.L, p.index)
            dr.scatter(seen, p.seen, p.index)
            return _begin(rays, total, p.index + step, p.walk.rng)

        def body(p: Path) -> tuple[Path]:
            p = dr.if_stmt((p,), p.walk.object >= 0, inside, _same, label="inside")
            outside = p.walk.alive & (p.walk.object < 0)
            p = dr.if_stmt((p,), outside, self._outside, _same, label="outside")
            return (dr.if_stmt((p,), ~p.walk.alive, renew, _same),)

        start = _begin(rays, total, dr.arange(mi.UInt32, lanes), generator(mi, lanes, pass_seed(*seed)))
        dr.while_loop((start,), lambda p: p.index < total, body, label="paths")
        dr.eval(L, seen)
        return L, seen

    def _outside(self, p: Path) -> Path:
        """A ray outside all objects, and the surface that it meets."""
        ray = mi.Ray3f(p.walk.o, p.walk.d)
        si = self.visitor.scene.ray_intersect(ray, mi.RayFlags.All, coherent=False)
        first = p.depth == 0
        shown = ~first if self.hide_emitters else mi.Bool(True)
        L = p.light.L + self.visitor.met_emitter(p.walk, p.light, si, shown)
        L = L + self.visitor.spread_lights(p.walk, p.light, p.walk.alive)
        light = replace(p.light, L=L, joined=mi.Bool(False), guided=mi.Bool(False))
        depth = p.depth + 1
        alive = si.is_valid() & (depth < mi.UInt32(self.max_depth))
        walk = replace(p.walk, alive=alive)
        p = replace(p, walk=walk, light=light, seen=p.seen | (first & si.is_valid()), depth=depth)
        return dr.if_stmt((p, si), alive, self._bounce, lambda p, si: p, label="bounce")

    def _bounce(self, p: Path, si: Any) -> Path:
        walk, light, media = p.walk, p.light, self.visitor.media
        rng, k = walk.rng, media.index_of(si.shape)
        translucent, near = k >= 0, dr.maximum(k, 0)
        si = media.seen(si, k, walk.d)
        bsdf = si.bsdf()
        if media.objects:
            boundary = media.boundary(near)
            bsdf = dr.select(translucent, boundary if isinstance(boundary, mi.BSDFPtr) else mi.BSDFPtr(boundary), bsdf)
        mute = translucent & ~media.row("reflects", near) if media.objects else mi.Bool(False)
        lit = ~mute
        if media.inner is not None:
            around = media.inner.around(si.shape)
            encloses = ~translucent & (around >= 0) & media.inner.displaces(si.shape) & (dr.dot(walk.d, si.n) > 0)
            lit &= ~encloses  # emitters on its other side are behind a medium
        L = light.L + self.visitor.sampled_emitter(walk, si, bsdf, lit, translucent)
        bs, value = sample_bsdf(bsdf, si, rng)
        d, turned = sided(si, bs.wo)
        d, turned = dr.select(translucent, d, si.to_world(bs.wo)), turned & translucent
        enters = translucent & (dr.dot(d, si.n) < 0)
        weight, scale = walk.weight * value, walk.scale * dr.square(bs.eta)
        size = dr.max(weight) * scale
        survive = dr.select(p.depth >= self.rr_depth, dr.minimum(size, 0.95), 1)
        weight = weight / dr.maximum(survive, 1e-30)
        alive = (bs.pdf > 0) & (size > 0) & (rng.next_float32() < survive) & ~(mute & ~enters)
        u = rng.next_float32()
        channel = walk.channel
        if len(weight) > 1:  # drawn once in a path, whose densities are counted from there
            channel = dr.select(p.depth == 1, _channel(u, len(weight)), channel)
        if media.inner is not None:  # from glass inside an object
            returns = encloses & (dr.dot(d, si.n) > 0)
            k, enters = dr.select(returns, around, k), enters | returns
        o, skip = media.depart(near, si, d, enters) if media.objects else (si.spawn_ray(d).o, walk.skip)
        walk = replace(walk, o=o, d=d, skip=skip, alive=alive, order=dr.select(enters, 0, walk.order),
                       object=dr.select(alive & enters, k, OUTSIDE), weight=weight, scale=scale,
                       channel=channel)  # fmt: skip
        delta = mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta) | turned
        scattered = light.scattered | ~delta
        light = replace(light, L=L, last=si.p, pdf=bs.pdf, delta=delta, scattered=scattered)
        if media.inner is not None:
            light = replace(
                light, delta=delta | enters | encloses, L=L + self.visitor.spread_lamps(walk, scattered & enters)
            )
        return replace(p, walk=walk, light=light)


def _channel(u: Any, n: int) -> Any:
    return dr.minimum(mi.UInt32(u * n), n - 1)


def _same(p: Path) -> Path:
    return p


def _begin(rays: Any, total: Any, index: Any, rng: Any) -> Path:
    lanes, known = dr.width(index), index < total
    o, d = dr.gather(mi.Point3f, rays.o, index, known), dr.gather(mi.Vector3f, rays.d, index, known)
    no, first = dr.full(mi.Bool, False, lanes), dr.full(mi.UInt32, 0, lanes)
    return Path(index, start_walk(o, d, rng), start_light(lanes), no, first)
