"""Scores of walks: derivatives of images by media, from sums that each path takes along.

The light of a path is a sum of contributions. Inside an object each is a product of coefficients over a density that
is held (detached sampling; Zeltner, Speierer, Georgiev and Jakob 2021): with n scattering events and the length d,

    f = sigma_s^n e^(-sigma_t d) prod p(cos theta),    d log f = n dsigma_s / sigma_s - d dsigma_t + sum d log p.

This holds for each channel, whichever channel the walk was drawn by, and for all orders. MIS weights add up to one for
any medium, so they are held too. The loop sums contribution times n, d and sum d log p / dg; no path is replayed.

A walk takes of textures the medium of the point where it entered. So each stay has a place of its own, and Dr.Jit goes
on from the coefficients there to texels, vertices or faces.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, fields, replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from full_geometry.geometry.points import SurfacePoint
from full_geometry.surface.textured import TexturedMedium
from full_geometry.surface.wrapped import surface_of
from full_geometry.walk.media import Place, WalkMedia
from full_geometry.walk.random_walk import (
    Crossing,
    Event,
    ExitVisitor,
    StartVisitor,
    Visitor,
    Walk,
    WalkExits,
    walk_from,
)

SLOTS = 4  # stays of a path in textured objects that are kept apart


@dataclass
class Score:
    """What d log f is made of, or the sum of contributions times that; numbers, or one per channel."""

    n: mi.Float | mi.Spectrum  # scattering events
    d: mi.Float | mi.Spectrum  # length, scene units
    g: mi.Spectrum  # sum of d log p / dg

    def __add__(self, other: Score) -> Score:
        return Score(self.n + other.n, self.d + other.d, self.g + other.g)

    def __mul__(self, factor: mi.Float | mi.Spectrum) -> Score:
        return Score(self.n * factor, self.d * factor, self.g * factor)

    @classmethod
    def zeros(cls, lanes: int) -> Score:
        return cls(dr.zeros(mi.Float, lanes), dr.zeros(mi.Float, lanes), dr.zeros(mi.Spectrum, lanes))

    @classmethod
    def sums(cls, lanes: int) -> Score:
        """No contributions yet."""
        return cls(*(dr.zeros(mi.Spectrum, lanes) for _ in range(3)))


def phase_score(g: mi.Spectrum, cosine: mi.Float) -> mi.Spectrum:
    """d log p / dg of the Henyey-Greenstein phase function, for each channel."""
    # p = (1 - g²) / (4 pi (1 + g² - 2 g cos)^(3/2))
    parts = [3 * (cosine - c) / (1 + dr.square(c) - 2 * c * cosine) - 2 * c / (1 - dr.square(c)) for c in g]
    return mi.Spectrum(parts)


@dataclass
class Stay:
    """A stay of a path inside one object, from its entry on."""

    object: mi.Int32  # by number; -1 outside
    score: Score
    along: mi.Vector3f  # direction before the last scattering event
    turned: mi.Bool  # whether the flight begins at that
    before: mi.UInt32  # stays of the path that have ended
    place: Place | tuple[()] = ()  # where it entered, if media have textures

    @classmethod
    def none(cls, lanes: int, textured: bool, before: mi.UInt32 | None = None) -> Stay:
        """No stay, as of a path outside; `before` is the number of those that have ended, 0 where it begins."""
        along, turned = dr.zeros(mi.Vector3f, lanes), dr.full(mi.Bool, False, lanes)
        before = dr.zeros(mi.UInt32, lanes) if before is None else before
        place = Place.unknown(lanes) if textured else ()
        return cls(dr.full(mi.Int32, -1, lanes), Score.zeros(lanes), along, turned, before, place)

    def flown(self, walk: Walk, p: mi.Point3f, media: WalkMedia) -> Stay:
        """The stay after a flight to p, whose length and first angle count."""
        # d log p / dg of the angle that the flight began by, and its length d
        g = media.spectrum("g", walk.object)
        turn = dr.select(self.turned, phase_score(g, dr.dot(self.along, walk.d)), 0)
        score = self.score + Score(mi.Float(0), dr.norm(p - walk.o), turn)
        place = walk.medium and walk.medium.place
        return replace(self, object=walk.object, score=score, turned=mi.Bool(False), place=place)

    def scattered(self, event: Event) -> Stay:
        """The stay after a scattering event."""
        score = replace(self.score, n=self.score.n + 1)
        return replace(self, score=score, along=event.along, turned=mi.Bool(True))


@dataclass
class StayRecord:
    """What a visitor keeps of a path, the path's number, and its stay."""

    record: Any  # with the light L and the sums `slopes`
    index: mi.UInt32
    stay: Stay


