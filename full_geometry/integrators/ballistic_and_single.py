"""Ballistic and single scattering inside an object, orders 0 and 1, exactly: a walk that is scattered at most once.

From the exit the walk is refracted inwards, passes or is scattered by the phase function, then never again; it is
reflected at the boundary by Fresnel as often as it takes, and leaves. After k = 0, 1 events and a path length Λ

    L_o = T_o L_i f / p,    f = sigma_s^k p(cos)^k exp(-sigma_t Λ),

p the density of the walk; the factors eta² of radiance cancel, and Fresnel's inside with the probability of reflection.
Whether a segment is passed, and where and how the walk is scattered, is drawn for the channels by their weights f_c so
far. Some events are drawn nearer the boundary, and some directions towards it: that light is little attenuated.
This is no `walk.random_walk`, whose free flights mostly end in events that are scattered again and count nothing: with
at most one event that has 1.8 to 11 times the variance x time of this on five of six test scenes, and 0.3 on a dark
bunny under a large lamp.

Light of emitters and suns that reaches the event after one reflection or none is found by emitter connections: rays
that are refracted towards a sampled point of them, see `specular_connections`. Connections with an uneven environment,
without reflection, have MIS weights against phase sampling. All other light is left to phase sampling, that of delta
lights spread over a cone, see `objects.small_emitters`. The boundary refracts as if it were smooth.

A walk ends where it meets what lies inside the object: the transport has all such paths.

Where light at events was gathered (`precomputed.inner`), the walk passes, and what events along it send is looked up.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import drjit as dr
import mitsuba as mi

from full_geometry.geometry.points import SurfacePoint, lifted, mirrored, opaque, opposed, place
from full_geometry.geometry.rounding import blocked, clear, ray_from, ray_to
from full_geometry.integrators.lighting import RenderContext, delta_light
from full_geometry.integrators.specular_connections import (
    Connection,
    meet,
    no_connection,
    obstructed,
    refracted_connection,
    trial,
)
from full_geometry.objects.objects import TranslucentObject
from full_geometry.objects.small_emitters import WIDE
from full_geometry.surface.textured import MediumAt
from full_geometry.walk.emission import mis_weight, sample_emitter
from full_geometry.walk.media import Coefficients
from full_geometry.walk.random_walk import eval_phase
from halfspace_sss.physics.medium import sample_hg

MOST_SEGMENTS = 256
EARLY = 0.5  # probability of an event drawn by twice sigma_t: light has the way out to go as well
OUTWARDS = 0.3  # probability of a direction drawn from those that leave by the boundary behind
FAINT = 0.1  # weight below which a scattered walk may end
GRAZES = 0.05  # cosine at an emitter up to which no connection finds its points: their density over the area goes to 0
FOCUS = 100.0  # of the straight way into solid angle at the event; points of caustics beyond are left to phase sampling
SAME_WAY = 3e-3  # by which points of exit may differ, over the length inside
FAR = 1e4  # distance of what is infinitely far, over the size of the object


class RefractedRay(NamedTuple):
    """The ray from an exit into the object."""

    out: SurfacePoint
    d: mi.Vector3f
    T: mi.Float  # Fresnel transmittance
    valid: mi.Bool  # whether there is one
    passing: mi.Float  # probability to go along it to the boundary


class OneEventSample(NamedTuple):
    """Where a walk leaves the object, and light of emitter connections at its event."""

    p: mi.Point3f
    n: mi.Normal3f
    d: mi.Vector3f
    weight: mi.Spectrum
    connected: mi.Bool  # whether light of emitters along d is in `direct`
    pdf: mi.Float  # of d by the phase function, for MIS with the environment; 1 where no connection leads along d
    emitter_share: mi.Float  # 1 where one does, else 0
    direct: mi.Spectrum
    unconnected: mi.Spectrum  # of that, what phase sampling has hit and no connection finds
    once: mi.Bool  # whether it was scattered


@dataclass
class EventOfWalk:
    """The scattering event of a walk; without one, its start."""

    p: mi.Point3f
    d: mi.Vector3f  # direction of arrival
    n: mi.Normal3f  # of the boundary that was left last, outwards
    length: mi.Float  # Λ there
    inverse_pdf: mi.Float  # 1 / p there, before the phase function


@dataclass
class OneEventWalk:
    """Loop variables of a walk of one event or none; once it has `left`, o, d and n are those of the ray outside."""

    o: mi.Point3f
    d: mi.Vector3f
    n: mi.Normal3f  # geometric, outwards
    off: mi.Vector3f  # from o to where a ray is clear of the boundary
    length: mi.Float  # Λ
    inverse_pdf: mi.Float  # 1 / p
    order: mi.UInt32  # k
    cosine: mi.Float  # of the scattering angle
    event: EventOfWalk
    reflections: mi.UInt32  # at the boundary, since the event
    left: mi.Bool
    alive: mi.Bool
    medium: MediumAt | tuple[()] = ()  # of the exit, of objects with textures

    @classmethod
    def along(cls, p: mi.Point3f, d: mi.Vector3f, n: mi.Normal3f, active: mi.Bool) -> OneEventWalk:
        """A walk of weight 1 that begins at p along d, n the outward normal near it."""
        event = EventOfWalk(
            p=mi.Point3f(p), d=mi.Vector3f(d), n=mi.Normal3f(n), length=mi.Float(0), inverse_pdf=mi.Float(0)
        )
        return cls(
            o=mi.Point3f(p), d=mi.Vector3f(d), n=mi.Normal3f(n), off=mi.Vector3f(0), length=mi.Float(0),
            inverse_pdf=mi.Float(1), order=mi.UInt32(0), cosine=mi.Float(0), event=event, reflections=mi.UInt32(0),
            left=mi.Bool(False), alive=mi.Bool(active),
        )  # fmt: skip


# ---- The estimator ---------------------------------------------------------------------------------------------------


def sample_one_event(
    context: RenderContext,
    obj: TranslucentObject,
    refracted: RefractedRay,
    sampler: mi.Sampler,
    scattered: mi.Bool,
    active: mi.Bool,
) -> OneEventSample:
    """Light that leaves at an exit after at most one scattering event.
    What passes unscattered shows delta lights only if the path has `scattered` before."""
    if obj.gathered is not None and obj.gathered.inner is not None:
        return _by_inner_light(context, obj, refracted, sampler, scattered, active)
    with dr.suspend_grad():
        walk = _walk(obj, refracted, sampler, active & refracted.valid)
        once = walk.order == 1
        counts = walk.left & (once if 0 not in obj.low_orders else mi.Bool(True))
        straight, connected = once & (walk.reflections == 0), once & (walk.reflections <= 1)

    # ---- throughput f / p, with the derivatives of f
    if walk.medium:
        of_exit = refracted.out.medium
        if obj.textured is not None:
            of_exit = obj.textured.followed(obj.geometry, refracted.out, active)
        m = _coefficients(obj, of_exit)
    else:
        m = _by_channel(obj.derivatives.coefficients(obj.media))
    f = _contribution(m, walk.length, walk.order, walk.cosine)
    weight = dr.select(counts, f * (walk.inverse_pdf * refracted.T), 0)

    # ---- emitter connections: Σ over ways of f(event) p(cos) L_e T exp(-sigma_t Λ) over their density
    direct, unconnected, lights = mi.Spectrum(0), mi.Spectrum(0), context.lights
    pdf, share, environment = mi.Float(1), mi.Float(0), context.connects_environment(obj)
    if lights.some_local or context.suns or environment:
        at_event = _contribution(m, walk.event.length, mi.UInt32(1), None) * (walk.event.inverse_pdf * refracted.T)
        at = LitEvent(obj, m, walk, dr.select(once, at_event, 0))
        for light, d in _connected(context, at, sampler.next_2d(), sampler, environment, once):
            direct += light * eval_phase(m, dr.dot(walk.event.d, d))

    # ---- emission that phase sampling hits, delta lights over a cone, the MIS weight of the environment
    if lights.some_shaped or context.suns:
        unconnected = unconnected + weight * _hit_emission(context, obj, walk, sampler, counts & connected)
    if lights.some_delta:
        unconnected = unconnected + weight * _spread_lights(context, obj, walk, sampler, counts & (once | scattered))
    if environment:
        pdf, share = _environment_pdf(obj, walk, counts & straight)
    return OneEventSample(
        p=walk.o, n=walk.n, d=walk.d, weight=weight, connected=connected, pdf=pdf, emitter_share=share,
        direct=direct + unconnected, unconnected=unconnected, once=once,
    )  # fmt: skip


# ---- By gathered light: what events along a ray send is known --------------------------------------------------------

ALONG = 3  # events that are looked up on a segment, a multiple of the channels


def _by_inner_light(
    context: RenderContext, obj: TranslucentObject, refracted: RefractedRay, sampler: mi.Sampler, scattered: mi.Bool,
    active: mi.Bool,
) -> OneEventSample:  # fmt: skip
    """`sample_one_event` where light at events was gathered: the walk passes, and order 1 is what it looks up."""
    m, start = _coefficients(obj, ()), _begun(obj, refracted, active & refracted.valid)

    def step(k: mi.UInt32, sampler: mi.Sampler, walk: OneEventWalk, light: mi.Spectrum) -> tuple:
        # ---- single scattering along the segment: ∫ sigma_s exp(-sigma_t (Λ + s)) J ds
        met, length = _to_boundary(obj, walk)
        light = dr.select(walk.alive, light + _scattered_along(obj, m, walk, length, sampler), light)

        # ---- the boundary, then Russian roulette by exp(-sigma_t Λ) / p
        walk = _meet_boundary(obj, m, replace(walk, length=walk.length + length), met, sampler)
        survival = dr.minimum(dr.max(dr.exp(-m.sigma_t * walk.length)) * walk.inverse_pdf / FAINT, 1)
        survives = sampler.next_1d() < survival
        walk = replace(
            walk, left=walk.left & survives, alive=walk.alive & survives & (k + 1 < MOST_SEGMENTS),
            inverse_pdf=walk.inverse_pdf / dr.maximum(survival, 1e-30),
        )  # fmt: skip
        return k + 1, sampler, walk, light

    state = (mi.UInt32(0), sampler, start, mi.Spectrum(0))
    walk, light = dr.while_loop(state, lambda k, sampler, walk, light: walk.alive, step, label="passing")[2:]

    # ---- ballistic: what leaves has the weight T_o exp(-sigma_t Λ) / p
    counts = walk.left & mi.Bool(0 in obj.low_orders)
    weight = dr.select(counts, dr.exp(-m.sigma_t * walk.length) * (walk.inverse_pdf * refracted.T), 0)
    direct = dr.select(refracted.valid, light * refracted.T, 0)
    if context.lights.some_delta:
        direct += weight * _spread_lights(context, obj, walk, sampler, counts & scattered)
    return OneEventSample(
        p=walk.o, n=walk.n, d=walk.d, weight=weight, connected=mi.Bool(False), pdf=mi.Float(1),
        emitter_share=mi.Float(0), direct=direct, unconnected=mi.Spectrum(0), once=mi.Bool(False),
    )  # fmt: skip


def _scattered_along(
    obj: TranslucentObject, m: Coefficients, walk: OneEventWalk, length: mi.Float, sampler: mi.Sampler
) -> mi.Spectrum:
    """∫ sigma_s exp(-sigma_t (Λ + s)) J ds over a segment, over the density of the walk."""
    n, light = len(m.sigma_t), mi.Spectrum(0)
    ends, passed, shift = 1 - dr.exp(-m.sigma_t * length), dr.exp(-m.sigma_t * walk.length), sampler.next_1d()

    def look(k: mi.UInt32, light: mi.Spectrum) -> tuple[mi.UInt32, mi.Spectrum]:
        # ---- s = -ln(1 - u (1 - exp(-sigma_t length))) / sigma_t, for the channels in turn, u stratified
        rate, end = m.sigma_t[0], ends[0]
        for c in range(1, n):
            rate, end = dr.select(k % n == c, m.sigma_t[c], rate), dr.select(k % n == c, ends[c], end)
        u = shift + mi.Float(k) / ALONG
        s = dr.minimum(-dr.log(1 - dr.minimum((u - dr.floor(u)) * end, 1 - 1e-7)) / rate, length)

        # ---- sigma_s exp(-sigma_t s) J over the mean density of the channels
        density = dr.sum(m.sigma_t * dr.exp(-m.sigma_t * s) / dr.maximum(ends, 1e-30)) / n
        J = obj.gathered.inner(walk.o + walk.d * s, walk.d, walk.alive)
        return k + 1, light + m.sigma_s * dr.exp(-m.sigma_t * s) * J / dr.maximum(density, 1e-30)

    light = dr.while_loop((mi.UInt32(0), light), lambda k, _: k < ALONG, look, label="events")[1]
    return light * passed * (walk.inverse_pdf / ALONG)


class LightAtEvents(NamedTuple):
    """Light that reaches events without scattering.
    `connected`: by emitter connections, over the density of the emitter, with its direction; of several ways. `left`:
    walks that have left the object, and how many reflections they have met. `weight`: of them, per unit of the radiance
    that they meet. `unconnected`: of that light of emitters, which no connection has found, with the weight."""

    connected: list[tuple[mi.Spectrum, mi.Vector3f]]
    left: OneEventWalk
    weight: mi.Spectrum
    unconnected: mi.Spectrum


def light_at_events(
    context: RenderContext, obj: TranslucentObject, at: tuple[mi.Point3f, mi.Normal3f],
    ways: tuple[mi.Vector3f, mi.Float], u: mi.Point2f, sampler: mi.Sampler,
) -> LightAtEvents:  # fmt: skip
    """Light at places inside an object, along directions and by connections.
    `obj`: the object, of one medium. `at`: places, and outward geometric normals near them. `ways`: directions, and the
    inverse of their density, sr."""
    # ---- walks that begin at their event, scaled so that roulette meets a weight about 1
    (p, n), (d, inverse_pdf), m = at, ways, _coefficients(obj, ())
    scale = 1 / dr.maximum(dr.max(m.sigma_s), 1e-30)
    start = OneEventWalk.along(p, d, n, mi.Bool(True))
    start = replace(start, inverse_pdf=4 * dr.pi * scale, order=mi.UInt32(1))
    start.event.inverse_pdf = mi.Float(1)

    # ---- to the boundary and out, reflected as often as it takes; Λ adds up
    def step(k: mi.UInt32, sampler: mi.Sampler, walk: OneEventWalk) -> tuple:
        met, length = _to_boundary(obj, walk)
        walk = _meet_boundary(obj, m, replace(walk, length=walk.length + length), met, sampler)
        return k + 1, sampler, replace(walk, alive=walk.alive & (k + 1 < MOST_SEGMENTS))

    state = (mi.UInt32(0), sampler, start)
    walk = dr.while_loop(state, lambda k, sampler, walk: walk.alive, step, label="light at events")[2]

    # ---- exp(-sigma_t Λ) over the density of the direction
    weight = dr.select(walk.left, dr.exp(-m.sigma_t * walk.length) * (walk.inverse_pdf / scale), 0)
    weight *= inverse_pdf * dr.inv_four_pi

    # ---- emitters but for the environment: by connections, and what these do not find
    connected, unconnected, lights = [], mi.Spectrum(0), context.lights
    if lights.some_local or context.suns:
        k = dr.arange(mi.UInt32, dr.width(p)) // BLOCK
        looked = k % RARELY == 0  # whole blocks of lanes, as those that wait cost as much
        at_event = LitEvent(obj, m, walk, mi.Spectrum(1))
        connected = _connected(context, at_event, u, sampler, False, mi.Bool(True), (looked, RARELY))
    if lights.some_shaped or context.suns:
        active = walk.left & (walk.reflections <= 1)
        unconnected += weight * _hit_emission(context, obj, walk, sampler, active)
    if lights.some_delta:
        unconnected += weight * _spread_lights(context, obj, walk, sampler, walk.left)
    return LightAtEvents(connected, walk, weight, unconnected)


# ---- The walk --------------------------------------------------------------------------------------------------------


def _walk(obj: TranslucentObject, refracted: RefractedRay, sampler: mi.Sampler, active: mi.Bool) -> OneEventWalk:
    """The walk from an exit until it leaves."""
    m, start = _coefficients(obj, refracted.out.medium), _begun(obj, refracted, active)

    def step(k: mi.UInt32, sampler: mi.Sampler, passing: mi.Float, walk: OneEventWalk) -> tuple:
        own = _coefficients(obj, walk.medium) if walk.medium else m
        return k + 1, sampler, passing, _step(obj, own, k, sampler, passing, walk)

    state = (mi.UInt32(0), sampler, mi.Float(refracted.passing), start)
    return dr.while_loop(state, lambda k, sampler, passing, walk: walk.alive, step, label="one event")[3]


def _begun(obj: TranslucentObject, refracted: RefractedRay, active: mi.Bool) -> OneEventWalk:
    """A walk at the exit, refracted inwards."""
    walk = OneEventWalk.along(refracted.out.p, refracted.d, refracted.out.n, active)
    return replace(walk, off=clear(refracted.out.n, refracted.d, obj.geometry.clearance), medium=refracted.out.medium)


def _to_boundary(obj: TranslucentObject, walk: OneEventWalk) -> tuple[tuple, mi.Float]:
    """What a walk meets at the boundary, as of `meet`, and how far away."""
    flags = mi.RayFlags.Minimal | mi.RayFlags.ShadingFrame
    si, n_out, n = meet(obj, walk.o + walk.off, walk.d, flags, walk.alive)
    return (si, n_out, n), dr.maximum(si.t + dr.dot(walk.off, walk.d), 0)


def _by_channel(media: list[tuple[mi.Float, mi.Float, mi.Float]]) -> Coefficients:
    """The coefficients of sigma_s, sigma_t and g of each channel."""
    sigma_s, sigma_t, g = (mi.Spectrum(v) for v in zip(*media))
    return Coefficients(sigma_t=sigma_t, sigma_s=sigma_s, g=g, majorant=sigma_t, mean_t=sigma_t)


def _coefficients(obj: TranslucentObject, medium: MediumAt | tuple[()]) -> Coefficients:
    """Those of the exit, or of the object where it has no textures."""
    if not medium:
        return _by_channel([tuple(opaque(v) for v in (m.sigma_s, m.sigma_t, m.g)) for m in obj.media])
    g = medium.g if len(medium.g) else [opaque(m.g) for m in obj.media]
    return _by_channel([(a * t, t, each) for a, t, each in zip(medium.albedo, medium.sigma_t, g)])


def _step(
    obj: TranslucentObject, m: Coefficients, k: mi.UInt32, sampler: mi.Sampler, passing: mi.Float, walk: OneEventWalk
) -> OneEventWalk:
    """One segment: to the event, or to the boundary and what happens there."""
    # ---- the probability to pass: at first that of the choice of events, then Σ_c W_c T_c / Σ_c W_c, W = f / p
    met, length = _to_boundary(obj, walk)
    W = _contribution(m, walk.length, walk.order, walk.cosine) * walk.inverse_pdf
    T = dr.select(met[0].is_valid(), dr.exp(-m.sigma_t * length), 0)
    passing = dr.select(k == 0, passing, dr.sum(W * T) / dr.maximum(dr.sum(W), 1e-30))

    # ---- a walk that was scattered always passes
    first = walk.order == 0
    scatters = first & (sampler.next_1d() >= passing)
    scattered = _scatter(obj, m, walk, (W, 1 - T), dr.maximum(1 - passing, 1e-7), sampler)
    passed = replace(
        walk, length=walk.length + length, inverse_pdf=walk.inverse_pdf / dr.select(first, passing, 1)
    )  # fmt: skip
    passed = _meet_boundary(obj, m, passed, met, sampler)
    passed.alive &= ~walk.left & (k + 1 < MOST_SEGMENTS)

    # ---- it ends at what lies inside
    new = dr.select(scatters, scattered, passed)
    ended = obstructed(obj, walk.o, walk.d, new.length - walk.length, walk.alive)
    return dr.select(ended, replace(walk, alive=mi.Bool(False)), new)


def _scatter(
    obj: TranslucentObject, m: Coefficients, walk: OneEventWalk, weights: tuple[mi.Spectrum, mi.Spectrum],
    scattering: mi.Float, sampler: mi.Sampler,
) -> OneEventWalk:  # fmt: skip
    """The event on this segment, which happens with the probability `scattering`.
    `weights` are W_c = f_c / p and 1 - T_c, the probability of channel c to be scattered on the segment."""
    # ---- distance by a channel c of probability W_c (1 - T_c): s = -ln(1 - u (1 - T_c)) / sigma_t, or of 2 sigma_t
    W, ends = weights
    u, v, channel, scatters = sampler.next_1d(), sampler.next_2d(), sampler.next_2d(), W * ends
    rate, end = dr.maximum(_pick(m.sigma_t, scatters, channel.x), 1e-12), _pick(ends, scatters, channel.x)
    early = sampler.next_1d() < EARLY
    rate, end = rate * dr.select(early, 2, 1.0), end * dr.select(early, 2 - end, 1.0)
    s = -dr.log(1 - u * dr.minimum(end, 1 - 1e-7)) / rate

    # ---- density: the mean of both rates and of the channels, as 1 - T² = (1 - T) (2 - (1 - T)),
    #      Σ_c W_c sigma_t T_s ((1 - EARLY) + 2 EARLY T_s / (1 + T_c)) / Σ_c W_c (1 - T_c),  T_s = exp(-sigma_t s)
    passed = dr.exp(-m.sigma_t * s)
    density = W * m.sigma_t * passed * (1 - EARLY + 2 * EARLY * passed / (2 - ends))
    density = dr.sum(density) / dr.maximum(dr.sum(scatters), 1e-30) * scattering
    inverse_pdf = walk.inverse_pdf / dr.maximum(density, 1e-30)

    # ---- direction by the phase function of a channel, or uniform in the cone about the normal that a flat boundary
    #      lets out; density likewise
    W = _contribution(m, walk.length + s, mi.UInt32(1), None) * inverse_pdf
    outwards, least = sampler.next_1d() < OUTWARDS, _least_outwards(obj)
    cosine = dr.select(outwards, 1 - v.x * (1 - least), sample_hg(v.x, _pick(m.g, W, channel.y)))
    sine, (sin_phi, cos_phi) = dr.safe_sqrt((1 - cosine) * (1 + cosine)), dr.sincos(2 * dr.pi * v.y)
    axis = dr.select(outwards, mi.Vector3f(walk.n), walk.d)
    d = mi.Frame3f(axis).to_world(mi.Vector3f(sine * cos_phi, sine * sin_phi, cosine))
    p, length = mi.Point3f(walk.o + walk.d * s), walk.length + s
    pdf = _direction_pdf(obj, m, W, dr.dot(walk.d, d), dr.dot(walk.n, d))

    # ---- the walk from the event, 1 / p over the density of the direction
    event = EventOfWalk(
        p=p, d=mi.Vector3f(walk.d), n=mi.Normal3f(walk.n), length=length, inverse_pdf=inverse_pdf
    )  # fmt: skip
    return replace(
        walk, o=p, d=mi.Vector3f(d), off=mi.Vector3f(0), length=length,
        inverse_pdf=inverse_pdf / dr.maximum(pdf, 1e-30), order=mi.UInt32(1), cosine=mi.Float(dr.dot(walk.d, d)),
        event=event, reflections=mi.UInt32(0), alive=walk.alive & (dr.sum(W) > 0) & (dr.sum(scatters) > 0),
    )  # fmt: skip


def _least_outwards(obj: TranslucentObject) -> mi.Float:
    """The cosine to the normal from which on a flat boundary lets light out, sqrt(1 - 1 / eta²)."""
    return dr.safe_sqrt(1 - 1 / dr.square(obj.eta))


def _direction_pdf(
    obj: TranslucentObject, m: Coefficients, W: mi.Spectrum, cosine: mi.Float, outwards: mi.Float
) -> mi.Float:
    """Density of the direction of an event, 1/sr: Σ_c W_c p_c(cosine) / Σ_c W_c, mixed with the cone outwards.
    `obj`, `m`: the object, and its coefficients at the event. `W`: weights of the channels. `cosine`, `outwards`: of
    the direction to that of arrival and to the normal outwards."""
    least = _least_outwards(obj)
    phase = dr.sum(W * eval_phase(m, cosine)) / dr.maximum(dr.sum(W), 1e-30)
    return (1 - OUTWARDS) * phase + dr.select(outwards > least, OUTWARDS / (2 * dr.pi * (1 - least)), 0)


def _meet_boundary(
    obj: TranslucentObject, m: Coefficients, walk: OneEventWalk, met: tuple, sampler: mi.Sampler
) -> OneEventWalk:
    """Reflection by Fresnel, or the way out; Russian roulette for what is faint."""
    # ---- roulette of walks that were scattered, by W = f / p
    si, n_out, n = met
    size = dr.max(_contribution(m, walk.length, walk.order, walk.cosine) * walk.inverse_pdf)
    survival = dr.select(walk.order == 1, dr.minimum(size / FAINT, 1), 1)

    # ---- reflected with the probability F, else refracted; both stay on their side of the geometric normal
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


def _contribution(m: Coefficients, length: mi.Float, order: mi.UInt32, cosine: mi.Float | None) -> mi.Spectrum:
    """f = sigma_s^k p(cos)^k exp(-sigma_t Λ); without the phase function where there is no cosine."""
    once = m.sigma_s if cosine is None else m.sigma_s * eval_phase(m, cosine)
    return dr.select(order == 1, once, 1) * dr.exp(-m.sigma_t * length)


def _pick(values: mi.Spectrum, weights: mi.Spectrum, u: mi.Float) -> mi.Float:
    """The value of a channel drawn by its weight, for a uniform number."""
    # the channel k in which Σ_{j <= k} w_j passes u Σ w
    u, value = u * dr.sum(weights), values[0]
    for k in range(1, len(values)):
        u = u - weights[k - 1]
        value = dr.select(u >= 0, values[k], value)
    return value


# ---- Light: emitter connections, and what they do not find -----------------------------------------------------------


class LitEvent(NamedTuple):
    """The event of a walk, and its weight, what light that arrives there is worth without the phase function."""

    obj: TranslucentObject
    m: Coefficients
    walk: OneEventWalk
    weight: mi.Spectrum


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
    context: RenderContext, at: LitEvent, u: mi.Point2f, sampler: mi.Sampler, environment: bool, active: mi.Bool,
    others: tuple[mi.Bool | bool, float] = (True, 1.0),
) -> list[tuple[mi.Spectrum, mi.Vector3f]]:  # fmt: skip
    """Light of a sampled emitter that reaches an event by refraction or one reflection more.
    `environment`: whether the environment counts. `others`: where ways that no straight line leads to are looked for,
    and how much they count there.

    Returns:
        Of each way the light, without the phase function, and its direction at the event.
    """
    # ---- y of an emitter by p_e, as far as it is or as what is infinitely far
    obj, walk = at.obj, at.walk
    here = place(walk.event.p, mi.Normal3f(0, 0, 0), walk.medium)
    ds, light = sample_emitter(context.scene, here, u, active, context.mode.tracks)
    with dr.suspend_grad():
        distant = mi.has_flag(ds.emitter.flags(), mi.EmitterFlags.Infinite)
        alone = context.sampled_by_nee(ds.emitter, ds.d)
        active = active & (ds.pdf > 0)
        reach = dr.select(distant, opaque(FAR * obj.geometry.size), ds.dist)
        target = _Target(ds, light, walk.event.p + ds.d * reach, reach, alone)

        # ---- ways from the event that refract towards y: one, or of local emitters those by random starts too
        first = active & (alone | mi.Bool(environment))
        if context.lights.some_local or context.suns:
            near = active & alone & others[0] & _near(obj, walk, target.p, active)
            straight, *bent = _ways(context, at, target, (first, near), sampler)
            ways = [straight, *(replace(way, passed=way.passed * others[1]) for way in bent)]
        else:
            ways = [_way(context, at, target, refracted_connection(obj, walk.event.p, target.p, first))]
    return [(_light_along(at, target, way), way.d) for way in ways]


def _light_along(at: LitEvent, target: _Target, way: _Way) -> mi.Spectrum:
    """Light of a target that reaches the event, times the weight of that, without the phase function."""
    value = at.weight * _contribution(at.m, way.length, mi.UInt32(0), None) * way.passed * target.light
    return dr.select(way.passed > 0, value, 0)


def _way(context: RenderContext, at: LitEvent, target: _Target, met: Connection) -> _Way:
    """The way of light of a target by its connection with the event."""
    # ---- solid angle at the event per solid angle of the straight direction, over which the emitter was sampled:
    #      |cos_w| / |cos_straight| r² (dw / dA)
    (obj, _, walk, _), ds, alone, reach = at, target.ds, target.alone, target.reach
    facing = dr.select(dr.squared_norm(ds.n) > 0, dr.abs(dr.dot(ds.n, met.w)) / dr.abs(dr.dot(ds.n, ds.d)), 1)
    valid = met.valid & (ds.delta | ~alone | _is_sampled(walk.event.p, target.p, ds.n, met))
    valid &= dr.dot(ds.n, met.w) <= 0
    spread = dr.select(ds.delta | ~alone, 1, facing) * reach * reach * met.density

    # ---- MIS weight of the environment against phase sampling, p_e / (p_e + p_f), both per straight solid angle
    weight = mis_weight(ds.pdf, _phase_pdf(obj, walk, met) * met.T * spread)

    # ---- visibility from where the way leaves the object
    shadow = ray_to(
        place(met.p, met.n), target.p, obj.geometry.clearance, context.instance_scene.rounding_of(ds.emitter)
    )
    valid &= ~blocked(context.scene, shadow, valid)
    passed = dr.select(valid, met.T * spread * dr.select(alone, 1, weight), 0)
    return _Way(mi.Vector3f(met.d), mi.Float(met.length), passed)


def _phase_pdf(obj: TranslucentObject, walk: OneEventWalk, met: Connection) -> mi.Float:
    """Density by which phase sampling draws the direction of a connection, 1/sr inside, see `_scatter`."""
    # by the weights W_c of the channels at the event, as the walk has drawn its direction
    m = _coefficients(obj, walk.medium)
    W = _contribution(m, walk.event.length, mi.UInt32(1), None)
    return _direction_pdf(obj, m, W, dr.dot(walk.event.d, met.d), dr.dot(walk.event.n, met.d))


def _environment_pdf(obj: TranslucentObject, walk: OneEventWalk, active: mi.Bool) -> tuple[mi.Float, mi.Float]:
    """Density of a walk's direction outside, 1/sr, and 1, where a connection with the environment leads along it.
    Elsewhere 1 and 0."""
    with dr.suspend_grad():
        # p_f per solid angle outside: p(d) T dw_inside / dw_outside of the connection along the way of the walk
        reach = opaque(FAR * obj.geometry.size)
        met = refracted_connection(obj, walk.event.p, walk.event.p + walk.d * reach, active)
        same = active & _leaves(obj, met, walk.o, SAME_WAY)
        pdf = _phase_pdf(obj, walk, met) * met.T * reach * reach * met.density
    return dr.select(same, pdf, 1), dr.select(same, mi.Float(1), 0)


def _hit_emission(
    context: RenderContext, obj: TranslucentObject, walk: OneEventWalk, sampler: mi.Sampler, active: mi.Bool
) -> mi.Spectrum:
    """Emission that phase sampling hits, which no connection with that point of an emitter would find."""
    with dr.suspend_grad():
        # the emitter that the ray outside meets
        ray = ray_from(place(walk.o, walk.n, walk.medium), walk.d, obj.geometry.clearance)
        si = context.ray_intersect(ray, False, active)
        emitter = si.emitter(context.scene, active)
        active = active & (emitter != None) & context.sampled_by_nee(emitter, walk.d)  # noqa: E711

        # whether a connection of the event with that point takes the way of the walk
        far = walk.event.p + walk.d * opaque(FAR * obj.geometry.size)
        target, n = mi.Point3f(dr.select(si.is_valid(), si.p, far)), dr.select(si.is_valid(), si.n, 0)
        met = _taken(obj, walk, target, SAME_WAY, sampler, active)
        sampled = met.valid & _is_sampled(walk.event.p, target, n, met)
    return dr.select(active & ~sampled, emitter.eval(si, active), 0)


def _spread_lights(
    context: RenderContext, obj: TranslucentObject, walk: OneEventWalk, sampler: mi.Sampler, active: mi.Bool
) -> mi.Spectrum:
    """Light of a delta light whose cone holds a walk's way out, which no connection with it would find."""
    # E / Ω of one of the lights, but where a connection of the event with it takes the way of the walk
    ray = ray_from(place(walk.o, walk.n, walk.medium), walk.d, obj.geometry.clearance)
    which, L = delta_light(context, sampler, ray, active)
    with dr.suspend_grad():
        connects = active & (dr.max(L) > 0) & (walk.order == 1)
        target = context.small.point(which, walk.event.p, FAR * obj.geometry.size)
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
# Newton's method finds a ray m, of the many that may be refracted towards a point outside, with a probability q_m over
# random directions d_1, d_2, ... that it starts from. With T the trials until m is found again, at most N of them,
#
#     E[min(T, N)] = (1 - (1 - q_m)^N) / q_m,
#
# so that light along what d_1 leads to, times min(T, N), is the share 1 - (1 - q_m)^N of all. The rest is light that
# phase sampling hits, counted where N other directions do not lead to it. Both agree whatever the directions are drawn
# from; q_m decides how much is left to phase sampling.

