"""Scattering orders 0 and 1 inside an object, exactly: a walk that is scattered at most once.

From the exit the walk is refracted inwards, passes or is scattered by the phase function, then never again; it is
reflected at the boundary by Fresnel as often as it takes, and leaves. After k = 0, 1 events and a path length Λ

    L_o = T_o L_i f / p,    f = sigma_s^k p(cos)^k exp(-sigma_t Λ),

p the density of the walk; the factors eta² of radiance cancel, and Fresnel's inside with the chance to be reflected.
Whether a segment is passed, and where and how the walk is scattered, is drawn for the channels by their weights f_c so
far. Of events some are drawn nearer the boundary, and of directions some towards it: that light is little attenuated.

Light of emitters and suns that reaches the event after one reflection or none is found by emitter connections: rays
that are refracted towards a sampled point of them, where Newton's method finds some. Connections with an uneven sky,
without reflection, have MIS weights against the phase function. All other light is left to chance, that of delta lights
spread over a cone, see `objects.small_emitters`. The boundary refracts as if it were smooth.

A walk ends where it meets what lies inside the object: the transport has all such paths.

Where light at events was gathered (`precomputed.inner`), the walk passes, and what events along it send is looked up.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import drjit as dr
import mitsuba as mi

from full_geometry.geometry.points import SurfacePoint, lifted, mirrored, opaque, opposed, place, turned
from full_geometry.geometry.rounding import blocked, clear, ray_from, ray_to
from full_geometry.integrators.lighting import RenderContext, delta_light, mis_weight, sample_emitter
from full_geometry.objects.objects import TranslucentObject
from full_geometry.objects.small_emitters import WIDE
from full_geometry.surface.textured import MediumAt
from halfspace_sss.physics.medium import eval_hg, sample_hg

MOST_SEGMENTS = 256
EARLY = 0.5  # probability of an event drawn by twice sigma_t: light has the way out to go as well
OUTWARDS = 0.3  # probability of a direction drawn from those that leave by the boundary behind
FAINT = 0.1  # weight below which a scattered walk may end
GRAZES = 0.05  # cosine at an emitter up to which its points are left to chance: their density over the area goes to 0
FOCUS = 100.0  # of the straight way into solid angle at the event; points of caustics beyond are left to chance
SAME_WAY = 3e-3  # by which points of exit may differ, over the length inside
FAR = 1e4  # distance of what is infinitely far, over the size of the object

# steps of Newton's method and the longest, radians, of the first connection and of others
FIRST, OTHERS = (6, 0.5), (10, 0.15)
TOLERANCE = 2e-4  # distance by which the target may be missed, over its distance

Media = list["tuple[mi.Float, mi.Float, mi.Float]"]  # sigma_s, sigma_t and g of each channel


class RefractedRay(NamedTuple):
    """The ray from an exit into the object."""

    out: SurfacePoint
    d: mi.Vector3f
    T: mi.Float  # Fresnel transmittance
    valid: mi.Bool  # whether there is one
    passing: mi.Float  # probability to go along it to the boundary


class LowOrderSample(NamedTuple):
    """Where a walk leaves the object, and light of emitter connections at its event."""

    p: mi.Point3f
    n: mi.Normal3f
    d: mi.Vector3f
    weight: mi.Spectrum
    connected: mi.Bool  # whether light of emitters along d is in `direct`
    pdf: mi.Float  # of d by the phase function, for the MIS weight of the sky; 1 where no connection leads along d
    emitter_share: mi.Float  # 1 where one does, else 0
    direct: mi.Spectrum
    chance: mi.Spectrum  # of that, what no connection has found
    once: mi.Bool  # whether it was scattered


@dataclass
class _Walk:
    """Loop variables of a walk; once it has `left`, o, d and n are those of the ray outside."""

    o: mi.Point3f
    d: mi.Vector3f
    n: mi.Normal3f  # geometric, outwards
    off: mi.Vector3f  # from o to where a ray is clear of the boundary
    length: mi.Float  # Λ
    inverse_pdf: mi.Float  # 1 / p
    order: mi.UInt32  # k
    cosine: mi.Float  # of the scattering angle
    event: mi.Point3f  # the scattering event
    event_d: mi.Vector3f  # direction of arrival there
    event_n: mi.Normal3f  # of the boundary that was left last, outwards
    event_length: mi.Float  # Λ there
    event_inverse_pdf: mi.Float  # 1 / p there, before the phase function
    reflections: mi.UInt32  # at the boundary, since the event
    left: mi.Bool
    alive: mi.Bool
    medium: MediumAt | tuple[()] = ()  # of the exit, of objects with textures


# ---- The estimator ---------------------------------------------------------------------------------------------------


def sample_low_orders(
    context: RenderContext,
    obj: TranslucentObject,
    refracted: RefractedRay,
    sampler: mi.Sampler,
    scattered: mi.Bool,
    active: mi.Bool,
) -> LowOrderSample:
    """Light that leaves at an exit after at most one scattering event.

    What passes unscattered shows delta lights only if the path has `scattered` before.
    """
    if obj.gathered is not None and obj.gathered.inner is not None:
        return _by_inner_light(context, obj, refracted, sampler, scattered, active)
    with dr.suspend_grad():
        walk = _walk(obj, refracted, sampler, active & refracted.valid)
        once = walk.order == 1
        counts = walk.left & (once if 0 not in obj.low_orders else mi.Bool(True))
        straight, connected = once & (walk.reflections == 0), once & (walk.reflections <= 1)

    # ---- throughput f / p
    if walk.medium:
        of_exit = refracted.out.medium
        if obj.textured is not None:
            of_exit = obj.textured.followed(obj.geometry, refracted.out, active)
        media = _media(obj, of_exit)
    else:
        media = obj.derivatives.coefficients(obj.media)
    f = _contribution(media, walk.length, walk.order, walk.cosine)
    weight = dr.select(counts, f * (walk.inverse_pdf * refracted.T), 0)

    # ---- emitter connections, emission met by chance, delta lights
    direct, chance, lights = mi.Spectrum(0), mi.Spectrum(0), context.lights
    pdf, share, sky = mi.Float(1), mi.Float(0), context.connects_sky(obj)
    if lights.some_local or context.suns or sky:
        at_event = _contribution(media, walk.event_length, mi.UInt32(1), None) * (walk.event_inverse_pdf * refracted.T)
        for light, d in _connected(
            context, (obj, media), walk, dr.select(once, at_event, 0), sampler.next_2d(), sampler, sky, once
        ):
            cosine = dr.dot(walk.event_d, d)
            direct += light * _spectrum([eval_hg(cosine, g) for _, _, g in media])
    if lights.some_shaped or context.suns:
        chance = chance + weight * _met_by_chance(context, obj, walk, sampler, counts & connected)
    if lights.some_delta:
        chance = chance + weight * _spread_lights(context, obj, walk, sampler, counts & (once | scattered))
    if sky:
        pdf, share = _sky_pdf(obj, walk, counts & straight)
    return LowOrderSample(walk.o, walk.n, walk.d, weight, connected, pdf, share, direct + chance, chance, once)


# ---- By gathered light: what events along a ray send is known --------------------------------------------------------

ALONG = 3  # events that are looked up on a segment, a multiple of the channels


def _by_inner_light(
    context: RenderContext, obj: TranslucentObject, refracted: RefractedRay, sampler: mi.Sampler, scattered: mi.Bool,
    active: mi.Bool,
) -> LowOrderSample:  # fmt: skip
    """`sample_low_orders` where light at events was gathered: the walk passes, and order 1 is what it looks up."""
    media = _media(obj, ())
    start = _begun(obj, refracted, active & refracted.valid)

    def step(k: mi.UInt32, sampler: mi.Sampler, walk: _Walk, light: mi.Spectrum) -> tuple:
        met, length = _to_boundary(obj, walk)
        light = dr.select(walk.alive, light + _scattered_along((obj, media), walk, length, sampler), light)
        walk = _meet_boundary((obj, media), replace(walk, length=walk.length + length), met, sampler)
        survival = dr.minimum(dr.max(dr.exp(-_column(media, 1) * walk.length)) * walk.inverse_pdf / FAINT, 1)
        survives = sampler.next_1d() < survival
        walk = replace(
            walk, left=walk.left & survives, alive=walk.alive & survives & (k + 1 < MOST_SEGMENTS),
            inverse_pdf=walk.inverse_pdf / dr.maximum(survival, 1e-30),
        )  # fmt: skip
        return k + 1, sampler, walk, light

    state = (mi.UInt32(0), sampler, start, mi.Spectrum(0))
    walk, light = dr.while_loop(state, lambda k, sampler, walk, light: walk.alive, step, label="passing")[2:]
    counts = walk.left & mi.Bool(0 in obj.low_orders)
    weight = dr.select(counts, dr.exp(-_column(media, 1) * walk.length) * (walk.inverse_pdf * refracted.T), 0)
    direct = dr.select(refracted.valid, light * refracted.T, 0)
    if context.lights.some_delta:
        direct += weight * _spread_lights(context, obj, walk, sampler, counts & scattered)
    no = mi.Bool(False)
    return LowOrderSample(walk.o, walk.n, walk.d, weight, no, mi.Float(1), mi.Float(0), direct, mi.Spectrum(0), no)


def _scattered_along(
    of: tuple[TranslucentObject, Media], walk: _Walk, length: mi.Float, sampler: mi.Sampler
) -> mi.Spectrum:
    """∫ sigma_s exp(-sigma_t (Λ + s)) J ds over a segment, over the density of the walk."""
    (obj, media), n, light = of, len(of[1]), mi.Spectrum(0)
    sigma_s, sigma_t = _column(media, 0), _column(media, 1)
    ends, passed, shift = 1 - dr.exp(-sigma_t * length), dr.exp(-sigma_t * walk.length), sampler.next_1d()

    def look(m: mi.UInt32, light: mi.Spectrum) -> tuple[mi.UInt32, mi.Spectrum]:
        rate, end = media[0][1], ends[0]
        for c in range(1, n):
            rate, end = dr.select(m % n == c, media[c][1], rate), dr.select(m % n == c, ends[c], end)
        u = shift + mi.Float(m) / ALONG
        s = dr.minimum(-dr.log(1 - dr.minimum((u - dr.floor(u)) * end, 1 - 1e-7)) / rate, length)
        density = dr.sum(sigma_t * dr.exp(-sigma_t * s) / dr.maximum(ends, 1e-30)) / n
        J = obj.gathered.inner(walk.o + walk.d * s, walk.d, walk.alive)
        return m + 1, light + sigma_s * dr.exp(-sigma_t * s) * J / dr.maximum(density, 1e-30)

    light = dr.while_loop((mi.UInt32(0), light), lambda m, _: m < ALONG, look, label="events")[1]
    return light * passed * (walk.inverse_pdf / ALONG)


class LightAtEvents(NamedTuple):
    """Light that reaches events without scattering.

    Args:
        connected: by emitter connections, over the density of the emitter, with its direction; of several ways.
        left: walks that have left the object, and how many reflections they have met.
        weight: of them, per unit of the radiance that they meet.
        chance: of that light of emitters, which no connection has found, with the weight.
    """

    connected: list[tuple[mi.Spectrum, mi.Vector3f]]
    left: _Walk
    weight: mi.Spectrum
    chance: mi.Spectrum


def light_at_events(
    context: RenderContext, obj: TranslucentObject, at: tuple[mi.Point3f, mi.Normal3f],
    ways: tuple[mi.Vector3f, mi.Float], u: mi.Point2f, sampler: mi.Sampler,
) -> LightAtEvents:  # fmt: skip
    """Light at places inside an object, along directions and by connections.

    Args:
        context: of the scene.
        obj: the object, of one medium.
        at: places, and outward geometric normals near them.
        ways: directions, and the inverse of their density, sr.
        u: uniform numbers of emitters.
        sampler: of what else is random.
    """
    # ---- the walk has the weight 1 at its event
    (p, n), (d, inverse_pdf) = at, ways
    media, zero = _media(obj, ()), mi.Float(0)
    scale = 1 / dr.maximum(dr.max(_column(media, 0)), 1e-30)
    start = _Walk(
        mi.Point3f(p), mi.Vector3f(d), mi.Normal3f(n), mi.Vector3f(0), zero, 4 * dr.pi * scale, mi.UInt32(1), zero,
        mi.Point3f(p), mi.Vector3f(d), mi.Normal3f(n), zero, mi.Float(1), mi.UInt32(0), mi.Bool(False), mi.Bool(True),
    )  # fmt: skip

    def step(k: mi.UInt32, sampler: mi.Sampler, walk: _Walk) -> tuple:
        met, length = _to_boundary(obj, walk)
        walk = _meet_boundary((obj, media), replace(walk, length=walk.length + length), met, sampler)
        return k + 1, sampler, replace(walk, alive=walk.alive & (k + 1 < MOST_SEGMENTS))

    state = (mi.UInt32(0), sampler, start)
    walk = dr.while_loop(state, lambda k, sampler, walk: walk.alive, step, label="light at events")[2]
    weight = dr.select(walk.left, dr.exp(-_column(media, 1) * walk.length) * (walk.inverse_pdf / scale), 0)
    weight *= inverse_pdf * dr.inv_four_pi

    # ---- emitters beside the sky
    connected, chance, lights = [], mi.Spectrum(0), context.lights
    if lights.some_local or context.suns:
        k = dr.arange(mi.UInt32, dr.width(p)) // BESIDE
        looked = k % RARELY == 0  # lanes beside each other, as those that wait cost as much
        connected = _connected(
            context, (obj, media), walk, mi.Spectrum(1), u, sampler, False, mi.Bool(True), (looked, RARELY)
        )
    if lights.some_shaped or context.suns:
        chance += weight * _met_by_chance(context, obj, walk, sampler, walk.left & (walk.reflections <= 1))
    if lights.some_delta:
        chance += weight * _spread_lights(context, obj, walk, sampler, walk.left)
    return LightAtEvents(connected, walk, weight, chance)


# ---- The walk --------------------------------------------------------------------------------------------------------


def _walk(obj: TranslucentObject, refracted: RefractedRay, sampler: mi.Sampler, active: mi.Bool) -> _Walk:
    """The walk from an exit until it leaves."""
    media, start = _media(obj, refracted.out.medium), _begun(obj, refracted, active)

    def step(k: mi.UInt32, sampler: mi.Sampler, passing: mi.Float, walk: _Walk) -> tuple:
        own = _media(obj, walk.medium) if walk.medium else media
        return k + 1, sampler, passing, _step((obj, own), k, sampler, passing, walk)

    state = (mi.UInt32(0), sampler, mi.Float(refracted.passing), start)
    return dr.while_loop(state, lambda k, sampler, passing, walk: walk.alive, step, label="low orders")[3]


def _begun(obj: TranslucentObject, refracted: RefractedRay, active: mi.Bool) -> _Walk:
    """A walk at the exit."""
    zero, p = mi.Float(0), mi.Point3f(refracted.out.p)
    off = clear(refracted.out.n, refracted.d, obj.geometry.clearance)
    return _Walk(
        p, mi.Vector3f(refracted.d), mi.Normal3f(refracted.out.n), off, zero, mi.Float(1), mi.UInt32(0),
        zero, mi.Point3f(p), mi.Vector3f(refracted.d), mi.Normal3f(refracted.out.n), zero, zero, mi.UInt32(0),
        mi.Bool(False), mi.Bool(active), refracted.out.medium,
    )  # fmt: skip


def _to_boundary(obj: TranslucentObject, walk: _Walk) -> tuple[tuple, mi.Float]:
    """What a walk meets at the boundary, as of `meet`, and how far away."""
    flags = mi.RayFlags.Minimal | mi.RayFlags.ShadingFrame
    si, n_out, n = meet(obj, walk.o + walk.off, walk.d, flags, walk.alive)
    return (si, n_out, n), dr.maximum(si.t + dr.dot(walk.off, walk.d), 0)


def _media(obj: TranslucentObject, medium: MediumAt | tuple[()]) -> Media:
    """The medium of each channel: that of the exit, or of the object where it has no textures."""
    if not medium:
        return [tuple(opaque(v) for v in (m.sigma_s, m.sigma_t, m.g)) for m in obj.media]
    g = medium.g if len(medium.g) else [opaque(m.g) for m in obj.media]
    return [(a * t, t, each) for a, t, each in zip(medium.albedo, medium.sigma_t, g)]


def _step(
    of: tuple[TranslucentObject, Media], k: mi.UInt32, sampler: mi.Sampler, passing: mi.Float, walk: _Walk
) -> _Walk:
    """One segment: to the event, or to the boundary and what happens there."""
    obj, media = of
    (si, n_out, n), length = _to_boundary(obj, walk)
    W = _contribution(media, walk.length, walk.order, walk.cosine) * walk.inverse_pdf
    T = dr.select(si.is_valid(), dr.exp(-_column(media, 1) * length), 0)
    passing = dr.select(k == 0, passing, dr.sum(W * T) / dr.maximum(dr.sum(W), 1e-30))
    first = walk.order == 0
    scatters = first & (sampler.next_1d() >= passing)
    scattered = _scatter(of, walk, (W, 1 - T), dr.maximum(1 - passing, 1e-7), sampler)
    met = replace(
        walk, length=walk.length + length, inverse_pdf=walk.inverse_pdf / dr.select(first, passing, 1)
    )  # fmt: skip
    met = _meet_boundary(of, met, (si, n_out, n), sampler)
    met.alive &= ~walk.left & (k + 1 < MOST_SEGMENTS)
    new = dr.select(scatters, scattered, met)
    ended = _blocked(obj, walk.o, walk.d, new.length - walk.length, walk.alive)
    return dr.select(ended, replace(walk, alive=mi.Bool(False)), new)


def _blocked(obj: TranslucentObject, p: mi.Point3f, d: mi.Vector3f, length: mi.Float, active: mi.Bool) -> mi.Bool:
    """Whether something inside the object lies on a way from p."""
    inclusions = obj.geometry.inclusions
    return mi.Bool(False) if inclusions is None else inclusions.reach(p, d, length, active)[1]


def _scatter(
    of: tuple[TranslucentObject, Media], walk: _Walk, weights: tuple[mi.Spectrum, mi.Spectrum], scattering: mi.Float,
    sampler: mi.Sampler,
) -> _Walk:  # fmt: skip
    """The event on this segment, which happens with the probability `scattering`.

    `weights` are f_c / p and the chance of channel c to be scattered on the segment.
    """
    # ---- distance s by once or twice the coefficient of a channel; density by the mean over both and channels
    (obj, media), (W, ends) = of, weights
    sigma_t, g = _column(media, 1), _column(media, 2)
    u, v, channel, chance = sampler.next_1d(), sampler.next_2d(), sampler.next_2d(), W * ends
    rate, end = dr.maximum(_pick(sigma_t, chance, channel.x), 1e-12), _pick(ends, chance, channel.x)
    early = sampler.next_1d() < EARLY
    rate, end = rate * dr.select(early, 2, 1.0), end * dr.select(early, 2 - end, 1.0)
    s = -dr.log(1 - u * dr.minimum(end, 1 - 1e-7)) / rate
    passed = dr.exp(-sigma_t * s)
    density = W * sigma_t * passed * (1 - EARLY + 2 * EARLY * passed / (2 - ends))
    density = dr.sum(density) / dr.maximum(dr.sum(chance), 1e-30) * scattering
    inverse_pdf = walk.inverse_pdf / dr.maximum(density, 1e-30)

    # ---- direction by the phase function of a channel, or outwards; density likewise
    W = _contribution(media, walk.length + s, mi.UInt32(1), None) * inverse_pdf
    outwards, least = sampler.next_1d() < OUTWARDS, _least_outwards(obj)
    cosine = dr.select(outwards, 1 - v.x * (1 - least), sample_hg(v.x, _pick(g, W, channel.y)))
    sine, (sin_phi, cos_phi) = dr.safe_sqrt((1 - cosine) * (1 + cosine)), dr.sincos(2 * dr.pi * v.y)
    axis = dr.select(outwards, mi.Vector3f(walk.n), walk.d)
    d = mi.Frame3f(axis).to_world(mi.Vector3f(sine * cos_phi, sine * sin_phi, cosine))
    p, length = mi.Point3f(walk.o + walk.d * s), walk.length + s
    pdf = _direction_pdf(of, W, dr.dot(walk.d, d), dr.dot(walk.n, d))
    return replace(
        walk, o=p, d=mi.Vector3f(d), off=mi.Vector3f(0), length=length,
        inverse_pdf=inverse_pdf / dr.maximum(pdf, 1e-30), order=mi.UInt32(1), cosine=mi.Float(dr.dot(walk.d, d)),
        event=p, event_d=mi.Vector3f(walk.d), event_n=mi.Normal3f(walk.n), event_length=length,
        event_inverse_pdf=inverse_pdf, reflections=mi.UInt32(0),
        alive=walk.alive & (dr.sum(W) > 0) & (dr.sum(chance) > 0),
    )  # fmt: skip


def _least_outwards(obj: TranslucentObject) -> mi.Float:
    """The cosine to the normal from which on a flat boundary lets light out."""
    return dr.safe_sqrt(1 - 1 / dr.square(obj.eta))


def _direction_pdf(
    of: tuple[TranslucentObject, Media], W: mi.Spectrum, cosine: mi.Float, outwards: mi.Float
) -> mi.Float:
    """Density of the direction of an event, 1/sr.

    Args:
        W: weights of the channels.
        cosine, outwards: of the direction to that of arrival and to the normal outwards.
    """
    (obj, media) = of
    least = _least_outwards(obj)
    phase = dr.sum(W * _spectrum([eval_hg(cosine, m[2]) for m in media])) / dr.maximum(dr.sum(W), 1e-30)
    return (1 - OUTWARDS) * phase + dr.select(outwards > least, OUTWARDS / (2 * dr.pi * (1 - least)), 0)


def _meet_boundary(of: tuple[TranslucentObject, Media], walk: _Walk, met: tuple, sampler: mi.Sampler) -> _Walk:
    """Reflection by Fresnel, or the way out; Russian roulette for what is faint."""
    (obj, media), (si, n_out, n) = of, met
    size = dr.max(_contribution(media, walk.length, walk.order, walk.cosine) * walk.inverse_pdf)
    survival = dr.select(walk.order == 1, dr.minimum(size / FAINT, 1), 1)
    frame = mi.Frame3f(lifted(n_out, n, walk.d))
    w = frame.to_local(-walk.d)
    F, cos_t, _, eta_ti = mi.fresnel(mi.Frame3f.cos_theta(w), obj.eta)
    reflects = sampler.next_1d() < F
    back = -mirrored(-frame.to_world(mi.reflect(w)), n)
    onward = opposed(frame.to_world(mi.refract(w, cos_t, eta_ti)), n)
    d, leaves = mi.Vector3f(dr.select(reflects, back, onward)), ~reflects
    alive = walk.alive & si.is_valid() & (dr.dot(n, walk.d) > 0) & (sampler.next_1d() < survival)
    return replace(
        walk, o=mi.Point3f(si.p), d=d, n=mi.Normal3f(n), off=clear(n, d, obj.geometry.clearance), left=alive & leaves,
        reflections=walk.reflections + dr.select(leaves, 0, mi.UInt32(1)), alive=alive & ~leaves,
        inverse_pdf=walk.inverse_pdf / dr.maximum(survival, 1e-30),
    )  # fmt: skip


def meet(
    obj: TranslucentObject, p: mi.Point3f, d: mi.Vector3f, flags: int, active: mi.Bool
) -> tuple[mi.SurfaceInteraction3f, mi.Normal3f, mi.Normal3f]:
    """Interaction with the boundary, shading normal and geometric normal, both outwards (along d for a sheet)."""
    flags = flags | mi.RayFlags.All if obj.wrapping.bend is not None else flags
    si = obj.geometry.ray_intersect(mi.Ray3f(mi.Point3f(p), d), flags, False, active)
    si = obj.wrapping.bent(si, active & si.is_valid())
    sign = obj.geometry.side(si.prim_index, active & si.is_valid())
    if not obj.geometry.closed:
        sign = dr.select(dr.dot(si.n, d) > 0, 1.0, -1.0)
    return si, turned(si.sh_frame.n, si.n) * sign, si.n * sign


def _contribution(media: Media, length: mi.Float, order: mi.UInt32, cosine: mi.Float | None) -> mi.Spectrum:
    """f = sigma_s^k p(cos)^k exp(-sigma_t Λ); without the phase function where there is no cosine."""
    values = []
    for sigma_s, sigma_t, g in media:
        once = sigma_s if cosine is None else sigma_s * eval_hg(cosine, g)
        values.append(dr.select(order == 1, once, 1) * dr.exp(-sigma_t * length))
    return _spectrum(values)


def _pick(values: mi.Spectrum, weights: mi.Spectrum, u: mi.Float) -> mi.Float:
    """The value of a channel drawn by its weight, for a uniform number."""
    u, value = u * dr.sum(weights), values[0]
    for k in range(1, len(values)):
        u = u - weights[k - 1]
        value = dr.select(u >= 0, values[k], value)
    return value


def _column(media: Media, k: int) -> mi.Spectrum:
    return _spectrum([m[k] for m in media])


def _spectrum(values: list[mi.Float]) -> mi.Spectrum:
    return mi.Spectrum(*values) if len(values) > 1 else mi.Spectrum(values[0])


# ---- Light: emitter connections, and what they do not find -----------------------------------------------------------


class _Target(NamedTuple):
    """A sampled point of an emitter."""

    ds: mi.DirectionSample3f  # from the event
    light: mi.Spectrum  # over the density
    p: mi.Point3f
    reach: mi.Float  # its distance
    alone: mi.Bool  # whether no other strategy counts its light


@dataclass
class _Way:
    """Where light of a target passes from the event: the direction and length inside, and what passes."""

    d: mi.Vector3f
    length: mi.Float
    passed: mi.Float  # over the density of the target; times the trials of `_ways`


def _connected(
    context: RenderContext, of: tuple[TranslucentObject, Media], walk: _Walk, weight: mi.Spectrum, u: mi.Point2f,
    sampler: mi.Sampler, sky: bool, active: mi.Bool, others: tuple[mi.Bool | bool, float] = (True, 1.0),
) -> list[tuple[mi.Spectrum, mi.Vector3f]]:  # fmt: skip
    """Light of a sampled emitter that reaches the event, which has a weight, by refraction or one reflection more.

    Of each way the light, without the phase function, and its direction at the event; of the `sky` too if asked for.
    `others` says where ways that no straight line leads to are looked for, and how much they count there.
    """
    obj, media = of
    at = place(walk.event, mi.Normal3f(0, 0, 0), walk.medium)
    ds, light = sample_emitter(context, at, u, False, active)
    with dr.suspend_grad():
        distant = mi.has_flag(ds.emitter.flags(), mi.EmitterFlags.Infinite)
        alone = context.sampled_by_nee(ds.emitter, ds.d)
        active = active & (ds.pdf > 0)
        reach = dr.select(distant, opaque(FAR * obj.geometry.size), ds.dist)
        target = _Target(ds, light, walk.event + ds.d * reach, reach, alone)
        first = active & (alone | mi.Bool(sky))
        if context.lights.some_local or context.suns:
            near = active & alone & others[0] & _near(obj, walk, target.p, active)
            straight, *bent = _ways(context, obj, walk, weight, target, (first, near), sampler)
            ways = [straight, *(replace(way, passed=way.passed * others[1]) for way in bent)]
        else:
            ways = [_way(context, obj, walk, target, refracted_connection(obj, walk.event, target.p, first))]
    return [(_light_along(media, weight, target, way), way.d) for way in ways]


def _light_along(media: Media, weight: mi.Spectrum, target: _Target, way: _Way) -> mi.Spectrum:
    """Light of a target that reaches the event, which has a weight, without the phase function."""
    value = weight * _contribution(media, way.length, mi.UInt32(0), None) * way.passed * target.light
    return dr.select(way.passed > 0, value, 0)


def _way(context: RenderContext, obj: TranslucentObject, walk: _Walk, target: _Target, met: Connection) -> _Way:
    """The way of light of a target by its connection with the event."""
    # ---- solid angle at the event per solid angle of the straight direction, over which the emitter was sampled
    ds, alone, reach = target.ds, target.alone, target.reach
    facing = dr.select(dr.squared_norm(ds.n) > 0, dr.abs(dr.dot(ds.n, met.w)) / dr.abs(dr.dot(ds.n, ds.d)), 1)
    valid = met.valid & (ds.delta | ~alone | _is_sampled(walk.event, target.p, ds.n, met))
    valid &= dr.dot(ds.n, met.w) <= 0
    spread = dr.select(ds.delta | ~alone, 1, facing) * reach * reach * met.density
    weight_sky = mis_weight(ds.pdf, _phase_pdf(obj, walk, met) * met.T * spread)
    shadow = ray_to(
        place(met.p, met.n), target.p, obj.geometry.clearance, context.instance_scene.rounding_of(ds.emitter)
    )
    valid &= ~blocked(context.scene, shadow, valid)
    passed = dr.select(valid, met.T * spread * dr.select(alone, 1, weight_sky), 0)
    return _Way(mi.Vector3f(met.d), mi.Float(met.length), passed)


def _phase_pdf(obj: TranslucentObject, walk: _Walk, met: Connection) -> mi.Float:
    """Density of the direction of a connection by chance, 1/sr inside, see `_scatter`."""
    media = _media(obj, walk.medium)
    W = _contribution(media, walk.event_length, mi.UInt32(1), None)
    return _direction_pdf((obj, media), W, dr.dot(walk.event_d, met.d), dr.dot(walk.event_n, met.d))


def _sky_pdf(obj: TranslucentObject, walk: _Walk, active: mi.Bool) -> tuple[mi.Float, mi.Float]:
    """Density of a walk's direction outside, 1/sr, and 1, where a sky connection leads along it; elsewhere 1, 0."""
    with dr.suspend_grad():
        reach = opaque(FAR * obj.geometry.size)
        met = refracted_connection(obj, walk.event, walk.event + walk.d * reach, active)
        same = active & _leaves(obj, met, walk.o, SAME_WAY)
        pdf = _phase_pdf(obj, walk, met) * met.T * reach * reach * met.density
    return dr.select(same, pdf, 1), dr.select(same, mi.Float(1), 0)


