"""Fig. 1: candle, mandarin and croissant in surroundings, path traced and by gathered light of models, with FLIP."""

from __future__ import annotations

import time
from collections.abc import Mapping

import numpy as np

from figures.computing.contenders import OF_OBJECTS
from figures.computing.images import Shot
from figures.computing.learnt import (
    CHUNKS,
    FULL_GEOMETRY,
    object_parts,
    train_modelled,
    training_of,
    weight_files,
    with_weights,
)
from figures.computing.modelled import VIEWS, View, foot, scene
from figures.computing.references import NOTE, against, reference_image, reference_shot
from figures.computing.scenes import environment_file, prepare
from figures.computing.timed import COMPILING
from figures.drawing.image_files import image_files, label, rows_of
from figures.modelling.objects import TISSUES, tissue
from figures.parts.part import Part, Result, Task

TITLE = "candle with its flame, mandarin and croissant, path traced and by gathered light of models"
OBJECTS = ("candle", "mandarin", "croissant")
MODELS = ("neural", *(name for name in OF_OBJECTS if name == FULL_GEOMETRY))
TRUTH = "path_traced"
SIZES = {"draft": 128, "paper": 448}
SPP = {"draft": {TRUTH: 64, "model": 64}, "paper": {TRUTH: 512, "model": 32}}  # of few pixels more cost little
RESOLUTION = {"draft": 64, "paper": 240}  # of surfaces; grids have half of it
LIGHT = "sunset"  # the small lamps of the studio are hardly found by walks
NOTES = (
    "The candle is homogeneous wax with its flame as a small emitter in the bowl; mandarin and croissant are grid "
    "volumes, whose means the half-space takes. Smooth boundaries, all scattering orders; models render by "
    f"gathered light. FLIP and relative squared error of the pixels of the object. {NOTE}"
)


def parts(quality: str) -> list[Part]:
    """For each object its training, then its image by walks and by the models."""
    size, results = SIZES[quality], []
    for name in OBJECTS:
        results.append(train_modelled(name, RESOLUTION[quality], CHUNKS[quality]))
        for model in (TRUTH, *MODELS):
            spp = SPP[quality].get(model, SPP[quality]["model"])
            params = {"object": name, "model": model, "size": size, "spp": spp, "resolution": RESOLUTION[quality]}
            params |= {"view": list(_view(name)), "seed": 0}
            needs = (training_of(name),) if model == FULL_GEOMETRY else ()
            weights = weight_files(model, tissue("candle wax").medium)
            inputs = (environment_file(LIGHT), TISSUES, *weights)
            results.append(Part(f"{name}, {model}", shown, params, spp * size**2, needs, inputs, f"{name} {model}"))
    return results


def _view(name: str) -> View:
    return VIEWS[name]._replace(light=LIGHT)


def shown(task: Task) -> dict[str, object]:
    """An object in its surroundings: the reference, or the image of a model by its gathered light."""
    import mitsuba as mi

    from full_geometry.scenes.scene_files import load_scene

    prepare()
    p, name = task.params, task.params["object"]
    made = object_parts(name, p["resolution"], task.folder, p["seed"])
    description = scene(made, View(*p["view"]), p["size"], foot(made[name]))
    if p["model"] == TRUTH:
        alone = {key: description[key] for key in ("type", "sensor", name)}
        covering = mi.load_dict({**alone, "integrator": {"type": "path"}})
        return reference_image(task, load_scene(description, p["model"]), covering)
    description["integrator"] = {"type": "bssrdf", "light": "gathered"}
    with with_weights(task.folder, task.needed):
        loaded = load_scene(description, p["model"])
        mi.render(loaded, spp=COMPILING, seed=p["seed"] + 1)  # compiles
        began = time.process_time()
        image = np.array(mi.render(loaded, spp=p["spp"], seed=p["seed"] + 2))[..., :3]
    each = (time.process_time() - began) / p["spp"]
    return {"image": image, "spp": p["spp"], "cpu seconds of a sample": each}


def draw(results: Mapping[str, Result]) -> dict[str, bytes | str]:
    """The figure as PDF and PNG, the page to flip between the images, and the numbers as a table."""
    scenes = {name: _shots(results, name) for name in dict.fromkeys(key.split(", ")[0] for key in results)}
    return image_files("fig01", "Fig. 1: candle, mandarin and croissant", scenes, rows_of(scenes, "object"), NOTES)


def _shots(results: Mapping[str, Result], name: str) -> list[Shot]:
    """The images of an object, exposed alike."""
    reference = reference_shot(results[f"{name}, {TRUTH}"])
    images = {model: results[f"{name}, {model}"].images["image"] for model in MODELS}
    return [reference[0], *(against(reference, label(model), image) for model, image in images.items())]