TRIALS = 32  # N
NEAR = 4.0  # mean free paths of the straight way to the boundary, beyond which phase sampling is left with all others
RARELY, BLOCK = 8, 64  # of gathered events one block of lanes in so many, as other ways bring 1 % of the light


def _ways(
    context: RenderContext, at: LitEvent, target: _Target, looks: tuple[mi.Bool, mi.Bool], sampler: mi.Sampler
) -> list[_Way]:
    """The ways of light of a target: from the first guess, and from random directions, without and with a reflection.
    One loop over all, so that a kernel holds Newton's method once. `looks` says where it looks for the first, and for
    the others. Which are looked for again is decided by the medium itself, also where another is differentiated by."""
    obj, p_event = at.obj, at.walk.event.p
    m = _coefficients(obj, at.walk.medium)

    def step(
        kind: mi.UInt32, n: mi.UInt32, sampler: mi.Sampler, counted: mi.Float, seen: tuple, way: _Way, ways: list[_Way]
    ) -> tuple:
        """Trial n of a kind of way: the first finds one, others look for it again."""
        first, other, (straight, p) = n == 0, kind > 0, seen
        ends, active = (p_event, target.p), dr.select(other, looks[1], looks[0])
        met = trial(obj, ends, kind == 2, other, sampler, active)

        # ---- one that is found; with the probability `share`, less of fainter ones, it is looked for again
        new = met.valid & first & ~(other & _leaves(obj, straight, met.p, SAME_WAY))
        way = dr.select(first, _way(context, at, target, replace(met, valid=new)), way)
        lit = dr.max(_light_along(at, target, way)) > 0
        share = dr.minimum(met.T * dr.exp(-dr.min(m.sigma_t) * met.length) / FAINT, 1)
        again = first & other & lit & (sampler.next_1d(first & other) < share)
        counted, p = dr.select(first, share, counted), dr.select(first, met.p, p)
        straight = dr.select(other, straight, met)

        # ---- it counts min(T, N) / share times, as often as it took to be found again
        ends = dr.select(first, ~again, _leaves(obj, met, p, SAME_WAY) | (n == TRIALS))
        times = dr.select(other, dr.select(first, 0, mi.Float(n) / counted), 1)
        done = replace(way, passed=dr.select(times > 0, way.passed * times, 0))
        ways = [dr.select(ends & (kind == k), done, known) for k, known in enumerate(ways)]
        kind, n = dr.select(ends, kind + 1, kind), dr.select(ends, 0, n + 1)
        return kind, n, sampler, counted, (straight, p), way, ways

    # kinds 0, 1, 2: the first guess, random directions, random directions with a reflection
    def none() -> _Way:
        return _Way(mi.Vector3f(0, 0, 1), mi.Float(0), mi.Float(0))

    seen = no_connection(), mi.Point3f(0)
    state = (mi.UInt32(0), mi.UInt32(0), sampler, mi.Float(1), seen, none(), [none(), none(), none()])
    return dr.while_loop(state, lambda kind, *_: kind < 3, step, label="ways")[-1]