def _met_by_chance(
    context: RenderContext, obj: TranslucentObject, walk: _Walk, sampler: mi.Sampler, active: mi.Bool
) -> mi.Spectrum:
    """Emission that a walk meets from its event, which no connection with that point of an emitter would find."""
    with dr.suspend_grad():
        ray = ray_from(place(walk.o, walk.n, walk.medium), walk.d, obj.geometry.clearance)
        si = context.ray_intersect(ray, False, active)
        emitter = si.emitter(context.scene, active)
        active = active & (emitter != None) & context.sampled_by_nee(emitter, walk.d)  # noqa: E711
        target = mi.Point3f(dr.select(si.is_valid(), si.p, walk.event + walk.d * opaque(FAR * obj.geometry.size)))
        n = dr.select(si.is_valid(), si.n, 0)
        met = _taken(obj, walk, target, SAME_WAY, sampler, active)
        sampled = met.valid & _is_sampled(walk.event, target, n, met)
    return dr.select(active & ~sampled, emitter.eval(si, active), 0)


def _spread_lights(
    context: RenderContext, obj: TranslucentObject, walk: _Walk, sampler: mi.Sampler, active: mi.Bool
) -> mi.Spectrum:
    """Light of a delta light whose cone holds a walk's way out, which no connection with it would find."""
    ray = ray_from(place(walk.o, walk.n, walk.medium), walk.d, obj.geometry.clearance)
    which, L = delta_light(context, sampler, ray, active)
    with dr.suspend_grad():
        connects = active & (dr.max(L) > 0) & (walk.order == 1)
        target = context.small.point(which, walk.event, FAR * obj.geometry.size)
        met = _taken(obj, walk, target, 3 * WIDE, sampler, connects)
    return dr.select(met.valid, 0, L)


