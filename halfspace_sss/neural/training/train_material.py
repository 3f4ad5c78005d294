"""Training of the network of one medium: its maps, then one fit; the weights are found again by the medium."""

from __future__ import annotations

import math
import os
import time
from dataclasses import asdict, dataclass, field
from pathlib import Path

import numpy as np
import torch

from halfspace_sss.backend import array_types
from halfspace_sss.checks import check_choice, check_count, check_interval
from halfspace_sss.comparison.model_errors import ModelError, ReferenceSize, model_error, reference_maps
from halfspace_sss.maps.noisy_maps import CellGrid, draw_directions, make_pool
from halfspace_sss.materials import load
from halfspace_sss.neural import material_model, paper_model
from halfspace_sss.neural.material_model import network_arrays
from halfspace_sss.neural.network import Network, SymmetricModel
from halfspace_sss.neural.paper_model import NeuralPaper
from halfspace_sss.neural.store import check_weights_folder, save_weights, weights_folder, weights_name
from halfspace_sss.neural.training.fit import CHECKPOINT, Fit, claim, fit
from halfspace_sss.neural.training.learners import MapPool, PaperLearner, Small
from halfspace_sss.neural.universal import in_range, load_hypernetwork, shipped_weights
from halfspace_sss.physics.medium import Medium
from halfspace_sss.progress import NamedProgress
from halfspace_sss.provenance import JsonDict, check_folder, path_of, provenance

VALIDATION_SEED = 104729
VALIDATION_SETS = 4  # of 8 directions
BLOCK = 2  # cells of a map put together for the validation error


@dataclass(frozen=True)
class MaterialRecipe:
    """Size of the training of one medium.

    Args:
        n_groups: directions of incidence, each with 16 of observation.
        events: scattering events of the maps.
        grid: cells of a map.
        how: the fit.
        validation_share: events of the validation maps over those of the maps.
    """

    n_groups: int = 256
    events: float = 4e8
    grid: CellGrid = CellGrid(40, 16)
    how: Fit = field(default_factory=lambda: Fit(steps=2500, n_groups=16, n_queries=128, validate_every=1250))
    validation_share: float = 0.25

    def __post_init__(self) -> None:
        check_count("n_groups", self.n_groups, 1)
        check_interval("events", self.events, 1e4, 1e15)
        check_interval("validation_share", self.validation_share, 1e-3, 1e3)


STANDARD = MaterialRecipe()
FAST = MaterialRecipe(
    96, 4e7, how=Fit(steps=250, n_groups=16, n_queries=128, validate_every=250), validation_share=1.0
)  # with fewer events its error of about 1 % drowns in their noise


@dataclass(frozen=True)
class TrainedChannel:
    """Weights of one medium, their error on the validation maps, seconds of maps and fit."""

    medium: Medium
    path: Path
    error: ModelError
    data_seconds: float
    fit_seconds: float


class Trial(SymmetricModel):
    """A network under training as a model."""

    name = "trial"
    source = "under training"

    def __init__(self, medium: Medium, network: Network) -> None:
        super().__init__(medium)
        self.networks: list[Network] = [network]


class MaterialTraining:
    """What `neural_material` learns by, and how it then answers as a model.
    It starts from what the universal network says of the medium, where it says anything.

    Args:
        warm: False to start from random numbers.
    """

    kind = material_model.KIND

    def __init__(self, warm: bool = True) -> None:
        self.warm = warm

    def learner(self, medium: Medium, pool: MapPool, seed: int) -> Small:
        start = None
        if self.warm and in_range(medium) and shipped_weights().exists():
            hyper = load_hypernetwork(shipped_weights())
            start = hyper.network(float(medium.albedo), float(medium.g), medium.eta)
        return Small(seed=seed, start=start)

    def model(self, medium: Medium, learner: Small) -> Trial:
        return Trial(medium, learner.network())

    def record(self, learner: Small) -> JsonDict:
        return {"warm_start": self.warm}


class PaperTraining:
    """`neural_paper`: 3 x 256, raw S, squared error."""

    kind = paper_model.KIND

    def learner(self, medium: Medium, pool: MapPool, seed: int) -> PaperLearner:
        probe = PaperLearner(medium, 1.0, width=1)
        batch = pool.batch(64, 1024, torch.Generator().manual_seed(0))
        S = probe.S_over_y(batch)[:, : batch.y.shape[1]] * batch.y
        return PaperLearner(medium, max(math.sqrt(float((S**2).mean())), 1e-20), seed=seed)

    def model(self, medium: Medium, learner: PaperLearner) -> NeuralPaper:
        return NeuralPaper(medium, [(learner.network(), learner.scale)])

    def record(self, learner: PaperLearner) -> JsonDict:
        return {"scale": learner.scale}


Training = MaterialTraining | PaperTraining
TRAININGS: dict[str, Training] = {"neural_material": MaterialTraining(), "neural_paper": PaperTraining()}


