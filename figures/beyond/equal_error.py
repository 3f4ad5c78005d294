"""The time in which each method reaches the same error as Mitsuba's volume path tracer, and where that time goes."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from figures.beyond.modelled import MODELLED, long_modelled, modelled_contender
from figures.computing.contenders import MODELS, OF_OBJECTS, VOLUMES, WALK, contender, long_walk
from figures.computing.denoise import guides
from figures.computing.furnace import furnace, furnace_models
from figures.computing.model_inputs import weight_files
from figures.computing.sampling_cost import split
from figures.computing.scenes import BUNNY, MATERIALS, SCANS, prepare
from figures.computing.timed import Timed, alternating, rendered
from figures.drawing import error_tables
from figures.learnt.training import TRAIN_SECONDS, train_modelled, train_scan
from figures.learnt.weights import FULL_GEOMETRY, TRAINING, training_of, with_weights
from figures.modelling.grid import TISSUES, tissue
from figures.modelling.scene_parts import VARYING
from figures.parts.part import Part, Result, Task
from halfspace_sss import materials
from halfspace_sss.physics.medium import Medium

__all__ = ["TITLE", "draw", "errors", "measured", "parts"]

TITLE = "time to equal error against Mitsuba's volume path tracer, time per sample, white furnace"
OBJECTS = MODELLED
SUBJECTS = {name: ("bunny", name) for name in MATERIALS} | {"dragon of potato": ("dragon", "potato")}
LIGHTS = ("small light", "even sky")
TRUTH = "truth"  # last word of the names of parts
BARE = "bare"  # without reflection and without the single scattering that a model lacks
BARE_MATERIALS = ("marble", "potato", "ketchup")
SPLIT_MATERIAL = "marble"
SIZES = {"draft": 48, "paper": 128}
TRUTH_SPP = {"draft": 64, "paper": 8192}
SAMPLER = "multijitter"  # of all methods; it takes square numbers of samples as they are
PASSES = {"draft": 3, "paper": 8}
SPP = {  # of a pass; one that is much shorter would show what a render costs before its first sample
    "draft": {"volume": 4, WALK: 16, "model": 64},
    "paper": {"volume": 64, WALK: 64, "model": 1024},
}
BARE_MODELS = {"draft": (MODELS[0], MODELS[-1]), "paper": MODELS}  # most of the time of a draft goes into compiling
RESOLUTION = {"draft": 64, "paper": 192}  # of modelled objects
LANES = {"draft": 2**18, "paper": 2**22}
FURNACE = {"draft": {"size": 16, "spp": 256}, "paper": {"size": 32, "spp": 16384}}


def parts(quality: str) -> list[Part]:
    """For each object its training, for each light the truth and the errors with times; then samples and furnace."""
    found = []
    for name, (scan, material) in SUBJECTS.items():
        if FULL_GEOMETRY in OF_OBJECTS:
            found.append(train_scan(name, material, TRAIN_SECONDS[quality], scan=scan))
        for lights in LIGHTS:
            found += _parts_of(name, lights, quality)
    for name in OBJECTS:
        found.append(train_modelled(name, RESOLUTION[quality], TRAIN_SECONDS[quality]))
        for lights in LIGHTS:
            found += _parts_of(name, lights, quality)
    weights = weight_files("neural", materials.load(SPLIT_MATERIAL).medium)
    common = {"material": SPLIT_MATERIAL, "models": list(MODELS), "lanes": LANES[quality], "repeats": 5}
    found.append(Part("time per sample", split, common, LANES[quality], inputs=(BUNNY, *weights)))
    for model in (WALK, *furnace_models()):
        params = {"model": model, **FURNACE[quality]}
        inputs = weight_files(model, materials.load(SPLIT_MATERIAL).medium) if model == "neural" else ()
        work = params["spp"] * params["size"] ** 2
        found.append(Part(_furnace_name(model), furnace, params, work, inputs=inputs))
    return found


def _errors_name(name: str, lights: str) -> str:
    return f"{name}, {lights}, errors"


def _furnace_name(method: str) -> str:
    return f"furnace, {method}"


def _parts_of(name: str, lights: str, quality: str) -> list[Part]:
    of_subject, file, medium = _subject(name, quality)
    common, spp = {**of_subject, "size": SIZES[quality], "lights": lights}, SPP[quality]
    known = (model for model in OF_OBJECTS if name not in VARYING or model == FULL_GEOMETRY)  # of media that vary
    methods = [*VOLUMES, WALK, *MODELS, *known]
    if name in BARE_MATERIALS:
        methods += [f"{model}, {BARE}" for model in BARE_MODELS[quality]]
    kinds = {method: "volume" if method in VOLUMES else WALK if method == WALK else "model" for method in methods}
    params = {
        **common, "passes": PASSES[quality], "spp": {method: spp[kinds[method]] for method in methods}, "seed": 1,
        "sampler": SAMPLER,
    }  # fmt: skip
    work = sum(params["spp"].values()) * params["passes"] * SIZES[quality] ** 2
    truth = f"{name}, {lights}, {TRUTH}"
    needs = (truth, *((training_of(name),) if FULL_GEOMETRY in OF_OBJECTS else ()))
    models = (method for method in methods if kinds[method] == "model" and BARE not in method)
    inputs = (file, *(f for model in models for f in weight_files(model, medium)))
    long, trace = {**common, "spp": TRUTH_SPP[quality], "seed": 0}, long_modelled if name in OBJECTS else long_walk
    return [
        Part(truth, trace, long, long["spp"] * SIZES[quality] ** 2, inputs=(file,)),
        Part(_errors_name(name, lights), measured, params, work, needs=needs, inputs=inputs),
    ]


def _subject(name: str, quality: str) -> tuple[dict[str, Any], Path, Medium]:
    """What of the parameters of its parts tells an object, the file that it depends on, and its medium."""
    if name in OBJECTS:
        return {"object": name, "resolution": RESOLUTION[quality]}, TISSUES, tissue("candle wax").medium
    scan, material = SUBJECTS[name]
    return {"scan": scan, "material": material}, SCANS[scan].file, materials.load(material).medium


def measured(task: Task) -> dict[str, Any]:
    """Errors and CPU seconds of all methods, whose passes take turns, and those of training."""
    prepare()
    p = task.params
    (truth,) = (found for name, found in task.needed.items() if name.endswith(TRUTH))
    seconds = [found.numbers["cpu seconds"] for name, found in task.needed.items() if name.endswith(TRAINING)]

    def progress(done: int, total: int) -> None:
        task.progress(total + done, 2 * total)

    with with_weights(task.folder, task.needed):
        scenes = _compiled(task)
        cover = guides(scenes[WALK], 8)[0][..., 0] > 0
        found = alternating(scenes, p["spp"], p["seed"], passes=p["passes"], progress=progress)
    traced = (WALK, *VOLUMES)
    rows = [{"method": name, **errors(timed, truth, cover, name in traced)} for name, timed in found.items()]
    level = float(np.mean(truth.images["image"][cover].astype(np.float64) ** 2))
    noise = float(np.mean(truth.images["variance"][cover], dtype=np.float64))
    about = {"mean square": level, "variance": noise, "seconds": truth.numbers["seconds"], "spp": truth.numbers["spp"]}
    return {"rows": rows, "truth": about, "training": dict(zip([FULL_GEOMETRY], seconds))}


def _compiled(task: Task) -> dict[str, Any]:
    """The scenes of all methods, with their kernels: the walk and the sampler have one for each number of samples."""
    p, scenes = task.params, {}
    for k, (name, spp) in enumerate(p["spp"].items()):
        method, _, bare = name.partition(", ")
        if "object" in p:
            scenes[name] = modelled_contender(method, p, task.folder, p["sampler"])
        else:
            more = (bare == BARE, p["sampler"], p["scan"])
            scenes[name] = contender(method, p["material"], p["size"], p["lights"], *more)
        rendered(scenes[name], spp, p["seed"])
        task.progress(k, 2 * len(p["spp"]))
    return scenes


def errors(timed: Timed, truth: Result, mask: np.ndarray, is_exact: bool) -> dict[str, float]:
    """Mean squared errors of one pass, about a long independent image of the same method and about the truth.

    The independent image of a model is the average of all other passes; that of a path tracer is the truth itself.
    What the independent image and the truth vary by themselves is taken off, so that an error that is lost in the noise
    of the truth can come out below 0.

    Args:
        timed: at least two passes.
        truth: with images "image" and "variance".
        mask: (H, W), true for the pixels that count.
        is_exact: whether the method is a path tracer.
    """
    images = timed.images[:, mask].astype(np.float64)
    count = len(images)
    against, noise = (truth.images[name][mask].astype(np.float64) for name in ("image", "variance"))
    # the mean square about all other passes times (count - 1)/count
    spread = images.var(axis=0, ddof=1).mean(axis=1)
    error = (np.mean((images - against) ** 2, axis=0) - noise).mean(axis=1)
    bias2 = np.zeros_like(error) if is_exact else error - spread
    return {
        "spp": timed.spp // count,
        "seconds": timed.typical_cpu_seconds,
        "variance": float(np.mean(error if is_exact else spread)),
        "bias2": float(np.mean(bias2)),
        "bias2 standard error": _standard_error(bias2),
        "error": float(np.mean(error)),
        "error standard error": _standard_error(error),
        "spread": float(np.mean(spread)),
    }


def _standard_error(pixels: np.ndarray) -> float:
    """Of the mean; the noise of pixels is independent."""
    return float(pixels.std(ddof=1) / np.sqrt(len(pixels)))


def draw(results: Mapping[str, Result]) -> dict[str, bytes | str]:
    """The tables: all numbers as CSV, and what they say as Markdown."""
    scenes = {(name, lights): _errors_name(name, lights) for name in (*SUBJECTS, *OBJECTS) for lights in LIGHTS}
    furnaces = {method: _furnace_name(method) for method in (WALK, *furnace_models())}

    def numbers(names: Mapping[Any, str]) -> dict[Any, Mapping[str, Any]]:
        return {key: results[name].numbers for key, name in names.items() if name in results}

    tables = {
        "errors": error_tables.equal_error(numbers(scenes)),
        "sampling": error_tables.sampling(results["time per sample"].numbers["rows"]),
        "furnace": error_tables.furnace(numbers(furnaces)),
    }
    files: dict[str, bytes | str] = {
        f"equal_error_{name}.csv": table.to_csv(index=False, lineterminator="\n") for name, table in tables.items()
    }
    files["equal_error.md"] = error_tables.markdown(tables["errors"], tables["sampling"], tables["furnace"])
    return files
