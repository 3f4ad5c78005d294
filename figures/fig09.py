"""Fig. 9: five materials under a small light and in surroundings, path traced and by all models, with FLIP."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from figures.computing import contenders
from figures.computing.images import FLIP, Shot, compared, noise_of, stops_of
from figures.computing.learnt import CHUNKS, FULL_GEOMETRY, train_scan, training_of, weight_files, with_weights
from figures.computing.scenes import BUNNY, MATERIALS, bunny_scene, long_render, prepare
from figures.drawing.error_tables import label
from figures.drawing.image_files import image_files
from figures.parts.part import Part, Result, Task, unmodelled
from halfspace_sss import materials

TITLE = "five materials, path traced and by every kind of model, with FLIP"
MODELS = (*contenders.MODELS, *contenders.OF_OBJECTS)
SHOWN = {"draft": ("marble", "potato", "ketchup"), "paper": MATERIALS}
SIZES = {"draft": 96, "paper": 384}
MODEL_SPP = {"draft": 36, "paper": 576}  # of each of two passes; square numbers, for the sampler
TRUTH_SPP = {"draft": 192, "paper": 8192}
SPP_PER_PASS = 16
AGAIN_SEED = 10_000  # of the second path traced image; passes count up from the first seed
NOTES = (
    "All images contain all scattering orders: to the models without single scattering it is added, path traced. "
    "FLIP and relative squared error of the pixels of the object at the stated exposure, against the path traced "
    "image, whose own noise is in all of them alike: `path traced again` is what that noise alone makes. Seconds for "
    "the image on this machine, without compilation and without the training of `full_geometry`, which the table of "
    "the files has as CPU time; it draws 2 entries an exit."
)


def parts(quality: str) -> list[Part]:
    """For each material two path-traced images, then the image of each model."""
    size, results = SIZES[quality], []
    for material in SHOWN[quality]:
        common = {"material": material, "size": size, "seed": 0}
        spp = TRUTH_SPP[quality]
        for name, seed in (("path traced", 0), ("path traced again", AGAIN_SEED)):
            params = {**common, "seed": seed, "spp": spp}
            results.append(Part(f"{material}, {name}", path_traced, params, spp * size**2, inputs=(BUNNY,)))
        spp = MODEL_SPP[quality]
        for model in MODELS:
            learnt = model == FULL_GEOMETRY
            results += [train_scan(material, material, CHUNKS[quality])] if learnt else []
            params = {**common, "spp": spp, "model": model}
            inputs = (BUNNY, *weight_files(model, materials.load(material).medium))
            needs = (training_of(material),) if learnt else ()
            results.append(Part(f"{material}, {model}", rendered, params, 2 * spp * size**2, needs, inputs, model))
    return results


@unmodelled
def path_traced(task: Task) -> dict[str, Any]:
    """The image by random walks, in passes that survive an interruption."""
    from halfspace_sss.rendering.scenes.scene_files import load_scene

    prepare()
    p = task.params
    scene = load_scene(bunny_scene(p["material"], p["size"]), "path_traced")
    return long_render(task, scene, SPP_PER_PASS, p["spp"] // SPP_PER_PASS)


def rendered(task: Task) -> dict[str, Any]:
    """The image of a model, and the seconds it takes once it is compiled."""
    import mitsuba as mi

    from halfspace_sss.rendering.scenes.scene_files import load_scene

    prepare()
    p = task.params
    description = bunny_scene(p["material"], p["size"], sampler="multijitter")
    if "entries" in p:  # else as many as the model says
        description["integrator"] |= {"entries": p["entries"]}
    with with_weights(task.folder, task.needed):
        scene = load_scene(description, p["model"])
        first = np.array(mi.render(scene, spp=p["spp"], seed=p["seed"] + 1))  # compiles
        started = time.perf_counter()
        second = np.array(mi.render(scene, spp=p["spp"], seed=p["seed"] + 2))
        seconds = 2 * (time.perf_counter() - started)
    return {"image": (0.5 * (first + second)).astype(np.float32), "seconds": seconds, "spp": 2 * p["spp"]}


def draw(results: Mapping[str, Result]) -> dict[str, bytes | str]:
    """The figure as PDF and PNG, the page to flip between the images, and the numbers as a table."""
    scenes, rows = {}, []
    for material in (name for name in MATERIALS if f"{name}, path traced" in results):
        name, shots = _shots(results, material)
        scenes[name] = shots
        rows += [{"material": material, "model": s.label, **s.numbers} for s in shots if s.image is not None]
    return image_files("fig09", "Fig. 9: five materials by every kind of model", scenes, rows, NOTES)


def _shots(results: Mapping[str, Result], material: str) -> tuple[str, list[Shot]]:
    """The material with its exposure, and the images, multiplied by it."""
    truth = results[f"{material}, path traced"]
    reference = truth.images["image"]
    mask = reference.max(axis=2) > 0
    stops = stops_of(reference, mask)
    gain = np.float32(2.0**stops)
    error = noise_of(reference, truth.images["variance"], mask)
    numbers = {"seconds": truth.numbers["seconds"], "spp": truth.numbers["spp"], "standard error": error}
    shots = [Shot("Path traced", gain * reference, numbers)]
    again = results[f"{material}, path traced again"]
    numbers = {key: again.numbers[key] for key in ("seconds", "spp")}
    other = compared("Path traced again", gain * again.images["image"], gain * reference, mask=mask, numbers=numbers)
    shots.append(replace(other, numbers=other.numbers | {FLIP: f"{other.numbers[FLIP]:.3f}"}))  # text: no best model
    for model in MODELS:
        result = results[f"{material}, {model}"]
        numbers = {"seconds": result.numbers["seconds"], "spp": result.numbers["spp"]}
        if model == FULL_GEOMETRY:
            numbers["CPU seconds of training"] = results[training_of(material)].numbers["cpu seconds"]
        shots.append(
            compared(label(model), gain * result.images["image"], gain * reference, mask=mask, numbers=numbers)
        )
    return f"{material} ({stops:+g} stops)", shots