def _leaves(obj: TranslucentObject, met: Connection, x: mi.Point3f, tolerance: float) -> mi.Bool:
    """Whether a connection leaves through a point of the boundary, up to a share of its length, and to rounding."""
    apart = dr.norm(mi.Point3f(met.p) - x)
    return met.valid & (apart <= tolerance * met.length + obj.geometry.clearance)


def _is_sampled(event: mi.Point3f, p: mi.Point3f, n: mi.Normal3f, met: Connection) -> mi.Bool:
    """Whether light of the point p of an emitter, with the normal n, comes by its connection with the event."""
    way = p - event
    return _faces(n, dr.normalize(way)) & (dr.squared_norm(way) * met.density < FOCUS)


def _faces(n: mi.Normal3f, d: mi.Vector3f) -> mi.Bool:
    """Whether a point of an emitter with the normal n is seen along d straight from the front; all are without n."""
    return (dr.dot(n, d) < -GRAZES) | (dr.squared_norm(n) == 0)


# ---- Other connections, from random directions ----------------------------------------------------------------------
#
# Many rays from an event may be refracted towards a point outside, with or without a reflection before. Newton's method
# finds one of them, m, with a probability q_m over random directions d_1, d_2, ... that it starts from (specular
# manifold sampling, Zeltner, Georgiev and Jakob 2020). With T the trials until m is found again, at most N of them,
#
#     E[min(T, N)] = (1 - (1 - q_m)^N) / q_m,
#
# so that light along what d_1 leads to, times min(T, N), is the share 1 - (1 - q_m)^N of all. The rest is light met by
# chance, counted where N other directions do not lead to it. Chance and connections agree whatever the directions are
# drawn from; q_m decides how much is left to chance.

