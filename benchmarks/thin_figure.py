"""The figure `thin`: a dragon, a leaf and a shell lit from behind, walked, by half-spaces and by `neural_shape`."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

from benchmarks.head_and_leaf import LEAVES
from benchmarks.random_shapes import TRAINING, make_shape
from benchmarks.things import Staging, against_walks, lit_scene, shown, thing_parts, walked
from figures.computing.contenders import NOTE
from figures.computing.learnt import weight_files
from figures.computing.scans import DRAGON, SCANS
from figures.drawing.image_grid import image_files, rows_of
from figures.parts.part import Part, Result, SceneDict, Task
from halfspace_sss import materials
from halfspace_sss.provenance import check_folder

TITLE = "thin things lit from behind, by half-spaces and by the network of all shapes"
MODELS = ("better_dipole", "neural", "neural_shape")
SIZES = {"draft": 96, "paper": 384}
RESOLUTION = {"draft": 64, "paper": 192}  # of the meshes that are made
MODEL_SPP = {"draft": 16, "paper": 64}
TRUTH_SPP = {"draft": 128, "paper": 1024}
NOTES = (
    "All images contain all scattering orders: the models lack the orders below two, which are path traced beside "
    "them, except light that passes unscattered. The leaf is of a family of shapes that `neural_shape` was not "
    "trained on; the dragon was among its meshes, and shells, but not this one, among its families. Models render by "
    f"gathered light. FLIP and relative squared error of the pixels of the object. {NOTE}"
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
    spp, results = (TRUTH_SPP[quality], MODEL_SPP[quality]), []
    for name, thing in THINGS.items():
        common = {"thing": name, "made": list(thing), "size": SIZES[quality], "seed": 0}
        common |= {"resolution": RESOLUTION[quality]}
        medium, files = materials.load(thing.material).medium, ((DRAGON,) if not thing.family else ())
        models = [(model, weight_files(model, medium)) for model in MODELS]
        results += thing_parts(name, common, spp, (path_traced, rendered), models, files)
    return results


def path_traced(task: Task) -> dict[str, object]:
    """The image by random walks."""
    return walked(task, _scene)


def rendered(task: Task) -> dict[str, object]:
    """The image of a model."""
    return shown(task, _scene)


def _scene(task: Task) -> SceneDict:
    p, thing = task.params, THINGS[task.params["thing"]]
    path = _mesh(thing, p["resolution"], check_folder(task.folder))
    surface = {"type": "translucent", "material": thing.material, "model": "neural"}
    stage = Staging(thing.eye, thing.lamp, fov=27.0, lamp_radius=0.45, sky=0.15)
    shape = {"type": "ply", "filename": str(path), "bsdf": surface}
    return lit_scene({"thing": shape}, stage, p["size"], thing.mm_per_unit)


def _mesh(thing: Thing, resolution: int, folder: Path) -> Path:
    """The PLY file of a thing."""
    if not thing.family:
        return DRAGON
    return make_shape(thing.family, thing.seed, resolution, {**TRAINING, **LEAVES}).write_ply(folder / "thing.ply")


def draw(results: Mapping[str, Result]) -> dict[str, bytes | str]:
    """The figure, the page and the table."""
    scenes = {f"{name} of {thing.material}": against_walks(results, name, MODELS) for name, thing in THINGS.items()}
    return image_files("thin", "Thin things lit from behind", scenes, rows_of(scenes, "thing"), NOTES)
