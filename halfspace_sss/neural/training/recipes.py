"""Training from Python: of the channels of a material, and of the network for all media."""

from __future__ import annotations

import os
from pathlib import Path

from halfspace_sss.backend import array_types
from halfspace_sss.checks import check_choice, check_count, check_interval
from halfspace_sss.neural.symmetric import channels
from halfspace_sss.neural.trained import check_weights_folder
from halfspace_sss.neural.training.subjects import SUBJECTS
from halfspace_sss.neural.training.train_material import FAST, STANDARD, MaterialRecipe, TrainedChannel, train_channel
from halfspace_sss.neural.training.train_universal import UniversalRecipe, train_universal
from halfspace_sss.physics.medium import Medium
from halfspace_sss.progress import NamedProgress
from halfspace_sss.provenance import check_folder

__all__ = ["FAST", "STANDARD", "MaterialRecipe", "UniversalRecipe", "train", "train_universal"]


def train(
    material: str | Medium,
    *,
    model: str = "neural_material",
    recipe: MaterialRecipe = STANDARD,
    seed: int = 0,
    folder: str | os.PathLike | None = None,
    work: str | os.PathLike | None = None,
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
    check_choice("model", model, SUBJECTS)
    if not isinstance(recipe, MaterialRecipe):
        raise ValueError(f"recipe must be a MaterialRecipe, got {recipe!r}")
    check_count("seed", seed, 0)
    if target_error is not None:
        check_interval("target_error", target_error, 1e-4, 1.0)
    media = channels(_medium(material))
    check_weights_folder(folder)
    if work is not None:
        check_folder(work)
    array_types(backend)
    return [
        train_channel(
            m, SUBJECTS[model], recipe, int(seed), folder=folder, work=Path(work) / f"channel-{k}" if work else None,
            target_error=target_error, backend=backend, progress=progress,
        )
        for k, m in enumerate(media)
    ]  # fmt: skip


def _medium(material: str | Medium) -> Medium:
    if isinstance(material, Medium):
        return material
    from halfspace_sss.materials import load

    return load(material).medium
