"""The walk inside one object as a part of its own: its state, its step, and visitors that say what is recorded.

A step is a free flight to a scattering event or to the boundary. A visitor has a record of its own, any PyTree of
Dr.Jit, which goes through the loop beside the walk: light for images, exits for learning.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple, Protocol, TypeVar

import drjit as dr
import mitsuba as mi

from full_geometry.geometry.points import SurfacePoint, channel_mean, evaluate, lane_numbers, lift, sided, surface_point
from full_geometry.surface.textured import MediumAt
from full_geometry.walk.media import Coefficients, WalkMedia, WalkMedium, ray_of
from full_geometry.walk.priorities import OUTSIDE
from halfspace_sss.physics.medium import eval_hg, sample_hg
from halfspace_sss.tracing.walk import ROULETTE_BOOST, ROULETTE_WEIGHT, generator, pass_seed

# ---- Free flight, scattering and roulette with spectral MIS ---------------------------------------------------------
#
# A walk draws distances and angles with the coefficients of one channel, chosen at its start. Every channel c gets a
# value: with f_c the measured contribution and p_k the density of the whole walk under channel k, the weight is
# w_c = f_c / mean_k p_k (balance heuristic over channels). State are w_c and q_k = p_k / mean_j p_j; both stay in range
# whatever the length of the walk. Absorption is part of w. Hero wavelength sampling (Wilkie et al. 2014); Miller,
# Georgiev and Jarosz 2019 for volumes.


class Flight(NamedTuple):
    """How a free flight ended: in a scattering event, a null collision or at the boundary; the weights after it."""

    scatters: mi.Bool
    null: mi.Bool
    weight: mi.Spectrum
    density: mi.Spectrum


def pick(values: mi.Spectrum, channel: mi.UInt32) -> mi.Float:
    """The component of a spectrum that belongs to a channel."""
    value = values[0]
    for c in range(1, len(values)):
        value = dr.select(channel == c, values[c], value)
    return value


def weigh(
    weight: mi.Spectrum, density: mi.Spectrum, value: mi.Spectrum, pdf: mi.Spectrum
) -> tuple[mi.Spectrum, mi.Spectrum]:
    """w and q after a step with the value f_c and the density p_c, each up to one factor that they share."""
    if len(weight) == 1:
        return weight * value / pdf, density
    # q_k p_k over mean_j q_j p_j, and w_c f_c over the same
    grown = density * pdf
    scale = 1 / dr.maximum(channel_mean(grown), 1e-37)
    return weight * value * scale, grown * scale


def free_path(m: Coefficients, channel: mi.UInt32, u: mi.Float) -> mi.Float:
    """Distance to the next collision, scene units; where the medium is homogeneous, that is a scattering event."""
    return -dr.log(1 - u) / pick(m.majorant, channel)


def fly(
    m: Coefficients,
    weight: mi.Spectrum,
    density: mi.Spectrum,
    channel: mi.UInt32,
    t: mi.Float,
    reach: mi.Float,
    u: mi.Float | None = None,
) -> Flight:
    """A free flight of length t, cut short by the boundary where that is at a distance `reach` < t.

    Collisions are drawn by the majorant M_k of the channel of the walk. With M_c - sigma_t,c of null matter added, all
    channels fly through T_c = exp(-M_c t), and a collision is real with the probability sigma_t,k / M_k, so that the
    path, null collisions included, gains (Miller, Georgiev and Jarosz 2019, section 4)

        f_c = T_c sigma_s,c,             p_c = T_c sigma_t,c             real collision,
        f_c = T_c (M_c - sigma_t,c),     p_c = T_c (M_c - sigma_t,c)     null collision,
        f_c = T_c,                       p_c = T_c                       boundary.

    Every part of f_c is at most that of p_c, so that w_c = f_c / mean_k p_k is at most the number of channels, before
    roulette. One majorant for all channels makes w less noisy but walks longer: 1.2 to 1.7 times the variance x time of
    this at sigma_t of 1:2:4 and three null collisions in four.

    Args:
        m: coefficients at the distance t.
        u: uniform number that decides whether a collision is real; None where M = sigma_t, so that all are.
    """
    # real with the probability sigma_t,k / M_k of the channel of the walk
    collides = t < reach
    scatters = collides if u is None else collides & (u * pick(m.majorant, channel) < pick(m.sigma_t, channel))
    null = mi.Bool(False) if u is None else collides & ~scatters
    # one channel: f / p is the albedo at a scattering event, else 1
    if len(weight) == 1:
        value = dr.select(scatters, m.sigma_s / m.sigma_t, 1)
        return Flight(scatters, null, weight * value, density)

    # f_c and p_c, both over exp(-M_k t) of the walk's channel
    through = dr.exp(-(m.majorant - pick(m.majorant, channel)) * dr.minimum(t, reach))
    otherwise = mi.Spectrum(1) if u is None else dr.select(null, dr.maximum(m.majorant - m.sigma_t, 0), 1)
    value = dr.select(scatters, m.sigma_s, otherwise) * through
    pdf = dr.select(scatters, m.sigma_t, otherwise) * through
    return Flight(scatters, null, *weigh(weight, density, value, pdf))


def eval_phase(m: Coefficients, cosine: mi.Float) -> mi.Spectrum:
    """Henyey-Greenstein phase function of each channel, 1/sr."""
    return mi.Spectrum([eval_hg(cosine, g) for g in m.g])


def turn(
    m: Coefficients,
    weight: mi.Spectrum,
    density: mi.Spectrum,
    channel: mi.UInt32,
    d: mi.Vector3f,
    u: mi.Point2f,
    same_g: bool,
) -> tuple:
    """A new direction by the phase function, and w and q after it."""
    # theta by the phase function of the walk's channel, phi uniform
    cosine = sample_hg(u.x, pick(m.g, channel))
    sine = dr.safe_sqrt((1 - cosine) * (1 + cosine))
    sin_phi, cos_phi = dr.sincos(2 * dr.pi * u.y)
    new = mi.Frame3f(d).to_world(mi.Vector3f(sine * cos_phi, sine * sin_phi, cosine))
    new *= 1.5 - 0.5 * dr.squared_norm(new)  # one Newton step: float32 drifts over thousands of turns
    if same_g or len(weight) == 1:
        return new, weight, density
    # f_c = p_c = phase function of the channel
    phase = eval_phase(m, cosine)
    return new, *weigh(weight, density, phase, phase)


def roulette(weight: mi.Spectrum, scale: mi.Float, u: mi.Float) -> tuple[mi.Bool, mi.Spectrum]:
    """Whether a walk goes on, and its weight if it does; `scale` is the square of the relative index passed so far."""
    # q = size / (limit boost) below the limit: survivors are boosted, as few of them are worth their time
    size = dr.max(weight) * scale
    survive = dr.select(size < ROULETTE_WEIGHT, size / (ROULETTE_WEIGHT * ROULETTE_BOOST), 1)
    return u < survive, dr.select(survive < 1, weight / dr.maximum(survive, 1e-30), weight)


MET = 2  # scattering events at least, of a walk that has met something inside: such paths are a transport's
Record = TypeVar("Record")  # of a visitor, any PyTree of Dr.Jit


@dataclass
class Walk:
    """A walk in an object or outside, between two of its events."""

    alive: mi.Bool  # whether it goes on
    object: mi.Int32  # the object around it, by number, or OUTSIDE
    o: mi.Point3f  # where its flight begins
    d: mi.Vector3f  # direction of the flight
    off: mi.Vector3f  # from o to where its ray begins that looks for the boundary, see `WalkMedia.depart`
    channel: mi.UInt32  # by which distances and angles are drawn
    weight: mi.Spectrum  # w_c = f_c / mean_k p_k
    density: mi.Spectrum  # q_c = p_c / mean_k p_k
    scale: mi.Float  # square of the relative index passed so far
    order: mi.UInt32  # scattering events since it entered the object; MET at least once it has met what lies inside
    rng: mi.PCG32
    medium: WalkMedium | tuple[()] = ()  # that it took where it entered, see `WalkMedia.fetch`
    within: mi.UInt32 | tuple[()] = ()  # what is around it, where things overlap, see `walk.priorities`
    kept: mi.Spectrum | tuple[()] = ()  # of a first flight that must not leave, the probability that others do not

    def ray(self, t: mi.Float) -> mi.Ray3f:
        """Looks for the boundary on a flight of length t; see `reach` for its distances."""
        ray = ray_of(self.o + self.off, self.d, self.medium)
        ray.maxt = dr.maximum(t - dr.dot(self.off, self.d), 0)
        return ray

    def reach(self, t: mi.Float) -> mi.Float:
        """Length of the flight to what the ray meets at the distance t."""
        return dr.maximum(t + dr.dot(self.off, self.d), 0)


@dataclass
class Event:
    """A scattering event, before the walk turns."""

    p: mi.Point3f
    along: mi.Vector3f  # direction of arrival
    object: mi.Int32
    m: Coefficients
    medium: WalkMedium | tuple[()] = ()  # of the walk


@dataclass
class Crossing:
    """What a walk did at the boundary."""

    si: mi.SurfaceInteraction3f  # with the normals outwards
    along: mi.Vector3f  # direction of arrival
    leaves: mi.Bool  # all objects, or is reflected
    pdf: mi.Float  # density of the new direction, 1/sr
    delta: mi.Bool  # whether that direction was the only one

    def reflected(self, media: WalkMedia, d: mi.Vector3f) -> mi.Bool:
        """Whether the boundary of an object has reflected a walk back into it, along d."""
        if media.inner is None:
            return ~self.leaves
        inwards = (dr.dot(self.along, self.si.n) > 0) & (dr.dot(d, self.si.n) < 0)
        return inwards & (media.index_of(self.si) >= 0)

    def brings(self, media: WalkMedia, d: mi.Vector3f) -> mi.Bool:
        """Whether unscattered light that is precomputed comes by it to a walk inside that goes on along d."""
        if not media.nested:
            return self.reflected(media, d)
        return ~self.leaves & (media.index_of(self.si) >= 0)


class Visitor(Protocol):
    """What is recorded of a walk. Each method returns the walk, whose random numbers it may use up, and its record: as
    they are where nothing is to be done."""

    def event(self, walk: Walk, record: Record, event: Event) -> tuple[Walk, Record]:
        """At a scattering event, after `walk.order` others; it may end the walk."""
        return walk, record

    def boundary(self, walk: Walk, record: Record, si: mi.SurfaceInteraction3f, active: mi.Bool) -> tuple[Walk, Record]:
        """At the boundary from inside, where the walk may leave if `active`."""
        return walk, record

    def surface(
        self, walk: Walk, record: Record, si: mi.SurfaceInteraction3f, bsdf: mi.BSDFPtr, k: mi.Int32
    ) -> tuple[Walk, Record]:
        """At a surface inside an object: that of object k, or of something else if k < 0."""
        return walk, record

    def crossing(self, walk: Walk, record: Record, crossing: Crossing) -> tuple[Walk, Record]:
        """After reflection at the boundary or refraction through it; `walk` is on its way again."""
        return walk, record


class StartVisitor(Visitor, Protocol):
    """One of walks from given points."""

    def begun(self, index: mi.UInt32) -> Record:
        """The record of the walks with these numbers, at their starts; the numbers by default."""
        return index


@dataclass(frozen=True, eq=False)
class Walker:
    """A walk inside translucent objects.
    `media`: the objects. `visitor`: what is recorded. `roulette_from`: scattering events from which on roulette may end
    a walk. `ahead`: the record with what is recorded along a flight to the boundary, by its coefficients and length."""

    media: WalkMedia
    visitor: Visitor
    roulette_from: int = 1
    ahead: Callable | None = None

    def step(self, walk: Walk, record: Record) -> tuple[Walk, Record]:
        """A free flight, and the scattering event, the null collision or the boundary at its end."""
        # ---- free path t = -ln(1 - u) / M_k, and the boundary on its way
        media, rng = self.media, walk.rng
        m, u = media.coefficients(walk.object, walk.o, walk.medium), None
        draw = rng.next_float32()
        if len(walk.kept):
            draw = draw * pick(walk.kept, walk.channel)
        t = free_path(m, walk.channel, draw)
        ray, p = walk.ray(t), mi.Point3f(walk.o + walk.d * t)
        if self.ahead is not None:
            ray.maxt = dr.largest(mi.Float)
        hit = (media.inner or media).scene.ray_intersect_preliminary(ray, coherent=False)
        if self.ahead is not None:
            record = self.ahead(walk, record, m, walk.reach(hit.t))

        # ---- w_c = f_c / mean_k p_k of the flight, by the coefficients at its end
        if media.varies:
            m, u = media.coefficients(walk.object, p, walk.medium), rng.next_float32()
        flight = fly(m, walk.weight, walk.density, walk.channel, t, walk.reach(hit.t), u)
        walk = replace(walk, weight=flight.weight, density=flight.density)
        if len(walk.kept):
            weight, density = weigh(walk.weight, walk.density, mi.Spectrum(1), 1 / walk.kept)
            walk = replace(walk, weight=weight, density=density)

        # ---- a null collision goes on from p along the same direction; what rounding has put outside ends
        event = Event(p, ray.d, walk.object, m, walk.medium)
        meets = ~(flight.scatters | flight.null)
        if media.varies:
            o = dr.select(flight.null, p, walk.o)
            off = dr.select(flight.null, media.behind(walk.object, walk.d), walk.off)
            walk = replace(walk, o=o, off=off, alive=walk.alive & (~flight.null | media.box.contains(o)))
            walk.object = dr.select(walk.alive, walk.object, OUTSIDE)

        # ---- a real collision scatters, the boundary reflects or lets out
        walk, record = dr.if_stmt((walk, record, event), flight.scatters, self._scatter, _pass, label="scatter")
        meet = self._meet if media.inner is None else self._meet_inside
        return dr.if_stmt((walk, record, ray, hit), meets, meet, _pass, label="boundary")

    def _scatter(self, walk: Walk, record: Record, event: Event) -> tuple[Walk, Record]:
        # ---- light at the event, then a direction by the phase function
        walk, record = self.visitor.event(walk, record, event)
        rng, media = walk.rng, self.media
        u = mi.Point2f(rng.next_float32(), rng.next_float32())
        d, weight, density = turn(event.m, walk.weight, walk.density, walk.channel, event.along, u, media.same_g)

        # ---- roulette, by the largest weight as it would be outside
        order = walk.order + 1
        scale = walk.scale
        if self.roulette_from > 1:  # before, walks without weight alone end
            scale = dr.select(order < self.roulette_from, dr.largest(mi.Float), scale)
        survives, weight = roulette(weight, scale, rng.next_float32())
        alive = walk.alive & survives & (order <= media.row("most", walk.object)) & media.box.contains(event.p)
        walk = replace(walk, o=event.p, d=d, off=media.behind(walk.object, d), weight=weight, density=density,
                       kept=mi.Spectrum(1) if len(walk.kept) else (),
                       order=order, alive=alive, object=dr.select(alive, walk.object, OUTSIDE))  # fmt: skip
        return walk, record

    def _meet(
        self, walk: Walk, record: Record, ray: mi.Ray3f, hit: mi.PreliminaryIntersection3f
    ) -> tuple[Walk, Record]:
        """Reflection at the boundary seen from inside, or the way out."""
        # ---- the boundary that is met, with its normals outwards
        media, k = self.media, walk.object
        si = media.instance_scene.interaction(hit, ray, media.needed)
        met = media.met(si, k)
        si = media.seen(si, k, ray.d)
        # the flight goes on behind an object that overlaps, and behind the own boundary if rounding has put it outside
        passes = (met != k) | (dr.dot(si.n, ray.d) < 0)

        # ---- light through a rough boundary, then reflection with the probability F, else refraction
        counts = media.counts(k, walk.order)
        walk, record = self.visitor.boundary(walk, record, si, ~passes & counts)
        stays = mi.Bool(False)
        if len(walk.kept):
            stays, walk = dr.min(walk.kept) < 1, replace(walk, kept=mi.Spectrum(1))
        bs, value = sample_bsdf(media.boundary(k), si, walk.rng, reflects=stays)
        d, turned = sided(si, bs.wo)

        # ---- the way on: outside only with an order that counts; weight *= value, scale *= eta²
        out = ~passes & (dr.dot(d, si.n) > 0)
        alive = (passes | (bs.pdf > 0)) & (~out | counts)
        d = dr.select(passes, ray.d, d)
        o, off = media.depart(si, d, ~out)
        walk = replace(walk, o=o, d=d, off=off, alive=alive,
                       object=dr.select(alive & ~out, k, OUTSIDE),
                       weight=dr.select(passes, walk.weight, walk.weight * value),
                       scale=walk.scale * dr.select(passes, 1, dr.square(bs.eta)))  # fmt: skip
        delta = mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta) | turned
        crossing = Crossing(si, mi.Vector3f(ray.d), out, bs.pdf, delta)
        return dr.if_stmt((walk, record, crossing), ~passes, self._cross, _pass, label="crossing")

    def _meet_inside(
        self, walk: Walk, record: Record, ray: mi.Ray3f, hit: mi.PreliminaryIntersection3f
    ) -> tuple[Walk, Record]:
        """The same where something lies inside: reflection or refraction at any surface, into what is on that side."""
        # ---- what is met: the own boundary, that of an object within, or another surface
        media, inner, k = self.media, self.media.inner, walk.object
        si = media.instance_scene.interaction(hit, ray, mi.RayFlags.All)
        met, around = media.index_of(si, si.is_valid()), inner.around(si)
        own, nested, plain = met == k, (met >= 0) & (met != k), met < 0
        si = media.seen(si, met, ray.d)
        refracts = plain & inner.displaces(si)
        inwards = dr.dot(si.n, ray.d) < 0

        # the flight goes on behind what it can meet only if rounding has put it there
        passes = (own & inwards) | ((nested | refracts) & (~inwards | (around != k)))
        bsdf = dr.select(plain, si.bsdf(), media.boundary_pointer(dr.maximum(met, 0)))
        to = dr.select(own, around, dr.select(nested, met, dr.select(refracts, OUTSIDE, k)))
        if inner.priorities is not None:
            of = inner.priorities.meet(si, ray.d, walk.within)
            passes, to, bsdf = (
                dr.select(of.member, a, b) for a, b in zip((of.passes, of.object, of.bsdf), (passes, to, bsdf))
            )
            met = dr.select(of.member & passes, k, met)
            own &= (to >= 0) | (of.within == 0)

        # ---- light that the surface emits or sends on, then a direction by its BSDF
        walk, record = self.visitor.surface(walk, record, si, bsdf, met)
        walk, record = self.visitor.boundary(walk, record, si, own & ~passes & (to < 0))
        bs, value = sample_bsdf(bsdf, si, walk.rng)
        d, turned = sided(si, bs.wo)
        d = dr.select(plain, si.to_world(bs.wo), d)

        # ---- through: into what is around the own boundary, into the object met, or into glass, which is outside
        through = (mi.Frame3f.cos_theta(bs.wo) * mi.Frame3f.cos_theta(si.wi) < 0) & ~mi.has_flag(
            bs.sampled_type, mi.BSDFFlags.Null
        )
        through &= ~passes
        leaves = own & through & (to < 0)
        if inner.priorities is not None:
            walk = replace(walk, within=dr.select(of.member & (through | passes), of.within, walk.within))
        to, d, value = dr.select(through, to, k), dr.select(passes, ray.d, d), dr.select(passes, 1, value)
        alive = walk.alive & si.is_valid() & (passes | ((bs.pdf > 0) & (dr.max(value) > 0)))

        # ---- the way on, with the medium of what it enters; such paths count as a transport's from now on
        o, off = media.depart(si, d, to >= 0)
        if media.carried:
            new = (to != k) & (to >= 0)
            walk = replace(walk, medium=dr.select(new, media.fetch(dr.maximum(to, 0), si, new), walk.medium))
        walk = replace(walk, o=o, d=d, off=off, alive=alive, object=dr.select(alive, to, OUTSIDE),
                       weight=walk.weight * value, scale=walk.scale * dr.select(passes, 1, dr.square(bs.eta)),
                       order=dr.select(own | passes, walk.order, dr.maximum(walk.order, MET)))  # fmt: skip
        delta = mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta) | (turned & ~plain)
        crossing = Crossing(si, mi.Vector3f(ray.d), leaves, bs.pdf, delta)
        return dr.if_stmt((walk, record, crossing), ~passes, self._cross, _pass, label="crossing")

    def _cross(self, walk: Walk, record: Record, crossing: Crossing) -> tuple[Walk, Record]:
        return self.visitor.crossing(walk, record, crossing)


def _pass(walk: Walk, record: Record, *rest: object) -> tuple[Walk, Record]:
    return walk, record


def start_walk(o: mi.Point3f, d: mi.Vector3f, rng: mi.PCG32, medium: WalkMedium | tuple[()] = ()) -> Walk:
    """A walk that begins outside; `medium` is what it carries."""
    lanes = dr.width(o)
    return Walk(
        alive=dr.full(mi.Bool, True, lanes), object=dr.full(mi.Int32, OUTSIDE, lanes), o=o, d=d,
        off=dr.zeros(mi.Vector3f, lanes), channel=dr.full(mi.UInt32, 0, lanes), weight=dr.full(mi.Spectrum, 1, lanes),
        density=dr.full(mi.Spectrum, 1, lanes), scale=dr.full(mi.Float, 1, lanes),
        order=dr.full(mi.UInt32, 0, lanes), rng=rng, medium=medium,
    )  # fmt: skip


def sample_bsdf(
    bsdf: mi.BSDFPtr, si: mi.SurfaceInteraction3f, rng: mi.PCG32, ctx: mi.BSDFContext | None = None,
    reflects: mi.Bool | bool = False, refracts: mi.Bool | bool = False,
) -> tuple[mi.BSDFSample3f, mi.Spectrum]:  # fmt: skip
    """A direction by a BSDF and its weight: 1 for a smooth dielectric whose choice is given."""
    u, v = rng.next_float32(), mi.Point2f(rng.next_float32(), rng.next_float32())
    u = dr.select(reflects, 0, dr.select(refracts, 1, u))
    return bsdf.sample(ctx or mi.BSDFContext(), si, u, v)


def below(n: int, u: mi.Float) -> mi.UInt32:
    """One of the whole numbers 0 ... n - 1, for a uniform number."""
    return dr.minimum(mi.UInt32(u * n), n - 1)


def draw_channel(shares: mi.Spectrum, u: mi.Float) -> tuple[mi.UInt32, mi.Spectrum]:
    """A channel of these probabilities, and q of a walk that begins with it."""
    channel, below = mi.UInt32(0), mi.Float(0)
    for share in list(shares)[:-1]:
        below = below + share
        channel = channel + dr.select(u < below, mi.UInt32(0), 1)
    return channel, shares * len(shares)


def draw(n: int, rng: mi.PCG32) -> mi.UInt32:
    """A random whole number below n."""
    return below(n, rng.next_float32())


# ---- Surfaces met from outside, where something lies inside or overlaps ---------------------------------------------


class Behind(NamedTuple):
    """What is behind a surface that a ray outside of objects has met, where something lies inside or overlaps.

    Args:
        member: whether the surface is a boundary to an object or in one.
        object: the number of the object behind it, or OUTSIDE.
        within: see `Walk.within`.
        unlit: whether emitters are met by chance alone: a medium, or boundaries that are hidden, are between.
    """

    member: mi.Bool
    bsdf: mi.BSDFPtr
    object: mi.Int32
    within: mi.UInt32 | tuple[()]
    unlit: mi.Bool

    def entered(self, walk: Walk, through: mi.Bool, k: mi.Int32, enters: mi.Bool) -> tuple[Walk, mi.Int32, mi.Bool]:
        """The walk, the object that it is in and whether it has entered that, where it goes through the surface."""
        if len(walk.within):
            walk = replace(walk, within=dr.select(through, self.within, walk.within))
        inside = through & (self.object >= 0)
        return walk, dr.select(self.member, self.object, k), dr.select(self.member, inside, enters)


def behind_of(
    media: WalkMedia, walk: Walk, si: mi.SurfaceInteraction3f, bsdf: mi.BSDFPtr, translucent: mi.Bool
) -> Behind:
    """Glass inside an object seen from within, which has that behind it, and boundaries of things that overlap."""
    inner = media.inner
    around = inner.around(si)
    encloses = ~translucent & (around >= 0) & inner.displaces(si) & (dr.dot(walk.d, si.n) > 0)
    if not len(walk.within):
        return Behind(encloses, bsdf, around, (), encloses)
    met = inner.priorities.meet(si, walk.d, walk.within)
    pairs = ((met.bsdf, bsdf), (met.object, around), (met.within, walk.within))
    return Behind(
        encloses | met.member, *(dr.select(met.member, a, b) for a, b in pairs), encloses | (walk.within != 0)
    )


def skip(media: WalkMedia, walk: Walk, si: mi.SurfaceInteraction3f) -> tuple[Walk, mi.Bool]:
    """The walk behind a boundary that a higher priority hides, and whether it has met one."""
    si = media.face_outwards(si, media.index_of(si, si.is_valid()), walk.d)
    met = media.inner.priorities.meet(si, walk.d, walk.within)
    skips = walk.alive & met.passes
    o, _ = media.depart(si, walk.d, mi.Bool(False))
    return replace(walk, o=dr.select(skips, o, walk.o), within=dr.select(skips, met.within, walk.within)), skips


# ---- Walks from given points ----------------------------------------------------------------------------------------
#
# What a model of the light transport of an object is learnt from. A walk enters at x_o against the direction w_o and
# leaves at x_i into w_i with the throughput T of each channel. Both refractions and absorption are in T; reflection at
# x_o is not, so that walks which never enter have none:
#
#     ∫∫ S(x_i, w_i; x_o, w_o) mu_i f(x_i, w_i) dw_i dA_i = E[T f(x_i, w_i)].

LANES = 2**15
PATH_LANES = 2**14  # of paths from cameras and emitters: fastest of 2**12 to 2**18 on 2 cores
GPU_FACTOR = (
    16  # as many times lanes and samples on CUDA: 18 and 25 ns a sample on an H200; by 4 20 and 28, by 1 32 and 49
)
ROULETTE_FROM = 8  # scattering events: from 2 on weak channels of ketchup have 10 times the variance, for no time less
MOST = 2**31 - 1  # scattering events


def on_device(number: int) -> int:
    """A number of lanes or samples for the device of the current variant."""
    return number * GPU_FACTOR if mi.variant().startswith("cuda") else number


class WalkExits(NamedTuple):
    """Where walks leave, in the order of their starts.
    `at`: x_i and w_i. `T`: throughput; 0 where the walk ended inside or left at an order that is not kept. `order`:
    scattering events. `face`: of the mesh, at x_i."""

    at: SurfacePoint
    T: mi.Spectrum
    order: mi.UInt32
    face: mi.UInt32

    @classmethod
    def none(cls, n: int) -> WalkExits:
        """Room for those of n walks."""
        at = SurfacePoint(*(dr.zeros(kind, n) for kind in (mi.Point3f, mi.Normal3f, mi.Normal3f, mi.Vector3f)))
        return cls(at, dr.zeros(mi.Spectrum, n), dr.zeros(mi.UInt32, n), dr.zeros(mi.UInt32, n))

    def gather(self, walks: mi.UInt32) -> WalkExits:
        return WalkExits(self.at.gather(walks), *(dr.gather(type(v), v, walks) for v in self[1:]))

    def put(self, index: mi.UInt32, walk: Walk, crossing: Crossing, kept: mi.Bool) -> None:
        """Store x_i and w_i of a walk that leaves, with its throughput, at its number."""
        si = crossing.si
        at = surface_point(si.p, si.n, si.sh_frame.n, walk.d)
        targets, values = (*self.at[:4], *self[1:]), (*at[:4], walk.weight, walk.order, si.prim_index)
        for target, value in zip(targets, values):
            dr.scatter(target, type(target)(value), index, kept)

    @property
    def left(self) -> mi.Bool:
        """Whether the walk left at an order that is kept."""
        return dr.max(self.T) > 0


@dataclass(frozen=True, eq=False)
class ExitVisitor(StartVisitor):
    """Stores each exit at the number of its walk, which is its record, and ends the walk there.
    `exits`: where they are stored. `fewest`, `most`: orders that are kept."""

    exits: WalkExits
    fewest: mi.UInt32
    most: mi.UInt32

    @classmethod
    def of(cls, n: int, fewest: int = 0, most: int = MOST) -> ExitVisitor:
        """For n walks."""
        exits = WalkExits.none(n)
        evaluate(exits)
        return cls(exits, *(dr.opaque(mi.UInt32, order) for order in (fewest, most)))

    def crossing(self, walk: Walk, record: mi.UInt32, crossing: Crossing) -> tuple[Walk, mi.UInt32]:
        leaves = walk.alive & crossing.leaves
        kept = leaves & (walk.order >= self.fewest) & (walk.order <= self.most)
        self.exits.put(record, walk, crossing, kept)
        return replace(walk, alive=walk.alive & ~leaves), record


def exits(
    media: WalkMedia, k: int, start: SurfacePoint, seed: int | tuple[int, ...], fewest: int = 0, most: int = MOST
) -> WalkExits:
    """Where walks from points on object k leave it. `media`, `k`, `start`, `seed`: as of `walk_from`. `fewest`, `most`:
    numbers of scattering events that are kept, among the orders of the object. Returns exits in the order of the
    starts. ValueError if there is no object k, or the arrays of `start` are of different lengths."""
    visitor = ExitVisitor.of(dr.width(start.p), fewest, most)
    walk_from(media, k, start, visitor, seed)
    evaluate(visitor.exits)
    return visitor.exits


def walk_from(
    media: WalkMedia,
    k: int,
    start: SurfacePoint,
    visitor: StartVisitor,
    seed: int | tuple[int, ...],
) -> None:
    """Walk from points on object k until the walks leave it or end inside.

    Args:
        media: the translucent objects of a scene, see `WalkMedia.of`.
        start: p, n, n_out and w, arrays of one length; where w is below the surface, no walk enters.
        visitor: what is recorded. It has to end walks that leave.
        seed: one whole number or more.

    Raises:
        ValueError: there is no object k, its medium has textures and is not known at the start, or the arrays of
            `start` are of different lengths.
    """
    # ---- lanes take walks index, index + lanes, ... until none is left
    n = _check(media, k, start)
    if n == 0:
        return
    evaluate(start)
    lanes = min(LANES, n)
    walker = Walker(media, visitor, ROULETTE_FROM)
    total, step, k = (dr.opaque(mi.UInt32, v) for v in (n, lanes, k))  # kernels then serve any number of walks

    def renew(walk: Walk, index: mi.UInt32, record: Record) -> tuple[Walk, mi.UInt32, Record]:
        index = index + step
        return _enter(media, k, start, total, index, walk.rng), index, visitor.begun(index)

    # a free flight where a walk is alive, another walk where it has ended
    def body(walk: Walk, index: mi.UInt32, record: Record) -> tuple[Walk, mi.UInt32, Record]:
        walk, record = dr.if_stmt((walk, record), walk.alive, walker.step, lambda *s: s, label="inside")
        return dr.if_stmt((walk, index, record), ~walk.alive, renew, lambda *s: s, label="renew")

    # ---- one loop over all walks
    seeds = seed if isinstance(seed, tuple) else (seed,)
    index = lane_numbers(lanes)
    walk = _enter(media, k, start, total, index, generator(mi, lanes, pass_seed(*seeds)))
    state = (walk, index, visitor.begun(index))
    dr.while_loop(state, lambda walk, index, record: index < total, body, label="walks")
    dr.eval()


def _check(media: WalkMedia, k: int, start: SurfacePoint) -> int:
    """The number of starts."""
    if not 0 <= k < len(media.objects):
        raise ValueError(f"k must be a whole number in [0, {len(media.objects) - 1}], got {k!r}")
    if media.carried and not start.medium:
        raise ValueError(f"walks from points of {media.objects[k].name}, which has textures, must know their medium")
    widths = [dr.width(v) for v in start[:4]]
    if len(set(widths)) > 1:
        raise ValueError(f"p, n, n_out and w of the starts must be of one length, got {widths}")
    return widths[0]


def _enter(
    media: WalkMedia, k: mi.UInt32, start: SurfacePoint, total: mi.UInt32, index: mi.UInt32, rng: mi.PCG32
) -> Walk:
    """The walk of one of so many starts, refracted into the object."""
    # ---- the point of the boundary, as the direction w outside sees it
    known = index < total
    si = dr.zeros(mi.SurfaceInteraction3f, dr.width(index))
    si.p = dr.gather(mi.Point3f, start.p, index, known)
    si.n = dr.gather(mi.Normal3f, start.n, index, known)
    si.sh_frame = mi.Frame3f(dr.gather(mi.Normal3f, start.n_out, index, known))
    w = dr.gather(mi.Vector3f, start.w, index, known)
    si.wi = si.to_local(w)
    si = lift(si, w)

    # ---- refraction into the object, with the weight 1 - F
    ctx = mi.BSDFContext()
    ctx.type_mask = mi.BSDFFlags.Transmission
    bs, value = sample_bsdf(media.boundary(k), si, rng, ctx)
    d, _ = sided(si, bs.wo)

    # ---- the medium of the start, for the whole walk
    medium: WalkMedium | tuple[()] = ()
    if media.carried:
        of_exit = dr.gather(MediumAt, start.medium, index, known)
        lanes = dr.width(index)
        medium = replace(media.unknown(lanes), sigma_t=of_exit.sigma_t, sigma_s=of_exit.albedo * of_exit.sigma_t)

    # ---- the walk, whose channel is drawn once
    walk = start_walk(si.p, d, rng, medium)
    if media.overlaps:
        walk.within = media.inner.priorities.start(mi.UInt32(k) + dr.zeros(mi.UInt32, dr.width(index)))
    enters = known & (dr.dot(w, si.n) > 0) & (dr.dot(d, si.n) < 0) & (dr.max(value) > 0)
    enters &= mi.Frame3f.cos_theta(si.wi) > 0
    channel = draw(len(value), rng) if len(value) > 1 else walk.channel
    return replace(walk, alive=enters, object=mi.Int32(k) + dr.zeros(mi.Int32, dr.width(index)), weight=value,
                   off=media.clear(k, si.n, d), scale=dr.square(bs.eta), channel=channel)  # fmt: skip
