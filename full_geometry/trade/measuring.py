"""What ways of rendering say of the objects of a scene: samples at points that the camera sees, and numbers."""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np

from full_geometry.learning.learners import learners
from full_geometry.scenes.scene_files import first_cause
from full_geometry.surface.wrapped import surface_of
from full_geometry.trade.exits import Exits, visible_exits
from full_geometry.trade.results import Assessment, ObjectTrade, WayTrade
from full_geometry.trade.sampling import PILOT, Sampled, first_sample, sample_blur, sample_more, warm_up
from full_geometry.trade.statistics import (
    Number,
    RadianceEstimate,
    joined,
    mean_square,
    mean_square_of,
    mean_square_of_parts,
    ratio_of_means,
    relative_variance,
    seeded,
)
from full_geometry.trade.ways import GATHERED, WALKS, Stage, Way
from halfspace_sss.backend import clock
from halfspace_sss.progress import NamedProgress

WALKED = 0.5  # of the time of walks, where delta lights are blurred: the rest tells what that is worth
# Of the light that walks spread over 0.05 radians, what the blur is off by: from 0.2 to 0.4 radians that light changes
# by 0.06 +- 0.06 of itself, on a bunny of 2 to 5 mean free paths, where it is 12 % of all.
BLUR_EFFECT = 0.1
BLUR_SEEN = 0.04  # probability that a direction is in the cone of `sample_blur`
OWN_SHARE = 0.15  # of the time of a way, for what it costs in the light of the scene; soft light has the rest
SOFT_PAYS = 2.0  # times the variance in soft light that walks have in the light of the scene, from which it pays
SOFT_EFFECT = 0.2  # of a bias², what soft light may change of it: see docs/choosing.md
FEWEST, POINTS = 64, 5e-3  # of points, and how many times V t
LOOK, SLOW = 16_000, 4  # samples of all points by which a way is first looked at, for slow walks a quarter
UNEVEN = 1.5  # times the noise of a bias² if all points were as noisy
STEADY = 0.05  # relative error of their variance where nothing may win against walks
GATHERED_SHARE = 0.2  # most of the time for samples of gathered light: sqrt(V t) is a quarter of that of walks


class LookBudget(NamedTuple):
    """Of a look at several ways.

    Args:
        seconds: for each object; with 0 the first samples are all.
        samples: of each exit, instead.
        traced: share of the walks.
        own: share of the light of the scene, where biases are told by soft light.
    """

    seconds: float = 0.0
    samples: int | None = None
    traced: float = 1.0
    own: float = OWN_SHARE


