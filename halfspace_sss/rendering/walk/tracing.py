"""Paths through a scene with translucent objects, as one symbolic loop whose lanes begin a new path when one ends."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from halfspace_sss.physics.phase import eval_hg
from halfspace_sss.rendering.walk.connect import Joins
from halfspace_sss.rendering.walk.guide import Guide
from halfspace_sss.rendering.walk.inside import fly, free_path, roulette, turn
from halfspace_sss.rendering.walk.media import WalkMedia
from halfspace_sss.tracing.walk import _generator, pass_seed

__all__ = ["PathTracer", "balance"]

OUTSIDE = -1


@dataclass(frozen=True, eq=False)
class PathTracer:
    """What every path needs.

    Args:
        scene: the Mitsuba scene.
        media: its translucent objects.
        max_depth: most vertices on surfaces seen from outside; what happens inside an object does not count.
        rr_depth: vertices outside after which roulette may end a path.
        hide_emitters: whether the camera sees no emitters.
        joins: how light of small emitters enters objects, if there are any.
        guide: how it leaves them where joins cannot find it.
    """

    scene: Any
    media: WalkMedia
    max_depth: int
    rr_depth: int
    hide_emitters: bool
    joins: Joins | None
    guide: Guide | None

    def trace(self, rays: Any, lanes: int, seed: tuple[int, ...]) -> tuple[Any, Any]:
        """Radiance along each ray, and whether it hits anything."""
        import drjit as dr
        import mitsuba as mi

        n = dr.width(rays)
        dr.eval(rays)
        lanes = min(lanes, n)
        found = dr.zeros(mi.Spectrum, n), dr.zeros(mi.Bool, n)
        dr.eval(found)
        state = self._begin(rays, dr.arange(mi.UInt32, lanes))
        state["rng"] = _generator(mi, lanes, pass_seed(*seed))
        total = dr.opaque(mi.UInt32, n)

        def body(s: dict) -> tuple[dict]:
            s = dr.if_stmt((s,), s["object"] >= 0, self._inside, lambda s: s, label="inside")
            s = dr.if_stmt((s,), s["alive"] & (s["object"] < 0), self._outside, lambda s: s, label="outside")
            return (dr.if_stmt((s,), ~s["alive"], lambda s: self._renew(s, rays, lanes, found), lambda s: s),)

        dr.while_loop((state,), lambda s: s["path"] < total, body, label="paths")
        dr.eval(found)
        return found

    def _begin(self, rays: Any, path: Any) -> dict:
        import drjit as dr
        import mitsuba as mi

        lanes, known = dr.width(path), path < dr.width(rays)

        def full(kind: type, value: Any) -> Any:
            return dr.full(kind, value, lanes)

        return {
            "path": path, "alive": full(mi.Bool, True), "object": full(mi.Int32, OUTSIDE),
            "channel": full(mi.UInt32, 0), "o": dr.gather(mi.Point3f, rays.o, path, known),
            "d": dr.gather(mi.Vector3f, rays.d, path, known), "weight": full(mi.Spectrum, 1),
            "density": full(mi.Spectrum, 1), "scale": full(mi.Float, 1), "L": full(mi.Spectrum, 0),
            "seen": full(mi.Bool, False), "depth": full(mi.UInt32, 0), "order": full(mi.UInt32, 0),
            "last": full(mi.Point3f, 0), "pdf": full(mi.Float, 1), "delta": full(mi.Bool, True),
            "straight": full(mi.Bool, False), "joined": full(mi.Bool, False), "pivot": full(mi.Point3f, 0),
            "guided": full(mi.Bool, False), "event": full(mi.Point3f, 0), "ahead": full(mi.Vector3f, 0),
            "phase": full(mi.Float, 1), "from": full(mi.Int32, 0),
        }  # fmt: skip

    def _renew(self, s: dict, rays: Any, lanes: int, found: tuple) -> dict:
        import drjit as dr

        dr.scatter(found[0], s["L"], s["path"])
        dr.scatter(found[1], s["seen"], s["path"])
        new = self._begin(rays, s["path"] + lanes)
        new["rng"] = s["rng"]
        return new

    def _inside(self, s: dict) -> dict:
        """A free flight to a scattering event, or to the boundary."""
        import drjit as dr
        import mitsuba as mi

        rng, media = s["rng"], self.media
        m = media.coefficients(s["object"])
        t = free_path(m, s["channel"], rng.next_float32())
        ray = mi.Ray3f(s["o"], s["d"])
        ray.maxt = t
        hit = media.scene.ray_intersect_preliminary(ray, coherent=False)
        flight = fly(m, s["weight"], s["density"], s["channel"], t, hit.t)
        s = {**s, "weight": flight.weight, "density": flight.density}
        s = dr.if_stmt((s, ray, t, m), flight.scatters, self._scatter, lambda s, *rest: s, label="scatter")
        at_boundary = ~flight.scatters
        return dr.if_stmt((s, ray, hit), at_boundary, self._leave, lambda s, *rest: s, label="boundary")

    def _scatter(self, s: dict, ray: Any, distance: Any, m: Any) -> dict:
        import drjit as dr
        import mitsuba as mi

        rng = s["rng"]
        o = ray(distance)
        if self.joins is not None:
            smooth = ~self.media.row("rough", s["object"])
            edge = s["straight"] & smooth & (s["order"] > 0)  # this event ends one
            s = {**s, "joined": s["joined"] | edge, "pivot": dr.select(edge, ray.o, s["pivot"])}
            s = dr.if_stmt((s, o, ray.d, m), self._may_join(s), self._join, lambda s, *rest: s, label="joins")
            s["straight"] = mi.Bool(True)
            s["guided"] = smooth & ~s["joined"] & self._counts(s, s["order"] + 1)
            s = dr.if_stmt((s, o, ray.d, m), s["guided"], self._guide, lambda s, *rest: s, label="guide")
        u = mi.Point2f(rng.next_float32(), rng.next_float32())
        d, weight, density = turn(m, s["weight"], s["density"], s["channel"], ray.d, u, self.media.same_g)
        survives, weight = roulette(weight, s["scale"], rng.next_float32())
        order = s["order"] + 1
        alive = survives & (order <= self.media.row("most", s["object"])) & self.media.box.contains(o)
        number = dr.select(alive, s["object"], OUTSIDE)
        s["phase"] = dr.mean(mi.Spectrum([eval_hg(dr.dot(ray.d, d), g) for g in m.g]))
        return {**s, "o": o, "d": d, "weight": weight, "density": density, "order": order,
                "alive": alive, "object": number}  # fmt: skip

    def _may_join(self, s: dict) -> Any:
        k = s["object"]
        return ~self.media.row("rough", k) & (s["order"] + 2 <= self.media.row("most", k))

    def _join(self, s: dict, p: Any, along: Any, m: Any) -> dict:
        light = self.joins.light(p, along, s["object"], m, s["rng"])
        return {**s, "L": s["L"] + s["weight"] * light}

    def _guide(self, s: dict, v: Any, along: Any, m: Any) -> dict:
        light = self.guide.light(v, along, s["object"], m, s["rng"])
        return {**s, "L": s["L"] + s["weight"] * light}

    def _counts(self, s: dict, order: Any) -> Any:
        """Whether a walk that leaves after so many events counts."""
        k = s["object"]
        return (order >= self.media.row("fewest", k)) & (order <= self.media.row("most", k))

    def _leave(self, s: dict, ray: Any, hit: Any) -> dict:
        """Reflection at the boundary seen from inside, or the way out."""
        import drjit as dr
        import mitsuba as mi

        rng, media, k = s["rng"], self.media, s["object"]
        si = hit.compute_surface_interaction(ray)
        foreign = media.number(si.shape) != k  # of an object that overlaps: the flight goes on behind it
        si = media.face_outwards(si, k, ray.d)
        leaked = ~foreign & (dr.dot(si.n, ray.d) < 0)  # rounding has put the walk outside
        counts = self._counts(s, s["order"])
        if media.any_rough:
            s["L"] += self._emitters(s, si, media.boundary(k), ~foreign & counts)
        bs, value = self._sample(media.boundary(k), si, rng)
        d = si.to_world(bs.wo)
        out = ~foreign & (dr.dot(d, si.n) > 0)
        alive = ~leaked & (foreign | (bs.pdf > 0)) & (~out | counts)
        d = dr.select(foreign, ray.d, d)
        if self.joins is not None:
            s["straight"] = s["straight"] & out
            s["guided"] = s["guided"] & s["straight"]
            s = {**s, "event": ray.o, "ahead": ray.d, "from": k}
        return {**s, "o": si.spawn_ray(d).o, "d": d, "alive": alive,
                "object": dr.select(alive & ~out, k, OUTSIDE),
                "weight": dr.select(foreign, s["weight"], s["weight"] * value),
                "scale": s["scale"] * dr.select(foreign, 1, dr.square(bs.eta)),
                "last": si.p, "pdf": bs.pdf, "delta": mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)}  # fmt: skip

    def _outside(self, s: dict) -> dict:
        """A ray outside all objects, and the surface that it meets."""
        import drjit as dr
        import mitsuba as mi

        ray = mi.Ray3f(s["o"], s["d"])
        si = self.scene.ray_intersect(ray, mi.RayFlags.All, coherent=False)
        first = s["depth"] == 0
        s = {**s, "L": s["L"] + self._emission(s, si), "seen": s["seen"] | (first & si.is_valid())}
        s["joined"], s["guided"] = mi.Bool(False), mi.Bool(False)
        s["depth"] += 1
        s["alive"] = si.is_valid() & (s["depth"] < mi.UInt32(self.max_depth))
        return dr.if_stmt((s, si, ray.d), s["alive"], self._bounce, lambda s, *rest: s, label="bounce")

    def _bounce(self, s: dict, si: Any, along: Any) -> dict:
        import drjit as dr
        import mitsuba as mi

        rng, media = s["rng"], self.media
        k = media.number(si.shape)
        translucent = k >= 0
        near = dr.maximum(k, 0)
        si = media.face_outwards(si, k, along)
        bsdf = si.bsdf()
        if media.objects:
            boundary = media.boundary(near)
            bsdf = dr.select(translucent, boundary if isinstance(boundary, mi.BSDFPtr) else mi.BSDFPtr(boundary), bsdf)
        mute = translucent & ~media.row("reflects", near) if media.objects else mi.Bool(False)
        s["L"] += self._emitters(s, si, bsdf, ~mute, translucent)
        bs, value = self._sample(bsdf, si, rng)
        d = si.to_world(bs.wo)
        enters = translucent & (dr.dot(d, si.n) < 0)
        s["weight"] *= value
        s["scale"] *= dr.square(bs.eta)
        size = dr.max(s["weight"]) * s["scale"]
        survive = dr.select(s["depth"] >= self.rr_depth, dr.minimum(size, 0.95), 1)
        s["weight"] /= dr.maximum(survive, 1e-30)
        alive = (bs.pdf > 0) & (size > 0) & (rng.next_float32() < survive) & ~(mute & ~enters)
        u = rng.next_float32()
        fresh = s["depth"] == 1
        channels = len(s["weight"])
        if channels > 1:  # the channel of the walk is drawn once in a path, whose densities are counted from there
            drawn = dr.minimum(mi.UInt32(u * channels), channels - 1)
            s["channel"] = dr.select(fresh, drawn, s["channel"])
        return {**s, "o": si.spawn_ray(d).o, "d": d, "alive": alive, "order": dr.select(enters, 0, s["order"]),
                "object": dr.select(alive & enters, k, OUTSIDE), "last": si.p, "pdf": bs.pdf,
                "delta": mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)}  # fmt: skip

    def _sample(self, bsdf: Any, si: Any, rng: Any) -> tuple[Any, Any]:
        import mitsuba as mi

        u, v = rng.next_float32(), mi.Point2f(rng.next_float32(), rng.next_float32())
        return bsdf.sample(mi.BSDFContext(), si, u, v)

    def _emission(self, s: dict, si: Any) -> Any:
        """Light of an emitter that the ray meets, weighted against sampling it from the last vertex."""
        import drjit as dr
        import mitsuba as mi

        emitter = si.emitter(self.scene)
        active = emitter != None  # noqa: E711
        if self.hide_emitters:
            active &= s["depth"] > 0
        last = dr.zeros(mi.Interaction3f)
        last.p = s["last"]
        ds = mi.DirectionSample3f(self.scene, si, last)
        sampled = active & ~s["delta"]
        pdf = dr.select(sampled, self.scene.pdf_emitter_direction(last, ds, sampled), 0)
        share = dr.select(s["delta"], 1, balance(s["pdf"], pdf))
        if self.joins is not None:
            active &= ~(s["joined"] & self.joins.covers(emitter, si.p, s["d"], s["pivot"]))
            guided = active & s["guided"]
            _, _, more = dr.if_stmt((emitter, s, share), guided, self._against_guide, lambda *state: state)
            share = dr.select(guided, more, share)
        return dr.select(active, s["weight"] * emitter.eval(si, active) * share, 0)

    def _against_guide(self, emitter: Any, s: dict, share: Any) -> tuple:
        return emitter, s, self.guide.share(emitter, s, s["guided"])

    def _emitters(self, s: dict, si: Any, bsdf: Any, active: Any, outwards: Any = True) -> Any:
        """Light of a sampled emitter by the surface at `si`; by a boundary only from its outer side."""
        import drjit as dr
        import mitsuba as mi

        rng = s["rng"]
        u = mi.Point2f(rng.next_float32(), rng.next_float32())
        active = active & mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth)
        ds, light = self.scene.sample_emitter_direction(si, u, True, active)
        active &= (ds.pdf > 0) & (~mi.Bool(outwards) | (dr.dot(ds.d, si.n) > 0))
        value, pdf = bsdf.eval_pdf(mi.BSDFContext(), si, si.to_local(ds.d), active)
        share = dr.select(ds.delta, 1, balance(ds.pdf, pdf))
        return dr.select(active, s["weight"] * value * light * share, 0)


def balance(a: Any, b: Any) -> Any:
    """Weight of the power heuristic for density a against b."""
    import drjit as dr

    share = dr.square(a) / (dr.square(a) + dr.square(b))
    return dr.select(dr.isfinite(share), share, 0)
