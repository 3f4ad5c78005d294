"""How wrong and how dear each way of rendering a scene is, measured on its own lights, camera and objects."""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from statistics import NormalDist
from typing import Any, NamedTuple

import numpy as np

from halfspace_sss.backend import clock
from halfspace_sss.checks import check_count, check_interval, renamed
from halfspace_sss.progress import NamedProgress
from halfspace_sss.rendering.object.registry import learnt_names, lookup
from halfspace_sss.rendering.object.wrapped import surface_of
from halfspace_sss.rendering.paths.gathering import PART
from halfspace_sss.rendering.scenes.learners import CostedLearner, Learner, learner
from halfspace_sss.rendering.scenes.scene_files import PATH_TRACED, first_cause
from halfspace_sss.trade.exits import Exits, visible_exits
from halfspace_sss.trade.images import with_flip
from halfspace_sss.trade.results import Assessment, ObjectTrade, WayTrade, samples_for
from halfspace_sss.trade.sampling import PILOT, Sampled, first_sample, sample_blur, sample_more, warm_up
from halfspace_sss.trade.statistics import (
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
from halfspace_sss.trade.ways import GATHERED, Stage, Way, stage, ways

EXITS = 480  # few: their choice makes 3 % of a bias uncertain, and each gets the more samples
TRACED_SHARE = 0.4  # of the time, for the walks that all ways are compared with
WALKED = 0.5  # of it, where delta lights are blurred: the rest tells what that is worth
# Of the light that walks spread over 0.05 radians, what the blur is off by: from 0.2 to 0.4 radians that light changes
# by 0.06 +- 0.06 of itself, on a bunny of 2 to 5 mean free paths, where it is 12 % of all.
BLUR_EFFECT = 0.1
BLUR_SEEN = 0.04  # probability that a direction is in the cone of `sample_blur`
OWN_SHARE = 0.15  # of the time of a way, for what it costs in the light of the scene; soft light has the rest
SOFT_PAYS = 2.0  # times the variance in soft light that walks have in the light of the scene, from which it pays
SOFT_EFFECT = 0.2  # of a bias², what soft light may change of it: see docs/trade_check.md
MOST, FEWEST, POINTS = 384, 64, 5e-3  # of points for a tolerance, and how many times V t
LOOK, SLOW = 16_000, 4  # samples of all points by which a way is first looked at, for slow walks a quarter
WALKED_FIRST = 0.15  # seconds of walks that tell how many points and which ways are worth a look
FIRST_SHARE = 0.45  # of the time, for the look at all ways
LEAST_SHARE = 0.25  # of the time, for walks and what may win against them, however long all else takes
LAST_SHARE = 0.1  # likewise, after light has been gathered
TOLD = 0.1  # standard error of a bias² over the squared tolerance that is enough
UNEVEN = 1.5  # times the noise of a bias² if all points were as noisy
STEADY = 0.05  # relative error of their variance where nothing may win against walks
DOUBT = 2.0  # standard errors
FAR = 6.0  # times the tolerance: beyond 30 % models of the half-space were within a factor of 1.6 of each other
CANDIDATES = (
    PATH_TRACED, "lambert", "better_dipole", "neural", "full_geometry", "neural_shape",
    *(f"{name}, {GATHERED}" for name in ("better_dipole", "neural", "full_geometry", "neural_shape")),
)  # fmt: skip
DEAR, DEAR_SECONDS = ("neural_shape",), 30.0  # to look at, which takes that long
GATHERING = 2**19  # samples of a model whose time the gathering of its light takes at least
LONGEST = 1.5  # times the seconds of an assessment that a gathering may take
LIGHT_SECONDS = 0.4  # of a part of the light, beside its transfer: by emitters, and of the first samples
GATHERED_SHARE = 0.2  # most of the time for samples of gathered light: sqrt(V t) is a quarter of that of walks
CLOSE = 1.3  # times the cost of the cheapest way, up to which another may turn out cheaper


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


def assess(
    scene: Any,
    *,
    seconds: float = 4.0,
    models: Sequence[str] | None = None,
    sensor: int = 0,
    seed: int = 0,
    flip: bool = True,
    tolerance: float | None = None,
    images: int = 1,
    count_training: bool = True,
    exits: int = EXITS,
    parameters: dict[str, str] | None = None,
    train_seconds: float = 0.0,
    progress: NamedProgress | None = None,
    only: Sequence[str] | None = None,
) -> Assessment:
    """Measure each way of rendering a scene on each of its translucent objects.

    At points of an object that the camera sees, radiance by each way is compared with that by random walks, with the
    noise of both taken out; time is that of the same samples. Lights, reflections and other objects are those of the
    scene, at its own largest depth.

    Args:
        scene: a Mitsuba scene, a dict as for `mitsuba.load_dict`, or the path of an XML file.
        seconds: for each object, shared by all ways; compilation comes on top, and so does gathering of light without a
            tolerance. With one, walks have a quarter of the time however long all else takes.
        models: names of ways, such as "neural" or "neural, gathered", all of which are measured; by default all, or
            with a tolerance those of `CANDIDATES` that might be the cheapest to keep it. "path_traced" is always
            among them.
        sensor: number of the sensor.
        seed: of everything; what depends on the clock is how many samples are taken.
        flip: whether to render small images for FLIP, if the evaluator is installed.
        tolerance: of a job; most of the time is then for walks and for ways that might be the cheapest to keep it.
        images: of that job.
        count_training: whether the time of a training that has been done counts in it.
        exits: points of each object, with a tolerance fewer where walks are noisy.
        parameters: values of the parameters $name of an XML file.
        train_seconds: that each object without weights is learnt for before, as `train object` does; 0 for what has
            been learnt. The time of a training is a cost of its model.
        progress: called with (what, done, total).
        only: what `models` was called before.

    Left out: what lies behind glass or in mirrors, the mirror images of lamps on the objects, and the errors of fine
    detail between the points.

    Raises:
        ValueError: an argument is out of range, or the scene cannot be rendered.
    """
    check_interval("seconds", seconds, 0.05, 1e5)
    check_count("seed", seed, 0)
    check_count("exits", exits, 32)
    if tolerance is not None:
        check_interval("tolerance", tolerance, 1e-4, 10.0)
    check_count("images", images, 1)
    check_interval("train_seconds", train_seconds, 0.0, 1e7)
    named = renamed(models, only, "models", "only")
    chosen = _chosen(named if named is not None or tolerance is None else CANDIDATES)
    on = stage(scene, parameters)
    check_count("sensor", sensor, 0)
    if sensor >= len(on.scene.sensors()):
        raise ValueError(f"sensor must be below {len(on.scene.sensors())}, the number of sensors, got {sensor}")
    if train_seconds > 0:
        learn(on, train_seconds, seed, progress)
    how = {"seconds": seconds, "sensor": sensor, "seed": seed, "exits": exits, "progress": progress}
    if tolerance is None:
        result = assess_stage(on, chosen, **how)
    else:
        job = {"images": None if named else images, "count_training": count_training}
        result = assess_for(on, chosen, tolerance, **job, **how)
    if flip:
        result = with_flip(on, chosen, result, sensor, seed)
    return result


def _chosen(models: Sequence[str] | None) -> list[Way]:
    if models is None:
        return ways()
    chosen = [Way.of(name) for name in models]
    return [Way(PATH_TRACED), *(way for way in dict.fromkeys(chosen) if way.model != PATH_TRACED)]


# --------------------------------------------------------------------------------------------------
# All ways on all objects of a scene that is made ready.


def assess_stage(
    on: Stage,
    chosen: Sequence[Way],
    *,
    seconds: float = 4.0,
    samples: int | None = None,
    sensor: int = 0,
    seed: int = 0,
    exits: int = EXITS,
    traced: float = TRACED_SHARE,
    progress: NamedProgress | None = None,
) -> Assessment:
    """As `assessing.assess`, of a scene that is made ready.

    With `samples` of each exit instead of seconds; `traced` is the share of the time for walks.
    """
    look = _Samples.of(on, chosen, sensor, exits, seed)
    look.more(chosen, LookBudget(seconds, samples, traced), seeded(seed, 42), progress)
    return look.assessment(seed)


@dataclass(eq=False)
class _Samples:
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
    def of(cls, on: Stage, chosen: Sequence[Way], sensor: int, exits: int, seed: int) -> _Samples:
        """Nothing yet, at exits of all objects, with kernels ready for what ways have in common."""
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # they are heard when the ways are made ready again
            for walks in (True, False):
                warm_up(on, [way for way in chosen if (way.model == PATH_TRACED) == walks and way.light != GATHERED])
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
            noise = self.noise(k, Way(PATH_TRACED)).value if o.ways else 0.0
            if noise > 0:
                n = min(max(int(POINTS / noise), FEWEST), self.points[k].n)
                self.points[k] = self.points[k].first(n)
                for each in (each for item in self.sampled[k].values() for each in item):
                    each.estimate = each.estimate.of_first(n)

    def noise(self, k: int, way: Way) -> Number:
        """V t of the samples that tell the bias of a way, and the seconds that they took."""
        walks, told = (_told(self.on, each, self.sampled[k][each]) for each in (Way(PATH_TRACED), way))
        a, b = (joined([each.estimate for each in of]) for of in (told, walks))
        seconds = told[-1].seconds
        return Number(relative_variance(a, b).value * seconds, a.samples * a.mean.shape[1] * seconds)

    def soft_light_pays(self) -> bool:
        """Whether walks have much less noise in soft light than in that of the scene."""
        walks = (of.get(Way(PATH_TRACED)) for of in self.sampled)
        V = ([relative_variance(each.estimate, each.estimate).value for each in found] for found in walks if found)
        return any(own > SOFT_PAYS * soft for own, soft in V)

    def keep_own_light(self) -> None:
        """Tell biases by the light of the scene, and forget what has been sampled in soft light."""
        for of in self.sampled:
            of |= {way: _own(self.on, way, found) for way, found in of.items() if not isinstance(found, str)}
        self.on.lit(Way(PATH_TRACED))
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
            walks = sampled[Way(PATH_TRACED)]
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
    thickness = [size * float(m.sigma_t) for m in surface_of(on.shapes[k]).inside.channels()]
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
        share = budget.traced if way.model == PATH_TRACED and len(chosen) > 1 else 1 / (len(chosen) - done)
        share = min(share, GATHERED_SHARE) if way.light == GATHERED and len(chosen) > 1 and not samples else share
        for half, part in enumerate(on.looks(way)):
            started = clock()
            try:
                number = seeded(seed, chosen.index(way), *([half] if half else []))
                fewer = SLOW if way.model == PATH_TRACED else 1
                each = PILOT if samples else max(PILOT, LOOK // points.n) // fewer
                result, beside = _begun(on, part, points, (number, each), k, sampled[way], half)
                end, started = end + beside, started + beside
                left = share * _part_of(on, way, part, budget) * (end - started) - (clock() - started)
                blurs = way.model == PATH_TRACED and on.blurs and not part.soft
                left *= WALKED if blurs else 1.0
                sample_more(on, part, points, result, number, seconds=left, samples=samples)
                if blurs:
                    known = [result.blur] if result.blur else []
                    wanted = result.estimate.samples // 2 - sum(each.samples for each in known)
                    result.blur = joined([*known, sample_blur(on, points, number, wanted)])
            except (ValueError, RuntimeError) as error:
                if way.model == PATH_TRACED:
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
    (walked,), (b,) = _own(on, Way(PATH_TRACED), walks), [each.estimate for each in _told(on, Way(PATH_TRACED), walks)]
    parts, last = [each.estimate for each in _told(on, way, sampled)], _own(on, way, sampled)[-1]  # with kernels ready
    exact = way.model == PATH_TRACED
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
    """Seconds that the weights of a model of an object took to learn; 0 for what needs no training.

    A learner of the group `halfspace_sss.learners` tells them by a function `cost(scene, object)`.
    """
    learns = lookup(model).learner if model in learnt_names() else None
    return float(learns.cost(scene, object)) if isinstance(learns, CostedLearner) else 0.0


def learn(on: Stage, seconds: float, seed: int = 0, progress: NamedProgress | None = None) -> None:
    """Learn each object of a stage that has no weights yet; one that cannot be learnt is left out with a warning."""
    learns = learner()
    how = {"seconds": seconds, "target_error": None, "seed": seed, "folder": None, "work": None, "progress": progress}
    for name in on.names:
        if not _is_learnt(learns, on.scene, name):
            try:
                learns.train(on.scene, object=name, **how)
            except ValueError as error:
                warnings.warn(f"object {name!r} is not learnt: {first_cause(error)}", stacklevel=3)


def _is_learnt(learns: Learner, scene: Any, object: str) -> bool:
    if not isinstance(learns, CostedLearner):
        return False
    try:
        learns.cost(scene, object)
    except ValueError:
        return False
    return True


# --------------------------------------------------------------------------------------------------
# A second look at the ways on which the choice hangs: those that might be the cheapest to keep a tolerance.


def assess_for(
    on: Stage,
    chosen: Sequence[Way],
    tolerance: float,
    *,
    images: int | None = 1,
    seconds: float = 4.0,
    sensor: int = 0,
    seed: int = 0,
    exits: int = EXITS,
    count_training: bool = True,
    progress: NamedProgress | None = None,
) -> Assessment:
    """As `assess_stage`, with most of the time for ways that could be the cheapest to keep a tolerance.

    Ways that cannot be the cheapest for a job of `images` are left out by what few samples of others say; with None
    all are measured. The time is that of all that is done, and points are fewer where walks are noisy. Biases are
    told by soft light, see `soft_light`.
    """
    with on.softened() as lit:
        return _assessed_for(lit, chosen, tolerance, images, seconds, sensor, seed, exits, count_training, progress)


def _assessed_for(
    on: Stage, chosen: Sequence[Way], tolerance: float, images: int | None, seconds: float, sensor: int, seed: int,
    exits: int, count_training: bool, progress: NamedProgress | None,
) -> Assessment:  # fmt: skip
    dear = DEAR if seconds < DEAR_SECONDS else ()
    later = [way for way in chosen if images and (way.light == GATHERED or way.model in dear)]
    ahead = [way for way in chosen if way not in later]
    look = _Samples.of(on, ahead, sensor, min(exits, MOST) if images else exits, seed)
    for number, took in ((46, 0.0), (44, WALKED_FIRST)):  # the first launch tells little of time
        look.more([Way(PATH_TRACED)], LookBudget(took), seeded(seed, number), progress)
    if on.soft and not look.soft_light_pays():
        look.keep_own_light()
        look.more([Way(PATH_TRACED)], LookBudget(WALKED_FIRST), seeded(seed, 47), progress)
    if images:
        first = look.assessment(seed)
        out = _too_dear(look, first, chosen, tolerance, images) if count_training else {}
        ahead, later = ([way for way in ways if way not in out] for ways in (ahead, later))
        look.keep(first)
        flat = [way for way in ahead if way.model != PATH_TRACED and lookup(way.model).of_half_space]
        look.more(flat[:1], LookBudget(), seeded(seed, 45), progress)
        out |= _as_far_off(look.assessment(seed), flat, later, tolerance)
        ahead, later = ([way for way in ways if way not in out] for ways in (ahead, later))
        rest = [way for way in ahead if way.model != PATH_TRACED and way not in flat[:1]]
        look.more(rest, LookBudget(), seeded(seed, 43), progress)
    else:
        out: dict[Way, str] = {}
        look.more(ahead, LookBudget(FIRST_SHARE * seconds, traced=TRACED_SHARE), seeded(seed, 42), progress)
    first = look.assessment(seed)
    seen = [k for k, o in enumerate(first.objects) if o.ways and not o.is_dark]
    if not seen:
        return first

    def left_of(assessed: Assessment) -> float:
        return max(seconds - assessed.seconds / len(seen), 0.0)

    job = (tolerance, images, seconds, count_training)
    few, gathering, _ = _promising([first.objects[k] for k in seen], ahead, later, job)
    reserve = sum(_gathering(first.objects[k].way(gathering.model)) for k in seen) / len(seen) if gathering else 0.0
    told = TOLD * tolerance**2 if images else 0.0
    alone = images and not gathering and len(few) == 1
    left = max(left_of(first) - reserve, LEAST_SHARE * seconds)
    _go_on(look, first, few, (left, None if alone else told), seeded(seed, 71), progress)
    again = look.assessment(seed)
    few, gathering, reasons = _promising([again.objects[k] for k in seen], ahead, later, job)
    while gathering:
        look.more([gathering], LookBudget(), seeded(seed, 72), progress)
        again = look.assessment(seed)
        if not all(again.objects[k].way(gathering.name).refusal for k in seen):
            few.append(gathering)
            _go_on(look, again, few, (max(left_of(again), LAST_SHARE * seconds), told), seeded(seed, 73), progress)
            again = look.assessment(seed)
            break
        later = [way for way in later if way != gathering]
        few, gathering, reasons = _promising([again.objects[k] for k in seen], ahead, later, job)
    out |= {way: reasons[way] for way in later if way != gathering}
    rows = tuple(WayTrade(way.name, refusal=reason) for way, reason in out.items() if reason)
    objects = tuple(replace(o, ways=(*o.ways, *rows)) if o.ways else o for o in again.objects)
    return replace(again, objects=objects)


def _too_dear(
    look: _Samples, walked: Assessment, chosen: Sequence[Way], tolerance: float, images: int
) -> dict[Way, str]:
    """Ways that are not worth a look beside walks, as their training alone takes longer than the job by these."""
    found = {}
    walks = [(k, _cheapest(o, tolerance, images)) for k, o in enumerate(walked.objects) if o.ways]
    for way in chosen:
        pairs = [(look.training(k, way), best) for k, best in walks]
        if pairs and all(training > best for training, best in pairs):
            training, best = pairs[0]
            job = f"path_traced keeps {tolerance:.3g} in {best:.2g} s"
            found[way] = f"not measured, as {job}, and the training of {way.model} took {training:.2g} s"
    return found


def _as_far_off(found: Assessment, flat: Sequence[Way], later: Sequence[Way], tolerance: float) -> dict[Way, str]:
    """Models of the half-space that are not worth a look, as the first of them is far off and they err alike."""
    rows = [o.way(flat[0].name) for o in found.objects if o.ways] if flat else []
    if not rows or any(r.refusal or r.bias2 - DOUBT * r.bias2_error < (FAR * tolerance) ** 2 for r in rows):
        return {}
    others = {way.model for way in flat[1:]} - {flat[0].model}
    why = f"not measured, as {flat[0].model} is {rows[0].told_bias} % off, and models of the half-space err alike"
    return {way: why for way in (*flat, *later) if way.model in others}


def _promising(
    seen: Sequence[ObjectTrade], ahead: Sequence[Way], later: Sequence[Way], job: tuple[float, int | None, float, bool]
) -> tuple[list[Way], Way | None, dict[Way, str]]:
    """Walks and the ways that may win against them, the way whose light is worth gathering, and why others are not."""
    tolerance, images, _, counted = job
    names = {name for o in seen for name in contenders(o, tolerance)}
    reasons = {way: [_left_out(o, way, *job) for o in seen] for way in later}
    wanted = [way for way in later if "" in reasons[way]]
    told, best = {way: given[0] for way, given in reasons.items()}, None
    if wanted:
        best = _most_promising(seen, wanted, tolerance, images or 1, counted)
        told |= {way: f"not measured, as {best.name} promises more: ask for it by its name" for way in wanted}
        names -= {way.model for way in wanted}  # they cannot win where gathering their light is worth its time
    return [way for way in ahead if way.name in names or way.model == PATH_TRACED], best, told


def _go_on(
    look: _Samples, assessed: Assessment, few: Sequence[Way], limit: tuple[float, float | None], seed: int,
    progress: NamedProgress | None,
) -> None:  # fmt: skip
    """Sample some ways further, for the seconds of the limit or until a bias² is known to its second number.

    Noise is least where each has sqrt(V t) of the time; walks serve all others at once.
    """
    left, told = limit
    parts, enough = dict.fromkeys(few, 0.0), dict.fromkeys(few, 0.0)
    for k, o in enumerate(assessed.objects):
        rows = {way: o.way(way.name) for way in few} if o.ways else {}
        for way, row in rows.items():
            if not row.refusal and row.variance > 0:
                others = max(len(few) - 1, 1) if way.model == PATH_TRACED else 1
                parts[way] = max(parts[way], math.sqrt(others * look.noise(k, way).value))
                enough[way] = max(enough[way], look.enough(k, way, row, told))
    whole = max(sum(parts.values()), 1e-30)
    for way in few:
        seconds = min(left * parts[way] / whole, enough[way])
        if seconds > 0:
            budget = LookBudget(seconds, own=1.0 if told is None else OWN_SHARE)
            look.more([way], budget, seeded(seed, few.index(way)), progress)


def _gathering(row: WayTrade) -> float:
    """Seconds of gathering two parts of the light of a model."""
    return 2 * (PART * GATHERING * row.seconds + LIGHT_SECONDS)


def _left_out(
    assessed: ObjectTrade, way: Way, tolerance: float, images: int, seconds: float, counted: bool = True
) -> str:
    """Why a way is not worth a look for an object, after a look at others; empty where it is."""
    best, known = _cheapest(assessed, tolerance, images, counted), {row.way: row for row in assessed.ways}
    if way.model not in known:
        return f"not measured in less than {DEAR_SECONDS:g} s: ask for it by its name"
    row = known[way.model]
    if row.refusal:
        return row.refusal
    if row.bias2 - DOUBT * row.bias2_error > tolerance**2:
        return f"not measured, as {way.model} is {row.told_bias} % off, asked {100 * tolerance:.3g} %"
    least = _once(row, counted) + GATHERING * row.seconds
    if least > best:
        return f"not measured, as another way keeps {tolerance:.3g} in {best:.2g} s, before its light is gathered"
    parts = row.preparation + 2 * PART * GATHERING * row.seconds
    if parts > LONGEST * seconds:
        return f"not measured, as its light is gathered for {parts:.2g} s or longer: ask for it by its name"
    return ""


def _most_promising(
    seen: Sequence[ObjectTrade], ways: Sequence[Way], tolerance: float, images: int, counted: bool = True
) -> Way:
    """The way by which the job is expected to end first.

    It keeps the tolerance by the chance that its model does, and takes what gathering takes then, else what the
    cheapest of the other ways does.
    """

    def expected(way: Way) -> float:
        total = 0.0
        for o in seen:
            row = o.way(way.model)
            chance = NormalDist().cdf((tolerance**2 - max(row.bias2, 0.0)) / max(row.bias2_error, 1e-30))
            best = _cheapest(o, tolerance, images, counted)
            total += chance * (_once(row, counted) + GATHERING * row.seconds) + (1 - chance) * best
        return total

    return min(ways, key=expected)


def _cheapest(assessed: ObjectTrade, tolerance: float, images: int, counted: bool = True) -> float:
    """Seconds of a job by the ways that have been measured."""
    rows = [row for row in assessed.ways if not row.refusal and row.variance >= 0]
    jobs = [samples_for(row, tolerance) * row.seconds * images * assessed.pixels + _once(row, counted) for row in rows]
    return min(jobs, default=math.inf)


def _once(row: WayTrade, counted: bool = True) -> float:
    """Seconds before the first image."""
    return row.preparation + (row.training if counted else 0.0)


def contenders(assessed: ObjectTrade, tolerance: float) -> list[str]:
    """Ways beside walks that may keep the tolerance, and may be the cheapest that does."""
    rows = [row for row in assessed.ways if not row.refusal and row.variance >= 0]
    best = min((samples_for(row, tolerance) * row.seconds for row in rows), default=math.inf)
    return [row.way for row in rows if row.way != PATH_TRACED and _at_best(row, tolerance) < CLOSE * best]


def _at_best(row: WayTrade, tolerance: float) -> float:
    """Seconds for a pixel if the bias is as small as it may be."""
    left = tolerance**2 - max(row.bias2 - DOUBT * row.bias2_error, 0.0)
    return max(row.variance / left, 1.0) * row.seconds if left > 0 else math.inf
