"""One random scene: an assessment as users make it, a recommendation, and a long run that says how right it was."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from benchmarks.random_scenes import RandomScene, write_scene
from full_geometry.geometry.sensors import seeded
from full_geometry.scenes.scene_files import PATH_TRACED
from full_geometry.trade.advice import advise
from full_geometry.trade.assessing import assess_for, assess_stage, corrected_chance
from full_geometry.trade.results import Assessment, TechniqueTrade, samples_for
from full_geometry.trade.techniques import (
    CORRECTED,
    READY_FIRST,
    WALKED,
    Effort,
    Job,
    Technique,
    stage,
)
from halfspace_sss.provenance import provenance, write_atomically

WAYS = (*(way.name for way in WALKED), "lambert", f"{READY_FIRST}, {CORRECTED}")
UNLIKELY = 0.1  # chance to keep the tolerance, below which corrected light has no long run
NOISIER = 2.0  # times the noise of plain walks in the same time, beyond which they are not denoised in a long run
PLAIN = 0.25  # of the seconds of a long run, beside its denoised walks
KNOWN = 0.05  # relative standard error of the squared error of denoised walks, which ends it
FORMAT = "halfspace-sss trade check 10"


def check_scene(scene: RandomScene, folder: Path, seconds: float, truth_seconds: float) -> dict[str, object]:
    """The record of a scene: the assessment, and the mean of long runs; what the folder holds is not run again."""
    file = write_scene(scene, folder)
    on, ways = stage(file), [Technique.of(name) for name in WAYS]

    def short() -> Assessment:
        effort = Effort(seconds, seed=seeded(scene.seed, scene.number, 0))
        return assess_for(on, ways, Job(scene.tolerance, scene.images), effort)

    quick = _once(scene, file.with_suffix(".json"), seconds, ways, short)
    likely = _likely(scene, ways, Assessment.from_record(quick))

    def long() -> Assessment:
        effort = Effort(PLAIN * truth_seconds, seed=seeded(scene.seed, scene.number, 1))
        return assess_stage(on, likely, effort, None, scene.tolerance, truth_seconds, KNOWN)

    truth = _once(scene, file.with_suffix(".truth.json"), truth_seconds, likely, long)
    return {"scene": scene.record(), "quick": quick, "long": truth}


def _likely(scene: RandomScene, ways: list[Technique], quick: Assessment) -> list[Technique]:
    """Ways that may be the cheapest, and the advised one, which have a long run."""
    advised = {o.way for o in advise(quick, Job(scene.tolerance, scene.images)).objects}
    rows = {row.way: row for o in quick.objects for row in o.ways if not row.refusal}
    plain = [way for way in ways if way.walks and not way.denoised and way.name in rows]
    noise = {way.name: rows[way.name].variance * rows[way.name].seconds for way in plain}

    def may_win(way: Technique) -> bool:
        if way.light == CORRECTED:
            return corrected_chance(scene.tolerance) > UNLIKELY
        name = replace(way, denoised=False).name
        return not way.denoised or noise.get(name, math.inf) < NOISIER * min(noise.values(), default=math.inf)

    return [way for way in ways if way.name in advised or may_win(way)]


def _once(
    scene: RandomScene, path: Path, seconds: float, ways: list[Technique], measure: Callable[[], Assessment]
) -> dict[str, object]:
    """The record of an assessment, measured unless the file has it."""
    how = {"format": FORMAT, "scene": scene.record(), "seconds": seconds, "ways": [way.name for way in ways]}
    if path.is_file():
        record = json.loads(path.read_text(encoding="utf-8"))
        if json.loads(json.dumps(how)).items() <= record.items():
            return record["found"]
    result = measure().record()
    record = {**how, "found": result, "provenance": provenance(**how)}
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
    error2 = max(row.bias2, 0.0) + row.noise2(option.spp)
    error2_error = math.hypot(row.bias2_error, row.variance_error / option.spp**row.power)
    least = {name: _least(w, scene, pixels) for name, w in truth.items()}
    cheapest = min(least, key=lambda name: least[name])
    sure = min(_cost(w, scene, pixels, samples_for(w, scene.tolerance)) for w in truth.values())
    cost = _cost(row, scene, pixels, option.spp)
    results |= {"way": option.way, "spp": option.spp, "error": math.sqrt(error2)}
    results |= {"error_standard_error": error2_error / (2 * math.sqrt(error2)), "cost_s": cost}
    results |= {"cheapest": cheapest, "cheapest_s": least[cheapest], "ratio": cost / least[cheapest]}
    results |= {"sure_ratio": cost / sure, "technique_ratio": least[option.way] / least[cheapest]}
    results["keeps"] = error2 - 2 * error2_error <= scene.tolerance**2
    return results | {f"{name}_s": least.get(name, math.inf) for name in WAYS}


def _least(row: TechniqueTrade, scene: RandomScene, pixels: float) -> float:
    """Seconds of a job by a way whose bias and variance are as measured."""
    known = replace(row, bias2_error=0.0, variance_error=0.0)
    return _cost(row, scene, pixels, samples_for(known, scene.tolerance))


def _cost(row: TechniqueTrade, scene: RandomScene, pixels: float, spp: float) -> float:
    """Seconds of a job by so many samples of a pixel, training and preparation included."""
    return row.job_seconds(scene.images, pixels * math.ceil(spp)) if spp < math.inf else math.inf


def z_values(record: dict[str, object]) -> list[tuple[str, float]]:
    """(bias² of the assessment - that of the long run) over their standard errors together, for each way."""
    quick, long = (Assessment.from_record(record[key]) for key in ("quick", "long"))
    results = []
    for a in quick.objects[0].ways:
        if a.refusal or a.way == PATH_TRACED:
            continue
        b = next((row for row in long.objects[0].ways if row.way == a.way and not row.refusal), None)
        if b is None or Technique.of(a.way).denoised:
            continue
        error = math.hypot(a.bias2_error, b.bias2_error)
        if error > 0:
            results.append((a.way, (a.bias2 - b.bias2) / error))
    return results
