"""Objects that figures learn: a training is a part whose weights are its result, which renders find and no others."""

from __future__ import annotations

import base64
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from figures.computing.scans import BUNNY, MM_PER_UNIT, prepare, scan_scene
from figures.parts.part import Part, Result, SceneDict, Task
from halfspace_sss import materials
from halfspace_sss.neural.store import weights_in
from halfspace_sss.physics.medium import Medium
from halfspace_sss.provenance import check_folder
from halfspace_sss.registry import models_of

if TYPE_CHECKING:
    import mitsuba as mi


def bunny_of_potato() -> tuple[mi.Shape, Medium, float]:
    """A Mitsuba shape, its medium and millimetres of a unit."""
    import mitsuba as mi

    return mi.load_dict({"type": "ply", "filename": str(BUNNY)}), materials.load("potato").medium, MM_PER_UNIT


FULL_GEOMETRY = "full_geometry"
TRAINING = "training"


def training_of(name: str) -> str:
    """The name of the part in which an object is learnt."""
    return f"{name}, {TRAINING}"


@contextmanager
def with_weights(folder: Path, needed: Mapping[str, Result]) -> Iterator[None]:
    """Renders find what was learnt in the parts of training among the needed ones, and no other weights.
    `folder`: of the task, where the files are put. `needed`: results that the task was given."""
    place = check_folder(folder) / "weights"
    place.mkdir(parents=True, exist_ok=True)
    for name, result in needed.items():
        for file, data in result.numbers["files"].items() if name.endswith(f", {TRAINING}") else ():
            (place / file).write_bytes(base64.b64decode(data))
    with weights_in(place):
        yield


CHUNKS = {"draft": 2, "paper": 8}  # of all figures, which share parts; seconds would depend on what else runs


def train_scan(name: str, material: str, chunks: int) -> Part:
    """The part in which the bunny of a material is learnt by so many chunks of data.
    `name`: of what is learnt, by which `training_of` finds it. `material`: in the registry. `chunks`: see
    `full_geometry.learning.training.train_unattended`."""
    params = {"material": material, "chunks": chunks, "seed": 0, "model": FULL_GEOMETRY}
    return Part(training_of(name), _scanned, params, chunks, inputs=(BUNNY,))


def _scanned(task: Task) -> dict[str, object]:
    prepare()
    return trained(task, scan_scene(task.params["material"], 16, "even sky"), "bunny")


def trained(task: Task, scene: SceneDict, name: str) -> dict[str, object]:
    """Weights of the object called `name` in the description of a scene, with what they took.
    The parameters "chunks" and "seed" of the task are those of the training."""
    from full_geometry.learning.training import train_unattended
    from full_geometry.objects.objects import object_of
    from full_geometry.scenes.scene_files import open_scene
    from full_geometry.transport.storing import KIND
    from halfspace_sss.neural.store import load_weights

    obj = object_of(open_scene(scene, KIND), None, None, name)
    started, of_cpu = time.perf_counter(), time.process_time()
    p = task.params
    path = train_unattended(obj, task.folder / "weights", chunks=p["chunks"], seed=p["seed"]).path
    took = {"seconds": time.perf_counter() - started, "cpu seconds": time.process_time() - of_cpu}
    record = load_weights(path, KIND)[1]
    files = {file.name: file.read_bytes() for file in (path, path.with_suffix(".json"))}
    about = {key: record[key] for key in ("steps", "walks")} | {"kB": len(files[path.name]) / 1000}
    return {**took, **about, "files": {file: base64.b64encode(data).decode() for file, data in files.items()}}


def accepting(medium: Medium) -> list[str]:
    """Names of the models that can be made for the medium: a learnt one without weights for it is not among them."""
    return [model.name for model in models_of(medium)]


def weight_files(model: str, medium: Medium) -> tuple[Path, ...]:
    """The files of weights that a model reads for a medium, for `Part.inputs`; none for an analytic model.
    ValueError if the model is not trained for the medium."""
    from halfspace_sss.neural import material_model, paper_model
    from halfspace_sss.neural.universal import shipped_weights

    trained = {module.KIND: module for module in (material_model, paper_model)}
    if model in trained:
        return tuple(dict.fromkeys(trained[model].find_weights(model, m) for m in medium.channels()))
    if model == "neural_shape":
        from full_geometry.transport import any_shape

        return (any_shape.shipped_weights(),)
    return (shipped_weights(),) if model == "neural" else ()
