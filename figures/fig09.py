"""Fig. 9: five materials under a small light and in surroundings, path traced and by all models, with FLIP."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from figures.computing import contenders
from figures.computing.contenders import COMPILING, NOTE, against, gathered_anew, long_reference, reference_shot
from figures.computing.images import Shot
from figures.computing.learnt import CHUNKS, FULL_GEOMETRY, train_scan, training_of, weight_files, with_weights
from figures.computing.scans import BUNNY, MATERIALS, prepare, scan_scene
from figures.drawing.image_grid import image_files, label
from figures.parts.part import Part, Result, Task
from halfspace_sss import materials
from halfspace_sss.backend import clock

LIGHTS = "both"
TITLE = "five materials, path traced and by every kind of model, with FLIP"
MODELS = (*contenders.MODELS, *contenders.OF_OBJECTS)
SHOWN = {"draft": ("marble", "ketchup"), "paper": MATERIALS}
SIZES = {"draft": 96, "paper": 384}
MODEL_SPP = {"draft": 16, "paper": 64}
TRUTH_SPP = {"draft": 128, "paper": 1024}
ANEW = {"draft": False, "paper": True}  # light is gathered a second time, to be timed without compilation
NOTES = (
    "All images contain all scattering orders: to the models without single scattering it is added, path traced. "
    "Models by their gathered light. FLIP and relative squared error of the pixels of the object at the stated "
    f"exposure. {NOTE} CPU seconds for the image with gathering, without compilation but of a draft's gathering, and "
    "without the training of `full_geometry`, which the table of the files has as CPU time."
)


def parts(quality: str) -> list[Part]:
    """For each material the path-traced image, then the image of each model."""
    size, results = SIZES[quality], []
    for material in SHOWN[quality]:
        common = {"material": material, "size": size, "lights": LIGHTS, "seed": 0}
        spp = TRUTH_SPP[quality]
        params = {**common, "spp": spp}
        results.append(Part(f"{material}, path traced", long_reference, params, spp * size**2, inputs=(BUNNY,)))
        spp = MODEL_SPP[quality]
        for model in MODELS:
            learnt = model == FULL_GEOMETRY
            results += [train_scan(material, material, CHUNKS[quality])] if learnt else []
            params = {**common, "spp": spp, "model": model, "light": "gathered"}
            params["anew"] = ANEW[quality]
            inputs = (BUNNY, *weight_files(model, materials.load(material).medium))
            needs = (training_of(material),) if learnt else ()
            results.append(Part(f"{material}, {model}", rendered, params, spp * size**2, needs, inputs, model))
    return results


def rendered(task: Task) -> dict[str, object]:
    """The image of a model, and the CPU seconds it takes with gathering once it is compiled."""
    import mitsuba as mi

    from full_geometry.scenes.scene_files import load_scene

    prepare()
    p = task.params
    description = scan_scene(p["material"], p["size"], p["lights"])
    description["integrator"] |= {key: p[key] for key in ("light", "entries") if key in p}
    with with_weights(task.folder, task.needed):
        scene = load_scene(description, p["model"])
        mi.render(scene, spp=COMPILING, seed=p["seed"] + 1)  # compiles
        gathering = 0.0
        if p["light"] == "gathered":
            gathering = gathered_anew(scene) if p["anew"] else sum(scene.integrator().gathering.seconds)
        started = clock()
        image = np.array(mi.render(scene, spp=p["spp"], seed=p["seed"] + 2))
        seconds = gathering + clock() - started
    return {"image": image, "seconds": seconds, "seconds of gathering": gathering, "spp": p["spp"]}


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
    reference = reference_shot(results[f"{material}, path traced"])
    shots = [reference[0]]
    for model in MODELS:
        result = results[f"{material}, {model}"]
        numbers = {key: result.numbers[key] for key in ("seconds", "seconds of gathering", "spp")}
        if model == FULL_GEOMETRY:
            numbers["CPU seconds of training"] = results[training_of(material)].numbers["cpu seconds"]
        shots.append(against(reference, label(model), result.images["image"], **numbers))
    return f"{material} ({reference[2]:+g} stops)", shots
