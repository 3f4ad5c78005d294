"""A second look at the ways on which the choice hangs: those that might be the cheapest to keep a tolerance."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

from halfspace_sss.progress import NamedProgress
from halfspace_sss.rendering.scenes.scene_files import PATH_TRACED
from halfspace_sss.trade.measuring.objects import EXITS, assess_stage
from halfspace_sss.trade.measuring.results import Assessment, ObjectTrade, WayTrade, samples_for
from halfspace_sss.trade.measuring.seeds import seeded
from halfspace_sss.trade.measuring.ways import Stage, Way

__all__ = ["assess_for", "contenders"]

FIRST_SHARE = 0.3  # of the time, for the look at all ways
LEAST_SHARE = 0.25  # of the time, for the second look, however long the first one took
DOUBT = 2.0  # standard errors
CLOSE = 1.3  # times the cost of the cheapest way, up to which another may turn out cheaper
TRACED = (0.3, 0.85)  # least and most of the time of the second look for walks


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
    """As `assess_stage`, with most of the time for ways that could be the cheapest to keep a tolerance."""
    how = {"sensor": sensor, "exits": exits, "progress": progress}
    first = assess_stage(on, chosen, seconds=FIRST_SHARE * seconds, seed=seed, **how)
    seen = [o for o in first.objects if o.ways and not o.is_dark]
    if not seen:
        return first
    names = {name for o in seen for name in contenders(o, tolerance)}
    few = [way for way in chosen if way.name in names or way.model == PATH_TRACED]
    traced = sum(_traced_share(o, names) for o in seen) / len(seen)
    left = max(seconds - first.seconds / len(seen), LEAST_SHARE * seconds)
    again = assess_stage(on, few, seconds=left, seed=seeded(seed, 71), traced=traced, **how)
    objects = tuple(_merged(a, b) for a, b in zip(first.objects, again.objects))
    spent = (first.seconds + again.seconds, first.compilation + again.compilation)
    return Assessment(objects, *spent, first.seed)


def contenders(found: ObjectTrade, tolerance: float) -> list[str]:
    """Ways beside walks that may keep the tolerance, and may be the cheapest that does."""
    rows = [row for row in found.ways if not row.refusal and row.variance >= 0]
    best = min((samples_for(row, tolerance) * row.seconds for row in rows), default=math.inf)
    return [row.way for row in rows if row.way != PATH_TRACED and _at_best(row, tolerance) < CLOSE * best]


def _at_best(row: WayTrade, tolerance: float) -> float:
    """Seconds for a pixel if the bias is as small as it may be."""
    left = tolerance**2 - max(row.bias2 - DOUBT * row.bias2_error, 0.0)
    return max(row.variance / left, 1.0) * row.seconds if left > 0 else math.inf


def _traced_share(found: ObjectTrade, names: set[str]) -> float:
    """Of the time, by which noise of differences is least: each way has sqrt(V t), walks serve all others at once."""
    noise = [math.sqrt(r.variance * r.seconds) for r in found.ways if r.way in names and not r.refusal]
    walks = math.sqrt(len(noise) * found.traced.variance * found.traced.seconds)
    return min(max(walks / (walks + sum(noise)), TRACED[0]), TRACED[1]) if noise and walks > 0 else TRACED[1]


def _merged(a: ObjectTrade, b: ObjectTrade) -> ObjectTrade:
    """Both looks as one; they have exits and samples of their own."""
    if not a.ways or not b.ways:
        return a
    second = {row.way: row for row in b.ways if not row.refusal}
    walks = (a.traced, b.traced)
    rows = [_mean(row, second[row.way], walks) if row.way in second and not row.refusal else row for row in a.ways]
    return replace(a, ways=tuple(rows))


def _mean(a: WayTrade, b: WayTrade, walks: tuple[WayTrade, WayTrade]) -> WayTrade:
    """The mean of two rows, weighed by what noise their samples leave: errors grow with values, which they'd favour."""
    V, V_walks = a.variance + b.variance, walks[0].variance + walks[1].variance
    noise = [V / row.samples + V_walks / walk.samples for row, walk in zip((a, b), walks)]
    u = noise[1] / (noise[0] + noise[1]) if sum(noise) > 0 else 0.5
    ratio = tuple(u * x + (1 - u) * y for x, y in zip(a.ratio, b.ratio))
    return replace(
        a, bias2=u * a.bias2 + (1 - u) * b.bias2, bias2_error=math.hypot(u * a.bias2_error, (1 - u) * b.bias2_error),
        ratio=ratio, ratio_error=tuple(math.hypot(u * x, (1 - u) * y) for x, y in zip(a.ratio_error, b.ratio_error)),
        variance=0.5 * V, variance_error=0.5 * math.hypot(a.variance_error, b.variance_error),
        seconds=min(a.seconds, b.seconds), samples=a.samples + b.samples, memory=max(a.memory, b.memory),
    )  # fmt: skip
