"""The path loop of `translucent_walk`: surfaces by their BSDFs, objects by random walks, emitters by MIS.

One symbolic loop whose lanes begin a new path when one ends. A step is a segment inside an object (`random_walk`) or a
ray outside with the surface that it meets. Emission is weighted against next-event estimation at the previous vertex
and against the strategies of `emitter_connections`. Delta lights, which no ray meets, are spread over
a cone where a path leaves a vertex that next-event estimation could not light (`objects.small_emitters`). Boundaries of
index 1 are no vertices (`straight_light`).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple

import drjit as dr
import mitsuba as mi

from full_geometry.geometry.instances import shapes_of
from full_geometry.geometry.points import SurfacePoint, evaluate, lane_numbers, opaque, sided
from full_geometry.geometry.rounding import ray_from
from full_geometry.geometry.sensors import past_emitters, shows_sky
from full_geometry.integrators.gathering import OutgoingLight
from full_geometry.objects.small_emitters import NARROW, WIDE, SmallEmitters
from full_geometry.precomputed.forward_scattering import ForwardRun
from full_geometry.precomputed.scattered_light import FEW, ONWARD
from full_geometry.precomputed.unscattered_light import UnscatteredLight
from full_geometry.walk.emission import emission, emitter_pdf, mis_weight, next_event, survival
from full_geometry.walk.emitter_connections import Departure, EmitterDirections, InnerLights, SubpathConnections
from full_geometry.walk.media import Coefficients, WalkMedia, WalkMedium, interaction_of, ray_of
from full_geometry.walk.random_walk import (
    OUTSIDE,
    Crossing,
    Event,
    Visitor,
    Walk,
    Walker,
    WalkExits,
    behind_of,
    draw,
    draw_channel,
    eval_phase,
    pick,
    sample_bsdf,
    skip,
    start_walk,
)
from full_geometry.walk.scores import PathScores, Score, ScoreVisitor, Stay, StayRecord
from full_geometry.walk.straight_light import StraightLight
from halfspace_sss.tracing.walk import generator, pass_seed

ALONG = 3  # events that are looked up along a flight, a multiple of the channels
MIRRORS = 2  # of objects, one in the other, in which the first surface of a path finds emission
LEAST_SEEN = 1e-3  # transmittance, below which emission behind an object is left to chance
LEAST_FORWARD = 0.1  # share of forward events alone, from which directions to small emitters are drawn
REFLECTIONS, LEAST_REFLECTED = 6, 0.01  # inside an object, of what is seen through it; throughput that is followed

# ---- Loop state ------------------------------------------------------------------------------------------------------


@dataclass
class LightRecord:
    """Light of a path so far, and the last vertex as the MIS weight of the next emission needs it."""

    L: mi.Spectrum  # radiance
    previous: mi.Point3f  # vertex that the ray comes from
    pdf: mi.Float  # density of the ray's direction there, 1/sr
    delta: mi.Bool  # whether that direction was the only one
    straight: mi.Bool  # nothing has reflected since the last event
    connected: mi.Bool  # there was a straight edge: connections find what small emitters send along this path
    pivot: mi.Point3f  # the event that the last such edge began at, where they were made
    directed: mi.Bool  # directions to emitters were sampled at the last event, and nothing has reflected since
    departure: Departure  # from the last event
    sighted: mi.Bool  # an emitter was sampled at the last event, and only boundaries of index 1 were passed since
    scattered: mi.Bool  # whether a vertex has scattered into a solid angle: delta lights then are no longer hidden
    precomputed: mi.Bool  # the ray's emission is in the light of the last event, in the mirror image, or seen through
    known: mi.Bool  # light that comes by objects alone is in that of the last event
    ended: mi.Bool  # and that of later events too
    slopes: Score | tuple[()] = ()  # where derivatives are asked for, see `walk.scores`
    run: ForwardRun | tuple[()] = ()  # where precomputed light has met forward events
    shallow: mi.Bool | tuple[()] = ()  # one event at most since the path went in, where deep light is told apart
    exits: mi.UInt32 | tuple[()] = ()  # boundaries that a path without events meets, behind which emission is known

    def onward(self, passed: mi.Bool) -> LightRecord:
        """The record at a surface; `passed`: whether it is one of those that precomputed light comes by."""
        return replace(self, known=self.known & passed, ended=self.ended & passed)


class Seen(NamedTuple):
    """Emission that is found without chance along one way from a boundary.
    `light`: of that way, with the throughput. `found`: whether it is found. `kept`: probability that a path does not
    take that way; 1 where it may meet surfaces there."""

    light: mi.Spectrum
    found: mi.Bool
    kept: mi.Spectrum


class SeenThrough(NamedTuple):
    """Emission that is found without chance behind an object, on the way of a path without events.
    `light`: with the throughput. `exits`: boundaries on that way, behind which it is found. `kept`: probability that a
    first flight does not leave; 1 where it may meet surfaces there."""

    light: mi.Spectrum
    exits: mi.UInt32
    kept: mi.Spectrum


@dataclass
class WayThrough:
    """Loop variables of a way inside an object without events: where its segment begins, from there to where its ray
    does, the direction, the throughput, whether it goes on, the boundaries that it has met, and light so far."""

    o: mi.Point3f
    off: mi.Vector3f
    d: mi.Vector3f
    throughput: mi.Spectrum
    going: mi.Bool
    exits: mi.UInt32
    light: mi.Spectrum


@dataclass
class CameraPath:
    """Loop variables of a path from the camera."""

    index: mi.UInt32  # which ray it began with
    walk: Walk  # the ray it is on, outside or inside an object
    light: LightRecord  # what it has gathered
    hit: mi.Bool  # whether its first ray hit anything
    depth: mi.UInt32  # vertices on surfaces met from outside
    mirrored: mi.Bool  # whether it has met mirrors of objects alone, all from outside
    stay: Stay | tuple[()] = ()  # inside an object, where derivatives are asked for
    emission: mi.Spectrum | tuple[()] = ()  # seen at once or in the mirror of what is met first, if asked for
    passed: mi.Bool | tuple[()] = ()  # whether it has been inside an object, see `_cut`


# ---- Light gathered along a path -------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class LightVisitor:
    """Light gathered at the events and boundaries of walks.

    Args:
        connections: of events with light subpaths of small emitters, if there are any.
        directions: from events to small emitters, where connections cannot find their light, or after forward events
            alone where it is precomputed.
        straight_light: of emitters through boundaries of index 1, if there are any.
        inner_lights: delta lights inside objects, if there are any.
        blur: scale of the cones over which delta lights outside are spread; 0 leaves their light out.
        unscattered: light that events find precomputed, in place of connections and straight light.
        outgoing: deep light of objects, of paths inside that begin with two scattering events, known where they go in.
        deep: whether that light alone counts, of the object that a path meets first.
        reflections: whether emission behind objects is found after reflections inside, too.
        brightest: most that a direction to an emitter brings after forward events, as of `PathTracer`.
    """

    scene: mi.Scene
    media: WalkMedia
    small: SmallEmitters | None
    connections: SubpathConnections | None
    directions: EmitterDirections | None
    straight_light: StraightLight | None = None
    inner_lights: InnerLights | None = None
    blur: float = 1.0
    unscattered: UnscatteredLight | None = None
    outgoing: OutgoingLight | None = None
    deep: bool = False
    reflections: bool = False
    brightest: mi.Float | None = None

    @property
    def splits(self) -> bool:
        """Whether deep light is apart from all other."""
        return self.deep or self.outgoing is not None

    def event(self, walk: Walk, record: LightRecord, event: Event) -> tuple[Walk, LightRecord]:
        if not self.splits:
            return self._lit_event(walk, record, event)[:2]
        if self.forward:
            return self._split_event(walk, record, event)
        # ---- unscattered light that is looked up on the flight is no deep light, all else is; other walks end
        L, shallow = record.L, record.shallow
        if self.ahead:
            walk, record, _ = self._lit_event(walk, record, event)
            record = replace(record, L=dr.select(shallow, L, record.L), shallow=mi.Bool(False))
            return walk if self.deep else replace(walk, alive=walk.alive & ~shallow), record

        # ---- deep light begins at the second event, and by connections at the first; other walks end at the second
        L, second = record.L, record.shallow & (walk.order > 0)
        record = replace(record, shallow=record.shallow & ~second)
        walk, record, connected = self._lit_event(walk, record, event)
        if self.deep:
            return walk, replace(record, L=dr.select(record.shallow, L + connected, record.L))
        return replace(walk, alive=walk.alive & ~second), replace(record, L=dr.select(second, L, record.L))

    def _split_event(self, walk: Walk, record: LightRecord, event: Event) -> tuple[Walk, LightRecord]:
        """The walk and its record where phase functions are split: what has turned forwards alone is no deep light."""
        # ---- L += f throughput J, f the forward share of the turns so far, in deep light the rest
        before, L, first, shallow = record.run.share, record.L, walk.order == 0, record.shallow
        walk, record, _ = self._lit_event(walk, record, event)
        f = dr.select(shallow, self._part(walk, record), 1)
        if self.ahead and not self.deep:  # looked up along the flight
            f = dr.select(shallow & first, 0, f)
        record = replace(record, L=L + f * (record.L - L))
        if self.deep:
            return walk, record

        # ---- walks end where all is deep from here on, as where g is 0, else by roulette as the share falls
        onward = dr.max(dr.abs(mi.Spectrum(event.m.g))) > 0
        kept = dr.minimum(dr.max(dr.abs(record.run.share)) / dr.maximum(dr.max(dr.abs(before)), 1e-6), 1)
        kept = dr.select(shallow, dr.select(onward, dr.select(first, 1, kept), 0), 1)
        alive = walk.alive & (walk.rng.next_float32() < kept)
        return replace(walk, alive=alive, weight=walk.weight / dr.maximum(kept, 1e-6)), record

    def _part(self, walk: Walk, record: LightRecord) -> mi.Spectrum:
        """f of a walk: the forward share of its turns, 1 before the first, and in deep light the rest."""
        share = dr.select(walk.order > 0, record.run.share, 1)
        return 1 - share if self.deep else share

    @property
    def ahead(self) -> bool:
        """Whether unscattered light of first events is looked up along flights."""
        return self.splits and self.unscattered is not None and not self.media.varies

    def flight(self, walk: Walk, record: LightRecord, m: Coefficients, length: mi.Float) -> LightRecord:
        """The record with the light of first events along a flight: Σ w sigma_s T J / density."""
        n, looks = len(m.sigma_t), record.shallow & (walk.order == 0)
        ends, shift = 1 - dr.exp(-m.sigma_t * length), walk.rng.next_float32()

        def look(j: mi.UInt32, light: mi.Spectrum) -> tuple[mi.UInt32, mi.Spectrum]:
            # s = -ln(1 - u (1 - exp(-sigma_t length))) / sigma_t, for the channels in turn, u stratified
            c, u = j % n, shift + mi.Float(j) / ALONG
            u = (u - dr.floor(u)) * pick(ends, c)
            s = dr.minimum(-dr.log(1 - dr.minimum(u, 1 - 1e-7)) / pick(m.sigma_t, c), length)
            T = dr.exp(-m.sigma_t * s)
            density = dr.sum(m.sigma_t * T / dr.maximum(ends, 1e-30)) / n
            event = Event(walk.o + walk.d * s, walk.d, walk.object, m, walk.medium)
            J = self.unscattered.light(self.media, event)[0]
            return j + 1, light + m.sigma_s * T * J / dr.maximum(density, 1e-30)

        def along(light: mi.Spectrum) -> tuple[mi.Spectrum]:
            state = (mi.UInt32(0), light)
            return (dr.while_loop(state, lambda j, _: j < ALONG, look, label="events")[1],)

        (light,) = dr.if_stmt((mi.Spectrum(0),), looks, along, _same_state, label="along a flight")
        return replace(record, L=record.L + walk.weight * light / ALONG)

    def _left_early(self, walk: Walk, record: LightRecord, L: mi.Spectrum, moved: mi.Bool) -> tuple[Walk, LightRecord]:
        """The walk and its record; where it has moved on before deep light began, L stays in that."""
        early = record.shallow & moved
        record = replace(record, shallow=record.shallow & ~early)
        if self.forward:  # throughput *= f, and what this step has brought by f
            f = dr.select(early, self._part(walk, record), 1)
            walk = replace(walk, weight=walk.weight * f, alive=walk.alive & (dr.max(dr.abs(f)) > 0))
            return walk, replace(record, L=L + f * (record.L - L))
        if not self.deep:
            return walk, record
        return replace(walk, alive=walk.alive & ~early), replace(record, L=dr.select(early, L, record.L))

    def _lit_event(self, walk: Walk, record: LightRecord, event: Event) -> tuple[Walk, LightRecord, mi.Spectrum]:
        """The walk and its record with light of an event; the last is that of connections."""
        # ---- delta lights inside: L += throughput p(cos) E
        record = replace(record, scattered=mi.Bool(True))
        if self.inner_lights is not None:
            at = interaction_of(event.p, walk.medium)
            d, E = self.inner_lights.light(walk.object, at, walk.rng, True, walk.medium)
            record = replace(record, L=record.L + walk.weight * eval_phase(event.m, dr.dot(event.along, d)) * E)

        # ---- emitters whose light arrives unscattered: L += throughput ∫ p(w.w') L_0(x, w') dw'
        if self.unscattered is not None:
            counts = self.media.counts(walk.object, walk.order + 1)
            if self.unscattered.scattered is not None:
                return *self._all_light(walk, record, event), mi.Spectrum(0)
            L = walk.weight * self.unscattered.light(self.media, event)[0]
            if self.forward:
                share = dr.select(record.precomputed & (walk.order > 0), record.run.onward(event.along).share, 1)
                run = ForwardRun(share, mi.Vector3f(event.along), mi.Spectrum(event.m.g), mi.Bool(True))
                record = replace(record, run=run)
            record = replace(record, L=record.L + dr.select(counts, L, 0), precomputed=mi.Bool(True))
            if self.directions is not None:  # which go with forward events alone
                lit = counts & (dr.max(record.run.share) > LEAST_FORWARD) & (dr.max(dr.abs(record.run.g)) > 0)
                walk, record = self._directed(walk, record, event, lit)
            return walk, record, mi.Spectrum(0)

        # ---- emitters behind boundaries of index 1: L += throughput p L_e T / p_e  p_e / (p_e + p)
        if self.straight_light is not None:
            sees = self.media.straight(walk.object) & self.media.counts(walk.object, walk.order + 1)
            departure = Departure(event.p, event.along, record.departure.ahead, walk.object)
            record = replace(record, sighted=sees, departure=departure, delta=record.delta | sees)
            walk, record, _ = dr.if_stmt((walk, record, event), sees, self._see, _same_state, label="emitters")
        if self.directions is None:
            return walk, record, mi.Spectrum(0)
        L, connected = record.L, record.connected
        if self.connections is not None:
            walk, record = self._connected(walk, record, event)
            connected = record.connected
        met = record.L - L

        return *self._directed(walk, record, event, ~connected & self.media.counts(walk.object, walk.order + 1)), met

    def _directed(self, walk: Walk, record: LightRecord, event: Event, lit: mi.Bool) -> tuple[Walk, LightRecord]:
        """The walk and its record with light of emitters along directions to them, by MIS weights against phase
        sampling. `lit`: whether nothing else finds it."""
        directed = self.directions.leads(walk.object) & lit
        record = replace(record, straight=mi.Bool(True), directed=directed)
        walk, record, _ = dr.if_stmt((walk, record, event), directed, self._direct, _same_state, label="directions")
        departure = Departure(event.p, event.along, record.departure.ahead, walk.object)
        return walk, replace(record, departure=departure)

    def _connected(self, walk: Walk, record: LightRecord, event: Event) -> tuple[Walk, LightRecord]:
        """The walk and its record with light of connections.
        Where the edge to the last event was straight, they find the rest of its light."""
        smooth = self.media.connects(walk.object)
        edge = record.straight & smooth & (walk.order > 0)  # this event ends one
        connected = record.connected | edge
        record = replace(record, connected=connected, pivot=dr.select(edge, record.departure.p, record.pivot))
        connects = smooth & (walk.order + 2 <= self.media.row("most", walk.object))
        if self.outgoing is not None:
            connects &= ~record.shallow
        return dr.if_stmt((walk, record, event), connects, self._connect, _same_state, label="connections")[:2]

    def _all_light(self, walk: Walk, record: LightRecord, event: Event) -> tuple[Walk, LightRecord]:
        """Precomputed light of an event: unscattered, and of a few events on all, with which the walk ends."""
        # ---- L += throughput ∫ p (L_0 + L_u) dw', at the last event ∫ p (L_0 + L_u + L_s) dw'
        last = ~record.ended & (walk.order + 1 >= FEW)
        light, held = self.unscattered.light(self.media, event, last)
        last &= held
        L, ended = record.L + dr.select(record.ended, 0, walk.weight * light), record.ended | last
        record = replace(record, L=L, known=held | ended, ended=ended, precomputed=mi.Bool(True))

        # ---- a share goes on, for light by way of other surfaces
        if not self.others:
            return replace(walk, alive=walk.alive & ~last), record
        alive = walk.alive & (~last | (walk.rng.next_float32() < ONWARD))
        return replace(walk, alive=alive, weight=dr.select(last, walk.weight / ONWARD, walk.weight)), record

    def _connect(self, walk: Walk, record: LightRecord, event: Event) -> tuple[Walk, LightRecord, Event]:
        # L += throughput Σ connections of a light subpath with this event
        light, slopes, rng = self.connections.light(event, walk.rng)
        return replace(walk, rng=rng), _plus(record, walk, light, slopes), event

    def _see(self, walk: Walk, record: LightRecord, event: Event) -> tuple[Walk, LightRecord, Event]:
        return walk, _plus(record, walk, *self.straight_light.light(event, walk.rng)), event

    def _direct(self, walk: Walk, record: LightRecord, event: Event) -> tuple[Walk, LightRecord, Event]:
        # L += throughput share(d) p(d) T L_e / p_d, of which the forward share alone is not precomputed
        if not self.forward:
            return walk, _plus(record, walk, *self.directions.light(event, walk.rng)), event
        light, _ = self.directions.light(event, walk.rng, lambda d: record.run.onward(d).share)
        return walk, replace(record, L=record.L + _bounded(walk.weight * light, self.brightest)), event

    def boundary(
        self, walk: Walk, record: LightRecord, si: mi.SurfaceInteraction3f, active: mi.Bool
    ) -> tuple[Walk, LightRecord]:
        if not self.media.any_rough:
            return walk, record
        # next-event estimation through a rough boundary from inside, of what is not precomputed
        if self.forward:
            record = replace(record, run=record.run.onward(walk.d))
        left = self.left(record)
        if self.forward and self.splits:  # as deep light is split
            left = left * dr.select(record.shallow, self._part(walk, record), 1)
        else:
            active = active & ~record.shallow if self.deep else active
        active = active & (dr.max(dr.abs(left)) > 0)
        share = None if self.directions is None else partial(self._sampled_share, walk, record)
        light = self.sampled_emitter(walk, si, self.media.boundary(walk.object), active, share=share)
        return walk, replace(record, L=record.L + left * light)

    def _sampled_share(self, walk: Walk, record: LightRecord, ds: mi.DirectionSample3f, active: mi.Bool) -> mi.Float:
        """MIS weight of light that is sampled at a rough boundary, against directions from the last event."""
        departure = replace(record.departure, ahead=mi.Vector3f(walk.d))
        which = self.small.index_of(ds.emitter, ds.d)
        return self._against_directions(which, departure, walk.medium, mi.Float(1), active & record.directed)

    @property
    def others(self) -> bool:
        """Whether the scene has other surfaces than objects and glass in or over them."""
        passed = {id(shape) for shape in self.media.refracting}
        return any(id(shape) not in passed for shape in shapes_of(self.scene, self.media.shown))

    @property
    def forward(self) -> bool:
        """Whether precomputed light has met forward events."""
        return self.unscattered is not None and self.unscattered.forward

    def left(self, record: LightRecord) -> mi.Spectrum:
        """The share of the emission met next that is not precomputed."""
        if self.unscattered is None and self.outgoing is None:
            return mi.Spectrum(1)
        share = record.run.share if self.forward else mi.Spectrum(0)
        return dr.select(record.precomputed | record.known, share, mi.Spectrum(1))

    def surface(
        self, walk: Walk, record: LightRecord, si: mi.SurfaceInteraction3f, bsdf: mi.BSDFPtr, k: mi.Int32
    ) -> tuple[Walk, LightRecord]:
        """Light that the surface emits, where none was sampled, and of inner lights at it."""
        # L += throughput L_e, and for the inner lights throughput f E
        emitter = si.emitter(self.scene)
        shines = si.is_valid() & (k != walk.object) & (emitter != None)  # noqa: E711
        L = record.L + dr.select(shines, walk.weight * emitter.eval(si, shines), 0)
        if self.inner_lights is not None:
            lit = (k < 0) & mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth)
            d, E = self.inner_lights.light(walk.object, si, walk.rng, lit, walk.medium)
            L = L + dr.select(lit, walk.weight * bsdf.eval(mi.BSDFContext(), si, si.to_local(d), lit) * E, 0)
        before, record = record.L, replace(record, L=L)
        return self._left_early(walk, record, before, k != walk.object) if self.splits else (walk, record)

    def crossing(self, walk: Walk, record: LightRecord, crossing: Crossing) -> tuple[Walk, LightRecord]:
        L = record.L
        walk, record = self._lit_crossing(walk, record, crossing)
        if not self.splits:
            return walk, record
        moved = crossing.leaves
        if self.media.inner is not None:
            moved |= self.media.index_of(crossing.si) != walk.object
        return self._left_early(walk, record, L, moved)

    def _lit_crossing(self, walk: Walk, record: LightRecord, crossing: Crossing) -> tuple[Walk, LightRecord]:
        """The walk and its record behind a boundary, with what light there is at it."""
        # ---- the last vertex is the boundary, with the density of the direction that leaves it
        before = record
        record = replace(record, previous=crossing.si.p, pdf=crossing.pdf, delta=crossing.delta)
        if self.unscattered is not None:
            brings = crossing.brings(self.media, walk.d) & (walk.order > 0)
            if self.follows:  # `emitter_behind` knows so many reflections
                exits = dr.maximum(record.exits, 1) - 1
                record, brings = replace(record, exits=exits), brings | ((walk.order == 0) & (exits > 0))
            record = replace(record, precomputed=record.precomputed & (crossing.leaves | brings))
        if self.forward:
            record = replace(record, run=record.run.onward(crossing.along))

        # ---- where something lies inside: what emitter sampling could reach, and inner lights in a cone
        if self.media.inner is not None:
            sampled = (self.media.index_of(crossing.si) < 0) & ~crossing.delta
            record = replace(record, delta=crossing.delta | ~crossing.leaves, scattered=record.scattered | sampled,
                             L=record.L + self.spread_inner_lights(walk, record.scattered & ~sampled))  # fmt: skip

        # ---- index 1: the last vertex is still the event
        if self.straight_light is not None:
            record = self._from_event(walk, record, before, crossing)
        if self.directions is None:
            return walk, record

        # ---- refracted straight from the event: connections and directions to emitters have seen this way
        straight = record.straight & crossing.leaves
        departure = replace(record.departure, ahead=crossing.along)
        return walk, replace(record, straight=straight, directed=record.directed & straight, departure=departure)

    def _from_event(self, walk: Walk, record: LightRecord, before: LightRecord, crossing: Crossing) -> LightRecord:
        """The record of a path that has left an object of index 1: its last vertex is still the event."""
        # the event has sampled emitters along the first way out of its object, up to `reach`
        way, medium = before.departure, walk.medium
        first = before.delta  # way out since the event
        near = dr.norm(crossing.si.p - way.p) < self.straight_light.reach(way.object, way.p, medium)
        sighted = before.sighted & crossing.leaves & (~first | near)
        pdf = self.straight_light.pdf(way.object, way.p, dr.dot(way.along, crossing.along), medium)
        return replace(record, sighted=sighted, previous=dr.select(sighted, way.p, record.previous),
                       pdf=dr.select(sighted, pdf, record.pdf), delta=record.delta & ~sighted)  # fmt: skip

    def met_emitter(self, walk: Walk, record: LightRecord, si: mi.SurfaceInteraction3f, active: mi.Bool) -> mi.Spectrum:
        """Light of an emitter that the ray meets, weighted against sampling it from the last vertex."""
        # p_e of next-event estimation at the last vertex; 0 where that had but one direction
        emitter = si.emitter(self.scene)
        left = self.left(record)
        active = active & (emitter != None) & (dr.max(dr.abs(left)) > 0)  # noqa: E711
        previous, sampled = interaction_of(record.previous, walk.medium), active & ~record.delta
        pdf, ds = emitter_pdf(self.scene, previous, si, sampled)
        pdf = dr.select(sampled, pdf, 0)

        # p_e of `straight_light` at the last event, where nothing has refracted since
        if self.straight_light is not None:
            sighted = sampled & record.sighted
            pdf = dr.select(sighted, self.straight_light.pdf_emitter(previous, ds, sighted), pdf)
        weight = dr.select(record.delta, 1, mis_weight(record.pdf, pdf))

        # what connections find does not count; directions to emitters have weights of their own
        if self.directions is not None and self.small.some_met:
            which = self.small.index_of(emitter, walk.d)
            if self.connections is not None:
                active &= ~(record.connected & self.connections.covers(which, si.p, walk.d, record.pivot))
            directed = active & record.directed
            weight = self._against_directions(which, record.departure, walk.medium, weight, directed)
        return walk.weight * left * emission(emitter, si, weight, active)

    @property
    def sees_through(self) -> bool:
        """Whether emitters behind objects are found without chance, `emitter_behind`."""
        beyond = self.media.varies or self.media.carried or self.media.inner is not None
        return self.unscattered is not None and not beyond

    @property
    def follows(self) -> bool:
        """Whether that is so after reflections inside them, too."""
        return self.sees_through and self.reflections

    def seen_emitters(
        self, walk: Walk, si: mi.SurfaceInteraction3f, bsdf: mi.BSDFPtr, k: mi.Int32, active: mi.Bool
    ) -> tuple[Seen, SeenThrough]:
        """What object k mirrors, and what is seen through it; added whatever is chosen, it must not count again.
        Only where light inside or leaving is known: beside light that is met by chance, of an even sky above all, the
        choice between both sides of the boundary has less noise. `active`: whether emitters are looked for; where a
        path has scattered, cones of delta lights are met instead."""
        unseen = SeenThrough(mi.Spectrum(0), mi.UInt32(0), mi.Spectrum(1))
        if self.unscattered is None and self.outgoing is None:
            return Seen(mi.Spectrum(0), mi.Bool(False), mi.Spectrum(1)), unseen
        smooth = ~self.media.row("rough", k)
        behind = self.emitter_behind(walk, si, k, smooth & active) if self.sees_through else unseen
        return self.mirrored_emitter(walk, si, bsdf, k, smooth & active), behind

    def mirrored_emitter(
        self, walk: Walk, si: mi.SurfaceInteraction3f, bsdf: mi.BSDFPtr, k: mi.Int32, active: mi.Bool
    ) -> Seen:
        """What a smooth boundary mirrors, which no random choice of reflection then meets: F L_e, and 1 - F."""
        # the mirrored direction with its reflectance F, and L_e there
        ctx = mi.BSDFContext()
        ctx.type_mask = mi.BSDFFlags.DeltaReflection
        bs, value = bsdf.sample(ctx, si, 0.0, mi.Point2f(0), active)
        d, _ = sided(si, bs.wo)
        L_e, nothing = self._emission_along(si, d, active & (bs.pdf > 0))
        F = mi.Spectrum(self.media.reflected(k, si)) if self.media.tinted else value
        return Seen(walk.weight * value * L_e, active, dr.select(nothing, 1 - F, 1))

    def emitter_behind(self, walk: Walk, si: mi.SurfaceInteraction3f, k: mi.Int32, active: mi.Bool) -> SeenThrough:
        """What is seen through object k without an event inside, which no free flight then meets.
        The light is (1 - F) Σ_j T_j F_1 ... F_{j-1} (1 - F_j) L_e, F of the boundary, F_j of the j-th on the way inside
        and T_j the transmittance up to it; of first flights 1 - T_1 (1 - F_1) are kept."""
        # ---- the refracted direction with 1 - F, and what is seen at the first boundary on its way
        ctx = mi.BSDFContext()
        ctx.type_mask = mi.BSDFFlags.DeltaTransmission
        bs, value = self.media.boundary(k).sample(ctx, si, 0.0, mi.Point2f(0), active)
        d, _ = sided(si, bs.wo)
        active = active & (bs.pdf > 0) & (dr.dot(d, si.n) < 0)
        o, off = self.media.depart(si, d, mi.Bool(True))
        met = dr.zeros(mi.UInt32, dr.width(d))
        start = WayThrough(o, off, d, walk.weight * value, active, met, mi.Spectrum(0))
        way, passed, nothing = self._seen_at_boundary(start, k, walk.rng)

        # ---- what is seen at those after reflections inside, as far as there is light
        if not self.follows:
            return SeenThrough(way.light, way.exits, dr.select(nothing, 1 - passed, 1))
        least = opaque(LEAST_REFLECTED) * dr.max(walk.weight * value)

        def on(way: WayThrough) -> mi.Bool:
            return way.going & (way.exits <= REFLECTIONS) & (dr.max(way.throughput) > least)

        way = dr.while_loop((way,), on, lambda way: (self._seen_at_boundary(way, k, walk.rng)[0],), label="behind")[0]
        return SeenThrough(way.light, way.exits, dr.select(nothing, 1 - passed, 1))

    def _seen_at_boundary(self, way: WayThrough, k: mi.Int32, rng: mi.PCG32) -> tuple[WayThrough, mi.Spectrum, mi.Bool]:
        """The way through object k behind the next boundary, T (1 - F') there, and whether nothing is met beyond."""
        # ---- the boundary, no farther than there is light left: at its edges a thick object is thin
        media, ctx = self.media, mi.BSDFContext()
        ray = mi.Ray3f(way.o + way.off, way.d)
        ray.maxt = -math.log(LEAST_SEEN) / dr.min(media.spectrum("sigma_t", k)) - dr.dot(way.off, way.d)
        hit = media.scene.ray_intersect_preliminary(ray, coherent=False, active=way.going)
        out = media.instance_scene.interaction(hit, ray, media.needed)
        going = way.going & hit.is_valid() & (media.met(out, k) == k)
        out = media.seen(out, k, way.d)
        going = going & (dr.dot(out.n, way.d) > 0)
        T = media.transmittance(k, ray, dr.maximum(hit.t + dr.dot(way.off, way.d), 0), rng)
        going = going & (dr.max(T) > LEAST_SEEN)

        # ---- light += throughput T (1 - F') L_e of what is met beyond
        ctx.type_mask = mi.BSDFFlags.DeltaTransmission
        bs, leaves = media.boundary(k).sample(ctx, out, 0.0, mi.Point2f(0), going)
        d, _ = sided(out, bs.wo)
        leaving = going & (bs.pdf > 0) & (dr.dot(d, out.n) > 0)
        L_e, nothing = self._emission_along(out, d, leaving)
        F = media.reflected(k, out)
        let_out = mi.Spectrum(1 - F) if media.tinted else leaves * dr.square(bs.eta)
        light = way.light + dr.select(leaving, way.throughput * T * leaves * L_e, 0)

        # ---- throughput *= T F', along the direction that is reflected inside
        ctx.type_mask = mi.BSDFFlags.DeltaReflection
        bs, mirrored = media.boundary(k).sample(ctx, out, 0.0, mi.Point2f(0), going)
        d, _ = sided(out, bs.wo)
        o, off = media.depart(out, d, mi.Bool(True))
        throughput = way.throughput * T * mirrored
        onward = WayThrough(o, off, d, throughput, going & (bs.pdf > 0) & (dr.dot(d, out.n) < 0),
                            way.exits + dr.select(going, 1, 0), light)  # fmt: skip
        return onward, dr.select(leaving, T * let_out, 0), nothing

    def _emission_along(
        self, si: mi.SurfaceInteraction3f, d: mi.Vector3f, active: mi.Bool
    ) -> tuple[mi.Spectrum, mi.Bool]:
        """Radiance of the emitter that a ray from a surface meets, and whether it meets no surface."""
        ray = ray_from(si, d, self.media.instance_scene.rounding(si))
        met = self.media.instance_scene.intersect(self.scene, ray, mi.RayFlags.All, active=active)
        emitter = met.emitter(self.scene, active)
        found = active & (emitter != None)  # noqa: E711
        return dr.select(found, emitter.eval(met, found), 0), active & ~met.is_valid()

    def _against_directions(
        self, which: mi.Int32, departure: Departure, medium: WalkMedium, weight: mi.Float, directed: mi.Bool
    ) -> mi.Float:
        """The weight, times that against directions from the last event where such were sampled."""

        def shared(weight: mi.Float, *state: Any) -> tuple:
            return weight * self.directions.share(*state[:2], state[3], state[2]), *state

        state = (weight, which, departure, medium, directed)
        return dr.if_stmt(state, directed, shared, lambda *state: state)[0]

    def spread_lights(self, walk: Walk, record: LightRecord, active: mi.Bool) -> mi.Spectrum:
        """Light of a delta light whose cone holds the ray, where no other strategy finds it."""
        if self.small is None or self.small.n_delta == 0:
            return mi.Spectrum(0)
        # ---- one of n delta lights, where no connection finds it
        n = self.small.n_delta
        which = mi.Int32(draw(n, walk.rng)) if n > 1 else dr.zeros(mi.Int32, dr.width(walk.o))
        left = self.left(record)
        active = active & record.scattered & record.delta & (dr.max(dr.abs(left)) > 0)
        if self.connections is not None:
            w_0, _ = self.small.direction(which, walk.o)
            emitter = walk.o + w_0 * opaque(dr.norm(self.scene.bbox().extents()))
            active &= ~(record.connected & self.connections.covers(which, emitter, w_0, record.pivot))
        directed = active & record.directed if self.directions is not None else mi.Bool(False)

        # ---- n E / Ω within the cone, which is narrow where directions to emitters share the light
        radius = dr.select(directed, NARROW, opaque(WIDE * self.blur))
        ray = ray_of(walk.o, walk.d, walk.medium)
        L = self.small.spread(which, ray, radius, active)
        if self.directions is not None:
            directed &= dr.max(L) > 0
            L = L * self._against_directions(which, record.departure, walk.medium, mi.Float(1), directed)
        return dr.select(active, walk.weight * L * n * left, 0)

    def spread_inner_lights(self, walk: Walk, active: mi.Bool) -> mi.Spectrum:
        """Light of an inner light whose cone holds the ray, from a vertex that it was not sampled at."""
        if self.inner_lights is None:
            return mi.Spectrum(0)
        # L += throughput n E / Ω T
        ray = ray_of(walk.o + walk.off, walk.d, walk.medium)
        active = active & walk.alive & (walk.object >= 0)
        L = self.inner_lights.spread(walk.object, ray, walk.rng, active, walk.medium)
        return dr.select(active, walk.weight * L, 0)

    def sampled_emitter(
        self,
        walk: Walk,
        si: mi.SurfaceInteraction3f,
        bsdf: mi.BSDFPtr,
        active: mi.Bool,
        outwards: mi.Bool | bool = True,
        share: Callable[[mi.DirectionSample3f, mi.Bool], mi.Float] | None = None,
    ) -> mi.Spectrum:
        """Light of a sampled emitter by the surface at `si`; by a boundary only from its outer side.
        `share`: as of `next_event`."""
        u = mi.Point2f(walk.rng.next_float32(), walk.rng.next_float32())
        rays = self.media.instance_scene
        return walk.weight * next_event(self.scene, rays, (si, bsdf), u, active, outwards, share=share)


def _bounded(light: mi.Spectrum, most: mi.Float | None) -> mi.Spectrum:
    """Light in its own colour, its largest channel at most so large."""
    return light if most is None else light * dr.minimum(1, most / dr.maximum(dr.max(light), 1e-30))


def _same_state(*state: object) -> tuple:
    return state


def _plus(record: LightRecord, walk: Walk, light: mi.Spectrum, slopes: Score | tuple[()]) -> LightRecord:
    """With light per weight of the walk, and its slopes beyond those of the walk."""
    # slopes of the contribution, as its score beyond that of the walk times it
    slopes = slopes and record.slopes + slopes * walk.weight
    return replace(record, L=record.L + walk.weight * light, slopes=slopes)


def start_record(
    lanes: int, scored: bool = False, forward: bool = False, splits: bool = False, follows: bool = False
) -> LightRecord:
    """The record of a path that begins at the camera."""

    def full(kind: type, value: float | bool | int) -> Any:
        return dr.full(kind, value, lanes)

    point, along = full(mi.Point3f, 0), full(mi.Vector3f, 0)
    return LightRecord(
        L=full(mi.Spectrum, 0), previous=point, pdf=full(mi.Float, 1), delta=full(mi.Bool, True),
        straight=full(mi.Bool, False), connected=full(mi.Bool, False), pivot=mi.Point3f(point),
        directed=full(mi.Bool, False),
        departure=Departure(mi.Point3f(point), along, mi.Vector3f(along), full(mi.Int32, 0)),
        sighted=full(mi.Bool, False), scattered=full(mi.Bool, False),
        precomputed=full(mi.Bool, False), known=full(mi.Bool, False), ended=full(mi.Bool, False),
        slopes=Score.sums(lanes) if scored else (),
        run=ForwardRun.none(lanes) if forward else (), shallow=full(mi.Bool, False) if splits else (),
        exits=full(mi.UInt32, 0) if follows else (),
    )  # fmt: skip


# ---- The loop --------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class PathTracer:
    """What every path needs.

    Args:
        visitor: how light is gathered; it knows the scene and its objects.
        max_depth: most vertices on surfaces met from outside; what happens inside an object does not count.
        rr_depth: vertices outside after which roulette may end a path.
        hide_emitters: whether the camera sees no emitters.
        layers: whether emission that the camera sees, at once or in the mirror of an object, is also told apart.
        apart: by the number of a ray, whether light is without its `seen_emission`.
        within: glass that is around all rays where they begin, see `walk.priorities`.
        brightest: most that a path finds of emitters where few paths meet them, see `_cut`.
    """

    visitor: LightVisitor
    max_depth: int
    rr_depth: int
    hide_emitters: bool
    layers: bool = False
    apart: mi.Bool | None = None
    within: int = 0
    brightest: mi.Float | None = None

    @property
    def mirrors(self) -> int:
        """Mirrors of objects in which the first surface finds emission: no more than a path may have vertices."""
        return min(MIRRORS, self.max_depth - 1)

    def trace(
        self,
        rays: mi.Ray3f,
        lanes: int,
        seed: tuple[int, ...],
        exits: FirstExits | None = None,
        scores: PathScores | None = None,
    ) -> tuple[mi.Spectrum, mi.Bool, mi.Spectrum]:
        """Radiance along each ray, whether it shows anything, and the layer of emission; fills `exits` or `scores`."""
        # ---- results of all rays, which lanes write when their path ends
        n = dr.width(rays)
        dr.eval(rays)
        lanes = min(lanes, n)
        L, hit = dr.zeros(mi.Spectrum, n), dr.zeros(mi.Bool, n)
        emission = dr.zeros(mi.Spectrum, n if self.layers else 1)
        dr.eval(L, hit, emission)
        media, visitor = self.visitor.media, replace(self.visitor, brightest=self.brightest)
        scorer = ScoreVisitor(self.visitor, media, scores) if scores else None
        ahead = self.visitor.flight if self.visitor.ahead and not self.visitor.deep else None
        walker = Walker(media, scorer or (FirstExitVisitor(visitor, exits.exits) if exits else visitor), ahead=ahead)
        total, step = (dr.opaque(mi.UInt32, v) for v in (n, lanes))  # kernels then serve images of any size

        # ---- the parts of an iteration

        def begin(index: mi.UInt32, rng: mi.PCG32) -> CameraPath:
            path = _begin(rays, total, index, rng, self.visitor, bool(scores))
            if media.overlaps:
                path.walk.within = dr.opaque(mi.UInt32, self.within, dr.width(index))
            if self.visitor.sees_through and exits is None:  # of all orders, the lowest too
                path.walk.kept = dr.full(mi.Spectrum, 1, dr.width(index))
            path.passed = () if self.brightest is None else dr.full(mi.Bool, False, dr.width(index))
            return replace(path, emission=dr.zeros(mi.Spectrum, dr.width(index))) if self.layers else path

        # inside: a free flight, with what is recorded beside the light
        def inside(p: CameraPath) -> CameraPath:
            record = FirstExitRecord(p.light, p.index, p.depth == 1) if exits else p.light
            record = StayRecord(p.light, p.index, p.stay) if scores else record
            walk, record = walker.step(p.walk, record)
            stay = record.stay if scores else ()
            light = record.record if exits or scores else record
            return replace(p, walk=walk, light=light, stay=stay, passed=self._passed(p.passed, walk))

        def end_stay(p: CameraPath) -> CameraPath:
            record = scorer.end(StayRecord(p.light, p.index, p.stay))
            return replace(p, light=record.record, stay=record.stay)

        # a path that has ended: its light is stored, and the lane takes another ray
        def renew(p: CameraPath) -> CameraPath:
            dr.scatter(L, p.light.L, p.index)
            dr.scatter(hit, p.hit, p.index)
            if self.layers:
                dr.scatter(emission, p.emission, p.index)
            return begin(p.index + step, p.walk.rng)

        def body(p: CameraPath) -> tuple[CameraPath]:
            p = dr.if_stmt((p,), p.walk.object >= 0, inside, _same, label="inside")
            if scores:
                ended = (p.stay.object >= 0) & (p.walk.object != p.stay.object)
                p = dr.if_stmt((p,), ended, end_stay, _same, label="end of a stay")
            outside = p.walk.alive & (p.walk.object < 0)
            p = dr.if_stmt((p,), outside, self._outside, _same, label="outside")
            return (dr.if_stmt((p,), ~p.walk.alive, renew, _same),)

        # ---- lanes take rays index, index + lanes, ... until none is left
        rng = generator(mi, lanes, pass_seed(*seed))
        start = begin(lane_numbers(lanes), rng)
        with dr.scoped_set_flag(dr.JitFlag.OptimizeLoops, False):  # records the loop twice, for kernels no faster
            dr.while_loop((start,), lambda p: p.index < total, body, label="paths")
            dr.eval(L, hit, emission)
        return L, hit | mi.Bool(shows_sky(self.visitor.scene, self.hide_emitters)), emission

    def shown(self, rays: mi.Ray3f) -> mi.Ray3f:
        """The rays of a camera, which begin behind emitters that it does not see."""
        scene, instance_scene = self.visitor.scene, self.visitor.media.instance_scene
        return past_emitters(scene, instance_scene, rays) if self.hide_emitters else rays

    def seen_emission(self, rays: mi.Ray3f) -> mi.Spectrum:
        """Emission that rays see in the mirror of the object that they meet first, and behind it: a part of `trace`."""
        walk = start_walk(rays.o, rays.d, generator(mi, dr.width(rays), pass_seed(0)))
        return self._mirrored(walk, dr.full(mi.Bool, True, dr.width(rays)), self.mirrors)

    def mirrored(self, rays: mi.Ray3f) -> tuple[mi.Point3f, mi.Vector3f, mi.Bool]:
        """Where rays go on from the objects that they meet first, along what smooth boundaries mirror; whether any."""
        media, walk = self.visitor.media, start_walk(rays.o, rays.d, generator(mi, dr.width(rays), pass_seed(0)))
        si, k, boundary, found = self._reflector(walk, dr.full(mi.Bool, True, dr.width(rays)))
        walk, found = _along_mirror(media, walk, si, boundary, found & ~media.row("rough", k))
        return walk.o, walk.d, found

    def _reflector(self, walk: Walk, active: mi.Bool) -> tuple[mi.SurfaceInteraction3f, mi.Int32, mi.BSDFPtr, mi.Bool]:
        """What ways meet as objects show it: the point, the object, its boundary, and whether that reflects."""
        media = self.visitor.media
        si = media.instance_scene.intersect(
            self.visitor.scene, mi.Ray3f(walk.o, walk.d), mi.RayFlags.All, active=active
        )
        k = media.index_of(si, si.is_valid())
        near = dr.maximum(k, 0)
        active = active & (k >= 0) & media.row("reflects", near)
        return media.seen(si, k, walk.d), near, media.boundary_pointer(near), active

    def _mirrored(self, walk: Walk, active: mi.Bool, levels: int) -> mi.Spectrum:
        """Emission in the mirrors of objects that a way along mirrored directions meets, and behind them."""
        media, L = self.visitor.media, mi.Spectrum(0)
        for level in range(levels):
            # ---- emission seen at the surface
            si, k, boundary, active = self._reflector(walk, active)
            mirrored, behind = self.visitor.seen_emitters(walk, si, boundary, k, active)
            L = L + mirrored.light + behind.light
            if level + 1 < levels:
                walk, active = _along_mirror(media, walk, si, boundary, mirrored.found)
        return L

    def _outside(self, p: CameraPath) -> CameraPath:
        """A ray outside all objects, and the surface that it meets."""
        ray = ray_of(p.walk.o, p.walk.d, p.walk.medium)
        si = self.visitor.media.instance_scene.intersect(self.visitor.scene, ray, mi.RayFlags.All)

        # ---- emission: L += throughput L_e p_f / (p_f + p_e)
        first = p.depth == 0
        shown = ~first if self.hide_emitters else mi.Bool(True)
        L_e = self._cut(self.visitor.met_emitter(p.walk, p.light, si, shown), p, p.light.delta)
        if self.layers:
            p = replace(p, emission=p.emission + dr.select(first, L_e, 0))
        L = p.light.L + L_e
        L = L + self.visitor.spread_lights(p.walk, p.light, p.walk.alive)
        light = replace(p.light, L=L, connected=mi.Bool(False), directed=mi.Bool(False), precomputed=mi.Bool(False))

        # ---- the surface, unless the path is as deep as it may get
        depth = p.depth + 1
        alive = si.is_valid() & (depth < mi.UInt32(self.max_depth))
        walk, skips = replace(p.walk, alive=alive), mi.Bool(False)
        if len(walk.within):
            walk, skips = skip(self.visitor.media, walk, si)
            depth, alive = dr.select(skips, p.depth, depth), alive & ~skips
        p = replace(p, walk=walk, light=light, hit=p.hit | (first & si.is_valid()), depth=depth)
        return dr.if_stmt((p, si), alive, self._bounce, lambda p, si: p, label="bounce")

    def _bounce(self, p: CameraPath, si: mi.SurfaceInteraction3f) -> CameraPath:
        """A surface met from outside: next-event estimation, BSDF sampling, Russian roulette, the way on or in."""
        # ---- what masks leave: the boundary of object k or another BSDF
        walk, media, rng = p.walk, self.visitor.media, p.walk.rng
        k, bsdf, si, mute = self._drawn(p, si)
        translucent, near = k >= 0, dr.maximum(k, 0)
        behind, outer = None if media.inner is None else behind_of(media, walk, si, bsdf, translucent), translucent
        if behind is not None:
            bsdf, outer = behind.bsdf, translucent | behind.member
        light, held = p.light.onward(outer), translucent & (p.depth == 1)
        lit = ~(mute | light.known | (behind.unlit if behind is not None else False))

        # ---- next-event estimation: L += throughput f cos L_e / p_e  p_e / (p_e + p_f)
        L = light.L + self.visitor.sampled_emitter(walk, si, bsdf, lit, outer)

        # ---- deep light that is known, unless the last event has had it: L += throughput a C.Y
        if self.visitor.outgoing is not None:
            held, L_o = self.visitor.outgoing.radiance(si, near, -walk.d, walk.within, translucent & ~light.ended)
            L = L + walk.weight * L_o

        # ---- emitters in the mirror of a smooth boundary, and behind it: F L_e, (1 - F) T (1 - F') L_e
        mirrored, seen, L, p = self._seen(L, p, si, bsdf, near, translucent & lit)

        # ---- BSDF sampling: throughput *= f cos / p_f, by refraction alone where all that is mirrored is known
        bs, value = sample_bsdf(bsdf, si, rng, refracts=dr.max(mirrored.kept) < 1)
        d, turned = sided(si, bs.wo)
        d, turned = dr.select(translucent, d, si.to_world(bs.wo)), turned & translucent
        enters = translucent & (dr.dot(d, si.n) < 0)
        weight, scale = walk.weight * value * mirrored.kept, walk.scale * dr.square(bs.eta)

        # ---- Russian roulette: survive with q = min(size, 0.99), throughput /= q
        survive = survival(dr.max(weight) * scale, p.depth, self.rr_depth)
        alive = (bs.pdf > 0) & (dr.max(weight) > 0) & (rng.next_float32() < survive) & ~(mute & ~enters)

        # ---- the way on, or into an object
        channel, density = self._channel(p, near, rng.next_float32())
        if behind is not None:
            through = behind.member & (dr.dot(d, si.n) * dr.dot(walk.d, si.n) > 0)
            walk, k, enters = behind.entered(walk, through, k, enters)
        o, off = media.depart(si, d, enters)
        if media.carried:  # the medium of the exit, for the whole walk
            new = alive & enters
            walk = replace(walk, medium=dr.select(new, media.fetch(dr.maximum(k, 0), si, new), walk.medium))
        walk = replace(walk, o=o, d=d, off=off, alive=alive, order=dr.select(enters, 0, walk.order), channel=channel,
                       density=density, object=dr.select(alive & enters, k, OUTSIDE), scale=scale,
                       weight=weight / dr.maximum(survive, 1e-30),
                       kept=dr.select(enters, seen.kept, 1) if len(walk.kept) else ())  # fmt: skip

        # ---- the last vertex for the MIS weight of emission; index 1 keeps the event
        delta = mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta) | turned
        scattered, again = light.scattered | ~delta, mi.Bool(False)
        if self.visitor.straight_light is not None:
            same = k == light.departure.object
            again = light.sighted & enters & same & self.visitor.straight_light.passes_again(near)
        light = replace(light, L=L, previous=dr.select(again, light.previous, si.p), sighted=again,
                        pdf=dr.select(again, light.pdf, bs.pdf), delta=delta & ~again, scattered=scattered,
                        precomputed=dr.select(enters, seen.exits > 0, mirrored.found),
                        run=light.run and light.run.ended(), shallow=held & enters if self.visitor.splits else (),
                        exits=dr.select(enters, seen.exits, 0) if self.visitor.follows else ())  # fmt: skip
        if behind is not None:
            L = L + self.visitor.spread_inner_lights(walk, scattered & enters)
            light = replace(light, delta=~again & (delta | enters | through | behind.unlit), L=L)
        return replace(p, walk=walk, light=light, mirrored=p.mirrored & mirrored.found & ~enters)

    def _drawn(
        self, p: CameraPath, si: mi.SurfaceInteraction3f
    ) -> tuple[mi.Int32, mi.BSDFPtr, mi.SurfaceInteraction3f, mi.Bool]:
        """The number of the object that is met, or -1, the BSDF, the point as seen, and whether it must not reflect."""
        media, deep = self.visitor.media, self.visitor.deep
        k, bsdf = media.draw(si, p.walk.d, p.walk.rng)
        if deep and media.wrappings:
            k = dr.select(p.depth == 1, media.index_of(si), k)
        mute = mi.Bool(False)
        if media.objects:
            near = dr.maximum(k, 0)
            bsdf = dr.select(k >= 0, media.boundary_pointer(near), bsdf)
            mute = (k >= 0) & ~media.row("reflects", near)
            mute |= (k >= 0) & (p.depth == 1) if deep else False
        return k, bsdf, media.seen(si, k, p.walk.d), mute

    def _channel(self, p: CameraPath, k: mi.Int32, u: mi.Float) -> tuple[mi.UInt32, mi.Spectrum]:
        """The channel by which a path draws, once at its first surface, and its q from there."""
        known = p.walk.channel, p.walk.density
        n = len(p.walk.weight)
        if n == 1:
            return known
        # light by chance has rare bright paths, which are the noise of dark channels too
        shares = mi.Spectrum(1 / n) if self.visitor.unscattered is None else self.visitor.media.shares(k)
        return dr.select(p.depth == 1, draw_channel(shares, u), known)

    def _seen(
        self, L: mi.Spectrum, p: CameraPath, si: mi.SurfaceInteraction3f, bsdf: mi.BSDFPtr, k: mi.Int32, active: mi.Bool
    ) -> tuple[Seen, SeenThrough, mi.Spectrum, CameraPath]:
        """What object k mirrors, and what is seen through it, and the light with both, at first told apart."""
        # emission that rays find lacks delta lights: where a path has scattered, it meets their cones instead
        small = self.visitor.small
        active = active & ~p.light.scattered if small is not None and small.n_delta else active
        mirrored, behind = self.visitor.seen_emitters(p.walk, si, bsdf, k, active)
        light, first = self._cut(mirrored.light + behind.light, p), p.depth == 1

        # ---- the first surface finds what mirrors show in its mirror, so that they must not
        if self.visitor.unscattered is not None:
            meets = first & mirrored.found & (dr.min(mirrored.kept) == 1)
            walk, meets = _along_mirror(self.visitor.media, p.walk, si, bsdf, meets)
            state = (mi.Spectrum(0), walk, meets)
            found, _, _ = dr.if_stmt(state, meets, self._in_mirror, lambda *state: state, label="mirrors")
            light = light + self._cut(found, replace(p, depth=mi.UInt32(MIRRORS)))
            light = dr.select(p.mirrored & ~first & (p.depth <= MIRRORS), 0, light)
        if self.apart is not None:
            light = dr.select(first & dr.gather(mi.Bool, self.apart, p.index), 0, light)
        if self.layers:
            p = replace(p, emission=p.emission + dr.select(first, light, 0))
        return mirrored, behind, L + light, p

    def _in_mirror(self, light: mi.Spectrum, walk: Walk, active: mi.Bool) -> tuple:
        return light + self._mirrored(walk, active, self.mirrors - 1), walk, active

    def _passed(self, before: mi.Bool | tuple[()], walk: Walk) -> mi.Bool | tuple[()]:
        """Whether a path has been inside an object, and scattered there where light passes clear ones."""
        if self.brightest is None:
            return before
        return before | (walk.order > 0 if self.visitor.unscattered.clear else True)

    def _cut(self, light: mi.Spectrum, p: CameraPath, delta: mi.Bool | bool = True) -> mi.Spectrum:
        """Light of emitters at most as bright as `brightest`, in its own colour, where few paths meet small ones: once
        a path has come out of an object, or two have mirrored it. `delta`: whether the last vertex had one direction
        alone, as where others have sampled emitters MIS weights bound it."""
        if self.brightest is None:
            return light
        rare = (p.passed | (p.mirrored & (p.depth >= MIRRORS))) & delta
        return dr.select(rare, _bounded(light, self.brightest), light)


