"""Paths through a scene with translucent objects, as one symbolic loop whose lanes begin a new path when one ends."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi

from halfspace_sss.rendering.surface.horizon import sided
from halfspace_sss.rendering.walk.first_exits import FirstExits, FirstExitVisitor, Watched
from halfspace_sss.rendering.walk.light import Light, LightVisitor, start_light
from halfspace_sss.rendering.walk.steps import OUTSIDE, Walk, Walker, sample_bsdf, start_walk
from halfspace_sss.tracing.walk import generator, pass_seed

__all__ = ["PathTracer"]


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
            return replace(p, walk=walk, light=record.light if exits else record)

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
