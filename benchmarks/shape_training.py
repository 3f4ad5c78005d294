"""Learning the network of all shapes, by the likelihood of exits and the light of groups, and the data for it."""

from __future__ import annotations

import io
import json
import math
import time
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any, NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np
import torch
from torch import nn

from benchmarks.random_shapes import TRAINING, Family, make_shape
from full_geometry.geometry.points import SurfacePoint
from full_geometry.learning.network_fitting import DenseLayers, NamedNetwork
from full_geometry.objects.objects import TranslucentObject, object_of
from full_geometry.transport.any_shape import ALBEDO, ETA, KIND, LEAST, PLACE_OF_G, SIZE, WEIGHTS, Backbone, G, most
from full_geometry.transport.descriptors import (
    ALONE,
    CURVED_OWN,
    CURVED_SHARED,
    N_MEDIUM,
    N_OWN,
    N_SHARED,
    describe,
    end,
    medium,
    mixed,
)
from full_geometry.transport.exit_pairs import EntryProposals, trace_exits
from halfspace_sss.checks import check_count, check_interval
from halfspace_sss.neural.store import save_weights, to_json
from halfspace_sss.neural.training.fit import (
    CHECKPOINT,
    Descent,
    claim,
    cosine,
    gone_on_with,
    warm_up,
    write_checkpoint,
)
from halfspace_sss.physics.medium import Medium
from halfspace_sss.progress import NamedProgress
from halfspace_sss.provenance import check_folder, provenance, write_atomically
from halfspace_sss.tracing.walk import generator, pass_seed

LAST_RATE, WARM_UP, AVERAGE = 0.01, 100, 0.9985
MOST_OFF = 3.0  # of the light of a group: what is far too bright has its say by the likelihood


@dataclass(frozen=True)
class ShapeRecipe:
    """How the network is fitted.
    `objects`: of a batch. `pairs`: walks, and proposals, of each; at least two. `rate`: largest learning rate."""

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


class LearntShapes(NamedTuple):
    """The result of a training on random shapes: the file of its weights, the number of objects, and the cost."""

    path: Path
    objects: int
    steps: int
    seconds: float


class ShapeNetwork(NamedNetwork):
    """f of `NeuralShape` in torch; 0 initially."""

    NAMES = ("W", "b")

    def __init__(self, recipe: ShapeRecipe, seed: int = 0) -> None:
        super().__init__()
        curved = len(range(N_OWN)[CURVED_OWN]) + len(range(N_SHARED)[CURVED_SHARED])
        sizes = [N_OWN + N_SHARED + N_MEDIUM, *[recipe.width] * recipe.depth, curved]
        self.layers = DenseLayers(sizes, torch.Generator().manual_seed(seed))

    def forward(self, x: torch.Tensor, medium: torch.Tensor) -> torch.Tensor:
        """f (n,) of descriptors (n, numbers) and the numbers of media (n, 16)."""
        linear, swish = nn.functional.linear, nn.functional.hardswish
        o, i, shared = x[:, :N_OWN], x[:, N_OWN : 2 * N_OWN], x[:, 2 * N_OWN :]
        (W, *matrices), (b, *biases) = self.layers.matrices, (b[:, 0] for b in self.layers.biases)
        rest = linear(torch.cat((shared, medium), dim=1), W[:, N_OWN:], b)
        h = swish(linear(o, W[:, :N_OWN]) + rest) + swish(linear(i, W[:, :N_OWN]) + rest)
        for k, (W, b) in enumerate(zip(matrices, biases)):
            h = linear(h, W, b)
            h = swish(h) if k < len(matrices) - 1 else h
        u = torch.cat((o[:, CURVED_OWN] + i[:, CURVED_OWN], shared[:, CURVED_SHARED]), dim=1)
        g = (h * torch.tanh(u)).sum(dim=1)
        bound = torch.where(g > 0, most(torch, medium[:, PLACE_OF_G]), -LEAST)
        return bound * torch.tanh(g / bound)


