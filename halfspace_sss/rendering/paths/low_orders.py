"""Where rays inside an object meet its boundary, and the one ray that is refracted towards a given point.

The connection follows Walter, Zhao, Holzschuch and Bala 2009 in spirit: the direction at the event is moved by Newton's
method until the refracted ray meets the target; the derivative of the refracted ray (Igehy 1999) contains the curvature
of the shading normals. One solution is looked for, from where the straight ray meets the boundary: light that reaches
the event along several refracted rays is counted once, and where Newton's method fails the light is lost.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import drjit as dr
import mitsuba as mi

from halfspace_sss.physics.phase import eval_hg, sample_hg
from halfspace_sss.rendering.light.small_emitters import WIDE
from halfspace_sss.rendering.paths.lighting import World, sampled_light
from halfspace_sss.rendering.surface.derivatives import detached
from halfspace_sss.rendering.surface.horizon import lifted, mirrored, opposed
from halfspace_sss.rendering.surface.object import turned
from halfspace_sss.rendering.transport.body import Body
from halfspace_sss.rendering.transport.plane import Exit, number, place

__all__ = ["Connection", "Few", "Leg", "few_orders", "meet", "refracted_connection"]


ITERATIONS = 6
LONGEST_STEP = 0.5  # of the direction, radians
TOLERANCE = 1e-3  # distance by which the target may be missed, over its distance


class Connection(NamedTuple):
    """A refracted connection; `d` is its direction inside, `density` the solid angle inside per area across the ray."""

    p: Any
    n: Any
    d: Any
    w: Any
    T: Any
    length: Any
    density: Any
    valid: Any


def meet(body: Body, p: Any, d: Any, flags: Any, active: Any) -> tuple[Any, Any, Any]:
    """Interaction with the boundary, shading normal and geometric normal, both outwards (along d for a sheet)."""
    si = body.found.scene.ray_intersect(mi.Ray3f(p, d), flags, False, active)
    sign = body.found.side(si.prim_index, active & si.is_valid())
    if not body.found.closed:
        sign = dr.select(dr.dot(si.n, d) > 0, 1.0, -1.0)
    return si, turned(si.sh_frame.n, si.n) * sign, si.n * sign


def _refract(body: Body, d: Any, n: Any) -> tuple[Any, Any, Any]:
    """Direction outside, Fresnel reflectance, and whether light passes, for a ray inside along d."""
    eta = body.eta
    c = dr.dot(d, n)
    c_t2 = 1 - eta * eta * (1 - c * c)
    F = mi.fresnel(dr.maximum(c, 0), 1 / eta)[0]
    w = eta * d + n * (dr.safe_sqrt(c_t2) - eta * c)
    return dr.normalize(w), F, (c > 0) & (c_t2 > 0)


def refracted_connection(body: Body, p: Any, target: Any, active: Any) -> Connection:
    """The ray from p inside the body that is refracted towards `target` outside."""

    def step(k: Any, d: Any, found: tuple, active: Any) -> tuple:
        e, J, met, valid = _aim(body, p, d, target, active)
        (a, b), (c, f) = J
        det = a * f - b * c
        inverse = dr.rcp(dr.select(dr.abs(det) > 1e-12, det, 1e-12))
        step_1, step_2 = (f * e[0] - b * e[1]) * inverse, (a * e[1] - c * e[0]) * inverse
        size = dr.sqrt(step_1 * step_1 + step_2 * step_2)
        shrink = dr.minimum(1, LONGEST_STEP / dr.maximum(size, 1e-9))
        miss = dr.sqrt(e[0] * e[0] + e[1] * e[1])
        close = valid & (miss < TOLERANCE * dr.norm(target - mi.Point3f(met[0])))
        found = tuple(
            dr.select(active & close, x, y) for x, y in zip((*met, 1 / dr.maximum(dr.abs(det), 1e-12), d, close), found)
        )
        e_1, e_2 = mi.coordinate_system(d)
        onward = dr.normalize(d + (e_1 * step_1 + e_2 * step_2) * shrink)
        active = active & valid & (~close | (miss > 1e-5 * dr.norm(target - p))) & (k + 1 < ITERATIONS)
        return k + 1, dr.select(active, onward, d), found, active

    start = _first_guess(body, p, dr.normalize(target - p), active)
    nothing = (
        mi.Point3f(0), mi.Normal3f(0, 0, 1), mi.Vector3f(0, 0, 1), mi.Float(0), mi.Float(0),
        mi.Float(0), mi.Vector3f(0, 0, 1), mi.Bool(False),
    )  # fmt: skip
    state = (mi.UInt32(0), mi.Vector3f(start), nothing, mi.Bool(active))
    at, n, w, T, length, density, d, valid = dr.while_loop(state, lambda *s: s[-1], step, label="refraction")[2]
    return Connection(at, n, d, w, T, length, density, valid & active)


def _first_guess(body: Body, p: Any, w: Any, active: Any) -> Any:
    """The direction inside of light that arrives along -w where the straight ray along w meets the boundary."""
    _, n_out, _ = meet(body, p, w, mi.RayFlags.Minimal | mi.RayFlags.ShadingFrame, active)
    across = (w - n_out * dr.dot(w, n_out)) / body.eta
    return dr.normalize(across + n_out * dr.sqrt(dr.maximum(1 - dr.squared_norm(across), 1e-4)))


def _aim(body: Body, p: Any, d: Any, target: Any, active: Any) -> tuple[tuple, tuple, tuple, Any]:
    """Miss of the target in two axes across the refracted ray, its derivative by d, the passage, and its validity.

    With dw across d: dx = s (dw - d (dw.n)/(d.n)); dn = n_u du + n_v dv; refracted w = eta d + (c_t - eta c) n.
    """
    flags = mi.RayFlags.All | mi.RayFlags.dNSdUV
    si, n_out, n = meet(body, p, d, flags, active)
    w, F, valid = _refract(body, d, n_out)
    eta, c = body.eta, dr.dot(d, n_out)
    c_t = dr.sqrt(dr.maximum(1 - eta * eta * (1 - c * c), 1e-6))
    flip = dr.select(dr.dot(si.sh_frame.n, n_out) > 0, 1.0, -1.0) * body.found.curvature_sign
    D = dr.dot(target - si.p, w)
    f = mi.coordinate_system(w)
    columns = []
    for e in mi.coordinate_system(d):
        dx = si.t * (e - d * (dr.dot(e, n) / dr.dot(d, n)))
        du, dv = _surface_steps(si, dx)
        dn = (si.dn_du * du + si.dn_dv * dv) * flip
        dc = dr.dot(e, n_out) + dr.dot(d, dn)
        dw = eta * e + dn * (c_t - eta * c) + n_out * (eta * eta * c * dc / c_t - eta * dc)
        moved = dx + dw * D
        columns.append((dr.dot(f[0], moved), dr.dot(f[1], moved)))
    miss = target - (si.p + w * D)
    e = (dr.dot(f[0], miss), dr.dot(f[1], miss))
    J = ((columns[0][0], columns[1][0]), (columns[0][1], columns[1][1]))
    valid = valid & si.is_valid() & (D > 0) & (dr.dot(w, n) > 0)
    return e, J, (mi.Point3f(si.p), mi.Normal3f(n), mi.Vector3f(w), 1 - F, si.t), valid


def _surface_steps(si: Any, dx: Any) -> tuple[Any, Any]:
    """(du, dv) with dp_du du + dp_dv dv = dx; 0 where the shape has no parametrisation."""
    a, b, c = dr.dot(si.dp_du, si.dp_du), dr.dot(si.dp_du, si.dp_dv), dr.dot(si.dp_dv, si.dp_dv)
    p, q = dr.dot(si.dp_du, dx), dr.dot(si.dp_dv, dx)
    det = a * c - b * b
    inverse = dr.select(det > 1e-14 * a * c, dr.rcp(det), 0)
    return (c * p - b * q) * inverse, (a * q - b * p) * inverse


# ---- Scattering orders 0 and 1 -------------------------------------------------------------------------------------

MOST_LEGS = 256
FAINT = 0.1  # weight below which a scattered walk may end
GRAZES = 0.05  # cosine at an emitter up to which its points are left to chance: their density over the area goes to 0
FOCUS = 10.0  # of the straight way into solid angle at the event; points of caustics beyond are left to chance
SAME_WAY = 1e-2  # by which points of exit may differ, over their distance from the event

Media = list[tuple[Any, Any, Any]]  # sigma_s, sigma_t and g of each channel


class Leg(NamedTuple):
    """The way from an exit into the body: direction, Fresnel transmittance, whether there is one.

    `passing` is the probability to go along it to the boundary.
    """

    out: Exit
    along: Any
    T: Any
    valid: Any
    passing: Any


class Few(NamedTuple):
    """Where a walk leaves the body, and light of emitters that came to its event."""

    p: Any
    n: Any
    d: Any
    weight: Any  # spectrum
    connected: Any  # whether light of emitters on this way is in `direct`
    direct: Any  # spectrum
    once: Any  # whether it was scattered


@dataclass
class _Walk:
    """State of a walk; after it is `out`, o, d and n are those of the way outside."""

    o: Any
    d: Any
    n: Any
    skip: Any  # length after which a ray is clear of the boundary
    way: Any
    inverse: Any  # 1 / p
    order: Any
    cosine: Any
    event: Any
    along: Any
    event_way: Any
    event_inverse: Any  # 1 / p before the phase function
    straight: Any  # nothing has reflected since the event
    out: Any
    alive: Any


def few_orders(world: World, body: Body, leg: Leg, sampler: Any, scattered: Any, active: Any) -> Few:
    """Light that leaves at the exit of `leg` after at most one scattering event.

    What passes unscattered shows delta lights only if the path has `scattered` before.
    """
    with detached():
        walk = _walk(body, leg, sampler, active & leg.valid)
        once = walk.order == 1
        counts = walk.out & (once if 0 not in body.few else mi.Bool(True))
        straight = once & walk.straight
    coefficients = body.variation.coefficients(body.media)
    f = _value(coefficients, walk.way, walk.order, walk.cosine)
    weight = dr.select(counts, f * (walk.inverse * leg.T), 0)
    direct = mi.Spectrum(0)
    if world.lights.some_local or world.suns:
        value = _value(coefficients, walk.event_way, mi.UInt32(1), None) * (walk.event_inverse * leg.T)
        direct = _connected(world, (body, coefficients), walk, dr.select(once, value, 0), sampler, once)
    if world.lights.some_shaped or world.suns:
        direct = direct + weight * _met_by_chance(world, body, walk, counts & straight)
    if world.lights.some_delta:
        direct = direct + weight * _spread_lights(world, body, walk, sampler, counts & (once | scattered))
    return Few(walk.o, walk.n, walk.d, weight, straight, direct, once)


def _walk(body: Body, leg: Leg, sampler: Any, active: Any) -> _Walk:
    zero, point = mi.Float(0), mi.Point3f(leg.out.p)
    media = [tuple(number(v) for v in (m.sigma_s, m.sigma_t, m.g)) for m in body.media]
    skip = _clear(body, leg.out.n_face, leg.along)
    start = _Walk(
        point, mi.Vector3f(leg.along), mi.Normal3f(leg.out.n_face), mi.Float(skip), zero, mi.Float(1), mi.UInt32(0),
        zero, mi.Point3f(point), mi.Vector3f(leg.along), zero, zero, mi.Bool(True), mi.Bool(False), mi.Bool(active),
    )  # fmt: skip

    def step(k: Any, sampler: Any, passing: Any, walk: _Walk) -> tuple:
        return k + 1, sampler, passing, _step((body, media), k, sampler, passing, walk)

    state = (mi.UInt32(0), sampler, mi.Float(leg.passing), start)
    return dr.while_loop(state, lambda k, sampler, passing, walk: walk.alive, step, label="few orders")[3]


def _step(of: tuple[Body, Media], k: Any, sampler: Any, passing: Any, walk: _Walk) -> _Walk:
    """To the event, or to the boundary and what happens there."""
    (body, media), flags = of, mi.RayFlags.Minimal | mi.RayFlags.ShadingFrame
    si, n_out, n = meet(body, walk.o + walk.d * walk.skip, walk.d, flags, walk.alive)
    length = si.t + walk.skip
    W = _value(media, walk.way, walk.order, walk.cosine) * walk.inverse
    T = dr.select(si.is_valid(), dr.exp(-_row(media, 1) * length), 0)
    passing = dr.select(k == 0, passing, dr.sum(W * T) / dr.maximum(dr.sum(W), 1e-30))
    first = walk.order == 0
    scatters = first & (sampler.next_1d() >= passing)
    scattered = _scatter(media, walk, (W, 1 - T), dr.maximum(1 - passing, 1e-7), sampler)
    met = replace(walk, way=walk.way + length, inverse=walk.inverse / dr.select(first, passing, 1))
    met = _meet_boundary(of, met, (si, n_out, n), sampler)
    met.alive &= ~walk.out & (k + 1 < MOST_LEGS)
    return dr.select(scatters, scattered, met)


def _scatter(media: Media, walk: _Walk, weights: tuple[Any, Any], scattering: Any, sampler: Any) -> _Walk:
    """The event on this leg, which happens with the probability `scattering`.

    `weights` are f_c / p and the chance of channel c to be scattered on the leg.
    """
    sigma_t, g, (W, ends) = _row(media, 1), _row(media, 2), weights
    u, v, channel, chance = sampler.next_1d(), sampler.next_2d(), sampler.next_2d(), W * ends
    rate = dr.maximum(_pick(sigma_t, chance, channel.x), 1e-12)
    s = -dr.log(1 - u * dr.minimum(_pick(ends, chance, channel.x), 1 - 1e-7)) / rate
    density = dr.sum(W * sigma_t * dr.exp(-sigma_t * s)) / dr.maximum(dr.sum(chance), 1e-30)
    inverse = walk.inverse / dr.maximum(density * scattering, 1e-30)
    W = _value(media, walk.way + s, mi.UInt32(1), None) * inverse
    cosine = sample_hg(v.x, _pick(g, W, channel.y))
    phase = dr.sum(W * _spectrum([eval_hg(cosine, m[2]) for m in media])) / dr.maximum(dr.sum(W), 1e-30)
    sine, (sin_phi, cos_phi) = dr.safe_sqrt((1 - cosine) * (1 + cosine)), dr.sincos(2 * dr.pi * v.y)
    d = mi.Frame3f(walk.d).to_world(mi.Vector3f(sine * cos_phi, sine * sin_phi, cosine))
    p = mi.Point3f(walk.o + walk.d * s)
    return replace(
        walk, o=p, d=mi.Vector3f(d), skip=mi.Float(0), way=walk.way + s, inverse=inverse / dr.maximum(phase, 1e-30),
        order=mi.UInt32(1), cosine=mi.Float(cosine), event=p, along=mi.Vector3f(walk.d), event_way=walk.way + s,
        event_inverse=inverse, straight=mi.Bool(True), alive=walk.alive & (dr.sum(W) > 0) & (dr.sum(chance) > 0),
    )  # fmt: skip


def _meet_boundary(of: tuple[Body, Media], walk: _Walk, met: tuple[Any, Any, Any], sampler: Any) -> _Walk:
    """Reflection by Fresnel, or the way out; what is faint may end."""
    (body, media), (si, n_out, n) = of, met
    size = dr.max(_value(media, walk.way, walk.order, walk.cosine) * walk.inverse)
    survival = dr.select(walk.order == 1, dr.minimum(size / FAINT, 1), 1)
    frame = mi.Frame3f(lifted(n_out, n, walk.d))
    w = frame.to_local(-walk.d)
    F, cos_t, _, eta_ti = mi.fresnel(mi.Frame3f.cos_theta(w), body.eta)
    reflects = sampler.next_1d() < F
    back, on = -mirrored(-frame.to_world(mi.reflect(w)), n), opposed(frame.to_world(mi.refract(w, cos_t, eta_ti)), n)
    d, out = mi.Vector3f(dr.select(reflects, back, on)), ~reflects
    alive = walk.alive & si.is_valid() & (dr.dot(n, walk.d) > 0) & (sampler.next_1d() < survival)
    return replace(
        walk, o=mi.Point3f(si.p), d=d, n=mi.Normal3f(n), skip=mi.Float(_clear(body, n, d)), out=alive & out,
        straight=walk.straight & out, alive=alive & ~out, inverse=walk.inverse / dr.maximum(survival, 1e-30),
    )  # fmt: skip


def _connected(world: World, of: tuple[Body, Media], walk: _Walk, weight: Any, sampler: Any, active: Any) -> Any:
    """Light of a sampled emitter that is refracted at the boundary into the event, which has a weight."""
    body, media = of
    at = place(walk.event, mi.Normal3f(0, 0, 0))
    ds, light = sampled_light(world, at, sampler.next_2d(), False, active)
    with detached():
        distant = mi.has_flag(ds.emitter.flags(), mi.EmitterFlags.Infinite)
        active = active & (ds.pdf > 0) & _aimed_at(world, ds.emitter, ds.d)
        reach = dr.select(distant, number(1e4 * body.found.size), ds.dist)
        target = walk.event + ds.d * reach
        met = refracted_connection(body, walk.event, target, active)
        # solid angle at the event per solid angle of the straight direction, over which the emitter was sampled
        facing = dr.select(dr.squared_norm(ds.n) > 0, dr.abs(dr.dot(ds.n, met.w)) / dr.abs(dr.dot(ds.n, ds.d)), 1)
        found = met.valid & (ds.delta | _is_sampled(walk.event, target, ds.n, met))
        spread = dr.select(ds.delta, 1, facing) * reach * reach * met.density
        cosine, passed = dr.dot(walk.along, met.d), met.T * spread
    phase = _spectrum([eval_hg(cosine, g) for _, _, g in media])
    value = weight * phase * _value(media, met.length, mi.UInt32(0), None) * passed * light
    edge = place(met.p, met.n)
    blocked = world.scene.ray_test(edge.spawn_ray_to(target), False, found)
    return dr.select(found & ~blocked, value, 0)


def _clear(body: Body, n: Any, d: Any) -> Any:
    """Length along d after which a ray from the surface is clear of it; an origin moved instead lies deeper."""
    return number(body.found.rounding) / dr.maximum(dr.abs(dr.dot(n, d)), 0.1)


def _row(media: Media, k: int) -> Any:
    return _spectrum([m[k] for m in media])


def _met_by_chance(world: World, body: Body, walk: _Walk, active: Any) -> Any:
    """Light of an emitter that a walk meets from its event, which no connection with that point of it would find."""
    with detached():
        ray = place(walk.o, walk.n).spawn_ray(walk.d)
        si = world.scene.ray_intersect(ray, mi.RayFlags.All, False, active)
        emitter = si.emitter(world.scene, active)
        active = active & (emitter != None) & _aimed_at(world, emitter, walk.d)  # noqa: E711
        target = dr.select(si.is_valid(), si.p, walk.event + walk.d * number(1e4 * body.found.size))
        met = refracted_connection(body, walk.event, mi.Point3f(target), active)
        n = dr.select(si.is_valid(), si.n, 0)
        sampled = _is_same(walk, met, SAME_WAY) & _is_sampled(walk.event, target, n, met)
    return dr.select(active & ~sampled, emitter.eval(si, active), 0)


def _spread_lights(world: World, body: Body, walk: _Walk, sampler: Any, active: Any) -> Any:
    """Light of a delta light whose cone holds a walk's way out, which no connection with it would find."""
    n, small = world.small.n_delta, world.small
    which = mi.UInt32(dr.minimum(sampler.next_1d() * n, n - 1)) if n > 1 else mi.UInt32(0)
    L = n * small.spread(which, place(walk.o, walk.n).spawn_ray(walk.d), mi.Float(WIDE), active)
    with detached():
        connects = active & (dr.max(L) > 0) & walk.straight & (walk.order == 1)
        target = small.point(which, walk.event, 1e4 * body.found.size)
        met = refracted_connection(body, walk.event, target, connects)
    return dr.select(connects & _is_same(walk, met, 3 * WIDE), 0, L)


