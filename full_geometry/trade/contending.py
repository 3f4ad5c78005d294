"""Which ways may be the cheapest to keep a tolerance, after a look at some, and why others are not worth a look."""

from __future__ import annotations

import math
from collections.abc import Sequence
from statistics import NormalDist

from full_geometry.integrators.gathering import PART
from full_geometry.scenes.scene_files import PATH_TRACED
from full_geometry.trade.measuring import SceneSamples
from full_geometry.trade.results import Assessment, ObjectTrade, WayTrade, samples_for
from full_geometry.trade.ways import Way

DOUBT = 2.0  # standard errors
FAR = 6.0  # times the tolerance: beyond 30 % models of the half-space were within a factor of 1.6 of each other
DEAR_SECONDS = 30.0  # of an assessment that looks at the dearest ways too
GATHERING = 2**19  # samples of a model whose time the gathering of its light takes at least
LONGEST = 1.5  # times the seconds of an assessment that a gathering may take
LIGHT_SECONDS = 0.4  # of a part of the light, beside its transfer: by emitters, and of the first samples
CLOSE = 1.3  # times the cost of the cheapest way, up to which another may turn out cheaper


def too_dear(
    look: SceneSamples, walked: Assessment, chosen: Sequence[Way], tolerance: float, images: int
) -> dict[Way, str]:
    """Ways that are not worth a look beside walks, as their training alone takes longer than the job by these."""
    found = {}
    walks = [(k, cheapest(o, tolerance, images)) for k, o in enumerate(walked.objects) if o.ways]
    for way in chosen:
        pairs = [(look.training(k, way), best) for k, best in walks]
        if pairs and all(training > best for training, best in pairs):
            training, best = pairs[0]
            job = f"path_traced keeps {tolerance:.3g} in {best:.2g} s"
            found[way] = f"not measured, as {job}, and the training of {way.model} took {training:.2g} s"
    return found


def as_far_off(found: Assessment, flat: Sequence[Way], later: Sequence[Way], tolerance: float) -> dict[Way, str]:
    """Models of the half-space that are not worth a look, as the first of them is far off and they err alike."""
    rows = [o.way(flat[0].name) for o in found.objects if o.ways] if flat else []
    if not rows or any(r.refusal or r.bias2 - DOUBT * r.bias2_error < (FAR * tolerance) ** 2 for r in rows):
        return {}
    others = {way.model for way in flat[1:]} - {flat[0].model}
    why = f"not measured, as {flat[0].model} is {rows[0].told_bias} % off, and models of the half-space err alike"
    return {way: why for way in (*flat, *later) if way.model in others}


def promising(
    seen: Sequence[ObjectTrade], ahead: Sequence[Way], later: Sequence[Way], job: tuple[float, int | None, float, bool]
) -> tuple[list[Way], Way | None, dict[Way, str]]:
    """Walks and the ways that may win against them, the way whose light is worth gathering, and why others are not."""
    tolerance, images, _, counted = job
    names = {name for o in seen for name in contenders(o, tolerance)}
    reasons = {way: [left_out(o, way, *job) for o in seen] for way in later}
    wanted = [way for way in later if "" in reasons[way]]
    told, best = {way: given[0] for way, given in reasons.items()}, None
    if wanted:
        best = most_promising(seen, wanted, tolerance, images or 1, counted)
        told |= {way: f"not measured, as {best.name} promises more: ask for it by its name" for way in wanted}
        names -= {way.model for way in wanted}  # they cannot win where gathering their light is worth its time
    return [way for way in ahead if way.name in names or way.walks], best, told


def gathering_seconds(row: WayTrade) -> float:
    """Seconds of gathering two parts of the light of a model."""
    return 2 * (PART * GATHERING * row.seconds + LIGHT_SECONDS)


def left_out(
    assessed: ObjectTrade, way: Way, tolerance: float, images: int, seconds: float, counted: bool = True
) -> str:
    """Why a way is not worth a look for an object, after a look at others; empty where it is."""
    best, known = cheapest(assessed, tolerance, images, counted), {row.way: row for row in assessed.ways}
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


def most_promising(
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
            best = cheapest(o, tolerance, images, counted)
            total += chance * (_once(row, counted) + GATHERING * row.seconds) + (1 - chance) * best
        return total

    return min(ways, key=expected)


def cheapest(assessed: ObjectTrade, tolerance: float, images: int, counted: bool = True) -> float:
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