def _halves(values: torch.Tensor, counts: list[int]) -> torch.Tensor:
    """Means of every second one of so many values, and of the others, (len(counts), 2)."""
    place = np.concatenate([2 * k + np.arange(n) % 2 for k, n in enumerate(counts)])
    size = np.maximum(np.bincount(place, minlength=2 * len(counts)), 1)
    sums = torch.zeros(len(size)).index_add(0, torch.from_numpy(place), values)
    return (sums / torch.from_numpy(size).float()).view(-1, 2)


class ShapeFit:
    """The state of a fit, which follows from recipe, seed, number of steps and data.
    `recipe`: sizes and rates."""

    def __init__(self, recipe: ShapeRecipe, seed: int) -> None:
        self.recipe = recipe
        self.network = ShapeNetwork(recipe, seed)
        self.descent = Descent(self.network, average=AVERAGE)
        self.average: nn.Module = self.descent.average

    @property
    def step(self) -> int:
        return self.descent.steps

    def advance(self, pool: list[GroupedPairs], rng: np.random.Generator, part: float) -> float:
        """One step on random parts of random objects; returns the loss.
        `pool`: data to draw from. `part`: of the whole fit that is done, for the decay of the rate."""
        loss = self.loss([pool[k] for k in rng.integers(0, len(pool), self.recipe.objects)], rng)
        return self.descent.step(loss, cosine(self.recipe.rate * warm_up(self.step, WARM_UP), part, LAST_RATE))

    def loss(self, batch: list[GroupedPairs], rng: np.random.Generator) -> torch.Tensor:
        """E_q[(S_0 mu_i / q) exp f] - E_walks[T f] over the mean of T, and the light of groups; a mean over objects.
        A part of one group of the exits of each object is taken."""
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
        write_checkpoint(path, self.descent.tensors(), counters=counters)

    def load(self, path: Path) -> int:
        """Go on from a checkpoint; returns its chunks.
        ValueError if it is damaged or of another recipe."""
        with gone_on_with(path, self.descent.tensors()) as stored:
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
        seconds: for data and fit, after the kernels are compiled.
        meshes: closed PLY files among the shapes.
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


class _ShapeTraining:
    def __init__(self, recipe: ShapeRecipe, seed: int, meshes: list[Path], work: Path | None) -> None:
        self.recipe, self.seed, self.meshes, self.work = recipe, seed, meshes, work
        self.fitting = ShapeFit(recipe, seed)
        self.pool: list[GroupedPairs] = []
        self.seen: list[dict[str, Any]] = []

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
            np.savez(stream, record=np.array(json.dumps(record)), **(vars(data) if data else {}))
            write_atomically(place, stream.getvalue())
        return data, record

    def go(
        self, folder: Path, seconds: float, plan: tuple[int, int] | None, progress: NamedProgress | None
    ) -> LearntShapes:
        if self.work:
            claim(self.work, recipe=asdict(self.recipe), seed=self.seed, meshes=[m.name for m in self.meshes])
        objects, steps = self._plan(seconds, plan)
        started = saved = time.monotonic()
        first = max(int(FIRST_SHARE * objects), 1)
        done = 0
        if self.work and (self.work / CHECKPOINT).exists():
            done = self.fitting.load(self.work / CHECKPOINT)
        for k in range(objects):
            data, record = self.object(k)
            self.seen.append(record)
            if data is not None:
                self.pool.append(grouped(data))
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


# ---- Which shapes and media the network is trained on: drawn at random, each from its own seed -----


RESOLUTION = (32, 56)  # of meshes
MESH_SHARE, SPHERE_SHARE, ISOTROPIC_SHARE = 0.08, 0.03, 0.45
DENSE_SHARE, CONSERVATIVE_SHARE, LEAST_ABSORPTION = 0.75, 0.04, 1e-4


@dataclass(frozen=True, eq=False)
class Drawn:
    """A shape filled with a medium.
    `family`: of the shape, or the name of the mesh."""

    family: str
    object: TranslucentObject

    def record(self) -> dict[str, Any]:
        m = self.object.media[0]
        size = float(self.object.mean_free_paths()[0])
        return {"family": self.family, "size_in_mfp": size, "albedo": float(m.albedo), "g": float(m.g), "eta": m.eta}