def _along_mirror(
    media: WalkMedia, walk: Walk, si: mi.SurfaceInteraction3f, bsdf: mi.BSDFPtr, active: mi.Bool
) -> tuple[Walk, mi.Bool]:
    """The way on along the direction that a smooth boundary mirrors, with the reflectance as throughput."""
    ctx = mi.BSDFContext()
    ctx.type_mask = mi.BSDFFlags.DeltaReflection
    bs, value = bsdf.sample(ctx, si, 0.0, mi.Point2f(0), active)
    d, _ = sided(si, bs.wo)
    o, _ = media.depart(si, d, mi.Bool(False))
    return replace(walk, o=o, d=d, weight=walk.weight * value), active & (bs.pdf > 0)


def _same(p: CameraPath) -> CameraPath:
    return p


def _begin(
    rays: mi.Ray3f,
    total: mi.UInt32,
    index: mi.UInt32,
    rng: mi.PCG32,
    visitor: LightVisitor,
    scored: bool = False,
) -> CameraPath:
    """A path of the ray with this number, outside of all objects."""
    media = visitor.media
    lanes, known = dr.width(index), index < total
    o, d = dr.gather(mi.Point3f, rays.o, index, known), dr.gather(mi.Vector3f, rays.d, index, known)
    no, first = dr.full(mi.Bool, False, lanes), dr.full(mi.UInt32, 0, lanes)
    wavelengths = dr.gather(mi.Spectrum, rays.wavelengths, index, known) if mi.is_spectral else ()
    walk = start_walk(o, d, rng, media.unknown(lanes, wavelengths))
    stay = Stay.none(lanes, media.textured) if scored else ()
    yes = dr.full(mi.Bool, True, lanes)
    light = start_record(lanes, scored, visitor.forward, visitor.splits, visitor.follows)
    return CameraPath(index, walk, light, no, first, yes, stay)