TRIALS = 32  # N
SPREAD = (20.0, 2.0)  # concentrations of directions about the first guess
NEAR = 4.0  # mean free paths of the straight way to the boundary, beyond which other connections are left to chance
RARELY, BESIDE = 8, 64  # of gathered events one in so many, and lanes beside it, as other ways bring 1 % of the light
MIRRORED = 0.5  # probability to start as a flat boundary would reflect


def _ways(
    context: RenderContext, obj: TranslucentObject, walk: _Walk, weight: mi.Spectrum, target: _Target,
    looks: tuple[mi.Bool, mi.Bool], sampler: mi.Sampler,
) -> list[_Way]:  # fmt: skip
    """The ways of light of a target: from the first guess, and from random directions, without and with a reflection.

    One loop over all, so that a kernel holds Newton's method once. `looks` says where it looks for the first, and for
    the others. Which are looked for again is decided by the medium itself, also where another is differentiated by.
    """
    media = _media(obj, walk.medium)

    def step(
        kind: mi.UInt32, n: mi.UInt32, sampler: mi.Sampler, counted: mi.Float, seen: tuple, way: _Way, ways: list[_Way]
    ) -> tuple:
        """Trial n of a kind of way: the first finds one, others look for it again."""
        first, other, (straight, p) = n == 0, kind > 0, seen
        met = _trial(obj, walk.event, target.p, kind == 2, other, sampler, dr.select(other, looks[1], looks[0]))

        # ---- one that is found; the fainter, the fewer are looked for again
        new = met.valid & first & ~(other & _leaves(obj, straight, met.p, SAME_WAY))
        way = dr.select(first, _way(context, obj, walk, target, replace(met, valid=new)), way)
        lit = dr.max(_light_along(media, weight, target, way)) > 0
        share = dr.minimum(met.T * dr.exp(-dr.min(_column(media, 1)) * met.length) / FAINT, 1)
        again = first & other & lit & (sampler.next_1d(first & other) < share)
        counted, p = dr.select(first, share, counted), dr.select(first, met.p, p)
        straight = dr.select(other, straight, met)

        # ---- it counts as often as it took to be found again
        ends = dr.select(first, ~again, _leaves(obj, met, p, SAME_WAY) | (n == TRIALS))
        times = dr.select(other, dr.select(first, 0, mi.Float(n) / counted), 1)
        done = replace(way, passed=dr.select(times > 0, way.passed * times, 0))
        ways = [dr.select(ends & (kind == k), done, known) for k, known in enumerate(ways)]
        kind, n = dr.select(ends, kind + 1, kind), dr.select(ends, 0, n + 1)
        return kind, n, sampler, counted, (straight, p), way, ways

    def none() -> _Way:
        return _Way(mi.Vector3f(0, 0, 1), mi.Float(0), mi.Float(0))

    seen = _no_connection(), mi.Point3f(0)
    state = (mi.UInt32(0), mi.UInt32(0), sampler, mi.Float(1), seen, none(), [none(), none(), none()])
    return dr.while_loop(state, lambda kind, *_: kind < 3, step, label="ways")[-1]