def draw_medium(rng: np.random.Generator) -> tuple[float, float, float]:
    """Albedo, g and eta of a medium.
    Reduced albedo: three in four log-uniform in its distance to 1 down to 1e-4, the rest uniform; one in 25 is 1. g: 45
    in 100 are 0, the others uniform. eta: uniform, one in twenty 1."""
    dense = rng.random() < DENSE_SHARE
    reduced = 1 - LEAST_ABSORPTION ** rng.random() if dense else rng.uniform(*ALBEDO)
    reduced = 1.0 if rng.random() < CONSERVATIVE_SHARE else max(reduced, ALBEDO[0])
    g = 0.0 if rng.random() < ISOTROPIC_SHARE else rng.uniform(*G)
    eta = 1.0 if rng.random() < 0.05 else rng.uniform(1.05, ETA[1])
    return min(float(reduced / (1 - g + g * reduced)), 1.0), float(g), float(eta)


def draw_object(
    seed: Sequence[int], families: Mapping[str, Family] | None = None, meshes: Sequence[Path] = ()
) -> Drawn:
    """A random shape with a random medium.
    `seed`: numbers that it follows from. `families`: generators by name; by default those of training, with spheres and
    the meshes among them. `meshes`: PLY files that some of the shapes are taken from."""
    rng = np.random.default_rng(list(seed))
    u, path = rng.random(2), meshes[int(rng.integers(len(meshes)))] if meshes else None
    made = TRAINING if families is None else families
    family, number = str(rng.choice(list(made))), int(rng.integers(2**31))
    resolution = int(rng.integers(*RESOLUTION))
    if families is None and path is not None and u[0] < MESH_SHARE:
        family, shape = path.stem, mi.load_dict({"type": "ply", "filename": str(path)})
    elif families is None and u[1] < SPHERE_SHARE:
        family, shape = "sphere", mi.load_dict({"type": "sphere"})
    else:
        shape = make_shape(family, number, resolution, made).mitsuba(family)
    size = math.exp(rng.uniform(*np.log(SIZE)))
    albedo, g, eta = draw_medium(rng)
    area = float(np.sum(np.array(shape.surface_area())))
    sigma_t = size / math.sqrt(area)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # thin sheets look open to a survey of few rays
        obj = object_of(shape, Medium(albedo * sigma_t, (1 - albedo) * sigma_t, g, eta))
    return Drawn(family, obj)


def mean_events(obj: TranslucentObject) -> float:
    """About how many events a walk has: at most the mean path 4 eta² V/A in mean free paths, at most 1/(1 - albedo)."""
    m = obj.media[0]
    size = float(obj.mean_free_paths()[0])
    return 5 + min(1 / max(1 - float(m.albedo), 1e-9), 0.4 * size * m.eta**2)


# ----------------------------------------------------------------------------------------------------
# Training data of one object: descriptors of walks with their throughput, and of proposals with S_0 over the density.
# Half-precision descriptors; S_0 is evaluated in NumPy, as its kernels would be compiled for each medium.

EVENTS = 1e6  # of the walks of one object
FEWEST_WALKS, WALKS = 2**13, 2**15
KEPT = 2**13  # walks that left, and proposals, of one object
FEWEST_EXITS = 128


@dataclass(frozen=True, eq=False)
class PairData:
    """Descriptors (pairs, numbers): exit, entry, shared; one channel.

    Args:
        walks: of walks that left at order two or more.
        T: their throughput over the mean of all walks.
        W: their S_0 mu_i over the density and the same mean.
        share: of the walks that were begun which the first stand for.
    """

    walks: np.ndarray
    T: np.ndarray
    proposals: np.ndarray
    W: np.ndarray
    medium: np.ndarray
    share: float

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, np.ndarray]) -> PairData:
        """Read pairs from the arrays of a file; KeyError if it is another one."""
        stored = {each.name: arrays[each.name] for each in fields(cls)}
        return cls(**{**stored, "share": float(stored["share"])})