@dataclass(eq=False)
class SceneSamples:
    """What has been sampled of a scene.

    Args:
        on: the scene.
        started: when, by `clock`.
        points: of each object; None where it is hardly seen.
        sampled: by each way, or why it refuses the object.
        heard: warnings.
        mfp: mean free paths across, smallest and largest of the channels.
    """

    on: Stage
    started: float
    points: list[Exits | None]
    sampled: list[dict[Way, list[Sampled] | str]]
    heard: list[list[str]]
    mfp: list[tuple[float, float]]
    _training: dict[tuple[int, str], float] = field(default_factory=dict)

    @classmethod
    def of(cls, on: Stage, chosen: Sequence[Way], sensor: int, exits: int, seed: int) -> SceneSamples:
        """Nothing yet, at exits of all objects, with kernels ready for what ways have in common."""
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # they are heard when the ways are made ready again
            for walks in (True, False):
                warm_up(on, [way for way in chosen if way.walks == walks and way.light != GATHERED])
        started = clock()
        seen = visible_exits(on.scene, on.shapes, sensor, exits, seeded(seed, 41))
        mfp = [_mfp(on, k) for k in range(len(seen))]
        return cls(on, started, seen, [{} for _ in seen], [[] for _ in seen], mfp)

    def more(
        self,
        chosen: Sequence[Way],
        budget: LookBudget,
        seed: int,
        progress: NamedProgress | None,
    ) -> None:
        """Sample some ways, or go on with them."""
        for k, points in enumerate(self.points):

            def tell(way: str, done: int, k: int = k) -> None:
                if progress:
                    progress(f"{self.on.names[k]}, {way}", k * len(chosen) + done, len(self.points) * len(chosen))

            if points is not None:
                with warnings.catch_warnings(record=True) as caught:
                    warnings.simplefilter("always")
                    _object(self.on, k, points, chosen, budget, seeded(seed, k), tell, self.sampled[k])
                    self.heard[k] += [" ".join(str(w.message).split()) for w in caught]

    def keep(self, walked: Assessment) -> None:
        """Fewer points where walks are noisy or slow: of a bias² b² n of them leave errors of about

        b² sqrt(2 / n) by their choice and V t sqrt(2 n) / time by noise, which are equal for n = time b² / (V t).
        """
        for k, o in enumerate(walked.objects):
            noise = self.noise(k, WALKS).value if o.ways else 0.0
            if noise > 0:
                n = min(max(int(POINTS / noise), FEWEST), self.points[k].n)
                self.points[k] = self.points[k].first(n)
                for each in (each for item in self.sampled[k].values() for each in item):
                    each.estimate = each.estimate.of_first(n)

    def noise(self, k: int, way: Way) -> Number:
        """V t of the samples that tell the bias of a way, and the seconds that they took."""
        walks, told = (_told(self.on, each, self.sampled[k][each]) for each in (WALKS, way))
        a, b = (joined([each.estimate for each in of]) for of in (told, walks))
        seconds = told[-1].seconds
        return Number(relative_variance(a, b).value * seconds, a.samples * a.mean.shape[1] * seconds)

    def soft_light_pays(self) -> bool:
        """Whether walks have much less noise in soft light than in that of the scene."""
        walks = (of.get(WALKS) for of in self.sampled)
        V = ([relative_variance(each.estimate, each.estimate).value for each in found] for found in walks if found)
        return any(own > SOFT_PAYS * soft for own, soft in V)

    def keep_own_light(self) -> None:
        """Tell biases by the light of the scene, and forget what has been sampled in soft light."""
        for of in self.sampled:
            of |= {way: _own(self.on, way, found) for way, found in of.items() if not isinstance(found, str)}
        self.on.lit(WALKS)
        self.on = replace(self.on, soft=None)

    def enough(self, k: int, way: Way, row: WayTrade, told: float | None) -> float:
        """Further seconds of a way until a small bias² is known to `told`; with None until its variance is."""
        if told is None:
            return row.samples * row.seconds * ((row.variance_error / (STEADY * row.variance)) ** 2 - 1)
        noise, spent = self.noise(k, way)
        return UNEVEN * math.sqrt(2 * self.points[k].n) * noise / told - spent if told else math.inf

    def assessment(self, seed: int) -> Assessment:
        """What all samples say."""
        objects, compiled = [], 0.0
        for k, (points, sampled) in enumerate(zip(self.points, self.sampled)):
            if points is None:
                objects.append(_unseen(self.on.names[k], self.mfp[k]))
                continue
            walks = sampled[WALKS]
            rows = tuple(
                replace(
                    _row(self.on, k, way, item, walks), training=0.0 if isinstance(item, str) else self.training(k, way)
                )
                for way, item in sampled.items()
            )
            compiled += sum(row.compilation for row in rows)
            radiance = tuple(float(v) for v in walks[0].estimate.mean.mean(axis=1))
            seen, notes = (points.share, points.pixels, radiance, rows), tuple(dict.fromkeys(self.heard[k]))
            objects.append(ObjectTrade(self.on.names[k], self.mfp[k], *seen, notes))
        return Assessment(tuple(objects), self.seconds, compiled, seed)

    def training(self, k: int, way: Way) -> float:
        """`training_seconds` of an object."""
        if (k, way.model) not in self._training:
            self._training[k, way.model] = training_seconds(self.on.scene, self.on.names[k], way.model)
        return self._training[k, way.model]

    @property
    def seconds(self) -> float:
        """Spent, compilation left out."""
        compiling = sum(each.compiling for of in self.sampled for i in of.values() if isinstance(i, list) for each in i)
        return clock() - self.started - compiling


def _unseen(name: str, mfp: tuple[float, float]) -> ObjectTrade:
    note = f"object {name!r} is hardly seen by the camera, if at all: nothing can be told of it"
    return ObjectTrade(name, mfp, 0.0, 0.0, (), (), (note,))


def _mfp(on: Stage, k: int) -> tuple[float, float]:
    """Mean free paths across an object."""
    box = on.shapes[k].bbox()
    size = float(np.linalg.norm(np.array(box.max, dtype=float) - np.array(box.min, dtype=float))) * on.mm_per_unit
    thickness = [size * float(m.sigma_t) for m in surface_of(on.shapes[k]).spec.channels()]
    return min(thickness), max(thickness)


