"""The figure `gallery`: the ten scenes of docs/scenes, walked and by corrected light, with FLIP and CPU seconds."""

from __future__ import annotations

import io
import time
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
from matplotlib import colormaps
from matplotlib.image import imsave

from benchmarks.gallery_meshes import FOLDER
from benchmarks.things import against_walks
from figures.computing.contenders import COMPILING, NOTE, reference_image
from figures.computing.images import FLIP, Shot
from figures.computing.learnt import weight_files
from figures.computing.scans import prepare
from figures.drawing.image_grid import image_files, rows_of
from figures.parts.part import Part, Result, Task
from full_geometry.trade.denoising import Denoiser
from full_geometry.trade.image_differences import srgb
from halfspace_sss.materials import load

TITLE = "ten scenes to download, walked and by corrected light"
MODEL = "neural"
SCENES = ("candle", "fruit", "head", "ice", "jelly", "leaf", "milk", "soap", "statue", "toy")
ACROSS = 5  # scenes in a row of the picture
SIZES = {"draft": 96, "paper": 384}
MODEL_SPP = {"draft": 16, "paper": 64}
TRUTH_SPP = {"draft": 64, "paper": 128}
NOTES = (
    "Corrected light has the time of its walks and of the denoiser in its seconds; FLIP and relative squared error are "
    f"of the pixels with something in them. {NOTE}"
)


def parts(quality: str) -> list[Part]:
    """For each scene the path-traced image, and that of corrected light."""
    size, results = SIZES[quality], []
    for name in SCENES:
        common = {"thing": name, "size": size, "seed": 0}
        files = tuple(sorted(FOLDER.glob("*.ply"))) + (FOLDER / f"{name}.xml",)
        spp = TRUTH_SPP[quality]
        results.append(Part(f"{name}, path traced", path_traced, common | {"spp": spp}, spp * size**2, inputs=files))
        inputs = (*files, *weight_files(MODEL, load("marble").medium))
        params = common | {"spp": MODEL_SPP[quality], "model": MODEL}
        results.append(Part(f"{name}, {MODEL}", corrected, params, params["spp"] * size**2, (), inputs, MODEL))
    return results


def path_traced(task: Task) -> dict[str, object]:
    """The image by random walks."""
    from full_geometry.scenes.scene_files import PATH_TRACED, load_scene

    prepare()
    return reference_image(task, load_scene(_file(task), PATH_TRACED, parameters=_size(task)))


def corrected(task: Task) -> dict[str, object]:
    """The image by corrected light, denoised."""
    import mitsuba as mi

    from full_geometry.scenes.scene_files import load_scene

    prepare()
    p = task.params
    for spp in (COMPILING, p["spp"]):
        settings = {"light": "corrected", "layers": True}
        scene = load_scene(_file(task), p["model"], parameters=_size(task), settings=settings)
        began = time.process_time()
        image = np.array(mi.render(scene, spp=spp, seed=p["seed"] + 1))
        image = Denoiser(scene)(image)
    return {"image": image.astype(np.float32), "spp": p["spp"], "CPU s": time.process_time() - began}


def _file(task: Task) -> Path:
    return FOLDER / f"{task.params['thing']}.xml"


def _size(task: Task) -> dict[str, str]:
    return {"size": str(task.params["size"])}


def draw(results: Mapping[str, Result]) -> dict[str, bytes | str]:
    """The figure, the page and the table, and the images alone."""
    scenes = {}
    for name in SCENES:
        walked, model = against_walks(results, name, (MODEL,))
        seconds = results[f"{name}, {MODEL}"].numbers["CPU s"]
        scenes[name] = [walked, replace(model, numbers={**model.numbers, "CPU s": seconds})]
    files = image_files("gallery", "Ten scenes", scenes, rows_of(scenes, "scene"), NOTES, printed=(FLIP, "CPU s"))
    return files | {"gallery_scenes.png": _pictures(list(scenes.values()))}


def _pictures(scenes: list[list[Shot]]) -> bytes:
    """Walks above corrected light above FLIP maps, of ACROSS scenes beside each other."""
    rows = []
    for first in range(0, len(scenes), ACROSS):
        part, maps = scenes[first : first + ACROSS], colormaps["magma"]
        rows += [[srgb(shot[0].image) for shot in part], [srgb(shot[1].image) for shot in part]]
        rows.append([maps(shot[1].flip)[..., :3] for shot in part])
    file = io.BytesIO()
    imsave(file, np.concatenate([np.concatenate(row, axis=1) for row in rows]))
    return file.getvalue()