def make_data(obj: TranslucentObject, events: float, seed: tuple[int, ...]) -> PairData | None:
    """Walks and proposals of an object; None if too few walks leave it.
    `obj`: the object, of one channel or of equal ones. `events`: of a walk, about, which limits the number of walks."""
    n = int(np.clip(EVENTS / events, FEWEST_WALKS, WALKS))
    starts = obj.random_points(generator(mi, n, pass_seed(*seed, 0)))
    exits = trace_exits(obj, starts, (*seed, 1))
    kept = dr.compress(exits.T[0] > 0)
    if dr.width(kept) < FEWEST_EXITS:
        return None
    share = dr.width(kept) / n
    mean = float(dr.sum(exits.T[0])[0]) / n
    kept = dr.gather(mi.UInt32, kept, dr.arange(mi.UInt32, min(dr.width(kept), KEPT)))
    T = dr.gather(mi.Float, exits.T[0], kept).numpy()
    mixtures = mixed(obj)
    half_space = Backbone(obj, mixtures)
    walks, _ = _columns(half_space, starts.gather(kept), exits.at.gather(kept))
    rng = generator(mi, KEPT, pass_seed(*seed, 2))
    starts = obj.random_points(rng)
    entries, weight = EntryProposals(obj, half_space).sample(starts, rng)
    proposals, S_0 = _columns(half_space, starts, entries)
    W = (S_0 * weight.numpy() / mean).astype(np.float32)
    T = (T / mean).astype(np.float32)
    return PairData(walks, T, proposals, W, medium(obj, 0, mixtures[0]), share)


def _columns(half_space: Backbone, exits: SurfacePoint, entries: SurfacePoint) -> tuple[np.ndarray, np.ndarray]:
    """Descriptors of pairs, (pairs, numbers), and S_0 P_o P_i of the first channel."""
    obj = half_space.object
    o, i = (end(obj, at) for at in (exits, entries))
    query, F_t, above = half_space.query(exits, entries)
    added = F_t * half_space.added(o, i)[0]
    factor = dr.select(above, o.event.P[0] * i.event.P[0], 0)
    dr.eval(query, added, factor)
    S_0 = (half_space.models[0].eval(*(v.numpy() for v in query)) + added.numpy()) * factor.numpy()
    pair = describe(obj, o, i, half_space.shares([mi.Float(S_0.astype(np.float32))], o, i))[0]
    columns = [*pair.exit, *pair.entry, *pair.shared]
    dr.eval(columns)
    rows = np.stack([np.broadcast_to(c.numpy(), dr.width(exits.p)) for c in columns], axis=-1)
    return np.nan_to_num(rows, posinf=0, neginf=0).astype(np.float16), S_0


# ---- Exits of one object in groups of those that look alike, whose light a fit holds to that of walks
# The likelihood of pairs cares little for what leaves in sum: where things are thick, most of what f brings is a choice
# between entries, and the sum over them is off by some percent. So for a group of exits, B the mean throughput of its
# walks, Z and Z' the means of (S_0 mu_i / q) exp f of two halves of its proposals, whose product has no bias,
#
#     w (Z/B - 1)(Z'/B - 1)/2,    w = 4/(1 + v/0.03),
#
# stands beside the likelihood, v the squared noise of Z/B.

HALVINGS = 4
GROUPS = 2**HALVINGS
AXIS_FROM = 512  # exits
EMPHASIS = 4.0  # 16 is better for what is thick and worse for what is not
NOISE, PAIRS = 0.03, 64  # squared, of the mean of so many proposals
LEAST_LIGHT, FEWEST_PROPOSALS, FEWEST_WALKS_OF_GROUP = 1e-3, 128, 32


class GroupPart(NamedTuple):
    """Some pairs of one group.

    Args:
        walks, proposals: descriptors (pairs, numbers).
        T: of walks, so that their sum is a sample of the mean over the whole object.
        W: of proposals.
        share: of the mean of W in the mean over the whole object.
        light: B of the group.
        weight: w.
    """

    walks: np.ndarray
    T: np.ndarray
    proposals: np.ndarray
    W: np.ndarray
    medium: np.ndarray
    share: float
    light: float
    weight: float


