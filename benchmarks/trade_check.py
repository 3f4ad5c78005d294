"""One random scene: an assessment as users make it, a recommendation, and long runs that say how right they were."""

from __future__ import annotations

import json
import math
from pathlib import Path

from benchmarks.long_runs import long_run
from benchmarks.random_scenes import RandomScene, write_scene
from full_geometry.geometry.sensors import seeded
from full_geometry.scenes.scene_files import PATH_TRACED
from full_geometry.trade.advice import advise
from full_geometry.trade.assessing import assess_for, corrected_chance
from full_geometry.trade.results import Assessment, TechniqueTrade
from full_geometry.trade.techniques import (
    CORRECTED,
    READY_FIRST,
    WALKED,
    Effort,
    Job,
    Stage,
    Technique,
    stage,
)
from halfspace_sss.provenance import provenance, write_atomically

WAYS = (*(way.name for way in WALKED), "lambert", f"{READY_FIRST}, {CORRECTED}")
UNLIKELY = 0.1  # chance to keep the tolerance, below which corrected light has no long run
FORMAT = "halfspace-sss trade check 8"


def check_scene(scene: RandomScene, folder: Path, seconds: float, truth_seconds: float) -> dict[str, object]:
    """The record of a scene: the assessment, and the mean of long runs; what the folder holds is not run again."""
    file = write_scene(scene, folder)
    on, ways = stage(file), [Technique.of(name) for name in WAYS]
    quick = _quick(scene, on, ways, file.with_suffix(".json"), seconds)
    truth = file.with_suffix(".truth.json")
    likely = [way for way in ways if way.light != CORRECTED or corrected_chance(scene.tolerance) > UNLIKELY]
    long = long_run(on, likely, scene.tolerance, truth, seeded(scene.seed, scene.number, 1), truth_seconds)
    return {"scene": scene.record(), "quick": quick, "long": long.record()}


def _quick(scene: RandomScene, on: Stage, ways: list[Technique], path: Path, seconds: float) -> dict[str, object]:
    """The assessment as users make it, on which the recommendation rests."""
    how = {"format": FORMAT, "scene": scene.record(), "seconds": seconds, "ways": [way.name for way in ways]}
    if path.is_file():
        record = json.loads(path.read_text(encoding="utf-8"))
        if json.loads(json.dumps(how)).items() <= record.items():
            return record["quick"]
    number = seeded(scene.seed, scene.number, 0)
    result = assess_for(on, ways, Job(scene.tolerance, scene.images), Effort(seconds, seed=number)).record()
    record = {**how, "quick": result, "provenance": provenance(**how)}
    write_atomically(path, json.dumps(record, indent=1) + "\n")
    return result


def outcome(record: dict[str, object]) -> dict[str, object]:
    """What came of a scene: error and cost of the recommendation by the long runs, and those of the cheapest way."""
    scene = RandomScene(**{k: tuple(v) if isinstance(v, list) else v for k, v in record["scene"].items()})
    quick, long = (Assessment.from_record(record[key]) for key in ("quick", "long"))
    results: dict[str, object] = {"number": scene.number, "shape": scene.shape, "light": scene.light, "mfp": scene.mfp}
    results |= {"tolerance": scene.tolerance, "images": scene.images, "seconds": quick.seconds}
    if not quick.objects[0].ways or quick.objects[0].is_dark:
        return {**results, "way": None}
    job = Job(scene.tolerance, scene.images)
    chosen = advise(quick, job).objects[0]
    option = chosen.options[0]
    truth = {row.way: row for row in long.objects[0].ways if not row.refusal}
    row, pixels = truth[option.way], long.objects[0].pixels
    fewer = max(row.least / option.spp, 1.0)  # of denoised walks, whose error is that of `least` samples
    error2 = max(row.bias2, 0.0) * fewer + row.variance / option.spp
    error2_error = math.hypot(row.bias2_error, row.variance_error / option.spp)
    least = {name: _least(w, scene, pixels) for name, w in truth.items()}
    cheapest = min(least, key=lambda name: least[name])
    known = [name for name, w in truth.items() if w.bias2 + 2 * w.bias2_error < scene.tolerance**2]
    sure = min((least[name] for name in known), default=math.inf)
    cost = row.training + row.preparation + scene.images * pixels * option.spp * row.seconds
    results |= {"way": option.way, "spp": option.spp, "error": math.sqrt(error2)}
    results |= {"error_standard_error": error2_error / (2 * math.sqrt(error2)), "cost_s": cost}
    results |= {"cheapest": cheapest, "cheapest_s": least[cheapest], "ratio": cost / least[cheapest]}
    results |= {"sure_ratio": cost / sure}
    results["keeps"] = error2 - 2 * error2_error <= scene.tolerance**2
    return results | {f"{name}_s": least.get(name, math.inf) for name in WAYS}


def _least(row: TechniqueTrade, scene: RandomScene, pixels: float) -> float:
    """Seconds of a job by a way if bias and variance were known, training and preparation included."""
    left = scene.tolerance**2 - max(row.bias2, 0.0)
    if not left > 0:
        return math.inf
    return (
        row.training
        + row.preparation
        + scene.images * pixels * max(math.ceil(row.variance / left), row.least) * row.seconds
    )


def z_values(record: dict[str, object]) -> list[tuple[str, float]]:
    """(bias² of the assessment - that of the long run) over their standard errors together, for each way."""
    quick, long = (Assessment.from_record(record[key]) for key in ("quick", "long"))
    results = []
    for a in quick.objects[0].ways:
        if a.refusal or a.way == PATH_TRACED:
            continue
        b = long.objects[0].way(a.way)
        error = math.hypot(a.bias2_error, b.bias2_error)
        if error > 0:
            results.append((a.way, (a.bias2 - b.bias2) / error))
    return results
