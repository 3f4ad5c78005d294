"""Samples of radiance by each technique at points of objects that the camera sees, and the numbers that they give."""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from dataclasses import replace

import mitsuba as mi
import numpy as np

from full_geometry.geometry.rounding import box_ends
from full_geometry.geometry.sensors import seeded
from full_geometry.learning.learners import learners
from full_geometry.scenes.scene_files import first_cause
from full_geometry.surface.wrapped import surface_of
from full_geometry.trade.results import Assessment, ObjectTrade, TechniqueTrade
from full_geometry.trade.sampling import (
    PILOT,
    Exits,
    Sampled,
    first_sample,
    sample_blur,
    sample_more,
    visible_exits,
    warm_up,
)
from full_geometry.trade.statistics import (
    Number,
    RadianceEstimate,
    joined,
    mean_square,
    mean_square_of,
    noise_of_parts,
    ratio_of_means,
    relative_variance,
    with_prior,
)
from full_geometry.trade.techniques import PRECOMPUTED, PRECOMPUTED_WALKS, WALKS, Effort, Stage, Technique
from halfspace_sss.backend import clock
from halfspace_sss.progress import NamedProgress

TRACED_SHARE = 0.4  # of the time, for the walks that all techniques are compared with
WALKED = 0.5  # of the time of walks, where delta lights are blurred: the rest tells what that is worth
# Of the light that walks spread over 0.05 radians, what the blur is off by: from 0.2 to 0.4 radians that light changes
# by 0.06 +- 0.06 of itself, on a bunny of 2 to 5 mean free paths, where it is 12 % of all.
BLUR_EFFECT = 0.1
BLUR_SEEN = 0.04  # probability that a direction is in the cone of `sample_blur`
FEWEST, POINTS = 64, 5e-3  # of points, and how many times V t
# Of precomputed light before any measurement: means of images are right to .3 %, points to about .7 %. On a ball of
# skin under lamp and sky, 1e7 samples gave 4.8e-5 +- 5.4e-5, on a blob under a sky 0.5e-5 +- 2e-5.
KNOWN_BIAS2 = 5e-5
KNOWN_LIGHT = 0.03  # variance of precomputed light as that of a sample, before measuring: 0.0003 to 0.016 of scenes
TELLING = 0.02  # squared noise of walks at a point, above which their rare bright samples decide what they tell
RUN, SLOW = 16_000, 4  # samples of all points in the first run of a technique, for slow walks a quarter
UNEVEN = 1.5  # times the noise of a bias² if all points were as noisy
STEADY = 0.05  # relative error of their variance where nothing may win against walks
GATHERED_SHARE = 0.2  # most of the time for samples of gathered light: sqrt(V t) is a quarter of that of walks
Samples = dict[Technique, "list[Sampled] | str"]  # of an object by each technique, or why it refuses the object