def _taken(
    obj: TranslucentObject, walk: _Walk, target: mi.Point3f, tolerance: float, sampler: mi.Sampler, active: mi.Bool
) -> Connection:
    """The connection by which a walk has left its event, if one is found; without, it is met by chance alone."""
    near, reflected = _near(obj, walk, target, active), walk.reflections == 1

    def step(n: mi.UInt32, sampler: mi.Sampler, found: Connection, active: mi.Bool) -> tuple:
        met = _trial(obj, walk.event, target, reflected, n > 0, sampler, active)
        met = replace(met, valid=_leaves(obj, met, walk.o, tolerance))
        return n + 1, sampler, dr.select(active, met, found), active & ~met.valid & near & (n < TRIALS)

    # the first guess is without a reflection
    active = active & ((walk.reflections == 0) | (reflected & near))
    state = (dr.select(reflected, mi.UInt32(1), 0), sampler, _no_connection(), mi.Bool(active))
    return dr.while_loop(state, lambda n, sampler, found, active: active, step, label="trials")[2]


def _near(obj: TranslucentObject, walk: _Walk, target: mi.Point3f, active: mi.Bool) -> mi.Bool:
    """Whether other connections are looked for: where light of the target is likely to be seen."""
    if obj.geometry.inclusions is not None:
        return mi.Bool(False)
    ray = mi.Ray3f(walk.event, dr.normalize(target - walk.event))
    ray.maxt = NEAR / (dr.min(walk.medium.sigma_t) if walk.medium else opaque(min(m.sigma_t for m in obj.media)))
    return obj.geometry.ray_test(ray, False, active)