def train_channel(
    medium: Medium,
    training: Training,
    recipe: MaterialRecipe = STANDARD,
    seed: int = 0,
    *,
    folder: str | os.PathLike[str] | None = None,
    work: str | os.PathLike[str] | None = None,
    target_error: float | None = None,
    backend: str = "llvm",
    progress: NamedProgress | None = None,
) -> TrainedChannel:
    """Train a network for one scalar medium.

    Args:
        medium: scalar; only albedo, g and eta count.
        training: what is trained, see `TRAININGS`.
        recipe: STANDARD, FAST or your own.
        seed: maps, batches and first numbers follow from it.
        folder: for the weights; by default where `bssrdf` finds them.
        work: folder for maps and checkpoint of an unfinished run, which a run with the same arguments continues;
            that of another run is refused.
        target_error: stop early once the validation error is below this in 95 % of cases.
        backend: of the maps, "llvm" or "cuda".
        progress: called with (what, done, total).
    """
    started, place = time.monotonic(), Path(work) if work else None
    medium = medium.in_mfp()
    if place:
        what = {"model": training.kind, **vars(training)}
        claim(place, medium=_ratios(medium), training=what, recipe=asdict(recipe), seed=seed, backend=backend)
    ratios = (np.full(recipe.n_groups, float(v)) for v in _ratios(medium).values())
    groups = draw_directions(*ratios, np.random.default_rng([seed, 0]))
    halves = make_pool(groups, recipe.grid, recipe.events, (seed, 1), place, progress, backend)
    pool = MapPool(groups, recipe.grid, halves)
    check = (VALIDATION_SEED, seed)
    events = recipe.validation_share * recipe.events
    size = ReferenceSize(VALIDATION_SETS, recipe.grid, BLOCK)
    (reference,) = reference_maps([medium], size, events, check, backend=backend)
    data_seconds = time.monotonic() - started
    learner = training.learner(medium, pool, seed)
    results: list[ModelError] = []  # the last of them is that of the end, unless the run was over when it was resumed

    def validate() -> float:
        results.append(model_error(training.model(medium, learner), reference))
        return results[-1].known.bound

    how = recipe.how
    history, _ = fit(
        learner, pool.batches(how.n_groups, how.n_queries), how, seed,
        checkpoint=place / CHECKPOINT if place else None, validate=validate,
        target_error=target_error, progress=progress,
    )  # fmt: skip
    error = results[-1] if results else model_error(training.model(medium, learner), reference)
    fit_seconds = time.monotonic() - started - data_seconds
    record = {"width": learner.width, "depth": learner.depth, **training.record(learner)}
    record |= _record(medium, recipe, seed, error, history, data_seconds, fit_seconds)
    path = path_of(folder or weights_folder()) / weights_name(training.kind, medium)
    save_weights(path, training.kind, network_arrays(learner.network()), record)
    return TrainedChannel(medium, path, error, data_seconds, fit_seconds)


def _ratios(medium: Medium) -> dict[str, float]:
    return {"albedo": float(medium.albedo), "g": float(medium.g), "eta": medium.eta}


def _record(
    medium: Medium, recipe: MaterialRecipe, seed: int, error: ModelError, history: list, data_seconds: float,
    fit_seconds: float,
) -> JsonDict:  # fmt: skip
    """What the JSON beside the weights tells; errors of the history are upper ends, see `NoiseFree.bound`."""
    plain = {k: v if isinstance(v, dict) else float(v) for k, v in error._asdict().items()}
    plain |= {"standard_error": error.known.standard_error, "bound": error.known.bound}
    return {
        "medium": _ratios(medium),
        "orders": "multiple", "seed": seed, "recipe": asdict(recipe), "validation": plain, "history": history,
        "data_seconds": data_seconds, "fit_seconds": fit_seconds, "provenance": provenance(seed=seed),
    }  # fmt: skip


def train(
    material: str | Medium,
    *,
    model: str = "neural_material",
    recipe: MaterialRecipe = STANDARD,
    seed: int = 0,
    folder: str | os.PathLike[str] | None = None,
    work: str | os.PathLike[str] | None = None,
    target_error: float | None = None,
    backend: str = "llvm",
    progress: NamedProgress | None = None,
) -> list[TrainedChannel]:
    """Train a model for every channel of a material; `halfspace_sss.bssrdf(model, medium)` then finds the weights.

    Args:
        material: name in the registry, or a medium.
        model: "neural_material" or "neural_paper".
        recipe: size of the training, STANDARD or FAST or your own.
        seed: results repeat for the same seed, backend, version and number of threads.
        folder: for the weights; by default HALFSPACE_SSS_WEIGHTS or the user's data folder.
        work: folder for unfinished work; a killed run that is started again with it ends with the same weights.
        target_error: stop early once the validation error is below this in 95 % of cases.
        backend: of the maps, "llvm" or "cuda".
        progress: called with (what, done, total).

    Raises:
        ValueError: an argument is out of range, or the material is unknown; nothing has been traced then.
    """
    check_choice("model", model, TRAININGS)
    if not isinstance(recipe, MaterialRecipe):
        raise ValueError(f"recipe must be a MaterialRecipe, got {recipe!r}")
    check_count("seed", seed, 0)
    if target_error is not None:
        check_interval("target_error", target_error, 1e-4, 1.0)
    media = (material if isinstance(material, Medium) else load(material).medium).channels()
    check_weights_folder(folder)
    if work is not None:
        check_folder(work)
    array_types(backend)
    return [
        train_channel(
            m, TRAININGS[model], recipe, int(seed), folder=folder, work=Path(work) / f"channel-{k}" if work else None,
            target_error=target_error, backend=backend, progress=progress,
        )
        for k, m in enumerate(media)
    ]  # fmt: skip