class SceneSamples:
    """The samples that have been taken of the objects of a scene.

    Attributes:
        started: when, by `clock`.
        points: of each object; None where it is hardly seen.
        sampled: of each object by each technique.
        mfp: mean free paths across, smallest and largest of the channels.
        denoised: of each object by denoised walks.
    """

    def __init__(self, on: Stage, chosen: Sequence[Technique], effort: Effort, progress: NamedProgress | None) -> None:
        """No samples yet, at exits of all objects, with kernels ready for what techniques have in common."""
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # they are heard when the techniques are made ready again
            for kind in ((True, "sampled"), (True, PRECOMPUTED), (False, "sampled")):
                warm_up(on, [each for each in chosen if (each.walks, each.light) == kind])
        self.on, self.effort, self.progress, self.started = on, effort, progress, clock()
        self.points = visible_exits(on.scene, on.shapes, effort.sensor, effort.exits, seeded(effort.seed, 41))
        self.sampled: list[Samples] = [{} for _ in self.points]
        self.heard: list[list[str]] = [[] for _ in self.points]
        self.mfp = [_mfp(on, k) for k in range(len(self.points))]
        self.denoised: dict[Technique, list[TechniqueTrade | None]] = {}
        self._training: dict[tuple[int, str], float] = {}

    def run(self, chosen: Sequence[Technique], seed: int, seconds: float = 0.0, samples: int | None = None) -> None:
        """Sample all objects by some techniques, or go on with them.
        `seconds`: for each object; with 0 the first samples are all. `samples`: of each exit, instead."""
        for k, points in enumerate(self.points):
            if points is not None:
                with warnings.catch_warnings(record=True) as caught:
                    warnings.simplefilter("always")
                    self._run_object(k, points, chosen, seconds, samples, seeded(seed, k))
                    self.heard[k] += [" ".join(str(w.message).split()) for w in caught]

    def _run_object(
        self, k: int, points: Exits, chosen: Sequence[Technique], seconds: float, samples: int | None, seed: int
    ) -> None:
        on, sampled, end = self.on, self.sampled[k], clock() + seconds
        ordered = sorted(chosen, key=lambda each: not each.gathers)  # the others share what gathered light leaves
        sampled |= {technique: [] for technique in chosen if technique not in sampled}
        for done, technique in enumerate(ordered):
            if self.progress:
                whole = len(self.points) * len(chosen)
                self.progress(f"{on.names[k]}, {technique.name}", k * len(chosen) + done, whole)
            if isinstance(sampled[technique], str):
                continue
            share = TRACED_SHARE if technique.exact and len(chosen) > 1 else 1 / (len(chosen) - done)
            if technique.gathers and len(chosen) > 1 and not samples:
                share = min(share, GATHERED_SHARE)
            for half, part in enumerate(technique.halves):
                started = clock()
                try:
                    number = seeded(seed, chosen.index(technique), *([half] if half else []))
                    fewer = SLOW if technique.exact else 1
                    each = PILOT if samples else max(PILOT, RUN // points.n) // fewer
                    # Make it ready and take few samples; compilation is not counted in its time.
                    result, beside = _begun(on, part, points, (number, each), k, sampled[technique], half)
                    end, started = end + beside, started + beside
                    left = share / len(technique.halves) * (end - started) - (clock() - started)
                    blurs = technique.exact and on.blurs
                    left *= WALKED if blurs else 1.0
                    # Go on for its share of what is left.
                    sample_more(on, part, points, result, number, seconds=left, samples=samples)
                    if blurs:
                        known = [result.blur] if result.blur else []
                        wanted = result.estimate.samples // 2 - sum(each.samples for each in known)
                        result.blur = joined([*known, sample_blur(on, points, number, wanted)])
                except (ValueError, RuntimeError) as error:
                    if technique.exact:
                        raise ValueError(first_cause(error)) from error
                    sampled[technique] = first_cause(error)
                    break

    def keep(self, walked: Assessment) -> None:
        """Keep fewer points where walks are noisy or slow.
        For a bias² b², n points leave errors of about b² sqrt(2 / n) by their choice and V t sqrt(2 n) / time by noise,
        which are equal for n = time b² / (V t)."""
        for k, o in enumerate(walked.objects):
            noise = self.noise(k, self.reference(k)).value if o.ways else 0.0
            if noise > 0:
                n = min(max(int(POINTS / noise), FEWEST), self.points[k].n)
                self.points[k] = self.points[k].first(n)
                for each in (each for of in self.sampled[k].values() if not isinstance(of, str) for each in of):
                    each.estimate = each.estimate.of_first(n)

    def noise(self, k: int, technique: Technique) -> Number:
        """V t of the samples that tell the bias of a technique, and the seconds that they took."""
        found = self.sampled[k][technique]
        a, seconds = joined([each.estimate for each in found]), found[-1].pace
        b = joined([each.estimate for each in self.sampled[k][self.reference(k)]])
        return Number(relative_variance(a, b).value * seconds, a.samples * a.mean.shape[1] * seconds)

    def reference(self, k: int) -> Technique:
        """The walks that biases of an object are measured against: with precomputed light where that is possible."""
        found = self.sampled[k].get(PRECOMPUTED_WALKS)
        return PRECOMPUTED_WALKS if isinstance(found, list) and found else WALKS

    def enough(self, k: int, technique: Technique, row: TechniqueTrade, known: float | None) -> float:
        """Further seconds until a small bias² has the standard error `known`; with None until its variance is known."""
        if known is None:
            return row.samples * row.seconds * ((row.variance_error / (STEADY * row.variance)) ** 2 - 1)
        noise, spent = self.noise(k, technique)
        return UNEVEN * math.sqrt(2 * self.points[k].n) * noise / known - spent if known else math.inf

    def assessment(self) -> Assessment:
        """The numbers of all samples."""
        objects, compiled = [], 0.0
        for k, (points, sampled) in enumerate(zip(self.points, self.sampled)):
            if points is None:
                name = self.on.names[k]
                note = f"object {name!r} is hardly seen by the camera, if at all: nothing can be measured of it"
                objects.append(ObjectTrade(name, self.mfp[k], 0.0, 0.0, (), (), (note,)))
                continue
            rows, reference = [], sampled[self.reference(k)]
            for technique, item in sampled.items():
                row = _row(self.on, k, technique, item, sampled[WALKS], reference)
                rows.append(row if row.refusal else replace(row, training=self.training(k, technique)))
            compiled += sum(row.compilation for row in rows)
            rows += [found[k] for found in self.denoised.values() if found[k] is not None]
            radiance = tuple(float(v) for v in joined([r.estimate for r in reference]).mean.mean(axis=1))
            objects.append(ObjectTrade(
                object=self.on.names[k], mfp=self.mfp[k], share=points.share, pixels=points.pixels, radiance=radiance,
                ways=tuple(rows), notes=tuple(dict.fromkeys(self.heard[k])),
            ))  # fmt: skip
        return Assessment(tuple(objects), self.seconds, compiled, self.effort.seed)

    def training(self, k: int, technique: Technique) -> float:
        key = k, technique.model
        if key not in self._training:
            self._training[key] = training_seconds(self.on.scene, self.on.names[k], technique.model)
        return self._training[key]

    @property
    def seconds(self) -> float:
        """Spent, compilation left out."""
        compiling = sum(each.compiling for of in self.sampled for i in of.values() if isinstance(i, list) for each in i)
        return clock() - self.started - compiling


def _mfp(on: Stage, k: int) -> tuple[float, float]:
    low, high = box_ends(on.shapes[k].bbox())
    size = float(np.linalg.norm(high - low)) * on.mm_per_unit
    thickness = [size * float(m.sigma_t) for m in surface_of(on.shapes[k]).spec.channels()]
    return min(thickness), max(thickness)


def _begun(
    on: Stage, run: Technique, points: Exits, how: tuple[int, int], k: int, sampled: list[Sampled], half: int
) -> tuple[Sampled, float]:
    """A run made ready and among those sampled, and the seconds of that which no time is foreseen for."""
    if half < len(sampled):
        return sampled[half], 0.0
    result = first_sample(on, run, points, *how, k)
    if half == 1 and run.part:  # what the first part took longer to prepare was compilation
        sampled[0].compiling += max(sampled[0].preparing - result.preparing, 0.0)
    sampled.append(result)
    return result, result.compiling + (0.0 if half or not run.gathers else result.preparing)


def _row(
    on: Stage, k: int, technique: Technique, sampled: list[Sampled] | str, walks: list[Sampled],
    reference: list[Sampled],
) -> TechniqueTrade:  # fmt: skip
    if isinstance(sampled, str):
        return TechniqueTrade(technique.name, refusal=sampled)
    parts, known, last = [each.estimate for each in sampled], [each.estimate for each in reference], sampled[-1]
    (walked,), cost, b = walks, joined(parts), joined(known)
    # Estimate bias² against walks; of gathered light by two parts, whose noise more samples do not take away.
    bias2, doubt = Number(0.0, 0.0), Number(0.0, 0.0)
    if not technique.exact:
        kept = _kept(on, k, technique) if len(parts) > 1 else 0.0
        bias2 = mean_square(parts, [walked.estimate], kept)
        if technique.light == PRECOMPUTED:
            bias2 = _of_precomputed(walked, known)
        elif len(known) > 1:
            own, precisely = _of_precomputed(walked, known), mean_square(parts, known, kept)
            precisely = Number(precisely.value, math.hypot(precisely.error, max(own.value, 0.0) + own.error))
            bias2 = min(bias2, precisely, key=lambda each: each.error)
    if blurred := walked.blur:
        # an upper estimate of its squared bias; where no sample shows any blurred light, by the rule of three
        square = mean_square_of(blurred, walked.estimate)
        least = 3 / (BLUR_SEEN * blurred.samples * blurred.mean.shape[1])
        doubt = Number(BLUR_EFFECT**2 * square.value, BLUR_EFFECT**2 * math.hypot(square.error, least**2))
    # Add what the blur of delta lights may be off by to its standard error.
    bias2 = Number(bias2.value + max(doubt.value, 0.0), math.hypot(bias2.error, doubt.error))
    ratios = [(1.0, 0.0) if technique.exact else ratio_of_means(cost, b, c) for c in range(len(b.mean))]
    variance = relative_variance(cost, b)
    if technique.light == PRECOMPUTED:
        # Rays of light are as many as samples: their noise falls with that of walks.
        noise = light_variance(on, parts)
        variance = Number(variance.value + noise.value, math.hypot(variance.error, noise.error))
    return TechniqueTrade(
        way=technique.name, bias2=bias2.value, bias2_error=bias2.error, ratio=tuple(r[0] for r in ratios),
        ratio_error=tuple(r[1] for r in ratios), variance=variance.value, variance_error=variance.error,
        seconds=last.seconds, samples=cost.samples * cost.mean.shape[1],
        preparation=max(each.preparation for each in sampled),
        compilation=sum(each.compilation for each in sampled), memory=last.memory,
    )  # fmt: skip


def light_variance(on: Stage, parts: Sequence[RadianceEstimate]) -> Number:
    """Variance of precomputed light as that of one sample of a pixel, over the square of the mean radiance.
    `parts`: walks by two independent ones; of one light that is sampled it is 0."""
    if len(parts) < 2:
        return Number(0.0, 0.0)
    noise = noise_of_parts(parts, joined(parts))
    return with_prior(Number(on.lit * noise.value, on.lit * noise.error), KNOWN_LIGHT)


def _of_precomputed(walked: Sampled, parts: list[RadianceEstimate]) -> Number:
    """The bias² of walks with precomputed light, as far as walks by chance can tell."""
    noise = relative_variance(walked.estimate, joined(parts)).value / max(walked.estimate.samples, 1)
    found = mean_square(parts, [walked.estimate])
    return with_prior(found, KNOWN_BIAS2) if noise < TELLING else Number(0.0, KNOWN_BIAS2)


def _kept(on: Stage, k: int, technique: Technique) -> float:
    """Of the variance of parts of light, the share that more samples leave in a render."""
    if technique.walks:
        return 0.0
    one, two = (on.integrator(half).gathering for half in technique.halves)
    return one.kept(two, k)


def training_seconds(scene: mi.Scene, object: str, model: str) -> float:
    """Seconds that the weights of a model of an object took to learn; 0 without any, which the model itself tells."""
    if model not in learners():
        return 0.0
    try:
        return float(learners()[model].cost(scene, object))
    except ValueError:
        return 0.0