# ---- First exits of paths from the camera ------------------------------------------------------------------------
#
# While walks gather light for an image, where they leave is kept for learning. A path that meets an object first goes
# in at x_o against the direction w_o of the eye, or is reflected there, and leaves at x_i into w_i with the throughput
# T. Over all such paths, those included that do not enter,
#
#     ∫∫ S(x_i, w_i; x_o, w_o) mu_i f(x_i, w_i) dw_i dA_i = E[T f(x_i, w_i)].


class FirstExits(NamedTuple):
    """One lane for each path.
    `object`: the number of what it meets first, or -1. `start`: x_o and w_o there. `exits`: x_i, w_i and T."""

    object: mi.Int32
    start: SurfacePoint
    exits: WalkExits

    @classmethod
    def of(cls, scene: mi.Scene, media: WalkMedia, rays: mi.Ray3f) -> FirstExits:
        """What rays of the camera meet first, and room for where their walks leave."""
        si = media.instance_scene.intersect(scene, rays, mi.RayFlags.All, coherent=True)
        k = media.index_of(si, si.is_valid())
        si = media.seen(si, k, rays.d)
        start = SurfacePoint(mi.Point3f(si.p), mi.Normal3f(si.n), mi.Normal3f(si.sh_frame.n), mi.Vector3f(-rays.d))
        result = cls(k, start, WalkExits.none(dr.width(rays)))
        evaluate(result)
        return result

    def of_object(self, k: int) -> FirstExits:
        """The lanes of paths that meet object k first."""
        result = self.gather(dr.compress(self.object == k))
        evaluate(result)
        return result

    def gather(self, lanes: mi.UInt32) -> FirstExits:
        """The paths of the given lanes."""
        return FirstExits(dr.gather(mi.Int32, self.object, lanes), self.start.gather(lanes), self.exits.gather(lanes))


