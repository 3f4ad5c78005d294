"""Training of the network of all shapes: objects are drawn without end while it is fitted."""

from __future__ import annotations

import io
import json
import time
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from full_geometry.neural_shape.learning.drawing import draw_subject, mean_events
from full_geometry.neural_shape.learning.fitting import STANDARD, Fitting, Recipe
from full_geometry.neural_shape.learning.groups import Grouped, grouped
from full_geometry.neural_shape.learning.source import PairData, make_data
from full_geometry.neural_shape.ranges import ALBEDO, ETA, SIZE, G
from full_geometry.neural_shape.storing import KIND, WEIGHTS
from halfspace_sss.checks import check_count, check_interval
from halfspace_sss.neural.store import save_weights, to_json
from halfspace_sss.neural.training.work_folder import CHECKPOINT, claim
from halfspace_sss.progress import NamedProgress
from halfspace_sss.provenance import check_folder, provenance, write_atomically
from halfspace_sss.rendering.scenes.learners import LearntShapes

__all__ = ["make_objects", "train_shapes"]

PLAN = "plan.json"
DATA_SHARE, FIRST_SHARE = 0.5, 0.75  # of the time for data; of the objects before the first step
TRIAL_OBJECTS, TRIAL_STEPS = 4, 20
CHECKPOINT_EVERY = 30.0  # seconds


def train_shapes(
    folder: str | Path,
    *,
    seconds: float = 600.0,
    seed: int = 0,
    meshes: Sequence[str | Path] = (),
    recipe: Recipe = STANDARD,
    plan: tuple[int, int] | None = None,
    work: str | Path | None = None,
    progress: NamedProgress | None = None,
) -> LearntShapes:
    """Train the network of all shapes and write `neural_shape.safetensors` with its record.

    The numbers of objects and steps are planned once by the speed of the first ones, so that a run that was killed and
    is started again with the same `work` ends with the same weights.

    Args:
        folder: for the weights.
        seconds: for data and fit, after the kernels are compiled.
        seed: of everything.
        meshes: closed PLY files among the shapes.
        recipe: sizes and rates.
        plan: numbers of objects and steps instead of a plan by time.
        work: folder for unfinished work: every object that was made, and the state of the fit.
        progress: called with (what, done, total).

    Raises:
        ValueError: an argument is out of range, a mesh is missing, or `work` is of another run.
    """
    check_interval("seconds", seconds, 1.0, 1e7)
    check_count("seed", seed, 0)
    if plan is not None:
        for name, value in zip(("objects", "steps"), plan):
            check_count(name, value, 1)
    for mesh in map(Path, meshes):
        if not mesh.is_file():
            raise ValueError(f"meshes must be PLY files, got {str(mesh)!r}, which is none")
    for place in (folder, work):
        if place is not None:
            check_folder(place)
    run = _Run(recipe, int(seed), [Path(m) for m in meshes], Path(work) if work else None)
    return run.go(Path(folder), seconds, plan, progress)


def make_objects(
    seed: int, first: int, last: int, meshes: Sequence[str | Path], work: str | Path, recipe: Recipe = STANDARD
) -> None:
    """Make the data of objects ahead, as another process: a run with the same seed, meshes and work takes them over."""
    run = _Run(recipe, seed, [Path(m) for m in meshes], Path(work))
    for k in range(first, last):
        run.object(k)


