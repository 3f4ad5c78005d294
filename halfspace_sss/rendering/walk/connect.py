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

from dataclasses import dataclass
from typing import Any

import numpy as np

from halfspace_sss.physics.phase import eval_hg
from halfspace_sss.rendering.walk.inside import fly, free_path, pick, turn
from halfspace_sss.rendering.walk.media import Coefficients, WalkMedia, by_pointer, pointer_numbers

__all__ = ["DEEPEST", "Joins", "draw", "find_joins"]

DEEPEST = 12.0  # mean free paths up to which the boundary in front of an event is looked for
LARGEST = 0.5  # radius of an emitter over its distance
STEEPEST = 0.5  # least cosine of a ray with w_0
# Rates of fall about the aimed point, in 1/mfp: as light does around an event below a flat boundary, and one that
# falls no faster than any light at the least cosine, so that weights stay bounded.
RATES = (1.0, 0.4)
LEAST_PROMISE = 0.1  # of an event far below the boundary: light may enter nearer on another side


@dataclass(frozen=True, eq=False)
class Joins:
    """The emitters whose light is found by joins.

    Args:
        scene: the Mitsuba scene.
        media: its translucent objects.
        emitters: the small emitters.
        centres: three tables, of a point of each emitter or of the direction to it.
        distant: table of whether each is infinitely far.
        radii: table of the radius of the sphere about each emitter.
        share: probability of a join at an event near the boundary.
        numbers: table from the number of an emitter in Dr.Jit's registry to that here.
        pointers: table of those numbers.
    """

    scene: Any
    media: WalkMedia
    emitters: list[Any]
    centres: list[Any]
    distant: Any
    radii: Any
    share: float
    numbers: Any
    pointers: Any

    def _centre(self, k: Any) -> Any:
        import drjit as dr
        import mitsuba as mi

        return mi.Vector3f(*(dr.gather(mi.Float, column, k) for column in self.centres))

    def direction(self, k: Any, p: Any) -> tuple[Any, Any]:
        """w_0 from p to emitter k, and whether the emitter looks small from there."""
        import drjit as dr
        import mitsuba as mi

        centre, distant = self._centre(k), dr.gather(mi.Bool, self.distant, k)
        way = dr.select(distant, centre, centre - mi.Vector3f(p))
        size = dr.norm(way)
        small = distant | (dr.gather(mi.Float, self.radii, k) < LARGEST * size)
        return way / dr.maximum(size, 1e-20), small

    def angle2(self, k: Any, p: Any) -> Any:
        """Square of the angle under which the radius of emitter k is seen from p."""
        import drjit as dr
        import mitsuba as mi

        way = self._centre(k) - mi.Vector3f(p)
        return dr.square(dr.gather(mi.Float, self.radii, k)) / dr.squared_norm(way)

    def number(self, emitter: Any) -> Any:
        """The number of an emitter here, or -1."""
        import drjit as dr
        import mitsuba as mi

        pointer = dr.reinterpret_array(mi.UInt32, emitter)
        known = pointer < dr.width(self.numbers)
        return dr.select(known, dr.gather(mi.Int32, self.numbers, pointer, known), -1)

    def covers(self, emitter: Any, y: Any, w: Any, pivot: Any) -> Any:
        """Whether joins at `pivot` find light that arrives from the point y of an emitter along -w.

        The line must cross the plane through the pivot steeply on its way from the emitter.
        """
        import drjit as dr

        k = self.number(emitter)
        w_0, small = self.direction(dr.maximum(k, 0), pivot)
        cosine = dr.dot(w, w_0)
        return (k >= 0) & small & (dr.abs(cosine) > STEEPEST) & (dr.dot(y - pivot, w_0) * cosine > 0)

    def light(self, p: Any, along: Any, k: Any, m: Coefficients, rng: Any) -> Any:
        """An estimate of what joins at the event p of object k bring per weight of a walk that came `along`."""
        import drjit as dr
        import mitsuba as mi

        n = len(self.emitters)
        which = draw(n, rng)
        w_0, small = self.direction(which, p)
        shift, depth, survive = self._aim(p, w_0, k, m)
        chosen = small & (rng.next_float32() < self.share * survive)
        state = (rng, mi.Spectrum(0) + dr.zeros(mi.Spectrum, dr.width(p)), p, along, k, m, which, w_0, shift, depth)
        _, found, *_ = dr.if_stmt(state, chosen, self._enter, lambda *state: state, label="join")
        return found * (n / (self.share * survive))

    def _aim(self, p: Any, w_0: Any, k: Any, m: Coefficients) -> tuple[Any, Any, Any]:
        """Where to aim across w_0 relative to p, the depth of p, and how promising p is, (0, 1]."""
        import drjit as dr
        import mitsuba as mi

        ray = mi.Ray3f(p, w_0)
        ray.maxt = DEEPEST / dr.min(m.sigma_t)
        si = self.media.scene.ray_intersect(ray, mi.RayFlags.Minimal, coherent=False)
        n = si.n * self.media.side(k, si.prim_index)
        facing = si.is_valid() & (dr.dot(n, w_0) > 0)
        far = dr.select(si.is_valid(), si.t, ray.maxt)
        _, cos_t, _, eta_ti = mi.fresnel(dr.select(facing, dr.dot(n, w_0), 1), self.media.row("eta", k))
        back = w_0 * eta_ti + n * (dr.abs(cos_t) - eta_ti * dr.dot(n, w_0))  # from p to where the light enters
        entry = back * (dr.dot(n, w_0) * far / dr.maximum(dr.abs(cos_t), 1e-3))
        shift = dr.select(facing, entry - w_0 * dr.dot(entry, w_0), 0)
        depth = dr.select(facing, dr.minimum(dr.norm(entry), far), far)
        return shift, depth, dr.maximum(dr.exp(-0.5 * dr.min(m.sigma_t) * depth), LEAST_PROMISE)

    def _enter(self, rng: Any, found: Any, p: Any, along: Any, k: Any, m: Coefficients, which: Any, w_0: Any,
               shift: Any, depth: Any) -> tuple:  # fmt: skip
        """Aim a ray of light, refract it into the object and follow it."""
        import drjit as dr
        import mitsuba as mi

        wide = m.sigma_t * dr.rsqrt(1 + m.sigma_t * depth)
        rate = dr.select(rng.next_float32() < 0.5, RATES[0], RATES[1]) * pick(wide, draw(len(wide), rng))
        r = dr.maximum(-dr.log(1 - rng.next_float32()) / rate, 1e-20)
        pdf = sum(dr.mean(c * wide * dr.exp(-c * wide * r)) for c in RATES) / (len(RATES) * 2 * dr.pi * r)
        sin_phi, cos_phi = dr.sincos(2 * dr.pi * rng.next_float32())
        s, t = mi.coordinate_system(w_0)
        at = dr.zeros(mi.Interaction3f)
        at.p = mi.Point3f(p + shift + (s * cos_phi + t * sin_phi) * r)
        ds, light = self._emitter(which).sample_direction(at, mi.Point2f(rng.next_float32(), rng.next_float32()))
        flux = light * (dr.abs(dr.dot(ds.d, w_0)) / pdf)
        distant = dr.gather(mi.Bool, self.distant, which)
        away = dr.select(distant, 4 * dr.norm(self.scene.bbox().extents()), ds.dist * (1 - 1e-4))
        si = self.scene.ray_intersect(mi.Ray3f(mi.Point3f(at.p + ds.d * away), -ds.d), mi.RayFlags.All, coherent=False)
        steep = dr.abs(dr.dot(ds.d, w_0)) > STEEPEST
        enters = si.is_valid() & (ds.pdf > 0) & steep & (self.media.number(si.shape) == mi.Int32(k))
        si = self.media.face_outwards(si, dr.select(enters, mi.Int32(k), -1), -ds.d)
        F, cos_t, _, eta_ti = mi.fresnel(mi.Frame3f.cos_theta(si.wi), self.media.row("eta", k))
        d = si.to_world(mi.refract(si.wi, cos_t, eta_ti))
        enters &= (dr.dot(si.n, ds.d) > 0) & (mi.Frame3f.cos_theta(si.wi) > 0) & (dr.dot(si.n, d) < 0)
        # shading normals bend the ray, geometric ones hold its width
        bend = dr.dot(d, si.n) * mi.Frame3f.cos_theta(si.wi) / (dr.dot(d, si.sh_frame.n) * dr.dot(ds.d, si.n))
        weight = dr.select(enters, flux * ((1 - F) * bend), 0)
        enters &= dr.max(weight) > 0
        o, channel = si.spawn_ray(d).o, draw(len(wide), rng)
        state = (enters, rng, o, d, weight, dr.full(mi.Spectrum, 1, dr.width(p)), mi.Bool(enters), found, p, along,
                 k, m, channel)  # fmt: skip
        _, rng, *_, found, p, along, k, m, _ = dr.while_loop(state, lambda on, *rest: on, self._follow, label="light")
        return rng, found, p, along, k, m, which, w_0, shift, depth

    def _emitter(self, k: Any) -> Any:
        import drjit as dr
        import mitsuba as mi

        if len(self.emitters) == 1:
            return self.emitters[0]
        return dr.reinterpret_array(mi.EmitterPtr, dr.gather(mi.UInt32, self.pointers, k))

    def _follow(self, on: Any, rng: Any, o: Any, d: Any, weight: Any, density: Any, joinable: Any, found: Any, p: Any,
                along: Any, k: Any, m: Coefficients, channel: Any) -> tuple:  # fmt: skip
        """One ray of the walk from the light: a join on it, if it may have one, and a free flight."""
        import drjit as dr
        import mitsuba as mi

        u = rng.next_float32()
        t, value = _on_ray(o, d, p, along, m, u)
        t = dr.select(joinable, t, 0)
        flight = free_path(m, channel, rng.next_float32())
        ray = mi.Ray3f(o, d)
        ray.maxt = dr.maximum(t, flight)
        hit = self.media.scene.ray_intersect_preliminary(ray, coherent=False)
        value = dr.select(joinable & (t < hit.t), weight * value, 0)
        q = mi.Point3f(o + d * t)
        to_p = mi.Ray3f(q, dr.normalize(p - q))
        to_p.maxt = dr.norm(p - q)
        bright = dr.max(value) > 0
        found = found + dr.select(self.media.scene.ray_test(to_p, False, bright), 0, dr.select(bright, value, 0))

        ended = fly(m, weight, density, channel, flight, hit.t)
        u = mi.Point2f(rng.next_float32(), rng.next_float32())
        turned, weight, density = turn(m, ended.weight, ended.density, channel, d, u, self.media.same_g)
        state = (o, d, rng, k, ray, hit, mi.Bool(True))
        o_b, d_b, rng, k, _, _, reflected = dr.if_stmt(state, ~ended.scatters, self._reflect, lambda *state: state)
        weight = dr.select(ended.scatters, weight, ended.weight)
        density = dr.select(ended.scatters, density, ended.density)
        o = dr.select(ended.scatters, mi.Point3f(o + d * flight), o_b)
        d = dr.select(ended.scatters, turned, d_b)
        on = on & dr.select(ended.scatters, joinable, reflected)
        return on, rng, o, d, weight, density, ~ended.scatters, found, p, along, k, m, channel

    def _reflect(self, o: Any, d: Any, rng: Any, k: Any, ray: Any, hit: Any, on: Any) -> tuple:
        """Reflection at the boundary from inside with the probability of its reflectance."""
        import drjit as dr
        import mitsuba as mi

        si = hit.compute_surface_interaction(ray)
        si = self.media.face_outwards(si, mi.Int32(k), d)
        F, _, _, _ = mi.fresnel(mi.Frame3f.cos_theta(si.wi), self.media.row("eta", k))
        new = si.to_world(mi.reflect(si.wi))
        foreign = self.media.number(si.shape) != mi.Int32(k)  # an object that overlaps: the ray goes on behind it
        new = dr.select(foreign, d, new)
        inside = (dr.dot(si.n, d) > 0) & (dr.dot(si.n, new) < 0) & (rng.next_float32() < F)
        return si.spawn_ray(new).o, new, rng, k, ray, hit, foreign | inside


