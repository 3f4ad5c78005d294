"""Learning the network of all shapes, by the likelihood of exits and the light of groups of them."""

from __future__ import annotations

import io
import json
import math
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import nn

from full_geometry.learning.records import LearntShapes
from full_geometry.learning.shape_data import GroupedPairs, PairData, draw_object, grouped, make_data, mean_events
from full_geometry.transport.any_shape import ALBEDO, ETA, KIND, LEAST, PLACE_OF_G, SIZE, WEIGHTS, G, most
from full_geometry.transport.descriptors import CURVED_OWN, CURVED_SHARED, N_MEDIUM, N_OWN, N_SHARED
from halfspace_sss.checks import check_count, check_interval
from halfspace_sss.neural.store import save_weights, to_json
from halfspace_sss.neural.training import checkpoint
from halfspace_sss.neural.training.fit import Descent, cosine, warm_up
from halfspace_sss.neural.training.work_folder import CHECKPOINT, claim
from halfspace_sss.progress import NamedProgress
from halfspace_sss.provenance import check_folder, provenance, write_atomically

LAST_RATE, WARM_UP, AVERAGE = 0.01, 100, 0.9985
MOST_OFF = 3.0  # of the light of a group: what is far too bright has its say by the likelihood


@dataclass(frozen=True)
class ShapeRecipe:
    """How the network is fitted.

    Args:
        width, depth: hidden layers.
        objects: of a batch.
        pairs: walks, and proposals, of each; at least two.
        rate: largest learning rate.
    """

    width: int = 64
    depth: int = 3
    objects: int = 32
    pairs: int = 64
    rate: float = 4e-3

    def __post_init__(self) -> None:
        for name, least in (("width", 1), ("depth", 1), ("objects", 1), ("pairs", 2)):
            check_count(name, getattr(self, name), least)
        check_interval("rate", self.rate, 1e-8, 1.0)


STANDARD = ShapeRecipe()


class ShapeNetwork(nn.Module):
    """f of `NeuralShape` in torch; 0 initially.

    Args:
        recipe: its size.
        seed: of the initial weights.
    """

    def __init__(self, recipe: ShapeRecipe, seed: int = 0) -> None:
        super().__init__()
        generator = torch.Generator().manual_seed(seed)
        curved = len(range(N_OWN)[CURVED_OWN]) + len(range(N_SHARED)[CURVED_SHARED])
        sizes = [N_OWN + N_SHARED + N_MEDIUM, *[recipe.width] * recipe.depth, curved]
        self.matrices, self.biases = nn.ParameterList(), nn.ParameterList()
        for k, (i, j) in enumerate(zip(sizes, sizes[1:])):
            gain = math.sqrt((1.0 if k == 0 else 2.0) / i) if k < recipe.depth else 0.0
            self.matrices.append(gain * torch.randn(j, i, generator=generator))
            self.biases.append(torch.zeros(j))

    def forward(self, x: torch.Tensor, medium: torch.Tensor) -> torch.Tensor:
        """f (n,) of descriptors (n, numbers) and the numbers of media (n, 16)."""
        linear, swish = nn.functional.linear, nn.functional.hardswish
        o, i, shared = x[:, :N_OWN], x[:, N_OWN : 2 * N_OWN], x[:, 2 * N_OWN :]
        W = self.matrices[0]
        rest = linear(torch.cat((shared, medium), dim=1), W[:, N_OWN:], self.biases[0])
        h = swish(linear(o, W[:, :N_OWN]) + rest) + swish(linear(i, W[:, :N_OWN]) + rest)
        for k in range(1, len(self.matrices)):
            h = linear(h, self.matrices[k], self.biases[k])
            h = swish(h) if k < len(self.matrices) - 1 else h
        u = torch.cat((o[:, CURVED_OWN] + i[:, CURVED_OWN], shared[:, CURVED_SHARED]), dim=1)
        g = (h * torch.tanh(u)).sum(dim=1)
        bound = torch.where(g > 0, most(torch, medium[:, PLACE_OF_G]), -LEAST)
        return bound * torch.tanh(g / bound)

    def arrays(self) -> dict[str, np.ndarray]:
        """Matrices (outputs, inputs) and biases by name."""
        arrays = {f"W_{k}": W.detach().numpy().copy() for k, W in enumerate(self.matrices)}
        return arrays | {f"b_{k}": b.detach().numpy().copy() for k, b in enumerate(self.biases)}


def _halves(values: torch.Tensor, counts: list[int]) -> torch.Tensor:
    """Means of every second one of so many values, and of the others, (len(counts), 2)."""
    place = np.concatenate([2 * k + np.arange(n) % 2 for k, n in enumerate(counts)])
    size = np.maximum(np.bincount(place, minlength=2 * len(counts)), 1)
    sums = torch.zeros(len(size)).index_add(0, torch.from_numpy(place), values)
    return (sums / torch.from_numpy(size).float()).view(-1, 2)