@dataclass(frozen=True, eq=False)
class GroupedPairs:
    """Data in the order of groups.

    Args:
        data: of an object.
        proposals, walks: where groups begin and end among them, (GROUPS + 1,).
        share: of the exits that a group has, (GROUPS,).
        light: B over the mean of all walks, (GROUPS,).
        weight: w, (GROUPS,); 0 where too little is known.
    """

    data: PairData
    proposals: np.ndarray
    walks: np.ndarray
    share: np.ndarray
    light: np.ndarray
    weight: np.ndarray

    def part(self, n: int, rng: np.random.Generator) -> GroupPart:
        """n walks and proposals, or all there are, of a random group."""
        data, u = self.data, rng.random(3)
        k = int(u[0] * GROUPS)
        i, j = _some(self.proposals, k, n, u[1]), _some(self.walks, k, n, u[2], repeated=False)
        among = data.share * (self.walks[k + 1] - self.walks[k]) / len(data.T)
        T = data.T[j] * (among * GROUPS / max(len(j), 1))
        numbers = float(self.share[k] * GROUPS), float(self.light[k]), float(self.weight[k])
        return GroupPart(data.walks[j], T, data.proposals[i], data.W[i], data.medium, *numbers)


def grouped(data: PairData) -> GroupedPairs:
    """The data of an object in 16 groups of exits, halved four times at the median of their first principal axis."""
    exits = [v[:, ALONE].astype(np.float32) for v in (data.proposals, data.walks)]
    mean, spread = exits[0].mean(axis=0), exits[0].std(axis=0) + 1e-6
    labels = [np.zeros(len(v), np.int16) for v in exits]
    _halve([(v - mean) / spread for v in exits], labels, [np.arange(len(v)) for v in exits], HALVINGS, 0)
    (i, j), counts = (
        [np.argsort(v, kind="stable") for v in labels],
        [np.bincount(v, minlength=GROUPS) for v in labels],
    )
    data = replace(data, proposals=data.proposals[i], W=data.W[i], walks=data.walks[j], T=data.T[j])
    bounds = [np.concatenate([[0], np.cumsum(v)]) for v in counts]
    share = counts[0] / len(data.W)
    W, T = (_moments(v, at) for v, at in zip((data.W, data.T), bounds))
    light = T[0] * counts[1] * data.share / len(data.T) / np.maximum(share, 1e-9)
    known = (light > LEAST_LIGHT) & (counts[0] >= FEWEST_PROPOSALS) & (counts[1] >= FEWEST_WALKS_OF_GROUP)
    noise = W[1] / PAIRS + (1 + T[1]) / np.maximum(counts[1], 1)
    weight = np.where(known, EMPHASIS / (1 + noise / NOISE), 0.0)
    return GroupedPairs(data, *bounds, share, np.where(known, light, 1.0), weight)


def _halve(exits: list[np.ndarray], labels: list[np.ndarray], kept: list[np.ndarray], times: int, first: int) -> None:
    """Label the kept rows of proposals and walks, the axis and the median those of proposals."""
    if times == 0:
        for label, k in zip(labels, kept):
            label[k] = first
        return
    own = exits[0][kept[0]]
    axis = np.linalg.eigh(np.cov(own[:AXIS_FROM].T))[1][:, -1] if len(own) > 1 else np.ones(len(ALONE))
    along = [v[k] @ axis for v, k in zip(exits, kept)]
    middle = float(np.median(along[0])) if len(own) else math.inf
    lower, upper = ([k[side] for k, side in zip(kept, sides)]
                    for sides in ([v <= middle for v in along], [v > middle for v in along]))  # fmt: skip
    _halve(exits, labels, lower, times - 1, first)
    _halve(exits, labels, upper, times - 1, first + 2 ** (times - 1))


def _moments(values: np.ndarray, bounds: np.ndarray) -> np.ndarray:
    """Mean, and variance over its square, of each group, (2, GROUPS); 0 of what is empty."""
    parts = [values[a:b].astype(float) for a, b in zip(bounds, bounds[1:])]
    means, variances = (np.array([float(f(v)) if len(v) else 0.0 for v in parts]) for f in (np.mean, np.var))
    return np.stack([means, variances / np.maximum(means, 1e-6) ** 2])


def _some(bounds: np.ndarray, k: int, n: int, u: float, repeated: bool = True) -> np.ndarray:
    """n neighbours of group k from a random one on, in a circle; of fewer than n none twice unless it is allowed."""
    first, count = int(bounds[k]), int(bounds[k + 1] - bounds[k])
    if count == 0:
        return np.zeros(0, int)
    return first + (int(u * count) + np.arange(n if repeated else min(n, count))) % count
