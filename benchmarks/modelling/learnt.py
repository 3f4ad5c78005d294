"""Modelled objects as scenes have them, and the parts in which they are learnt."""

from __future__ import annotations

from pathlib import Path

from benchmarks.modelling.objects import candle_parts, learnable_parts, make_varying
from figures.computing.learnt import FULL_GEOMETRY, trained, training_of
from figures.computing.scans import prepare
from figures.parts.part import Part, SceneDict, Task
from halfspace_sss.provenance import check_folder

GRID = 0.5  # cells of a medium along an object over cubes of its surface


def train_modelled(name: str, resolution: int, chunks: int) -> Part:
    """The part in which a modelled object is learnt.
    `name`: "candle", or in `modelling.objects.MODELS`. `resolution`: of its surface. `chunks`: as in `train_scan`."""
    params = {"object": name, "resolution": resolution, "chunks": chunks, "seed": 0, "model": FULL_GEOMETRY}
    return Part(training_of(name), _modelled, params, chunks)


def object_parts(name: str, resolution: int, folder: Path, seed: int = 0) -> SceneDict:
    """A modelled object with a smooth boundary, and what belongs to it, for a scene in mm.
    `name`, `resolution`: as in `train_modelled`. `seed`: of everything uneven about it."""
    if name == "candle":
        return candle_parts(folder, resolution, seed)
    result = make_varying(name, resolution, max(round(GRID * resolution), 8), seed)
    return learnable_parts(result, folder)


def _modelled(task: Task) -> dict[str, object]:
    prepare()
    p, name = task.params, task.params["object"]
    shown = object_parts(name, p["resolution"], check_folder(task.folder), p["seed"])
    scene = {"type": "scene", "integrator": {"type": "bssrdf"}, **shown}
    return trained(task, scene, name)