class ShapeFit:
    """The state of a fit, which follows from recipe, seed, number of steps and data.

    Args:
        recipe: sizes and rates.
        seed: of the initial weights.
        network: another network to fit, for comparisons.
    """

    def __init__(self, recipe: ShapeRecipe, seed: int, network: nn.Module | None = None) -> None:
        self.recipe = recipe
        self.network = network or ShapeNetwork(recipe, seed)
        self.descent = Descent(self.network, average=AVERAGE)
        self.average: nn.Module = self.descent.average

    @property
    def step(self) -> int:
        """Steps that were taken."""
        return self.descent.steps

    def advance(self, pool: list[GroupedPairs], rng: np.random.Generator, part: float) -> float:
        """One step on random parts of random objects; returns the loss.

        Args:
            pool: data to draw from.
            rng: that draws.
            part: of the whole fit that is done, for the decay of the rate.
        """
        loss = self.loss([pool[k] for k in rng.integers(0, len(pool), self.recipe.objects)], rng)
        return self.descent.step(loss, cosine(self.recipe.rate * warm_up(self.step, WARM_UP), part, LAST_RATE))

    def loss(self, batch: list[GroupedPairs], rng: np.random.Generator) -> torch.Tensor:
        """E_q[(S_0 mu_i / q) exp f] - E_walks[T f] over the mean of T, and the light of groups; a mean over objects.

        Of each object a part of one group of its exits is taken.
        """
        parts = [data.part(self.recipe.pairs, rng) for data in batch]
        T, W = (torch.from_numpy(np.concatenate(v)).float() for v in zip(*((p.T, p.W) for p in parts)))
        counts = [len(p.T) for p in parts] + [len(p.W) for p in parts]
        media = np.repeat(np.stack([p.medium for p in parts] * 2), counts, axis=0)
        x = np.concatenate([p.walks for p in parts] + [p.proposals for p in parts])
        f = self.network(torch.from_numpy(x).float(), torch.from_numpy(media))
        Z = _halves(W * torch.exp(f[len(T) :]), [len(p.W) for p in parts])
        share, light, weight = torch.tensor([(p.share, p.light, p.weight) for p in parts]).float().T
        off = torch.clamp(Z / light[:, None] - 1, max=MOST_OFF)
        likelihood = (share * Z.mean(dim=1)).sum() - (T * f[: len(T)]).sum()
        return (likelihood + (0.5 * weight * off[:, 0] * off[:, 1]).sum()) / len(batch)

    def arrays(self) -> dict[str, np.ndarray]:
        """The averaged numbers."""
        return self.average.arrays()

    def save(self, path: Path, done: int) -> None:
        """Write a checkpoint after `done` chunks."""
        counters = torch.tensor([self.step, done], dtype=torch.float64)
        checkpoint.write(path, self.descent.tensors(), counters=counters)

    def load(self, path: Path) -> int:
        """Go on from a checkpoint; returns its chunks.

        Raises:
            ValueError: it is damaged or of another recipe.
        """
        with checkpoint.gone_on_with(path, self.descent.tensors()) as stored:
            self.descent.steps, done = (int(v) for v in stored["counters"].tolist())
        return done


# ---- Training of the network of all shapes: objects are drawn without end while it is fitted -------

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
    recipe: ShapeRecipe = STANDARD,
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
    run = _ShapeTraining(recipe, int(seed), [Path(m) for m in meshes], Path(work) if work else None)
    return run.go(Path(folder), seconds, plan, progress)


def make_objects(
    seed: int, first: int, last: int, meshes: Sequence[str | Path], work: str | Path, recipe: ShapeRecipe = STANDARD
) -> None:
    """Make the data of objects ahead, as another process: a run with the same seed, meshes and work takes them over."""
    run = _ShapeTraining(recipe, seed, [Path(m) for m in meshes], Path(work))
    for k in range(first, last):
        run.object(k)


class _ShapeTraining:
    """A training on its way."""

    def __init__(self, recipe: ShapeRecipe, seed: int, meshes: list[Path], work: Path | None) -> None:
        self.recipe, self.seed, self.meshes, self.work = recipe, seed, meshes, work
        self.fitting = ShapeFit(recipe, seed)
        self.pool: list[GroupedPairs] = []
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
        drawn = draw_object((self.seed, k), meshes=self.meshes)
        data = make_data(drawn.object, mean_events(drawn.object), (self.seed, k))
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
                drawn = draw_object((self.seed, 2**31 + k), meshes=self.meshes)
                pool += [make_data(drawn.object, mean_events(drawn.object), (self.seed, k))]
            pool = [grouped(data) for data in pool if data]
            each = (time.monotonic() - at) / TRIAL_OBJECTS
            trial, rng, at = ShapeFit(self.recipe, 0), np.random.default_rng(0), time.monotonic()
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
