"""Which ways may be the cheapest to keep a tolerance, after a look at some, and why others are not worth a look."""

from __future__ import annotations

import math
from collections.abc import Sequence
from statistics import NormalDist

from full_geometry.integrators.gathering import PART
from full_geometry.scenes.scene_files import PATH_TRACED
from full_geometry.trade.job import Job
from full_geometry.trade.measuring import SceneSamples
from full_geometry.trade.results import Assessment, ObjectTrade, TechniqueTrade, samples_for
from full_geometry.trade.techniques import Technique

DOUBT = 2.0  # standard errors
FAR = 6.0  # times the tolerance: beyond 30 % models of the half-space were within a factor of 1.6 of each other
DEAR_SECONDS = 30.0  # of an assessment that looks at the dearest ways too
GATHERING = 2**19  # samples of a model whose time the gathering of its light takes at least
LONGEST = 1.5  # times the seconds of an assessment that a gathering may take
LIGHT_SECONDS = 0.4  # of a part of the light, beside its transfer: by emitters, and of the first samples
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
    seen: Sequence[ObjectTrade], ahead: Sequence[Technique], later: Sequence[Technique], job: Job, seconds: float
) -> tuple[list[Technique], Technique | None, dict[Technique, str]]:
    """Walks and the techniques that may win against them, the one whose light is worth gathering, why others are not.

    Args:
        seen: what is known of the objects that are seen and not dark.
        ahead: techniques that have been run.
        later: those whose light has to be gathered before, or that take long to run.
        job: that the cheapest is looked for.
        seconds: of the assessment.
    """
    names = {name for o in seen for name in contenders(o, job.tolerance)}
    reasons = {technique: [left_out(o, technique, job, seconds) for o in seen] for technique in later}
    wanted = [technique for technique in later if "" in reasons[technique]]
    why, best = {technique: given[0] for technique, given in reasons.items()}, None
    if wanted:
        best = most_promising(seen, wanted, job)
        why |= dict.fromkeys(wanted, f"not measured, as {best.name} promises more: ask for it by its name")
        names -= {technique.model for technique in wanted}  # they cannot win where their light is worth gathering
    return [technique for technique in ahead if technique.name in names or technique.exact], best, why


def gathering_seconds(row: TechniqueTrade) -> float:
    """Seconds of gathering two parts of the light of a model."""
    return 2 * (PART * GATHERING * row.seconds + LIGHT_SECONDS)


def left_out(assessed: ObjectTrade, technique: Technique, job: Job, seconds: float) -> str:
    """Why a technique is not worth a run for an object, by what others have shown; empty where it is."""
    best, known = cheapest(assessed, job), {row.way: row for row in assessed.ways}
    if technique.model not in known:
        return f"not measured in less than {DEAR_SECONDS:g} s: ask for it by its name"
    row = known[technique.model]
    if row.refusal:
        return row.refusal
    if row.bias2 - DOUBT * row.bias2_error > job.tolerance**2:
        off = f"{technique.model} is {row.told_bias} % off"
        return f"not measured, as {off}, asked {100 * job.tolerance:.3g} %"
    least = _once(row, job) + GATHERING * row.seconds
    if least > best:
        return f"not measured, as another way keeps {job.tolerance:.3g} in {best:.2g} s, before its light is gathered"
    parts = row.preparation + 2 * PART * GATHERING * row.seconds
    if parts > LONGEST * seconds:
        return f"not measured, as its light is gathered for {parts:.2g} s or longer: ask for it by its name"
    return ""


def most_promising(seen: Sequence[ObjectTrade], wanted: Sequence[Technique], job: Job) -> Technique:
    """The technique by which the job is expected to end first.

    It keeps the tolerance by the chance that its model does, and takes what gathering takes then, else what the
    cheapest of the other techniques does.
    """

    def expected(technique: Technique) -> float:
        total = 0.0
        for o in seen:
            row = o.way(technique.model)
            chance = NormalDist().cdf((job.tolerance**2 - max(row.bias2, 0.0)) / max(row.bias2_error, 1e-30))
            total += chance * (_once(row, job) + GATHERING * row.seconds) + (1 - chance) * cheapest(o, job)
        return total

    return min(wanted, key=expected)


def cheapest(assessed: ObjectTrade, job: Job) -> float:
    """Seconds of a job by the techniques that have been measured."""
    rows, n = [row for row in assessed.ways if not row.refusal and row.variance >= 0], job.images * assessed.pixels
    jobs = [samples_for(row, job.tolerance) * row.seconds * n + _once(row, job) for row in rows]
    return min(jobs, default=math.inf)


def _once(row: TechniqueTrade, job: Job) -> float:
    """Seconds before the first image."""
    return row.preparation + (row.training if job.count_training else 0.0)


def contenders(assessed: ObjectTrade, tolerance: float) -> list[str]:
    """Ways beside walks that may keep the tolerance, and may be the cheapest that does."""
    rows = [row for row in assessed.ways if not row.refusal and row.variance >= 0]
    best = min((samples_for(row, tolerance) * row.seconds for row in rows), default=math.inf)
    return [row.way for row in rows if row.way != PATH_TRACED and _at_best(row, tolerance) < CLOSE * best]


def _at_best(row: TechniqueTrade, tolerance: float) -> float:
    """Seconds for a pixel if the bias is as small as it may be."""
    left = tolerance**2 - max(row.bias2 - DOUBT * row.bias2_error, 0.0)
    return max(row.variance / left, 1.0) * row.seconds if left > 0 else math.inf