def draw(n: int, rng: Any) -> Any:
    """A whole number below n."""
    import drjit as dr
    import mitsuba as mi

    return dr.minimum(mi.UInt32(rng.next_float32() * n), n - 1)


def _on_ray(o: Any, d: Any, p: Any, along: Any, m: Coefficients, u: Any) -> tuple[Any, Any]:
    """Distance of an event q on a ray of light, and what the two events and the way between bring over its density."""
    import drjit as dr
    import mitsuba as mi

    v = p - o
    t_0 = dr.dot(v, d)
    D = dr.maximum(dr.norm(v - d * t_0), 1e-9)
    start = dr.atan2(-t_0, D)
    width = 0.5 * dr.pi - start
    t = dr.maximum(t_0 + D * dr.tan(start + u * width), 0)
    way = o + d * t - p
    distance = dr.norm(way)
    way = way / dr.maximum(distance, 1e-20)
    c_1, c_2 = dr.dot(along, way), -dr.dot(way, d)
    phases = mi.Spectrum([eval_hg(c_1, g) * eval_hg(c_2, g) for g in m.g])
    value = m.sigma_s * phases * dr.exp(-m.sigma_t * (t + distance)) * (width / D)
    return t, dr.select(dr.isfinite(t), value, 0)


def find_joins(scene: Any, media: WalkMedia, share: float) -> Joins | None:
    """The small emitters of a scene, or None if there are none, or no object whose boundary is smooth."""
    import drjit as dr
    import mitsuba as mi

    at = mi.Interaction3f()
    at.p = mi.Point3f(0)
    emitters, centres, distant, radii = [], [], [], []
    for emitter in scene.emitters():
        shape = emitter.get_shape()
        if emitter.is_environment() or (shape is not None and hasattr(shape.bsdf(), "inside")):
            continue
        ds, _ = emitter.sample_direction(at, mi.Point2f(0.5))
        far = mi.has_flag(emitter.flags(), mi.EmitterFlags.Infinite)
        centre = shape.bbox().center() if shape is not None else ds.d if far else ds.p
        emitters.append(emitter)
        centres.append(np.ravel(np.array(centre)).tolist())
        distant.append(bool(far))
        radii.append(0.0 if shape is None else 0.5 * float(np.linalg.norm(np.array(shape.bbox().extents()))))
    if not emitters or not media.objects or media.all_rough or share == 0:
        return None
    pointers = [mi.EmitterPtr(emitter) for emitter in emitters]
    tables = [mi.Float([c[axis] for c in centres]) for axis in range(3)], mi.Bool(distant), mi.Float(radii)
    dr.make_opaque(tables)
    return Joins(scene, media, emitters, *tables, share, by_pointer(pointers), pointer_numbers(pointers))
