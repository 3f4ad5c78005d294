"""The figure `thin`: a dragon, a leaf and a shell lit from behind, walked, by half-spaces and by `neural_shape`."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from figures.computing.images import Shot, compared, noise_of, stops_of
from figures.computing.learnt import weight_files
from figures.computing.scenes import DRAGON, SCANS, long_render, prepare
from figures.drawing.error_tables import label
from figures.drawing.image_grid import image_grid
from figures.drawing.page import page
from figures.drawing.style import paper, saved
from figures.parts.part import Part, Result, Task, unmodelled
from figures.studies.held_out import HELD_OUT
from full_geometry.learning.shapes import TRAINING, make_shape
from halfspace_sss import materials
from halfspace_sss.provenance import check_folder

TITLE = "thin things lit from behind, by half-spaces and by the network of all shapes"
MODELS = ("better_dipole", "neural", "neural_shape")
SIZES = {"draft": 96, "paper": 384}
RESOLUTION = {"draft": 64, "paper": 192}  # of the meshes that are made
MODEL_SPP = {"draft": 256, "paper": 2304}  # square numbers, for the sampler
TRUTH_SPP = {"draft": 256, "paper": 8192}
SPP_PER_PASS = 16
LAMP, GLOW, SKY = 0.45, 60.0, 0.15  # radius over that of the thing; radiance of the lamp and of the sky
DISTANCE, FOV = 4.0, 27.0  # of the camera, radii of the thing
NOTES = (
    "All images contain all scattering orders: the models lack the orders below two, which are path traced beside "
    "them, but for what passes a half-space unscattered. The leaf is of a family of shapes that `neural_shape` was not "
    "trained on; the dragon was among its meshes, and shells, but not this one, among its families. FLIP and relative "
    "squared error of the pixels of the object; the noise of both images is in them."
)


class Thing(NamedTuple):
    """Family ("" for the dragon) and seed of a shape; material, mm of a unit, directions to the eye and to the lamp."""

    family: str
    seed: int
    material: str
    mm_per_unit: float
    eye: tuple[float, float, float]
    lamp: tuple[float, float, float]


THINGS = {
    "dragon": Thing("", 0, "potato", SCANS["dragon"].mm_per_unit, (0.27, 0.05, 1), (-0.6, 0.75, -1)),
    "leaf": Thing("leaves", 3, "apple", 15.0, (0.1, -0.35, 1), (-0.3, 0.5, -1)),
    "shell": Thing("shells", 5, "marble", 30.0, (0.2, 0.3, 1), (-0.4, 0.6, -1)),
}


def parts(quality: str) -> list[Part]:
    """For each thing the path-traced image, then the image of each model."""
    size, results = SIZES[quality], []
    for name, thing in THINGS.items():
        common = {"thing": name, "made": list(thing), "size": size, "resolution": RESOLUTION[quality], "seed": 0}
        files, spp = ((DRAGON,) if not thing.family else ()), TRUTH_SPP[quality]
        results.append(Part(f"{name}, path traced", path_traced, {**common, "spp": spp}, spp * size**2, inputs=files))
        for model in MODELS:
            params = {**common, "spp": MODEL_SPP[quality], "model": model}
            inputs = (*files, *weight_files(model, materials.load(thing.material).medium))
            work = params["spp"] * size**2
            results.append(Part(f"{name}, {model}", rendered, params, work, inputs=inputs, like=model))
    return results


@unmodelled
def path_traced(task: Task) -> dict[str, Any]:
    """The image by random walks, in passes that survive an interruption."""
    prepare()
    return long_render(task, _scene(task, "path_traced"), SPP_PER_PASS, task.params["spp"] // SPP_PER_PASS)


def rendered(task: Task) -> dict[str, Any]:
    """The image of a model."""
    import mitsuba as mi

    prepare()
    p = task.params
    image = mi.render(_scene(task, p["model"]), spp=p["spp"], seed=p["seed"] + 1)
    return {"image": np.array(image)[..., :3].astype(np.float32), "spp": p["spp"]}


def _scene(task: Task, model: str) -> Any:
    """A thing between the camera and a lamp, under a dim even sky."""
    import mitsuba as mi

    from halfspace_sss.rendering.scenes.scene_files import load_scene

    p, thing = task.params, THINGS[task.params["thing"]]
    path = _mesh(thing, p["resolution"], check_folder(task.folder))
    box = mi.load_dict({"type": "ply", "filename": str(path)}).bbox()
    centre, radius = np.array(box.center()).ravel(), 0.5 * float(np.linalg.norm(np.array(box.extents()).ravel()))
    eye, lamp = (np.array(d) / np.linalg.norm(d) for d in (thing.eye, thing.lamp))
    view = mi.ScalarTransform4f().look_at(list(centre + DISTANCE * radius * eye), list(centre), [0, 1, 0])
    film = {"type": "hdrfilm", "width": p["size"], "height": p["size"], "rfilter": {"type": "box"}}
    sampler = {"type": "independent" if model == "path_traced" else "multijitter"}
    surface = {"type": "translucent", "material": thing.material, "model": "neural"}
    glow = {"type": "area", "radiance": GLOW}
    description = {
        "type": "scene",
        "integrator": {"type": "bssrdf", "mm_per_unit": thing.mm_per_unit, "hide_emitters": True},
        "sensor": {"type": "perspective", "fov": FOV, "to_world": view, "film": film, "sampler": sampler},
        "thing": {"type": "ply", "filename": str(path), "bsdf": surface},
        "sky": {"type": "constant", "radiance": SKY},
        "lamp": {
            "type": "sphere", "center": list(centre + 3 * radius * lamp), "radius": LAMP * radius, "emitter": glow,
        },
    }  # fmt: skip
    return load_scene(description, model)


def _mesh(thing: Thing, resolution: int, folder: Path) -> Path:
    """The PLY file of a thing."""
    if not thing.family:
        return DRAGON
    return make_shape(thing.family, thing.seed, resolution, {**TRAINING, **HELD_OUT}).write_ply(folder / "thing.ply")


def draw(results: Mapping[str, Result]) -> dict[str, bytes | str]:
    """The figure as PDF and PNG, the page to flip between the images, and the numbers as a table."""
    import pandas

    scenes: dict[str, list[Shot]] = {}
    for name, thing in THINGS.items():
        scenes[f"{name} of {thing.material}"] = _shots(results, name)
    rows = [{"thing": n, "model": s.label, **s.numbers} for n, shots in scenes.items() for s in shots[1:]]
    with paper():
        files: dict[str, bytes | str] = {f"thin.{end}": data for end, data in saved(image_grid(scenes)).items()}
    files["thin.csv"] = pandas.DataFrame(rows).to_csv(index=False, lineterminator="\n")
    files["thin.html"] = page("Thin things lit from behind", scenes, notes=NOTES)
    return files


def _shots(results: Mapping[str, Result], name: str) -> list[Shot]:
    """The images of a thing, exposed alike; with the mean of each over that of the walks."""
    truth = results[f"{name}, path traced"]
    reference = truth.images["image"]
    mask = reference.max(axis=2) > 0
    gain = np.float32(2.0 ** stops_of(reference, mask))
    error = noise_of(reference, truth.images["variance"], mask)
    shots = [Shot("Path traced", gain * reference, {"standard error": error})]
    for model in MODELS:
        image = results[f"{name}, {model}"].images["image"]
        numbers = {"mean over path traced": float(image[mask].mean() / reference[mask].mean())}
        shots.append(compared(label(model), gain * image, gain * reference, mask=mask, numbers=numbers))
    return shots