def _object(
    on: Stage,
    k: int,
    points: Exits,
    chosen: Sequence[Way],
    budget: LookBudget,
    seed: int,
    tell: Any,
    sampled: dict[Way, list[Sampled] | str],
) -> None:
    """What all ways say of an object, or why they refuse it; what is known of one is added to."""
    samples, end = budget.samples, clock() + budget.seconds
    gathered_first = sorted(chosen, key=lambda way: way.light != GATHERED)  # what is left of the time serves the others
    sampled |= {way: [] for way in chosen if way not in sampled}
    for done, way in enumerate(gathered_first):
        tell(way.name, done)
        if isinstance(sampled[way], str):
            continue
        share = budget.traced if way.walks and len(chosen) > 1 else 1 / (len(chosen) - done)
        share = min(share, GATHERED_SHARE) if way.light == GATHERED and len(chosen) > 1 and not samples else share
        for half, part in enumerate(on.looks(way)):
            started = clock()
            try:
                number = seeded(seed, chosen.index(way), *([half] if half else []))
                fewer = SLOW if way.walks else 1
                each = PILOT if samples else max(PILOT, LOOK // points.n) // fewer
                result, beside = _begun(on, part, points, (number, each), k, sampled[way], half)
                end, started = end + beside, started + beside
                left = share * _part_of(on, way, part, budget) * (end - started) - (clock() - started)
                blurs = way.walks and on.blurs and not part.soft
                left *= WALKED if blurs else 1.0
                sample_more(on, part, points, result, number, seconds=left, samples=samples)
                if blurs:
                    known = [result.blur] if result.blur else []
                    wanted = result.estimate.samples // 2 - sum(each.samples for each in known)
                    result.blur = joined([*known, sample_blur(on, points, number, wanted)])
            except (ValueError, RuntimeError) as error:
                if way.walks:
                    raise ValueError(first_cause(error)) from error
                sampled[way] = first_cause(error)
                break


def _part_of(on: Stage, way: Way, look: Way, budget: LookBudget) -> float:
    """The share of a look in the time of its way; few samples tell what gathered light costs."""
    own = 0.0 if way.light == GATHERED else budget.own
    if on.soft is None:
        return 1 / len(way.halves)
    return (1 - own) / len(way.halves) if look.soft else own


def _begun(
    on: Stage, way: Way, points: Exits, how: tuple[int, int], k: int, sampled: list[Sampled], half: int
) -> tuple[Sampled, float]:
    """A way or half of one made ready and among those sampled, and seconds of that which no time is foreseen for."""
    if half < len(sampled):
        return sampled[half], 0.0
    result = first_sample(on, way, points, *how, k)
    if half == 1 and way.part:  # what the first part took longer to prepare was compilation
        sampled[0].compiling += max(sampled[0].preparing - result.preparing, 0.0)
    sampled.append(result)
    return result, result.compiling + (0.0 if half or way.light != GATHERED else result.preparing)


def _own(on: Stage, way: Way, sampled: list[Sampled]) -> list[Sampled]:
    """Of what has been sampled of a way, that in the light of the scene."""
    return [each for look, each in zip(on.looks(way), sampled) if not look.soft]


def _told(on: Stage, way: Way, sampled: list[Sampled]) -> list[Sampled]:
    """Of what has been sampled of a way, that which tells its bias."""
    return [each for look, each in zip(on.looks(way), sampled) if look.soft == (on.soft is not None)]


def _row(on: Stage, k: int, way: Way, sampled: list[Sampled] | str, walks: list[Sampled]) -> WayTrade:
    if isinstance(sampled, str):
        return WayTrade(way.name, refusal=sampled)
    own, told = (joined([each.estimate for each in of(on, way, sampled)]) for of in (_own, _told))
    (walked,), (b,) = _own(on, WALKS, walks), [each.estimate for each in _told(on, WALKS, walks)]
    parts, last = [each.estimate for each in _told(on, way, sampled)], _own(on, way, sampled)[-1]  # with kernels ready
    exact = way.walks
    bias2, doubt = Number(0.0, 0.0), Number(0.0, 0.0)
    if not exact:
        bias2 = mean_square(told, b) if len(parts) == 1 else mean_square_of_parts(parts, b, _kept(on, k, way))
    if walked.blur:
        doubt = _of_blur(walked.blur, walked.estimate)
    effect = SOFT_EFFECT * max(bias2.value, 0.0) if on.soft else 0.0
    bias2 = Number(bias2.value + max(doubt.value, 0.0), math.hypot(bias2.error, doubt.error, effect))
    ratios = [(1.0, 0.0) if exact else ratio_of_means(told, b, c) for c in range(len(b.mean))]
    return WayTrade(
        way.name, *bias2, tuple(r[0] for r in ratios), tuple(r[1] for r in ratios),
        *relative_variance(own, walked.estimate), last.seconds, own.samples * own.mean.shape[1], last.preparation,
        sum(each.compilation for each in sampled), 0.0, last.memory,
    )  # fmt: skip


def _kept(on: Stage, k: int, way: Way) -> float:
    """Of the variance of parts of gathered light, the share that a render has."""
    one, two = (on.integrator(half).gathering for half in way.halves)
    return one.kept(two, k)


def _of_blur(blurred: RadianceEstimate, b: RadianceEstimate) -> Number:
    """An upper estimate of the squared bias of walks; where no sample shows any blurred light, by the rule of three."""
    square, least = mean_square_of(blurred, b), 3 / (BLUR_SEEN * blurred.samples * blurred.mean.shape[1])
    return Number(BLUR_EFFECT**2 * square.value, BLUR_EFFECT**2 * math.hypot(square.error, least**2))


def training_seconds(scene: Any, object: str, model: str) -> float:
    """Seconds that the weights of a model of an object took to learn; 0 without any, which the model itself tells."""
    if model not in learners():
        return 0.0
    try:
        return float(learners()[model].cost(scene, object))
    except ValueError:
        return 0.0
