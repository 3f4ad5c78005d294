"""Training of the network for all media: maps of many media, a fit, and one to exact reflectances."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from halfspace_sss.backend import array_types
from halfspace_sss.checks import check_count, check_interval
from halfspace_sss.maps.grid import RANGES, draw_media
from halfspace_sss.maps.noisy_maps import CellGrid, draw_directions, looking_back, make_pool
from halfspace_sss.neural.hypernetwork import named_layers
from halfspace_sss.neural.store import save_weights
from halfspace_sss.neural.training.fit import fit
from halfspace_sss.neural.training.learners import Hyper
from halfspace_sss.neural.training.pool import MapPool
from halfspace_sss.neural.training.reflectances import balanced, collect
from halfspace_sss.neural.training.schedules import Fit
from halfspace_sss.neural.training.work_folder import CHECKPOINT, claim
from halfspace_sss.neural.universal import hypernetwork_of
from halfspace_sss.progress import NamedProgress
from halfspace_sss.provenance import check_folder, provenance

__all__ = ["UniversalRecipe", "train_universal"]


@dataclass(frozen=True)
class UniversalRecipe:
    """Size of the training.

    Args:
        n_media: of the maps, each with one direction of incidence and 16 of observation.
        events: scattering events of the maps.
        grid: cells of a map.
        how: the fit.
        rank: numbers that describe a medium.
        balance_media: whose reflectances the factor `balance` is fitted to.
        balance_how: that fit, of `n_groups` media a step.
    """

    n_media: int = 16384
    events: float = 1e10
    grid: CellGrid = CellGrid(40, 16)
    how: Fit = field(default_factory=lambda: Fit(steps=150_000, n_groups=32, n_queries=128))
    rank: int = 48
    balance_media: int = 4096
    balance_how: Fit = field(default_factory=lambda: Fit(steps=25_000, n_groups=256))

    def __post_init__(self) -> None:
        check_count("n_media", self.n_media, 1)
        check_count("balance_media", self.balance_media, 1)
        check_count("rank", self.rank, 1)
        check_interval("events", self.events, 1e4, 1e15)


def train_universal(
    folder: str | os.PathLike,
    seed: int = 0,
    recipe: UniversalRecipe | None = None,
    *,
    backend: str = "llvm",
    progress: NamedProgress | None = None,
    validate: Callable[[Hyper], float] | None = None,
) -> Path:
    """Train the universal network in `folder`, going on with what a killed run left there; returns the weights.

    Args:
        folder: gets maps, checkpoint and `neural.safetensors` with its record.
        seed: media, maps, batches and first weights follow from it.
        recipe: size of the training.
        backend: of the maps, "llvm" or "cuda".
        progress: called with (what, done, total).
        validate: error of the learner, for the history.

    Raises:
        ValueError: an argument is out of range, or the folder holds the work of another run; nothing was done then.
    """
    recipe, folder, started = recipe or UniversalRecipe(), Path(folder), time.monotonic()
    check_count("seed", seed, 0)
    array_types(backend)
    seed = int(seed)  # torch takes no other
    claim(check_folder(folder), recipe=asdict(recipe), seed=seed, backend=backend)
    rng = np.random.default_rng([seed, 0])
    groups = looking_back(draw_directions(*draw_media(recipe.n_media, rng), rng), rng)
    halves = make_pool(groups, recipe.grid, recipe.events, (seed, 1), folder, progress, backend)
    pool, data_seconds = MapPool(groups, recipe.grid, halves), time.monotonic() - started
    del halves
    learner = Hyper(rank=recipe.rank, seed=seed)
    how, check = recipe.how, (lambda: validate(learner)) if validate else None
    history, _ = fit(learner, pool.batches(how.n_groups, how.n_queries), how, seed, checkpoint=folder / CHECKPOINT,
                     validate=check, progress=progress)  # fmt: skip
    arrays = learner.parameters_as_arrays()
    hyper = hypernetwork_of(arrays, learner.width, learner.depth)
    known = collect(hyper, recipe.balance_media, seed, folder, progress)
    arrays |= named_layers("balance", balanced(known, recipe.balance_how, seed))
    record: dict[str, Any] = {
        "width": learner.width, "depth": learner.depth, "ranges": {k: list(v) for k, v in RANGES.items()}, "seed": seed,
        "recipe": asdict(recipe), "data_seconds": data_seconds, "seconds": time.monotonic() - started,
        "history": history, "provenance": provenance(seed=seed),
    }  # fmt: skip
    return save_weights(folder / "neural.safetensors", "neural", arrays, record)