def _trial(
    obj: TranslucentObject, p: mi.Point3f, target: mi.Point3f, reflects: mi.Bool, random: mi.Bool, sampler: mi.Sampler,
    active: mi.Bool,
) -> Connection:  # fmt: skip
    """A connection from the first guess, or a `random` direction: about the guess, or where it reflects from any."""
    v, u, toward = sampler.next_1d(random), sampler.next_2d(random), dr.normalize(target - p)
    d = mi.warp.square_to_uniform_sphere(u)
    si, n, _ = meet(obj, p, dr.select(reflects, d, toward), mi.RayFlags.Minimal | mi.RayFlags.ShadingFrame, active)
    guess = _refracted_inwards(obj, n, toward)
    about = mi.warp.square_to_von_mises_fisher(u, dr.select(v < 0.5, mi.Float(SPREAD[0]), SPREAD[1]))
    mirror = dr.normalize(target - (p + n * (2 * dr.dot(si.p - p, n))))
    d = dr.select(v < MIRRORED, mirror - n * (2 * dr.dot(mirror, n)), d)
    start = dr.select(reflects, d, dr.select(random, mi.Frame3f(guess).to_world(about), guess))
    newton = dr.select(random, mi.UInt32(OTHERS[0]), FIRST[0]), dr.select(random, mi.Float(OTHERS[1]), FIRST[1])
    met = _connect(obj, p, target, start, reflects, newton, active & (~reflects | si.is_valid()))
    return replace(met, valid=met.valid & ~_blocked(obj, p, met.d, met.length, met.valid))


