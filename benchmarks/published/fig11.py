"""Fig. 11: path tracing and ours in the same time, raw and denoised by Open Image Denoise, with FLIP."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from benchmarks.methods import VOLUMES, contender
from benchmarks.timed import TimedRender, alternating, pass_size
from figures.computing.contenders import MODELS, NOTE, OF_OBJECTS, WALK, against, long_reference, reference_shot
from figures.computing.images import FLIP, RELATIVE_MSE, Shot
from figures.computing.learnt import CHUNKS, FULL_GEOMETRY, train_scan, training_of, weight_files, with_weights
from figures.computing.scans import BUNNY, prepare
from figures.drawing.image_grid import image_files, label
from figures.parts.part import Part, Result, Row, Task
from full_geometry.trade.denoising import check_denoiser, denoised, guides
from halfspace_sss import materials

TITLE = "path tracing and ours in equal time, raw and denoised, with FLIP"
MATERIALS = ("marble", "ketchup")
LIGHTS = "both"
OURS = MODELS[-1]
METHODS = (*VOLUMES, WALK, OURS, *OF_OBJECTS)
ROULETTES = {"draft": (VOLUMES[0], VOLUMES[-1]), "paper": VOLUMES}
SIZES = {"draft": 96, "paper": 384}
SECONDS = {"draft": 2.0, "paper": 60.0}  # for an image
TRUTH_SPP = {"draft": 128, "paper": 1024}
PASSES, SHORTEST = 8, 1.0  # of an image, about; seconds, of a pass: a render has a cost of its own
NOTES = (
    "Every method had the same time, compilation and the training of `full_geometry` left out; passes of all methods "
    "took turns on the same machine. Of "
    "Mitsuba's volpathmis with Russian roulette from vertex 5, 64, 200 and 1024 on, the one with the smallest relMSE "
    "is shown, a choice in its favour; the table of the files lists all. FLIP and relMSE of the pixels of the object "
    f"at the stated exposure. {NOTE}"
)


def parts(quality: str) -> list[Part]:
    """For each material a long path-traced image, then what every method makes of the time."""
    size, results = SIZES[quality], []
    for material in MATERIALS:
        common = {"material": material, "size": size, "lights": LIGHTS}
        spp = TRUTH_SPP[quality]
        params = {**common, "spp": spp, "seed": 0}
        results.append(Part(f"{material}, truth", long_reference, params, spp * size**2, inputs=(BUNNY,)))
        methods = [name for name in METHODS if name not in VOLUMES or name in ROULETTES[quality]]
        params = {**common, "seconds": SECONDS[quality], "methods": methods, "seed": 1}
        learnt = FULL_GEOMETRY in METHODS
        results += [train_scan(material, material, CHUNKS[quality])] if learnt else []
        files = [file for name in methods for file in weight_files(name, materials.load(material).medium)]
        work, needs = len(methods) * SECONDS[quality], (training_of(material),) if learnt else ()
        results.append(Part(f"{material}, equal time", rivals, params, work, needs, (BUNNY, *files)))
    return results


def rivals(task: Task) -> dict[str, object]:
    """What each method makes of the same time, raw and denoised."""
    check_denoiser()
    prepare()
    p = task.params
    each = max(p["seconds"] / PASSES, min(SHORTEST, p["seconds"]))
    with with_weights(task.folder, task.needed):
        scenes = {name: contender(name, p["material"], p["size"], p["lights"]) for name in p["methods"]}
        spp = {name: pass_size(scene, each, p["seed"]) for name, scene in scenes.items()}
        result = alternating(scenes, spp, p["seed"], seconds=p["seconds"], progress=task.progress)
    seen = next(iter(scenes.values()))
    about = guides(seen)
    images, numbers = {}, {}
    for name, timed in result.items():
        images[_key(name, "raw")] = timed.image.astype(np.float32)
        images[_key(name, "denoised")], seconds = denoised(timed.image, *about)
        numbers[name] = _numbers(timed, seconds)
    return {**images, "methods": numbers}


def _key(name: str, state: str) -> str:
    """Of an image in a result."""
    return f"{name.replace(' ', '_')}-{state}"


def _numbers(timed: TimedRender, seconds: float) -> Row:
    return {
        "spp": timed.spp,
        "seconds": timed.seconds,
        "passes": len(timed.pass_seconds),
        "seconds of denoising": seconds,
    }


def draw(results: Mapping[str, Result]) -> dict[str, bytes | str]:
    """The figure as PDF and PNG, the page to flip between the images, and the numbers as a table."""
    scenes, rows = {}, []
    for material in dict.fromkeys(name.split(",")[0] for name in results):
        name, shots, result = _shots(results[f"{material}, truth"], results[f"{material}, equal time"], material)
        scenes[name] = shots
        rows += result
    return image_files(
        "fig11", "Fig. 11: path tracing and ours in equal time", scenes, rows, NOTES, (FLIP, RELATIVE_MSE, "spp")
    )


def _shots(truth: Result, rivals: Result, material: str) -> tuple[str, list[Shot], list[Row]]:
    """The material with its exposure, the images that are shown, multiplied by it, and the rows of all methods."""
    reference = reference_shot(truth, "Path traced, long")
    shots, rows = {}, [{"material": material, "method": WALK, "state": "truth", **reference[0].numbers}]
    for name, about in rivals.numbers["methods"].items():
        for state in ("raw", "denoised"):
            extra = {"spp": str(about["spp"]), "seconds": about["seconds"]}
            if state == "denoised":
                extra["seconds"] += about["seconds of denoising"]
            shot = against(reference, _title(name, state), rivals.images[_key(name, state)], **extra)
            shots[name, state] = shot
            rows.append({"material": material, "method": name, "state": state, **shot.numbers})
    volumes = [name for name in rivals.numbers["methods"] if name in VOLUMES]
    best = min(volumes, key=lambda name: shots[name, "raw"].numbers[RELATIVE_MSE])
    for row in rows:
        row["shown"] = row["state"] == "truth" or row["method"] not in volumes or row["method"] == best
    chosen = [shot for (name, _), shot in shots.items() if name not in volumes or name == best]
    return f"{material} ({reference[2]:+g} stops)", [reference[0], *chosen], rows


def _title(name: str, state: str) -> str:
    """Title of a column; the settings of volpathmis share one."""
    return f"{'Mitsuba volpathmis' if name in VOLUMES else label(name)}, {state}"