def _aimed_at(world: World, emitter: Any, d: Any) -> Any:
    """Whether events are connected with an emitter in the direction d: with any but a sky that has no sun there."""
    found = ~emitter.is_environment()
    return found | (world.small.index_of(emitter, d) >= 0) if world.suns else found


def _is_same(walk: _Walk, met: Connection, tolerance: float) -> Any:
    """Whether a walk has left its event by the connection, up to a share of the distance."""
    return met.valid & (dr.norm(mi.Point3f(met.p) - walk.o) <= tolerance * dr.norm(walk.o - walk.event))


def _is_sampled(event: Any, p: Any, n: Any, met: Connection) -> Any:
    """Whether light of the point p of an emitter, with the normal n, comes by its connection with the event."""
    way = p - event
    return _faces(n, dr.normalize(way)) & (dr.squared_norm(way) * met.density < FOCUS)


def _faces(n: Any, d: Any) -> Any:
    """Whether a point of an emitter with the normal n is seen along d straight from the front; all are without n."""
    return (dr.dot(n, d) < -GRAZES) | (dr.squared_norm(n) == 0)


def _value(media: Media, way: Any, order: Any, cosine: Any) -> Any:
    """sigma_s^k p(cos)^k exp(-sigma_t Λ); without the phase function where there is no cosine."""
    found = []
    for sigma_s, sigma_t, g in media:
        once = sigma_s if cosine is None else sigma_s * eval_hg(cosine, g)
        found.append(dr.select(order == 1, once, 1) * dr.exp(-sigma_t * way))
    return _spectrum(found)


def _pick(values: Any, weights: Any, u: Any) -> Any:
    """The value of a channel drawn by its weight, for a uniform number."""
    u, value = u * dr.sum(weights), values[0]
    for k in range(1, len(values)):
        u = u - weights[k - 1]
        value = dr.select(u >= 0, values[k], value)
    return value


def _spectrum(values: list[Any]) -> Any:
    return mi.Spectrum(*values) if len(values) > 1 else mi.Spectrum(values[0])
