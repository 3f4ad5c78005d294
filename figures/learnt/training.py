"""Training of objects as parts of figures: their weights are results, so that all images of an object share them."""

from __future__ import annotations

import base64
import time
from pathlib import Path
from typing import Any

from figures.computing.scenes import SCANS, prepare, scan_scene
from figures.learnt.weights import FULL_GEOMETRY, training_of
from figures.modelling.scene_parts import candle_parts, learnable_parts, make_varying
from figures.parts.part import Part, Task
from halfspace_sss.provenance import check_folder

__all__ = ["TRAIN_SECONDS", "object_parts", "train_modelled", "train_scan"]

TRAIN_SECONDS = {"draft": 24, "paper": 240}  # CPU time: half of it on two cores; one for all figures, which share parts
GRID = 0.5  # cells of a medium along an object over cubes of its surface


def train_scan(name: str, material: str, seconds: float, seed: int = 0, scan: str = "bunny") -> Part:
    """The part in which a scanned object of a material is learnt, for so many seconds of CPU time.

    Args:
        name: of what is learnt, by which `training_of` finds it.
        material: in the registry.
        seconds: of CPU time.
        seed: of the training.
        scan: name in `scenes.SCANS`.
    """
    params = {"scan": scan, "material": material, "seconds": seconds, "seed": seed, "model": FULL_GEOMETRY}
    return Part(training_of(name), _scanned, params, seconds, inputs=(SCANS[scan].file,))


def train_modelled(name: str, resolution: int, seconds: float, seed: int = 0) -> Part:
    """The part in which a modelled object is learnt.

    Args:
        name: a name in `scene_parts.OBJECTS`.
        resolution: of its surface.
        seconds: of CPU time.
        seed: of the object and its training.
    """
    params = {"object": name, "resolution": resolution, "seconds": seconds, "seed": seed, "model": FULL_GEOMETRY}
    return Part(training_of(name), _modelled, params, seconds)


def object_parts(name: str, resolution: int, folder: Path, seed: int = 0, model: str = "neural") -> dict[str, Any]:
    """A modelled object with a smooth boundary, and what belongs to it, for a scene in mm.

    Args:
        name, resolution, seed: as in `train_modelled`.
        folder: for its files.
        model: of light in it.
    """
    if name == "candle":
        return candle_parts(folder, resolution, seed, model)
    found = make_varying(name, resolution, max(round(GRID * resolution), 8), seed)
    return learnable_parts(found, folder, model)


def _scanned(task: Task) -> dict[str, Any]:
    prepare()
    p = task.params
    return _trained(task, scan_scene(p["scan"], p["material"], 16, "even sky"), p["scan"])


def _modelled(task: Task) -> dict[str, Any]:
    prepare()
    p, name = task.params, task.params["object"]
    shown = object_parts(name, p["resolution"], check_folder(task.folder), p["seed"])
    scene = {"type": "scene", "integrator": {"type": "bssrdf"}, **shown}
    return _trained(task, scene, name)


def _trained(task: Task, scene: dict[str, Any], name: str) -> dict[str, Any]:
    """Weights of an object, with what they took."""
    from full_geometry.learning.training import train_by_cpu
    from full_geometry.models.storing import KIND
    from full_geometry.object.subject import Subject
    from halfspace_sss.neural.store import load_weights
    from halfspace_sss.rendering.scenes.scene_files import open_scene

    subject = Subject.given(open_scene(scene, KIND), None, None, name)
    started, of_cpu = time.perf_counter(), time.process_time()
    _, path = train_by_cpu(subject, task.params["seconds"], task.folder / "weights", seed=task.params["seed"])
    took = {"seconds": time.perf_counter() - started, "cpu seconds": time.process_time() - of_cpu}
    record = load_weights(path, KIND)[1]
    files = {file.name: file.read_bytes() for file in (path, path.with_suffix(".json"))}
    about = {key: record[key] for key in ("steps", "walks")} | {"kB": len(files[path.name]) / 1000}
    return {**took, **about, "files": {file: base64.b64encode(data).decode() for file, data in files.items()}}
