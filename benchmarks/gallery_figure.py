"""The figure `gallery`: the ten scenes of docs/scenes, walked, and by corrected light where a model takes them."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from benchmarks.gallery_meshes import FOLDER
from benchmarks.things import against_walks
from figures.computing.contenders import NOTE, reference_image
from figures.computing.learnt import weight_files
from figures.computing.scans import prepare
from figures.drawing.image_grid import image_files, rows_of
from figures.parts.part import Part, Result, Task
from halfspace_sss.materials import load

TITLE = "ten scenes to download, walked and by corrected light"
MODEL = "neural"
SCENES = {  # models that take them
    "candle": (MODEL,), "fruit": (MODEL,), "head": (MODEL,), "ice": (), "jelly": (), "leaf": (MODEL,), "milk": (),
    "soap": (), "statue": (MODEL,), "toy": (MODEL,),
}  # fmt: skip
SIZES = {"draft": 96, "paper": 384}
MODEL_SPP = {"draft": 16, "paper": 64}
TRUTH_SPP = {"draft": 64, "paper": 1024}
NOTES = (
    "Models refuse what lies inside an object or overlaps it, so that milk, ice, jelly and soap are walked alone. FLIP "
    f"and relative squared error of the pixels with something in them. {NOTE}"
)


def parts(quality: str) -> list[Part]:
    """For each scene the path-traced image, and that of corrected light."""
    size, results = SIZES[quality], []
    for name, models in SCENES.items():
        common = {"thing": name, "size": size, "seed": 0}
        files = tuple(sorted(FOLDER.glob("*.ply"))) + (FOLDER / f"{name}.xml",)
        spp = TRUTH_SPP[quality]
        results.append(Part(f"{name}, path traced", path_traced, common | {"spp": spp}, spp * size**2, inputs=files))
        for model in models:
            inputs = (*files, *weight_files(model, load("marble").medium))
            params = common | {"spp": MODEL_SPP[quality], "model": model}
            results.append(Part(f"{name}, {model}", corrected, params, params["spp"] * size**2, (), inputs, model))
    return results


def path_traced(task: Task) -> dict[str, object]:
    """The image by random walks."""
    from full_geometry.scenes.scene_files import PATH_TRACED, load_scene

    prepare()
    return reference_image(task, load_scene(_file(task), PATH_TRACED, parameters=_size(task)))


def corrected(task: Task) -> dict[str, object]:
    """The image by corrected light."""
    import mitsuba as mi

    from full_geometry.scenes.scene_files import load_scene

    prepare()
    p, light = task.params, {"light": "corrected"}
    scene = load_scene(_file(task), p["model"], parameters=_size(task), settings=light)
    image = mi.render(scene, spp=p["spp"], seed=p["seed"] + 1)
    return {"image": np.array(image)[..., :3].astype(np.float32), "spp": p["spp"]}


def _file(task: Task) -> Path:
    return FOLDER / f"{task.params['thing']}.xml"


def _size(task: Task) -> dict[str, str]:
    return {"size": str(task.params["size"])}


def draw(results: Mapping[str, Result]) -> dict[str, bytes | str]:
    """The figure, the page and the table."""
    scenes = {name: against_walks(results, name, models) for name, models in SCENES.items()}
    return image_files("gallery", "Ten scenes", scenes, rows_of(scenes, "scene"), NOTES)