def _taken(
    obj: TranslucentObject, walk: OneEventWalk, target: mi.Point3f, tolerance: float, sampler: mi.Sampler,
    active: mi.Bool,
) -> Connection:  # fmt: skip
    """The connection by which a walk has left its event, if one is found; without, phase sampling alone finds it."""
    # ---- trials 0 ... N, until one leaves the object where the walk has left it
    near, reflected = _near(obj, walk, target, active), walk.reflections == 1

    def step(n: mi.UInt32, sampler: mi.Sampler, found: Connection, active: mi.Bool) -> tuple:
        met = trial(obj, (walk.event.p, target), reflected, n > 0, sampler, active)
        met = replace(met, valid=_leaves(obj, met, walk.o, tolerance))
        return n + 1, sampler, dr.select(active, met, found), active & ~met.valid & near & (n < TRIALS)

    # the first guess is without a reflection
    active = active & ((walk.reflections == 0) | (reflected & near))
    state = (dr.select(reflected, mi.UInt32(1), 0), sampler, no_connection(), mi.Bool(active))
    return dr.while_loop(state, lambda n, sampler, found, active: active, step, label="trials")[2]


def _near(obj: TranslucentObject, walk: OneEventWalk, target: mi.Point3f, active: mi.Bool) -> mi.Bool:
    """Whether other connections are looked for: where light of the target is likely to be seen."""
    if obj.geometry.inclusions is not None:
        return mi.Bool(False)
    # whether the boundary is met within `NEAR` mean free paths on the straight way
    ray = mi.Ray3f(walk.event.p, dr.normalize(target - walk.event.p))
    ray.maxt = NEAR / (dr.min(walk.medium.sigma_t) if walk.medium else opaque(min(m.sigma_t for m in obj.media)))
    return obj.geometry.ray_test(ray, False, active)
