"""How wrong and how dear techniques of rendering a scene are, by its lights, camera and objects; which are tried."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Collection, Sequence
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from statistics import NormalDist
from typing import Any

import mitsuba as mi
import numpy as np

from full_geometry.geometry.sensors import seeded
from full_geometry.integrators.correction import FEWEST as FEWEST_WALKS
from full_geometry.integrators.gathering import PART
from full_geometry.learning.learners import Learner, learner
from full_geometry.scenes.reference import check_sensor
from full_geometry.scenes.scene_files import PATH_TRACED, first_cause
from full_geometry.trade.denoised_walks import KNOWN as KNOWN_ERROR
from full_geometry.trade.denoised_walks import Walked, denoised_rows
from full_geometry.trade.measuring import SceneSamples, light_variance
from full_geometry.trade.results import Assessment, ObjectTrade, TechniqueTrade, samples_for
from full_geometry.trade.sampling import Sampled
from full_geometry.trade.statistics import joined
from full_geometry.trade.techniques import (
    CORRECTED,
    GATHERED,
    READY_FIRST,
    WALKED,
    WALKS,
    Effort,
    Job,
    Stage,
    Technique,
    stage,
    techniques,
)
from full_geometry.transport.models import lookup
from halfspace_sss.checks import check_interval
from halfspace_sss.progress import NamedProgress

MOST = 384  # points for a tolerance
WALKED_FIRST = 0.15  # seconds of walks that tell how many points and which techniques are worth a run
DENOISED_SHARE = 0.8  # of the time, for small images that are denoised
FIRST_SHARE = 0.45  # of the time, for the first run of all techniques
LEAST_SHARE = 0.25  # of the time, for walks and what may win against them, however long all else takes
LAST_SHARE = 0.1  # likewise, after light has been gathered
KNOWN = 0.1  # standard error of a bias² over the squared tolerance that is enough
CANDIDATES = (
    *(each.name for each in WALKED), "lambert", READY_FIRST, "neural", "full_geometry", "neural_shape",
    f"{READY_FIRST}, {CORRECTED}",
    *(f"{name}, {GATHERED}" for name in (READY_FIRST, "neural", "full_geometry", "neural_shape")),
)  # fmt: skip
DEAR = ("neural_shape",)  # to run, which takes DEAR_SECONDS


def assess(
    scene: mi.Scene | dict[str, Any] | str | Path,
    *,
    models: Sequence[str] | None = None,
    job: Job | None = None,
    parameters: dict[str, str] | None = None,
    train_seconds: float = 0.0,
    progress: NamedProgress | None = None,
    **effort: Any,
) -> Assessment:
    """Measure each technique of rendering a scene on each of its translucent objects.

    At points of an object that the camera sees, radiance by each technique is compared with that by random walks, with
    the noise of both taken out; time is that of the same samples. Lights, reflections and other objects are those of
    the scene, at its own largest depth. Walks that tell biases have precomputed light where that is possible and among
    the techniques; its own bias, 1 % at a point, counts as doubt. Denoised walks are measured on small images.

    Args:
        scene: a Mitsuba scene, a dict as for `mitsuba.load_dict`, or the path of an XML file.
        models: names of techniques, such as "neural" or "neural, gathered", which are all measured; by default all,
            or for a job those of `CANDIDATES` that might be the cheapest for it. "path_traced" is always among them.
        job: most of the time is then for walks and for techniques that might be the cheapest to keep its tolerance.
        parameters: values of the parameters $name of an XML file.
        train_seconds: that each object without weights is learnt for before, as `train object` does; 0 for what has
            been learnt. The time of a training is a cost of its model.
        progress: called with (what, done, total).
        effort: fields of `Effort`. Gathering of light comes on top of the seconds without a job; for one, walks have a
            quarter of the time however long all else takes, and points are fewer where walks are noisy.

    Left out: what lies behind glass or in mirrors, the mirror images of lamps on the objects, and the errors of fine
    detail between the points.

    Raises:
        ValueError: an argument is out of range, or the scene cannot be rendered.
    """
    how = Effort(**effort)
    check_interval("seconds", how.seconds, 0.05, 1e5)
    check_interval("train_seconds", train_seconds, 0.0, 1e7)
    if models is None and job is None:
        chosen = techniques()
    else:
        named = [Technique.of(name) for name in (CANDIDATES if models is None else models)]
        chosen = [WALKS, *(technique for technique in dict.fromkeys(named) if not technique.exact)]
    on = stage(scene, parameters)
    check_sensor(on.scene, how.sensor)
    if train_seconds > 0:
        learn(on, train_seconds, how.seed, progress)
    if job is None:
        return assess_stage(on, chosen, how, progress)
    return assess_for(on, chosen, job, how, progress, every=bool(models))


def assess_stage(
    on: Stage, chosen: Sequence[Technique], effort: Effort, progress: NamedProgress | None = None,
    tolerance: float | None = None, denoising: float | None = None, known: float = KNOWN_ERROR,
) -> Assessment:  # fmt: skip
    """As `assess`, of a scene that is made ready, with the time shared by all techniques alike.
    Denoised walks have `denoising` seconds each, or end where the error² of the samples that keep the tolerance has the
    relative error `known`."""
    samples = SceneSamples(on, chosen, effort, progress)
    samples.run([t for t in chosen if not t.denoised], seeded(effort.seed, 42), effort.seconds, effort.samples)
    seconds = DENOISED_SHARE * effort.seconds if denoising is None else denoising
    _denoise(samples, chosen, seconds, tolerance, True, known)
    return samples.assessment()


def assess_for(
    on: Stage, chosen: Sequence[Technique], job: Job, effort: Effort, progress: NamedProgress | None = None,
    every: bool = False,
) -> Assessment:  # fmt: skip
    """As `assess_stage`, with most of the time for techniques that could be the cheapest to keep a tolerance.
    Techniques that cannot be the cheapest for the job are left out by what few samples of others say; with `every` all
    are measured. The time is that of all that is done, and points are fewer where walks are noisy."""
    dear = DEAR if effort.seconds < DEAR_SECONDS else ()
    later = [t for t in chosen if not every and (t.gathers or t.model in dear)]
    ahead = [t for t in chosen if t not in later and not t.denoised]
    exits = effort.exits if every else min(effort.exits, MOST)
    samples = SceneSamples(on, ahead, replace(effort, exits=exits), progress)

    def run(chosen: Sequence[Technique], number: int, seconds: float = 0.0) -> None:
        samples.run(chosen, seeded(effort.seed, number), seconds)

    # Run walks twice, as the first launch tells little of time.
    run(walks := [t for t in ahead if t.walks], 46)
    run(walks, 44, len(walks) * WALKED_FIRST)
    _denoise(samples, chosen, DENOISED_SHARE * effort.seconds, job.tolerance, every)
    out: dict[Technique, str] = {}
    if every:
        run(ahead, 42, FIRST_SHARE * effort.seconds)
    else:
        out = _look_at_models(samples, chosen, ahead, later, job, run)
        ahead, later = ([t for t in some if t not in out] for some in (ahead, later))
    first = samples.assessment()
    seen = [k for k, o in enumerate(first.objects) if o.ways and not o.is_dark]
    if not seen:
        return first

    def left_of(assessed: Assessment) -> float:
        return max(effort.seconds - assessed.seconds / len(seen), 0.0)

    def look(assessed: Assessment) -> tuple[list[Technique], Technique | None, dict[Technique, str]]:
        of, references = [assessed.objects[k] for k in seen], {samples.reference(k) for k in seen}
        return promising(of, ahead, later, job, effort.seconds, references)

    # Spend the time that is left, less what the most promising gathering takes, on walks and those that may win.
    few, gathering, reasons = look(first)
    if not (every or gathering) and all(t.walks for t in few) and _denoised_wins(first, job):
        return _with_reasons(first, out | {t: reasons[t] for t in later})
    reserve = sum(making_seconds(first.objects[k], gathering) for k in seen) / len(seen) if gathering else 0.0
    known, alone = 0.0 if every else KNOWN * job.tolerance**2, not every and not gathering and len(few) == 1
    left = max(left_of(first) - reserve, LEAST_SHARE * effort.seconds)
    _go_on(samples, first, few, left, None if alone else known, seeded(effort.seed, 71))
    # Gather the light of the most promising technique, or of the next one if the scene refuses it.
    again = samples.assessment()
    few, gathering, reasons = look(again)
    while gathering:
        run([gathering], 72)
        again = samples.assessment()
        if not all(again.objects[k].way(gathering.name).refusal for k in seen):
            few.append(gathering)
            left = max(left_of(again), LAST_SHARE * effort.seconds)
            _go_on(samples, again, few, left, known, seeded(effort.seed, 73))
            again = samples.assessment()
            break
        later = [t for t in later if t != gathering]
        few, gathering, reasons = look(again)
    return _with_reasons(again, out | {t: reasons[t] for t in later if t != gathering})


def _look_at_models(
    samples: SceneSamples, chosen: Sequence[Technique], ahead: Sequence[Technique], later: Sequence[Technique],
    job: Job, run: Callable[[Sequence[Technique], int], None],
) -> dict[Technique, str]:  # fmt: skip
    """Run models of those `ahead` after their walks, and say which of them and of those later are left out, and why.
    `run`: runs some with a number of the seed."""
    # Leave out what trains for longer than walks need for the job, with the points that its noise allows.
    out = too_dear(samples, first := samples.assessment(), chosen, job)
    models = [t for t in ahead if not t.walks and t not in out]
    samples.keep(first)
    # Run one model of the half-space; where it is far off the others are left out, as they err alike.
    flat = [t for t in models if lookup(t.model).capabilities.of_half_space]
    run(flat[:1], 45)
    out |= as_far_off(samples.assessment(), flat, later, job.tolerance)
    run([t for t in models if t not in out and t not in flat[:1]], 43)
    return out


def _with_reasons(assessed: Assessment, out: dict[Technique, str]) -> Assessment:
    """List what was left out of each object, with its reason."""
    refused = tuple(TechniqueTrade(t.name, refusal=reason) for t, reason in out.items() if reason)
    return replace(
        assessed, objects=tuple(replace(o, ways=(*o.ways, *refused)) if o.ways else o for o in assessed.objects)
    )


def _go_on(
    samples: SceneSamples, assessed: Assessment, few: Sequence[Technique], left: float, known: float | None, seed: int
) -> None:
    """Run some techniques further, for the seconds that are left or until each bias² has the standard error `known`.
    With V t of a technique, the noise of all biases is least where its share of the time is sqrt(V t) over the sum of
    these. Walks are compared with all n others, so that their V t counts n times."""
    parts, enough = dict.fromkeys(few, 0.0), dict.fromkeys(few, 0.0)
    for k, o in enumerate(assessed.objects):
        rows = {technique: o.way(technique.name) for technique in few} if o.ways else {}
        for technique, row in rows.items():
            if not row.refusal and row.variance > 0:
                others = max(len(few) - 1, 1) if technique == samples.reference(k) else 1
                parts[technique] = max(parts[technique], math.sqrt(others * samples.noise(k, technique).value))
                enough[technique] = max(enough[technique], samples.enough(k, technique, row, known))
    whole = max(sum(parts.values()), 1e-30)
    for technique in few:
        seconds = min(left * parts[technique] / whole, enough[technique])
        if seconds > 0:
            samples.run([technique], seeded(seed, few.index(technique)), seconds)


def _denoise(
    samples: SceneSamples, chosen: Sequence[Technique], seconds: float, tolerance: float | None, every: bool,
    error: float = KNOWN_ERROR,
) -> None:  # fmt: skip
    """Measure denoised walks, if not `every` one those with less noise in the same time alone."""
    if not (asked := [t for t in chosen if t.denoised]):
        return
    found = samples.assessment().objects
    seen = [k for k, o in enumerate(found) if o.ways and not o.is_dark]
    plain = {t: replace(t, denoised=False) for t in asked}
    by = {t: {k: _plain(found[k], plain[t].name) for k in seen} for t in asked}
    # variance of a sample times its seconds
    costs = {t: sum(math.inf if w.refusal else w.variance * w.seconds for w in by[t].values()) for t in asked}
    best = min(costs, key=lambda t: costs[t])
    for technique in asked if seen else ():
        rows = by[technique]
        reason = next((row.refusal for row in rows.values() if row.refusal), "")
        if not samples.on.scene.sensors()[samples.effort.sensor].film().rfilter().is_box_filter():
            reason = "the film must have a box filter for a denoiser"
        if not find_spec("mitsuba_oidn"):
            reason = "no denoiser is installed (mitsuba-oidn)"
        if tolerance is not None and not every and not reason:
            other = plain[best].name
            reason = "" if technique == best else f"not measured, as {other} has less noise in the same time"
        if reason:
            samples.denoised[technique] = [TechniqueTrade(technique.name, refusal=reason)] * len(found)
            continue
        known = [
            _walked(samples.on, samples.sampled[k][plain[technique]], o, rows[k]) if k in rows else None
            for k, o in enumerate(found)
        ]
        effort = samples.effort
        samples.denoised[technique] = denoised_rows(samples.on, technique, known, effort, seconds, tolerance, error)


def _walked(on: Stage, sampled: list[Sampled], assessed: ObjectTrade, row: TechniqueTrade) -> Walked:
    parts = [each.estimate for each in sampled]
    light = light_variance(on, parts)
    return Walked(float(np.mean(assessed.radiance)), row, sampled[-1].pace, joined(parts).limits, light, on.lit)


def _denoised_wins(assessed: Assessment, job: Job) -> bool:
    """Whether denoised walks are the cheapest on each object that is seen, so that more of plain ones tells nothing."""
    seen = [(o, [row for row in o.ways if not row.refusal]) for o in assessed.objects if o.ways]
    best = [min(rows, key=lambda row, o=o: o.job(row, job.tolerance, job.images)) for o, rows in seen]
    return all(Technique.of(row.way).denoised for row in best)


def _plain(assessed: ObjectTrade, name: str) -> TechniqueTrade:
    rows = [row for row in assessed.ways if row.way == name]
    return rows[0] if rows else TechniqueTrade(name, refusal=f"{name} is not among the techniques")


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


def _is_learnt(learns: Learner, scene: mi.Scene, object: str) -> bool:
    try:
        learns.cost(scene, object)
    except ValueError:
        return False
    return True


# --------------------------------------------------------------------------------------------------
# Which ways may be the cheapest to keep a tolerance, after a look at some, and why others are not worth a look.


DOUBT = 2.0  # standard errors
FAR = 6.0  # times the tolerance: beyond 30 % models of the half-space were within a factor of 1.6 of each other
DEAR_SECONDS = 30.0  # of an assessment that looks at the dearest ways too
GATHERING = 2**19  # samples of a model whose time the gathering of its light takes at least
LONGEST = 1.5  # times the seconds of an assessment that a gathering may take
LIGHT_SECONDS = 0.4  # of a part of the light, beside its transfer: by emitters, and of the first samples
CORRECTED_ERROR, CORRECTED_SPREAD = 0.05, 1.6  # median and factor of it over scenes, see docs/light.md
CLOSE = 1.3  # times the cost of the cheapest way, up to which another may turn out cheaper


def too_dear(samples: SceneSamples, walked: Assessment, chosen: Sequence[Technique], job: Job) -> dict[Technique, str]:
    """Techniques whose training alone takes longer than the job by walks."""
    found = {}
    walks = [(k, cheapest(o, job)) for k, o in enumerate(walked.objects) if o.ways]
    for technique in chosen:
        pairs = [(samples.training(k, technique), best) for k, best in walks]
        if pairs and all(training > best for training, best in pairs):
            training, best = pairs[0]
            why = f"path_traced keeps {job.tolerance:.3g} in {best:.2g} s"
            found[technique] = f"not measured, as {why}, and the training of {technique.model} took {training:.2g} s"
    return found


def as_far_off(
    found: Assessment, flat: Sequence[Technique], later: Sequence[Technique], tolerance: float
) -> dict[Technique, str]:
    """Models of the half-space that are not worth a run, as the first of them is far off and they err alike."""
    rows = [o.way(flat[0].name) for o in found.objects if o.ways] if flat else []
    if not rows or any(r.refusal or r.bias2 - DOUBT * r.bias2_error < (FAR * tolerance) ** 2 for r in rows):
        return {}
    others = {technique.model for technique in flat[1:]} - {flat[0].model}
    why = f"not measured, as {flat[0].model} is {rows[0].told_bias} % off, and models of the half-space err alike"
    return {technique: why for technique in (*flat, *later) if technique.model in others}


def promising(
    seen: Sequence[ObjectTrade],
    ahead: Sequence[Technique],
    later: Sequence[Technique],
    job: Job,
    seconds: float,
    references: Collection[Technique] = (WALKS,),
) -> tuple[list[Technique], Technique | None, dict[Technique, str]]:
    """Walks and the techniques that may win against them, the one whose light is worth gathering, why others are not.

    Args:
        seen: what is known of the objects that are seen and not dark.
        ahead: techniques that have been run.
        later: those whose light has to be gathered before, or that take long to run.
        job: that the cheapest is looked for.
        references: walks that biases are measured against.
    """
    names = {name for o in seen for name in contenders(o, job.tolerance)}
    reasons = {technique: [left_out(o, technique, job, seconds) for o in seen] for technique in later}
    wanted = [technique for technique in later if "" in reasons[technique]]
    why, best = {technique: given[0] for technique, given in reasons.items()}, None
    if wanted:
        best = most_promising(seen, wanted, job)
        why |= dict.fromkeys(wanted, f"not measured, as {best.name} promises more: ask for it by its name")
        # they cannot win where their light is worth gathering
        names -= {technique.model for technique in wanted if technique.light == GATHERED}
    few = [t for t in ahead if t.name in names or t.exact or t in references]
    return few, best, why


def making_seconds(assessed: ObjectTrade, technique: Technique) -> float:
    """Seconds of what an assessment makes of the light of a model: two parts of gathered light, or all, corrected."""
    row = _plain(assessed, technique.model)
    gathering = 0.0 if row.refusal else GATHERING * row.seconds
    if technique.light != CORRECTED:
        return 2 * (PART * gathering + LIGHT_SECONDS)
    walks = min(row.seconds for row in assessed.ways if row.way.startswith(PATH_TRACED) and row.seconds > 0)
    return gathering + 2 * LIGHT_SECONDS + FEWEST_WALKS * walks


def left_out(assessed: ObjectTrade, technique: Technique, job: Job, seconds: float) -> str:
    """Why a technique is not worth a run for an object, by what others have shown; empty where it is."""
    best, known = cheapest(assessed, job), {row.way: row for row in assessed.ways}
    if technique.light == CORRECTED:
        least, chance = making_seconds(assessed, technique), corrected_chance(job.tolerance)
        # time is spent on it by its chance, all that others have at one half
        if least < min(chance * (best - least), 2 * chance * LONGEST * seconds):
            return ""
        why = f"not measured, as it takes {least:.2g} s or longer, and {100 * chance:.2g} % of such light is so right"
        return f"{why}: ask for it by its name"
    if technique.model not in known:
        return f"not measured in less than {DEAR_SECONDS:g} s: ask for it by its name"
    row = known[technique.model]
    if row.refusal:
        return row.refusal
    if row.bias2 - DOUBT * row.bias2_error > job.tolerance**2:
        off = f"{technique.model} is {row.told_bias} % off"
        return f"not measured, as {off}, the tolerance is {100 * job.tolerance:.3g} %"
    least = row.once + GATHERING * row.seconds
    if least > best:
        return f"not measured, as another keeps {job.tolerance:.3g} in {best:.2g} s, before its light is gathered"
    parts = row.preparation + 2 * PART * GATHERING * row.seconds
    if parts > LONGEST * seconds:
        return f"not measured, as its light is gathered for {parts:.2g} s or longer: ask for it by its name"
    return ""


def most_promising(seen: Sequence[ObjectTrade], wanted: Sequence[Technique], job: Job) -> Technique:
    """The technique that is expected to end the job first.
    It keeps the tolerance by the chance that its model does, and takes what gathering takes then, else what the
    cheapest of the other techniques does."""

    def expected(technique: Technique) -> float:
        total = 0.0
        for o in seen:
            if technique.light == CORRECTED:
                chance = corrected_chance(job.tolerance)
                total += chance * making_seconds(o, technique) + (1 - chance) * cheapest(o, job)
                continue
            row = o.way(technique.model)
            chance = NormalDist().cdf((job.tolerance**2 - max(row.bias2, 0.0)) / max(row.bias2_error, 1e-30))
            total += chance * (row.once + GATHERING * row.seconds) + (1 - chance) * cheapest(o, job)
        return total

    return min(wanted, key=expected)


def corrected_chance(tolerance: float) -> float:
    """The chance that corrected light of the fewest walks keeps a tolerance, by what was measured of others."""
    return NormalDist().cdf(math.log(tolerance / CORRECTED_ERROR) / math.log(CORRECTED_SPREAD))


def cheapest(assessed: ObjectTrade, job: Job) -> float:
    """Seconds of a job by the techniques that have been measured."""
    return min((assessed.job(row, job.tolerance, job.images)[0] for row in assessed.ways), default=math.inf)


def contenders(assessed: ObjectTrade, tolerance: float) -> list[str]:
    """Ways beside walks that may keep the tolerance, and may be the cheapest that does."""
    rows = [row for row in assessed.ways if not row.refusal and row.variance >= 0]
    best, found = min((samples_for(row, tolerance) * row.seconds for row in rows), default=math.inf), []
    for row in rows:
        # seconds for a pixel if the bias is as small as it may be
        left = tolerance**2 - max(row.bias2 - DOUBT * row.bias2_error, 0.0)
        if row.way != PATH_TRACED and left > 0 and row.time_to(math.sqrt(left)) < CLOSE * best:
            found.append(row.way)
    return found