@dataclass(frozen=True, eq=False)
class KeptStays:
    """The stays of each path in textured objects, in slots: one after another those of all paths.

    Where a path has more of them, the last slot keeps one, drawn evenly from the rest, times their number.

    Args:
        paths: their number.
        number: by slot, of the object; -1 in empty slots.
        place: by slot, where the stay began.
        left: by path, for how many stays its last slot stands.
        p, q: by slot, as of `PathScores`.
    """

    paths: int
    number: mi.Int32
    place: Place
    left: mi.UInt32
    p: Score
    q: Score

    @classmethod
    def of(cls, paths: int) -> KeptStays:
        """Empty slots for so many paths."""
        room = SLOTS * paths
        number, left = dr.full(mi.Int32, -1, room), dr.full(mi.UInt32, 1, paths)
        result = cls(paths, number, Place.unknown(room), left, Score.sums(room), Score.zeros(room))
        dr.eval(result)
        return result

    def add(self, index: mi.UInt32, stay: Stay, p: Score, active: mi.Bool) -> None:
        """A stay of each path that has ended."""
        # stay i >= SLOTS - 1 replaces the last slot with the probability 1 / (i - SLOTS + 2): reservoir sampling
        left = mi.UInt32(dr.maximum(mi.Int32(stay.before) - (SLOTS - 2), 1))
        drawn = mi.sample_tea_32(index, stay.before)[0] % left == 0
        at = index + dr.minimum(stay.before, SLOTS - 1) * dr.opaque(mi.UInt32, self.paths)

        # where the stay began, p and q at its end
        pairs = [(self.number, stay.object)]
        for to, value in ((self.place, stay.place), (self.p, p), (self.q, stay.score)):
            pairs += [(getattr(to, each.name), getattr(value, each.name)) for each in fields(to)]
        for to, value in pairs:
            dr.scatter(to, type(to)(value), at, active & drawn)
        dr.scatter(self.left, left, index, active)

    def slots(self, L: mi.Spectrum) -> Iterator[tuple[mi.Int32, Place, Score]]:
        """For each slot, of the light L of all paths: the number of the object, the place and the slopes."""
        # the last slot counts for all stays from there on
        for slot in range(SLOTS):
            at = dr.arange(mi.UInt32, self.paths) + slot * self.paths
            number, place, p, q = (dr.gather(type(v), v, at) for v in (self.number, self.place, self.p, self.q))
            slopes = p + q * L
            yield number, place, slopes * mi.Float(self.left) if slot == SLOTS - 1 else slopes


@dataclass(frozen=True, eq=False)
class PathScores:
    """Sums over the stays of each path in each object that is followed, one row of paths for each such object.

    Light L of a path after a stay has the score q at its end. So the whole path has the slopes p + q L, with p the
    slopes of light gathered inside less q times the light until the end.

    Args:
        paths: their number.
        rows: table from the number of an object to its row, -1 without one.
        p, q: sums over stays.
        kept: stays in textured objects that are followed, if there are any.
        painted: by the number of an object, whether it is one of these.
    """

    paths: int
    rows: mi.Int32
    p: Score
    q: Score
    kept: KeptStays | None
    painted: mi.Bool

    @classmethod
    def of(cls, media: WalkMedia, paths: int) -> PathScores:
        """Sums of 0 for so many paths."""
        # rows of objects of one medium; those with textures have slots
        numbers = [k for k, _ in followed(media)]
        rows = mi.Int32([numbers.index(k) if k in numbers else -1 for k in media.instance_table.kind])
        room, textured = paths * len(numbers), followed_textures(media)
        painted = mi.Bool([k in textured for k in media.instance_table.kind])
        kept = KeptStays.of(paths) if textured else None
        result = cls(paths, rows, Score.sums(room), Score.zeros(room), kept, painted)
        dr.eval(result.p, result.q, rows, painted)
        return result

    def add(self, r: StayRecord) -> None:
        """The stays of paths, which have ended."""
        # p += slopes of the light inside - q L, q += score at the end: slopes of the whole path are p + q L
        row, end = dr.gather(mi.Int32, self.rows, r.stay.object), r.stay.score
        at, known = r.index + mi.UInt32(dr.maximum(row, 0)) * dr.opaque(mi.UInt32, self.paths), row >= 0
        p = r.record.slopes + end * (-r.record.L)
        for target, value in ((self.p, p), (self.q, end)) if dr.width(self.q.n) else ():
            for to, each in zip(vars(target).values(), vars(value).values()):
                dr.scatter_reduce(dr.ReduceOp.Add, to, type(to)(each), at, known, dr.ReduceMode.NoConflicts)
        if self.kept:
            self.kept.add(r.index, r.stay, p, dr.gather(mi.Bool, self.painted, r.stay.object))

    def slopes(self, row: int, L: mi.Spectrum) -> Score:
        """The slopes p + q L of the light L of all paths, in one object."""
        at = dr.arange(mi.UInt32, self.paths) + row * self.paths
        return dr.gather(Score, self.p, at) + dr.gather(Score, self.q, at) * L