@dataclass
class FirstExitRecord:
    """What a visitor keeps of a path, the number of the path, and whether it is inside the object it met first."""

    record: LightRecord
    index: mi.UInt32
    first: mi.Bool


@dataclass(frozen=True, eq=False)
class FirstExitVisitor:
    """Another visitor, beside which the first exit of each path is stored at the number of the path.
    `visitor`: the other one. `exits`: where they are stored."""

    visitor: Visitor
    exits: WalkExits

    def event(self, walk: Walk, record: FirstExitRecord, event: Event) -> tuple[Walk, FirstExitRecord]:
        walk, kept = self.visitor.event(walk, record.record, event)
        return walk, replace(record, record=kept)

    def boundary(
        self, walk: Walk, record: FirstExitRecord, si: mi.SurfaceInteraction3f, active: mi.Bool
    ) -> tuple[Walk, FirstExitRecord]:
        walk, kept = self.visitor.boundary(walk, record.record, si, active)
        return walk, replace(record, record=kept)

    def surface(
        self, walk: Walk, record: FirstExitRecord, si: mi.SurfaceInteraction3f, bsdf: mi.BSDFPtr, k: mi.Int32
    ) -> tuple[Walk, FirstExitRecord]:
        walk, kept = self.visitor.surface(walk, record.record, si, bsdf, k)
        return walk, replace(record, record=kept)

    def crossing(self, walk: Walk, record: FirstExitRecord, crossing: Crossing) -> tuple[Walk, FirstExitRecord]:
        walk, kept = self.visitor.crossing(walk, record.record, crossing)
        # of a walk that leaves the object which its path has met first
        self.exits.put(record.index, walk, crossing, walk.alive & crossing.leaves & record.first)
        return walk, replace(record, record=kept)
