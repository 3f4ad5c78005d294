"""The figure `scenes`: a painted head, a leaf of coloured vertices and a stone in jelly, walked and by models."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from benchmarks.head_and_leaf import LEAVES, make_head, write_painted
from benchmarks.modelling.meshes import Box, surface
from benchmarks.random_shapes import box, make_shape
from benchmarks.things import Staging, against_walks, lit_scene, shown, thing_parts, walked
from figures.computing.contenders import NOTE
from figures.computing.learnt import CHUNKS, FULL_GEOMETRY, trained, training_of, weight_files, with_weights
from figures.computing.scans import prepare
from figures.drawing.image_grid import image_files, rows_of
from figures.parts.part import Part, Result, SceneDict, Task
from halfspace_sss.physics.medium import Medium
from halfspace_sss.provenance import check_folder

TITLE = "a painted head, a leaf of coloured vertices and a stone in jelly, walked and by models"
OF_OBJECTS = (FULL_GEOMETRY,)
OF_SURFACES = ("better_dipole", "neural", *OF_OBJECTS)
THINGS = {"head": OF_SURFACES, "leaf": OF_SURFACES, "jelly": OF_OBJECTS}
SIZES = {"draft": 112, "paper": 384}
RESOLUTION = {"draft": 96, "paper": 192}
MODEL_SPP = {"draft": 16, "paper": 64}
TRUTH_SPP = {"draft": 128, "paper": 1024}
MM_PER_UNIT = {"head": 10.0, "leaf": 15.0, "jelly": 10.0}
WAX_MFP, LEAF_MFP, LEAF_SEED = "1.0,0.6,0.4", "0.2,0.25,0.12", 3  # mm
JELLY = Medium.from_albedo(np.array([0.99, 0.72, 0.6]), np.array([0.16, 0.18, 0.20]), 0.5, 1.35)
STAGES = {
    "head": Staging((0.35, 0.05, 1), (-0.8, 0.7, 0.9), fov=23.0, lamp_radius=0.4, sky=0.25),
    "leaf": Staging((0.1, -0.35, 1), (-0.6, 0.5, 0.8), fov=27.0, lamp_radius=0.4, sky=0.25),
    "jelly": Staging((0.5, 0.45, 1), (-0.9, 0.9, -0.4), fov=27.0, lamp_radius=1.3, sky=0.2, glow=8.0),
}
NOTES = (
    "All images contain all scattering orders. The head's reflectance is a bitmap by uv, the leaf's an attribute of "
    "vertices: the walk takes the medium of its exit for the whole way, half-space models take both ends, and "
    "full_geometry learnt it from walks. The stone in the jelly is opaque: half-space models refuse it, "
    "full_geometry learnt jelly and stone. Models render by gathered light. FLIP and relative squared error of the "
    f"pixels of the object. {NOTE}"
)


def parts(quality: str) -> list[Part]:
    """For each thing its training, if a model needs it, the path-traced image, and the image of each model."""
    spp, results = (TRUTH_SPP[quality], MODEL_SPP[quality]), []
    for thing, models in THINGS.items():
        common = {"thing": thing, "size": SIZES[quality], "resolution": RESOLUTION[quality], "seed": 0}
        files = [(model, weight_files(model, JELLY)) for model in models]
        needs: tuple[str, ...] = ()
        if FULL_GEOMETRY in models:
            training = {**common, "chunks": CHUNKS[quality], "model": FULL_GEOMETRY}
            results.append(Part(training_of(thing), learnt, training, CHUNKS[quality]))
            needs = (training_of(thing),)
        results += thing_parts(thing, common, spp, (path_traced, rendered), files, needs=needs)
    return results


def learnt(task: Task) -> dict[str, object]:
    """Weights of a thing, of the jelly with its stone."""
    prepare()
    return trained(task, _scene(task), "thing")


def path_traced(task: Task) -> dict[str, object]:
    """The image by random walks."""
    return walked(task, _scene)


def rendered(task: Task) -> dict[str, object]:
    """The image of a model."""
    with with_weights(task.folder, task.needed):
        return shown(task, _scene)


def _scene(task: Task) -> SceneDict:
    p, folder = task.params, check_folder(task.folder)
    name = p["thing"]
    things = {"head": _head, "leaf": _leaf, "jelly": _jelly}[name](folder, p["resolution"])
    return lit_scene(things, STAGES[name], p["size"], MM_PER_UNIT[name])


def _head(folder: Path, resolution: int) -> SceneDict:
    result = write_painted(make_head(resolution), folder / "head.ply")
    return {"thing": {**result["shape"], "bsdf": _painted(result["paint"], WAX_MFP)}}


def _painted(reflectance: SceneDict, mfp: str) -> SceneDict:
    return {"type": "translucent", "reflectance": reflectance, "mfp": mfp, "eta": 1.4, "model": "better_dipole"}


def _leaf(folder: Path, resolution: int) -> SceneDict:
    """A leaf whose colour is an attribute of its vertices."""
    mesh = make_shape("leaves", LEAF_SEED, resolution, LEAVES)
    shape = mesh.mitsuba("leaf")
    shape.add_attribute("vertex_colour", 3, leaf_colours(mesh.vertices).astype(np.float32).ravel().tolist())
    path = folder / "leaf.ply"
    shape.write_ply(str(path))
    colour = {"type": "mesh_attribute", "name": "vertex_colour"}
    return {"thing": {"type": "ply", "filename": str(path), "bsdf": _painted(colour, LEAF_MFP)}}


def leaf_colours(p: np.ndarray) -> np.ndarray:
    """Reflectance at points of a leaf along x: green between pale veins, red towards the rim and the tip."""
    x, y = p[:, 0], np.abs(p[:, 1])
    along = (x - x.min()) / np.ptp(x)
    rim = np.clip(1.3 * y / y.max() + 1.2 * (along - 0.75), 0, 1)[:, None]
    wave = np.abs((7 * (along - 0.55 * y / y.max())) % 1 - 0.5) * 2  # 1 on veins
    vein = np.clip(np.maximum((wave - 0.82) / 0.12, 1 - y / (0.06 * y.max())), 0, 1)[:, None]
    blade = (1 - rim) * np.array([0.10, 0.34, 0.06]) + rim * np.array([0.62, 0.14, 0.05])
    return (1 - vein) * blade + vein * np.array([0.55, 0.58, 0.25])


def _jelly(folder: Path, resolution: int) -> SceneDict:
    """A cube of jelly with an opaque stone in it."""
    import mitsuba as mi

    cube = surface(
        lambda p: box(p, np.array([1.0, 0.7, 1.0]), 0.25), Box((-1.1, -0.8, -1.1), (1.1, 0.8, 1.1)), resolution
    )
    jelly = {key: ",".join(map(str, getattr(JELLY, key))) for key in ("albedo", "sigma_t")}
    surface_of_jelly = {"type": "translucent", **jelly, "g": 0.5, "eta": JELLY.eta, "model": FULL_GEOMETRY}
    stone = make_shape("blobs", 1, resolution).write_ply(folder / "stone.ply")
    place = mi.ScalarTransform4f().translate([0.1, -0.05, 0.15]).scale(0.45)
    grey = {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.22, 0.20, 0.18]}}
    return {
        "thing": {"type": "ply", "filename": str(cube.write_ply(folder / "jelly.ply")), "bsdf": surface_of_jelly},
        "stone": {"type": "ply", "filename": str(stone), "to_world": place, "bsdf": grey},
    }


def draw(results: Mapping[str, Result]) -> dict[str, bytes | str]:
    """The figures of textured surfaces and of what lies inside, with their pages and tables."""
    files: dict[str, bytes | str] = {}
    for figure, models in (("scenes", OF_SURFACES), ("scenes_jelly", OF_OBJECTS)):
        scenes = {name: against_walks(results, name, models) for name in THINGS if THINGS[name] == models}
        files |= image_files(figure, "Scenes as people have them", scenes, rows_of(scenes, "thing"), NOTES)
    return files