@dataclass(frozen=True, eq=False)
class ScoreVisitor:
    """Another visitor, beside which the scores of paths are summed.
    `visitor`: the other one, whose record has L and `slopes`. `media`: the objects. `scores`: where stays are
    summed."""

    visitor: Visitor
    media: WalkMedia
    scores: PathScores

    def _gathered(self, r: StayRecord, stay: Stay, before: mi.Spectrum, after: Any) -> StayRecord:
        """The record after a visit that has added to the light."""
        # slopes += score (L after - L before)
        slopes = after.slopes + stay.score * (after.L - before)
        return replace(r, record=replace(after, slopes=slopes), stay=stay)

    def event(self, walk: Walk, record: StayRecord, event: Event) -> tuple[Walk, StayRecord]:
        # the event counts before its light does: light there has scattered at it
        stay = record.stay.flown(walk, event.p, self.media).scattered(event)
        before = mi.Spectrum(record.record.L)
        walk, after = self.visitor.event(walk, record.record, event)
        return walk, self._gathered(record, stay, before, after)

    def boundary(
        self, walk: Walk, record: StayRecord, si: mi.SurfaceInteraction3f, active: mi.Bool
    ) -> tuple[Walk, StayRecord]:
        # where something lies inside, `surface` has come here first
        stay = record.stay.flown(walk, si.p, self.media) if self.media.inner is None else record.stay
        before = mi.Spectrum(record.record.L)
        walk, after = self.visitor.boundary(walk, record.record, si, active)
        return walk, self._gathered(record, stay, before, after)

    def surface(
        self, walk: Walk, record: StayRecord, si: mi.SurfaceInteraction3f, bsdf: mi.BSDFPtr, k: mi.Int32
    ) -> tuple[Walk, StayRecord]:
        stay, before = record.stay.flown(walk, si.p, self.media), mi.Spectrum(record.record.L)
        walk, after = self.visitor.surface(walk, record.record, si, bsdf, k)
        return walk, self._gathered(record, stay, before, after)

    def crossing(self, walk: Walk, record: StayRecord, crossing: Crossing) -> tuple[Walk, StayRecord]:
        walk, kept = self.visitor.crossing(walk, record.record, crossing)
        return walk, replace(record, record=kept)

    def end(self, record: StayRecord) -> StayRecord:
        """Store the stay and begin another."""
        # p and q of the stay; light that follows belongs to the next one
        self.scores.add(record)
        lanes = dr.width(record.index)
        painted = dr.gather(mi.Bool, self.scores.painted, record.stay.object)
        stay = Stay.none(lanes, self.media.textured, record.stay.before + dr.select(painted, mi.UInt32(1), 0))
        return replace(record, record=replace(record.record, slopes=Score.sums(lanes)), stay=stay)


# ---- Walks from given points ----------------------------------------------------------------------------------------


@dataclass
class ScoredWalk:
    """The number of a walk, and its stay."""

    index: mi.UInt32
    stay: Stay


@dataclass(frozen=True, eq=False)
class ScoredExitVisitor(StartVisitor):
    """Stores exits, and the score of each walk at its exit; of objects with nothing inside and without textures.
    `exits`: stores them without scores. `media`: the objects. `scores`: where those of the exits are stored."""

    exits: ExitVisitor
    media: WalkMedia
    scores: Score

    def begun(self, index: mi.UInt32) -> ScoredWalk:
        return ScoredWalk(index, Stay.none(dr.width(index), False))

    def event(self, walk: Walk, record: ScoredWalk, event: Event) -> tuple[Walk, ScoredWalk]:
        return walk, replace(record, stay=record.stay.flown(walk, event.p, self.media).scattered(event))

    def boundary(
        self, walk: Walk, record: ScoredWalk, si: mi.SurfaceInteraction3f, active: mi.Bool
    ) -> tuple[Walk, ScoredWalk]:
        return walk, replace(record, stay=record.stay.flown(walk, si.p, self.media))

    def crossing(self, walk: Walk, record: ScoredWalk, crossing: Crossing) -> tuple[Walk, ScoredWalk]:
        # n, d and d log p / dg of the walk, at the number of its exit
        leaves = walk.alive & crossing.leaves
        for target, value in zip(vars(self.scores).values(), vars(record.stay.score).values()):
            dr.scatter(target, value, record.index, leaves)
        walk, _ = self.exits.crossing(walk, record.index, crossing)
        return walk, record


