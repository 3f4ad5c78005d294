"""How wrong and how dear each way of rendering a scene is, measured on its own lights, camera and objects."""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from full_geometry.learning.learners import Learner, learner
from full_geometry.scenes.scene_files import PATH_TRACED, first_cause
from full_geometry.trade.contending import (
    DEAR_SECONDS,
    as_far_off,
    gathering_seconds,
    promising,
    too_dear,
)
from full_geometry.trade.images import with_flip
from full_geometry.trade.measuring import OWN_SHARE, LookBudget, SceneSamples
from full_geometry.trade.results import Assessment, WayTrade
from full_geometry.trade.statistics import seeded
from full_geometry.trade.ways import GATHERED, WALKS, Stage, Way, stage, ways
from full_geometry.transport.models import lookup
from halfspace_sss.checks import check_count, check_interval
from halfspace_sss.progress import NamedProgress

EXITS = 480  # few: their choice makes 3 % of a bias uncertain, and each gets the more samples
MOST = 384  # points for a tolerance
TRACED_SHARE = 0.4  # of the time, for the walks that all ways are compared with
WALKED_FIRST = 0.15  # seconds of walks that tell how many points and which ways are worth a look
FIRST_SHARE = 0.45  # of the time, for the look at all ways
LEAST_SHARE = 0.25  # of the time, for walks and what may win against them, however long all else takes
LAST_SHARE = 0.1  # likewise, after light has been gathered
TOLD = 0.1  # standard error of a bias² over the squared tolerance that is enough
CANDIDATES = (
    PATH_TRACED, "lambert", "better_dipole", "neural", "full_geometry", "neural_shape",
    *(f"{name}, {GATHERED}" for name in ("better_dipole", "neural", "full_geometry", "neural_shape")),
)  # fmt: skip
DEAR = ("neural_shape",)  # to look at, which takes DEAR_SECONDS


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
) -> Assessment:
    """Measure each way of rendering a scene on each of its translucent objects.

    At points of an object that the camera sees, radiance by each way is compared with that by random walks, with the
    noise of both taken out; time is that of the same samples. Lights, reflections and other objects are those of the
    scene, at its own largest depth. With a tolerance, biases under an environment map are told by soft
    light, see `soft_light`; the map of a loaded scene is edited meanwhile, and put back.

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
    chosen = _chosen(models if models is not None or tolerance is None else CANDIDATES)
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
        job = {"images": None if models else images, "count_training": count_training}
        result = assess_for(on, chosen, tolerance, **job, **how)
    if flip:
        result = with_flip(on, chosen, result, sensor, seed)
    return result


def _chosen(models: Sequence[str] | None) -> list[Way]:
    if models is None:
        return ways()
    chosen = [Way.of(name) for name in models]
    return [WALKS, *(way for way in dict.fromkeys(chosen) if not way.walks)]


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
    look = SceneSamples.of(on, chosen, sensor, exits, seed)
    look.more(chosen, LookBudget(seconds, samples, traced), seeded(seed, 42), progress)
    return look.assessment(seed)


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
    look = SceneSamples.of(on, ahead, sensor, min(exits, MOST) if images else exits, seed)
    for number, took in ((46, 0.0), (44, WALKED_FIRST)):  # the first launch tells little of time
        look.more([WALKS], LookBudget(took), seeded(seed, number), progress)
    if on.soft and not look.soft_light_pays():
        look.keep_own_light()
        look.more([WALKS], LookBudget(WALKED_FIRST), seeded(seed, 47), progress)
    if images:
        first = look.assessment(seed)
        out = too_dear(look, first, chosen, tolerance, images) if count_training else {}
        ahead, later = ([way for way in ways if way not in out] for ways in (ahead, later))
        look.keep(first)
        flat = [way for way in ahead if not way.walks and lookup(way.model).capabilities.of_half_space]
        look.more(flat[:1], LookBudget(), seeded(seed, 45), progress)
        out |= as_far_off(look.assessment(seed), flat, later, tolerance)
        ahead, later = ([way for way in ways if way not in out] for ways in (ahead, later))
        rest = [way for way in ahead if not way.walks and way not in flat[:1]]
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
    few, gathering, _ = promising([first.objects[k] for k in seen], ahead, later, job)
    rows = [first.objects[k].way(gathering.model) for k in seen] if gathering else []
    reserve = sum(map(gathering_seconds, rows)) / len(seen)
    told = TOLD * tolerance**2 if images else 0.0
    alone = images and not gathering and len(few) == 1
    left = max(left_of(first) - reserve, LEAST_SHARE * seconds)
    _go_on(look, first, few, (left, None if alone else told), seeded(seed, 71), progress)
    again = look.assessment(seed)
    few, gathering, reasons = promising([again.objects[k] for k in seen], ahead, later, job)
    while gathering:
        look.more([gathering], LookBudget(), seeded(seed, 72), progress)
        again = look.assessment(seed)
        if not all(again.objects[k].way(gathering.name).refusal for k in seen):
            few.append(gathering)
            _go_on(look, again, few, (max(left_of(again), LAST_SHARE * seconds), told), seeded(seed, 73), progress)
            again = look.assessment(seed)
            break
        later = [way for way in later if way != gathering]
        few, gathering, reasons = promising([again.objects[k] for k in seen], ahead, later, job)
    out |= {way: reasons[way] for way in later if way != gathering}
    refused = tuple(WayTrade(way.name, refusal=reason) for way, reason in out.items() if reason)
    objects = tuple(replace(o, ways=(*o.ways, *refused)) if o.ways else o for o in again.objects)
    return replace(again, objects=objects)


def _go_on(
    look: SceneSamples, assessed: Assessment, few: Sequence[Way], limit: tuple[float, float | None], seed: int,
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
                others = max(len(few) - 1, 1) if way.walks else 1
                parts[way] = max(parts[way], math.sqrt(others * look.noise(k, way).value))
                enough[way] = max(enough[way], look.enough(k, way, row, told))
    whole = max(sum(parts.values()), 1e-30)
    for way in few:
        seconds = min(left * parts[way] / whole, enough[way])
        if seconds > 0:
            budget = LookBudget(seconds, own=1.0 if told is None else OWN_SHARE)
            look.more([way], budget, seeded(seed, few.index(way)), progress)


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
    try:
        learns.cost(scene, object)
    except ValueError:
        return False
    return True