# ---- Specular connections: Newton's method ---------------------------------------------------------------------------
#
# In the spirit of Walter, Zhao, Holzschuch and Bala 2009: the direction at the event is moved by Newton's method until
# the refracted ray meets the target. The derivatives of reflected and refracted rays (Igehy 1999) contain the curvature
# of the shading normals. Without reflection one solution is looked for, from where the straight ray meets the boundary:
# light that reaches the event along several refracted rays is counted once, and where Newton's method fails the light
# is lost. The curvature of normal and bump maps is left out of derivatives, so that they focus no light.


@dataclass
class Connection:
    """A specular connection of a point inside with a point outside."""

    p: mi.Point3f  # where it leaves
    n: mi.Normal3f  # geometric, outwards
    d: mi.Vector3f  # direction inside, at the point inside
    w: mi.Vector3f  # direction outside
    T: mi.Float  # Fresnel transmittance, times the reflectance where it is reflected
    length: mi.Float  # inside
    density: mi.Float  # solid angle inside per area across the ray at the target
    valid: mi.Bool


def _no_connection() -> Connection:
    p, n, d = mi.Point3f(0), mi.Normal3f(0, 0, 1), mi.Vector3f(0, 0, 1)
    return Connection(p, n, d, mi.Vector3f(d), mi.Float(0), mi.Float(0), mi.Float(0), mi.Bool(False))


def refracted_connection(obj: TranslucentObject, p: mi.Point3f, target: mi.Point3f, active: mi.Bool) -> Connection:
    """The ray from p inside the object that is refracted towards `target` outside, found from the first guess."""
    toward = dr.normalize(target - p)
    _, n, _ = meet(obj, p, toward, mi.RayFlags.Minimal | mi.RayFlags.ShadingFrame, active)
    start = _refracted_inwards(obj, n, toward)
    met = _connect(obj, p, target, start, False, FIRST, active)
    return replace(met, valid=met.valid & ~_blocked(obj, p, met.d, met.length, met.valid))


def _connect(
    obj: TranslucentObject, p: mi.Point3f, target: mi.Point3f, start: mi.Vector3f, reflects: mi.Bool | bool,
    newton: tuple, active: mi.Bool,
) -> Connection:  # fmt: skip
    """A ray from p inside the object, reflected once or not, then refracted towards `target`; found from `start`.

    `newton` are the number of its steps and the longest. Where `reflects` is False itself, code for it is left out.
    """

    steps, longest = newton

    def step(k: mi.UInt32, d: mi.Vector3f, best: Connection, active: mi.Bool) -> tuple:
        # ---- J step = e in two axes
        e, J, met, valid = _miss(obj, p, d, target, reflects, active)
        (a, b), (c, f) = J
        det = a * f - b * c
        inverse = dr.rcp(dr.select(dr.abs(det) > 1e-12, det, 1e-12))
        step_1, step_2 = (f * e[0] - b * e[1]) * inverse, (a * e[1] - c * e[0]) * inverse
        size = dr.sqrt(step_1 * step_1 + step_2 * step_2)
        shrink = dr.minimum(1, longest / dr.maximum(size, 1e-9))

        # ---- keep it where it is close; go on where it is not exact
        miss = dr.sqrt(e[0] * e[0] + e[1] * e[1])
        close = valid & (miss < TOLERANCE * dr.norm(target - mi.Point3f(met[0])))
        at, n, w, T, length = met
        new = Connection(at, n, d, w, T, length, 1 / dr.maximum(dr.abs(det), 1e-12), close)
        best = dr.select(active & close, new, best)
        e_1, e_2 = mi.coordinate_system(d)
        moved = dr.normalize(d + (e_1 * step_1 + e_2 * step_2) * shrink)
        active = active & valid & (~close | (miss > 1e-5 * dr.norm(target - p))) & (k + 1 < steps)
        return k + 1, dr.select(active, moved, d), best, active

    state = (mi.UInt32(0), mi.Vector3f(start), _no_connection(), mi.Bool(active))
    best = dr.while_loop(state, lambda k, d, best, active: active, step, label="connection")[2]
    return replace(best, valid=best.valid & active)


