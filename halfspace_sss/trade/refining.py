"""A second look at the ways that might be cheaper than the best one so far, if only their bias were known better."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

from halfspace_sss.progress import NamedProgress
from halfspace_sss.rendering.scenes.scene_files import PATH_TRACED
from halfspace_sss.trade.measuring.objects import EXITS, assess_stage
from halfspace_sss.trade.measuring.results import Assessment, ObjectTrade, WayTrade
from halfspace_sss.trade.measuring.seeds import seeded
from halfspace_sss.trade.measuring.ways import Stage, Way

__all__ = ["assess_for"]

FIRST_SHARE = 0.6  # of the time, for the look at all ways
DOUBT = 2.0  # standard errors


def assess_for(
    on: Stage,
    chosen: Sequence[Way],
    tolerance: float,
    *,
    seconds: float = 4.0,
    sensor: int = 0,
    seed: int = 0,
    exits: int = EXITS,
    progress: NamedProgress | None = None,
) -> Assessment:
    """As `assess_stage`, with the last part of the time for ways that could be the cheapest to keep a tolerance."""
    how = {"sensor": sensor, "exits": exits, "progress": progress}
    first = assess_stage(on, chosen, seconds=FIRST_SHARE * seconds, seed=seed, **how)
    names = {name for o in first.objects for name in _doubtful(o, tolerance)}
    if not names:
        return first
    few = [way for way in chosen if way.name in names or way.model == PATH_TRACED]
    again = assess_stage(on, few, seconds=(1 - FIRST_SHARE) * seconds, seed=seeded(seed, 71), **how)
    objects = tuple(_merged(a, b) for a, b in zip(first.objects, again.objects))
    spent = (first.seconds + again.seconds, first.compilation + again.compilation)
    return Assessment(objects, *spent, first.seed)


def _doubtful(found: ObjectTrade, tolerance: float) -> list[str]:
    """Ways that may or may not keep the tolerance, and would be cheaper than the cheapest that does."""
    rows = [row for row in found.ways if not row.refusal and row.variance > 0]
    known = [_cost(row, tolerance, row.bias_bound) for row in rows]
    best = min(known, default=math.inf)
    return [
        row.way
        for row, cost in zip(rows, known)
        if row.way != PATH_TRACED
        and row.bias2 - DOUBT * row.bias2_error < tolerance**2
        and _cost(row, tolerance, 0.0) < best < cost
    ]


def _cost(row: WayTrade, tolerance: float, bias: float) -> float:
    left = tolerance**2 - bias**2
    return row.time_to(math.sqrt(left)) if left > 0 else math.inf


def _merged(a: ObjectTrade, b: ObjectTrade) -> ObjectTrade:
    """Both looks as one; they have exits and samples of their own."""
    second = {row.way: row for row in b.ways if not row.refusal}
    rows = tuple(_mean(row, second[row.way]) if row.way in second and not row.refusal else row for row in a.ways)
    return replace(a, ways=rows)


def _mean(a: WayTrade, b: WayTrade) -> WayTrade:
    """The mean of two rows, by their standard errors squared where there are any."""
    bias2, bias2_error = _weighted((a.bias2, a.bias2_error), (b.bias2, b.bias2_error))
    variance, variance_error = _weighted((a.variance, a.variance_error), (b.variance, b.variance_error), even=True)
    pairs = [_weighted(*p) for p in zip(zip(a.ratio, a.ratio_error), zip(b.ratio, b.ratio_error))]
    return replace(
        a, bias2=bias2, bias2_error=bias2_error, variance=variance, variance_error=variance_error,
        ratio=tuple(p[0] for p in pairs), ratio_error=tuple(p[1] for p in pairs),
        seconds=min(a.seconds, b.seconds), samples=a.samples + b.samples, memory=max(a.memory, b.memory),
    )  # fmt: skip


def _weighted(a: tuple[float, float], b: tuple[float, float], even: bool = False) -> tuple[float, float]:
    """Value and standard error; `even` weighs both alike: errors that grow with the value would favour small ones."""
    if even or not (a[1] > 0 and b[1] > 0):
        return 0.5 * (a[0] + b[0]), 0.5 * math.hypot(a[1], b[1])
    u, v = a[1] ** -2, b[1] ** -2
    return (u * a[0] + v * b[0]) / (u + v), (u + v) ** -0.5