class _Run:
    """A training on its way."""

    def __init__(self, recipe: Recipe, seed: int, meshes: list[Path], work: Path | None) -> None:
        self.recipe, self.seed, self.meshes, self.work = recipe, seed, meshes, work
        self.fitting = Fitting(recipe, seed)
        self.pool: list[Grouped] = []
        self.seen: list[dict[str, Any]] = []

    def claim(self) -> None:
        """Say whose the folder of work is, or check it."""
        if self.work:
            claim(self.work, recipe=asdict(self.recipe), seed=self.seed, meshes=[m.name for m in self.meshes])

    def object(self, k: int) -> tuple[PairData | None, dict[str, Any]]:
        """Data and record of object k, from the folder of work if they are there."""
        place = self.work / f"object-{k:05d}.npz" if self.work else None
        if place and place.exists():
            with np.load(place) as stored:
                record = json.loads(str(stored["record"]))
                return (PairData.from_arrays(stored) if record["kept"] else None), record
        started = time.process_time()
        drawn = draw_subject((self.seed, k), meshes=self.meshes)
        data = make_data(drawn.subject, mean_events(drawn.subject), (self.seed, k))
        record = {**drawn.record(), "kept": data is not None, "cpu_seconds": time.process_time() - started}
        if place:
            stream = io.BytesIO()
            np.savez(stream, record=np.array(json.dumps(record)), **(data.arrays() if data else {}))
            write_atomically(place, stream.getvalue())
        return data, record

    def go(
        self, folder: Path, seconds: float, plan: tuple[int, int] | None, progress: NamedProgress | None
    ) -> LearntShapes:
        self.claim()
        objects, steps = self._plan(seconds, plan)
        started = saved = time.monotonic()
        first = max(int(FIRST_SHARE * objects), 1)
        done = 0
        if self.work and (self.work / CHECKPOINT).exists():
            done = self.fitting.load(self.work / CHECKPOINT)
        for k in range(objects):
            self._take(k)
            if k + 1 >= max(first, done + 1) and self.pool:
                self._fit(k, first, objects, steps)
                if self.work and time.monotonic() - saved > CHECKPOINT_EVERY:
                    self.fitting.save(self.work / CHECKPOINT, k + 1)
                    self.write(self.work, steps, time.monotonic() - started)
                    saved = time.monotonic()
            if progress:
                progress("shapes" if k + 1 < first else "training", k + 1, objects)
        spent = time.monotonic() - started
        return LearntShapes(self.write(folder, steps, spent), len(self.pool), self.fitting.step, spent)

    def _take(self, k: int) -> None:
        data, record = self.object(k)
        self.seen.append(record)
        if data is not None:
            self.pool.append(grouped(data))

    def _fit(self, k: int, first: int, objects: int, steps: int) -> None:
        """The steps between object k and the next one."""
        rng = np.random.default_rng([self.seed, k, 1])
        until = steps * (k + 2 - first) // (objects + 1 - first)
        while self.fitting.step < until:
            self.fitting.advance(self.pool, rng, self.fitting.step / steps)

    def _plan(self, seconds: float, plan: tuple[int, int] | None) -> tuple[int, int]:
        """Numbers of objects and steps: given, written down by the run before, or by the time that some take."""
        place = self.work / PLAN if self.work else None
        if place and place.exists():
            stored = json.loads(place.read_text(encoding="utf-8"))
            return int(stored["objects"]), int(stored["steps"])
        if plan is None:
            self.object(0)  # compiles the kernels
            at, pool = time.monotonic(), []
            for k in range(1, 1 + TRIAL_OBJECTS):
                drawn = draw_subject((self.seed, 2**31 + k), meshes=self.meshes)
                pool += [make_data(drawn.subject, mean_events(drawn.subject), (self.seed, k))]
            pool = [grouped(data) for data in pool if data]
            each = (time.monotonic() - at) / TRIAL_OBJECTS
            trial, rng, at = Fitting(self.recipe, 0), np.random.default_rng(0), time.monotonic()
            for _ in range(TRIAL_STEPS):
                trial.advance(pool, rng, 0.0)
            step = (time.monotonic() - at) / TRIAL_STEPS
            plan = max(int(DATA_SHARE * seconds / each), 2), max(int((1 - DATA_SHARE) * seconds / step), 1)
        if place:
            write_atomically(place, to_json({"objects": plan[0], "steps": plan[1]}))
        return plan

    def write(self, folder: Path, steps: int, seconds: float) -> Path:
        """Weights as they stand, with their record."""
        families: dict[str, int] = {}
        for record in self.seen:
            families[record["family"]] = families.get(record["family"], 0) + bool(record["kept"])
        record = {
            "orders": "multiple", "recipe": asdict(self.recipe), "seed": self.seed, "objects": len(self.pool),
            "families": families, "meshes": [m.name for m in self.meshes], "steps": self.fitting.step,
            "planned_steps": steps, "seconds_of_last_process": seconds,
            "data_cpu_seconds": sum(r["cpu_seconds"] for r in self.seen),
            "ranges": {"size_in_mfp": SIZE, "albedo_prime": ALBEDO, "g": G, "eta": ETA},
            "provenance": provenance(seed=self.seed),
        }  # fmt: skip
        arrays = {name: value.astype(np.float16) for name, value in self.fitting.arrays().items()}
        return save_weights(Path(folder) / WEIGHTS, KIND, arrays, record)
