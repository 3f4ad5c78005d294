"""Fig. 1: candle, mandarin and croissant, path traced and by models whose light is gathered or corrected, with FLIP."""

from __future__ import annotations

import itertools
import time
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from benchmarks.modelling.learnt import object_parts, train_modelled
from benchmarks.modelling.objects import TISSUES, tissue
from figures.computing.contenders import COMPILING, NOTE, OF_OBJECTS, against, reference_image, reference_shot
from figures.computing.images import Shot
from figures.computing.learnt import CHUNKS, FULL_GEOMETRY, training_of, weight_files, with_weights
from figures.computing.scans import environment, environment_file, prepare
from figures.parts.part import Part, Result, SceneDict, Task
from full_geometry.trade.denoising import Denoiser

TITLE = "candle with its flame, mandarin and croissant, path traced and by models, light gathered and corrected"
OBJECTS = ("candle", "mandarin", "croissant")
MODELS = ("neural", *(name for name in OF_OBJECTS if name == FULL_GEOMETRY))
LIGHTS = ("gathered", "corrected")
TRUTH = "path_traced"
SIZES = {"draft": 128, "paper": 448}
SPP = {"draft": {TRUTH: 64, "model": 64}, "paper": {TRUTH: 512, "model": 32}}  # of few pixels more cost little
RESOLUTION = {"draft": 64, "paper": 240}  # of surfaces; grids have half of it
LIGHT = "sunset"  # the small lamps of the studio are hardly found by walks
NOTES = (
    "The candle is homogeneous wax with its flame as a small emitter in the bowl; mandarin and croissant are grid "
    "volumes, whose means the half-space takes. Smooth boundaries, all scattering orders. Light is gathered by the "
    f"model, or corrected by walks and denoised. FLIP and relative squared error of the pixels of the object. {NOTE}"
)

FLOOR, GAP = (0.33, 0.3, 0.27), 0.02  # reflectance of the floor, and how far it lies below the lowest point, mm


class View(NamedTuple):
    """Where the camera stands and looks, mm, its field of view, the environment, its scale and turn, degrees."""

    origin: tuple[float, float, float]
    target: tuple[float, float, float]
    fov: float
    light: str
    scale: float
    turn: float


VIEWS = {
    "candle": View((25, 125, 140), (0, 31.5, 0), 29, "sunset", 0.25, 0),
    "mandarin": View((18, 100, 150), (1, 14, 14), 33, "studio", 0.3, 0),
    "croissant": View((30, 110, 170), (-4, 11, 21), 35, "studio", 0.3, -75),
}


def parts(quality: str) -> list[Part]:
    """For each object its training, then its image by walks and by the models."""
    size, results = SIZES[quality], []
    for name in OBJECTS:
        results.append(train_modelled(name, RESOLUTION[quality], CHUNKS[quality]))
        for model, light in ((TRUTH, "sampled"), *itertools.product(MODELS, LIGHTS)):
            spp = SPP[quality].get(model, SPP[quality]["model"])
            params = {"object": name, "model": model, "light": light, "size": size, "spp": spp}
            params |= {"resolution": RESOLUTION[quality], "view": list(_view(name)), "seed": 0}
            needs = (training_of(name),) if model == FULL_GEOMETRY else ()
            weights = weight_files(model, tissue("candle wax").medium)
            inputs = (environment_file(LIGHT), TISSUES, *weights)
            key = f"{name}, {model}" if model == TRUTH else f"{name}, {model}, {light}"
            results.append(Part(key, shown, params, spp * size**2, needs, inputs, f"{name} {model}"))
    return results


def _view(name: str) -> View:
    return VIEWS[name]._replace(light=LIGHT)


def shown(task: Task) -> dict[str, object]:
    """An object in its surroundings: the reference, or the image of a model."""
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
    correct = p["light"] == "corrected"
    description["integrator"] = {"type": "bssrdf", "light": p["light"], "layers": correct}
    with with_weights(task.folder, task.needed):
        loaded = load_scene(description, p["model"])

        def rendered(spp: int, seed: int) -> np.ndarray:
            image = np.array(mi.render(loaded, spp=spp, seed=seed))
            return Denoiser(loaded)(image) if correct else image[..., :3]

        rendered(COMPILING, p["seed"] + 1)  # compiles
        began = time.process_time()
        image = rendered(p["spp"], p["seed"] + 2)
    each = (time.process_time() - began) / p["spp"]
    return {"image": image.astype(np.float32), "spp": p["spp"], "cpu seconds of a sample": each}


def scene(shown: SceneDict, view: View, size: int, low: float = 0.0) -> SceneDict:
    """A scene of parts on a grey floor below the height `low`, mm, for `mitsuba.load_dict`; without an integrator."""
    import mitsuba as mi

    T = mi.ScalarTransform4f
    to_world = T().look_at(list(view.origin), list(view.target), [0, 1, 0])
    film = {"type": "hdrfilm", "width": size, "height": size, "rfilter": {"type": "box"}}
    floor = T().translate([0, low - GAP, 0]).rotate([1, 0, 0], -90).scale(2000)
    return {
        "type": "scene",
        "sensor": {"type": "perspective", "fov": view.fov, "to_world": to_world, "film": film},
        "sky": environment(view.light, view.scale, view.turn),
        "floor": {
            "type": "rectangle",
            "to_world": floor,
            "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": list(FLOOR)}},
        },
        **shown,
    }


def foot(part: SceneDict) -> float:
    """Height of the lowest point of a mesh in a file, mm; 0 if it is above."""
    import mitsuba as mi

    return min(0.0, float(mi.load_dict({"type": "ply", "filename": part["filename"]}).bbox().min[1]))


def draw(results: Mapping[str, Result]) -> dict[str, bytes | str]:
    """The figure as PDF and PNG, the page to flip between the images, and the numbers as a table."""
    from figures.drawing.image_grid import image_files, rows_of

    scenes = {name: _shots(results, name) for name in dict.fromkeys(key.split(", ")[0] for key in results)}
    return image_files("fig01", "Fig. 1: candle, mandarin and croissant", scenes, rows_of(scenes, "object"), NOTES)


def _shots(results: Mapping[str, Result], name: str) -> list[Shot]:
    """The images of an object, exposed alike."""
    from figures.drawing.image_grid import label

    reference = reference_shot(results[f"{name}, {TRUTH}"])
    return [
        reference[0],
        *(
            against(reference, f"{label(model)}, {light}", results[f"{name}, {model}, {light}"].images["image"])
            for model, light in itertools.product(MODELS, LIGHTS)
        ),
    ]