def scored_exits(
    media: WalkMedia, k: int, start: SurfacePoint, seed: int | tuple[int, ...], fewest: int = 0
) -> tuple[WalkExits, Score]:
    """`random_walk.exits`, with the score of each walk up to its exit.
    ValueError as there."""
    n = dr.width(start.p)
    # the walks of `exits` with the same random numbers
    visitor = ScoredExitVisitor(ExitVisitor.of(n, fewest), media, Score.zeros(n))
    dr.eval(visitor.scores)
    walk_from(media, k, start, visitor, seed)
    dr.eval(visitor.exits.exits, visitor.scores)
    return visitor.exits.exits, visitor.scores


# ---- Derivatives of images ------------------------------------------------------------------------------------------


def followed(media: WalkMedia) -> list[tuple[int, dict[str, mi.Spectrum]]]:
    """The number and the coefficients (scene units) of each object with gradients enabled.
    ValueError if the albedo of one of them, which must have gradients, is 0 in a channel."""
    result = []
    for k, obj in enumerate(media.objects):
        surface, unit = surface_of(obj.shape), {"sigma_t": media.mm_per_unit}
        own = [n for n in surface.spec.constants if n == "g" or surface.spec.textured is None]  # the rest by place
        values = {name: getattr(surface, name) for name in own}
        values = {name: value * unit.get(name, 1.0) for name, value in values.items() if dr.grad_enabled(value)}
        if "albedo" in values and np.min(surface.spec.medium.albedo) <= 0:
            raise ValueError(f"albedo must be > 0 to be differentiated by, got 0 in a channel of {obj.name}")
        result += [(k, values)] if values else []
    return result


def followed_textures(media: WalkMedia) -> dict[int, TexturedMedium]:
    """The number and the textures (scene units) of each object with gradients enabled in texels or attributes.
    ValueError if the albedo of one of them is 0 somewhere."""
    # d log f has n / albedo: no channel may be black
    result = {}
    for k, (obj, inside) in enumerate(zip(media.objects, media.specs)):
        if inside.textured is None:
            continue
        textured = inside.textured.scaled(media.mm_per_unit)
        if textured.is_followed(obj.shape):
            with dr.suspend_grad():
                if textured.values_on(obj.shape)[0].min() <= 0:
                    raise ValueError(f"albedo must be > 0 to be differentiated by, got 0 in a texture of {obj.name}")
            result[k] = textured
    return result


def with_derivatives(L: mi.Spectrum, scores: PathScores, media: WalkMedia) -> mi.Spectrum:
    """The light L of paths, with derivatives by the media of objects whose gradients are enabled."""
    # objects of one medium: Σ over paths of dL / dcoefficient
    result = mi.Spectrum(L)
    for row, (_, values) in enumerate(followed(media)):
        with dr.suspend_grad():
            slopes = scores.slopes(row, L)
        result += _change(slopes, values)

    # objects with textures: by the coefficients where each stay began
    textured = followed_textures(media) if scores.kept else {}
    with dr.suspend_grad():
        slots = list(scores.kept.slots(L)) if textured else []
    for number, place, slopes in slots:
        for k, medium in textured.items():
            here = media.has_shape(number, k)
            at = medium.at(place.on(media.objects[k].shape), here)
            values = {name: dr.select(here, getattr(at, name), 1) for name in ("albedo", "sigma_t")}
            result += _change(slopes, values)
    return result


def _change(slopes: Score, values: dict[str, mi.Spectrum]) -> mi.Spectrum:
    """Zero, with the derivatives that the slopes are by coefficients."""
    # d log f = n dalbedo / albedo + (n / sigma_t - d) dsigma_t + Σ d log p / dg dg, as sigma_s = albedo sigma_t
    result = mi.Spectrum(0)
    for name, value in values.items():
        known = dr.detach(value)
        by = {"albedo": slopes.n / known, "sigma_t": slopes.n / known - slopes.d, "g": slopes.g}[name]
        result += by * (value - known)
    return result
