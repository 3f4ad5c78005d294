"""Long runs of a scene: batches with exits and samples of their own, until error and variance of each way are known.

The mean of batches is unbiased, as they are of equal length and none is weighed by its own error.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from full_geometry.geometry.sensors import seeded
from full_geometry.trade.assessing import assess_stage
from full_geometry.trade.results import Assessment, ObjectTrade, TechniqueTrade
from full_geometry.trade.techniques import Effort, Stage, Technique
from halfspace_sss.provenance import provenance, write_atomically

FORMAT = "halfspace-sss trade truth 2"
BATCH = 6.0  # seconds
CLOSE = 0.2  # standard error of bias² over tolerance², which is a tenth of the tolerance for a bias as large
CERTAIN = 3.0  # standard errors beyond the tolerance, after which a way is left
STEADY = 0.15  # relative standard error of variances
FIRST, LATER = 0.4, 0.6  # share of walks in the time of a batch


def long_run(
    on: Stage, ways: Sequence[Technique], tolerance: float, path: Path, seed: int, seconds: float
) -> Assessment:
    """The mean of as many batches as it takes, at most `seconds`; those that the file holds are not run again."""
    how = {"format": FORMAT, "tolerance": tolerance, "seed": seed, "ways": [way.name for way in ways]}
    batches: list[dict[str, object]] = []
    if path.is_file():
        kept = json.loads(path.read_text(encoding="utf-8"))
        if how.items() <= kept.items():
            batches = kept["batches"]
    while True:
        result = mean_of([Assessment.from_record(b) for b in batches]) if batches else None
        names = _open(result.objects[0], tolerance) if result else [way.name for way in ways]
        if result and (not names or len(batches) * BATCH >= seconds):
            return result
        few = [way for way in ways if way.name in names or way.walks]
        traced = LATER if batches else FIRST
        effort = Effort(min(BATCH, seconds), seed=seeded(seed, len(batches)), traced=traced)
        batch = assess_stage(on, few, effort, tolerance=tolerance)
        batches.append(batch.record())
        write_atomically(path, json.dumps({**how, "batches": batches, "provenance": provenance(**how)}) + "\n")


def _open(assessed: ObjectTrade, tolerance: float) -> list[str]:
    """Ways that may keep the tolerance and are not known well enough."""
    if assessed.is_dark:
        return []
    rows = [row for row in assessed.ways if not row.refusal and row.bias2 - CERTAIN * row.bias2_error < tolerance**2]
    return [r.way for r in rows if r.bias2_error > CLOSE * tolerance**2 or r.variance_error > STEADY * r.variance]


def mean_of(batches: Sequence[Assessment]) -> Assessment:
    """One assessment of several of the same scene; a way counts where it was sampled."""
    objects = []
    for k, first in enumerate(batches[0].objects):
        rows = []
        for row in first.ways:
            same = [w for b in batches for w in b.objects[k].ways if w.way == row.way and not w.refusal]
            rows.append(_mean(same) if same else row)
        objects.append(replace(first, ways=tuple(rows)))
    spent = sum(b.seconds for b in batches), sum(b.compilation for b in batches)
    return Assessment(tuple(objects), *spent, batches[0].seed)


def _mean(rows: Sequence[TechniqueTrade]) -> TechniqueTrade:
    n = len(rows)

    def mean(key: str) -> float:
        return sum(getattr(row, key) for row in rows) / n

    def error(key: str) -> float:
        return math.sqrt(sum(getattr(row, key) ** 2 for row in rows)) / n

    return replace(
        rows[0], bias2=mean("bias2"), bias2_error=error("bias2_error"), variance=mean("variance"),
        variance_error=error("variance_error"), seconds=min(row.seconds for row in rows),
        samples=sum(row.samples for row in rows), memory=max(row.memory for row in rows),
    )  # fmt: skip