def _refracted_inwards(obj: TranslucentObject, n: mi.Normal3f, w: mi.Vector3f) -> mi.Vector3f:
    """The direction inside, from the event, of light that arrives along -w where the normal outwards is n."""
    across = (w - n * dr.dot(w, n)) / obj.eta
    return dr.normalize(across + n * dr.sqrt(dr.maximum(1 - dr.squared_norm(across), 1e-4)))


_Steps = list["tuple[mi.Vector3f, mi.Vector3f]"]  # differentials of a ray's origin and direction, by two axes


def _miss(
    obj: TranslucentObject, p: mi.Point3f, d: mi.Vector3f, target: mi.Point3f, reflects: mi.Bool | bool, active: mi.Bool
) -> tuple[tuple, tuple, tuple, mi.Bool]:
    """Miss of the target in two axes across the ray outside, its derivative by d, the passage, and its validity.

    With dw across d, t the length and d' = -d reflected:

        dx = (1 - d n / (d.n)) (dx + t dd),    dn = n_u du + n_v dv,
        reflected  d - 2 (d.n) n,              refracted  eta d + (c_t - eta c) n.
    """
    # ---- to the boundary, if reflected twice
    zero, T, length, off, valid = mi.Vector3f(0), mi.Float(1), mi.Float(0), mi.Vector3f(0), mi.Bool(active)
    steps, o = [(zero, mi.Vector3f(e)) for e in mi.coordinate_system(d)], p
    if reflects is not False:
        t, (si, n_out, n), arrived = _arrive(obj, o, d, off, steps, valid & reflects)
        c = dr.dot(d, n_out)
        dc = [dr.dot(dd, n_out) + dr.dot(d, dn) for _, dd, dn in arrived]
        onward = [(dx, dd - 2 * (n_out * k + dn * c)) for (dx, dd, dn), k in zip(arrived, dc)]
        F, back = mi.fresnel(dr.maximum(c, 0), 1 / obj.eta)[0], d - n_out * (2 * c)
        valid &= ~reflects | (si.is_valid() & (c > 0) & (dr.dot(back, n) < 0))
        T, length = dr.select(reflects, F, 1), dr.select(reflects, t, 0)
        off = dr.select(reflects, clear(n, back, obj.geometry.clearance), 0)
        o, d = dr.select(reflects, si.p, o), dr.select(reflects, back, d)
        steps = [tuple(dr.select(reflects, x, y) for x, y in zip(*pair)) for pair in zip(onward, steps)]
    t, (si, n_out, n), steps = _arrive(obj, o, d, off, steps, valid)

    # ---- refracted ray, and its differentials
    w, F, passes = _refract(obj, d, n_out)
    eta, c = obj.eta, dr.dot(d, n_out)
    c_t = dr.sqrt(dr.maximum(1 - eta * eta * (1 - c * c), 1e-6))
    D, f, columns = dr.dot(target - si.p, w), mi.coordinate_system(w), []
    for dx, dd, dn in steps:
        dc = dr.dot(dd, n_out) + dr.dot(d, dn)
        dw = eta * dd + dn * (c_t - eta * c) + n_out * (eta * eta * c * dc / c_t - eta * dc)
        moved = dx + dw * D
        columns.append((dr.dot(f[0], moved), dr.dot(f[1], moved)))
    miss = target - (si.p + w * D)
    e = (dr.dot(f[0], miss), dr.dot(f[1], miss))
    J = ((columns[0][0], columns[1][0]), (columns[0][1], columns[1][1]))
    valid = valid & passes & si.is_valid() & (D > 0) & (dr.dot(w, n) > 0)
    return e, J, (mi.Point3f(si.p), mi.Normal3f(n), mi.Vector3f(w), T * (1 - F), length + t), valid


def _arrive(
    obj: TranslucentObject, o: mi.Point3f, d: mi.Vector3f, off: mi.Vector3f, steps: _Steps, active: mi.Bool
) -> tuple[mi.Float, tuple, list[tuple]]:
    """Length of a ray inside, where it meets the boundary as of `meet`, and differentials dx, dd, dn there."""
    si, n_out, n = met = meet(obj, o + off, d, mi.RayFlags.All | mi.RayFlags.dNSdUV, active)
    t, found = dr.maximum(si.t + dr.dot(off, d), 0), []
    flip = dr.select(dr.dot(si.sh_frame.n, n_out) > 0, 1.0, -1.0) * obj.geometry.curvature_sign
    for dx, dd in steps:
        dx = dx + dd * t
        dx = dx - d * (dr.dot(dx, n) / dr.dot(d, n))
        du, dv = _surface_steps(si, dx)
        found.append((dx, dd, (si.dn_du * du + si.dn_dv * dv) * flip))
    return t, met, found


def _refract(obj: TranslucentObject, d: mi.Vector3f, n: mi.Normal3f) -> tuple[mi.Vector3f, mi.Float, mi.Bool]:
    """Direction outside, Fresnel reflectance, and whether light passes, for a ray inside along d."""
    eta = obj.eta
    c = dr.dot(d, n)
    c_t2 = 1 - eta * eta * (1 - c * c)
    F = mi.fresnel(dr.maximum(c, 0), 1 / eta)[0]
    w = eta * d + n * (dr.safe_sqrt(c_t2) - eta * c)
    return dr.normalize(w), F, (c > 0) & (c_t2 > 0)


def _surface_steps(si: mi.SurfaceInteraction3f, dx: mi.Vector3f) -> tuple[mi.Float, mi.Float]:
    """(du, dv) with dp_du du + dp_dv dv = dx; 0 where the shape has no parametrisation."""
    a, b, c = dr.dot(si.dp_du, si.dp_du), dr.dot(si.dp_du, si.dp_dv), dr.dot(si.dp_dv, si.dp_dv)
    p, q = dr.dot(si.dp_du, dx), dr.dot(si.dp_dv, dx)
    det = a * c - b * b
    inverse = dr.select(det > 1e-14 * a * c, dr.rcp(det), 0)
    return (c * p - b * q) * inverse, (a * q - b * p) * inverse
