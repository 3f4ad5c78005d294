"""The learner `full_geometry_paper`: the paper's network of an object of a scene, trained, kept and measured."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from full_geometry.identity import Identity, identify
from full_geometry.learning.model_errors import ModelError
from full_geometry.learning.radiance import reference
from full_geometry.paper.errors import paper_errors
from full_geometry.paper.network import PaperNetwork, PaperRecipe, fit_paper
from full_geometry.subject import Subject
from halfspace_sss.checks import check_choice, check_count, check_interval
from halfspace_sss.neural.store import load_weights, save_weights
from halfspace_sss.neural.trained import check_weights_folder, weights_folder
from halfspace_sss.progress import NamedProgress
from halfspace_sss.provenance import provenance
from halfspace_sss.rendering.scenes.learners import LearntObject, ObjectError

__all__ = ["KIND", "errors", "load_network", "save_network", "train"]

KIND = "full_geometry_paper"
EXITS, WALKS = 256, 4096  # of the truth


def save_network(folder: Path, identity: Identity, net: PaperNetwork, record: dict[str, Any]) -> Path:
    """Write the network of an object; returns the path."""
    arrays = {name: value.numpy().astype(np.float16) for name, value in net.state_dict().items()}
    whole = {"orders": "multiple", **identity.record(), "n": net.n, **record}
    path = Path(folder) / f"{KIND}-{identity.digest()}.safetensors"
    return save_weights(path, KIND, {**arrays, "anchors": identity.anchors.astype(np.float32)}, whole)


def load_network(subject: Subject, folder: Path | None = None) -> PaperNetwork:
    """The network of an object as it stands where it was trained.

    Raises:
        ValueError: the object has not been trained or has been moved since, or the file is damaged.
    """
    import torch

    here = identify(subject)
    path = (Path(folder) if folder else weights_folder()) / f"{KIND}-{here.digest()}.safetensors"
    if not path.exists():
        raise ValueError(
            f"object {subject.found.shape.id()!r} must be trained for {KIND}, got one that is not in {path.parent}; "
            f"`halfspace-sss train --scene --model {KIND}` does it"
        )
    arrays, record = load_weights(path, KIND)
    anchors = arrays.pop("anchors")
    R, t = Identity(record["kind_of_shape"], record["topology"], anchors, dict(record["medium"])).pose(here)
    if not (np.allclose(R, np.eye(3), atol=1e-5) and np.allclose(t, 0, atol=1e-4 * np.ptp(anchors))):
        raise ValueError(f"{path}: object must stand where it was trained, got it moved or turned")
    net = PaperNetwork(record["n"], len(subject.media))
    net.load_state_dict({name: torch.from_numpy(value.astype(np.float32)) for name, value in arrays.items()})
    return net


def train(
    scene: Any, *, object: str | None = None, seconds: float = 60.0, target_error: float | None = None, seed: int = 0,
    folder: Path | None = None, work: Path | None = None, progress: NamedProgress | None = None,
    start: str | None = None,
) -> LearntObject:  # fmt: skip
    """The network of an object after so many seconds of CPU time, or where the paper's stop is met.

    Raises:
        ValueError: an argument is out of range, or one is given that this learner does not know.
    """
    check_interval("seconds", seconds, 1e-3, 1e7)
    check_count("seed", seed, 0)
    for name, value in (("target_error", target_error), ("work", work), ("start", start)):
        if value is not None:
            raise ValueError(f"{name} must be left out for {KIND}, got {value!r}")
    folder = check_weights_folder(folder)
    subject, began = Subject.given(scene, None, None, object), time.monotonic()
    net, steps = fit_paper(subject, PaperRecipe(seconds=seconds), seed, progress)
    found = paper_errors(subject, net, reference(subject, EXITS, WALKS, seed), seed=seed)
    record = {"steps": steps, "seconds": seconds, "seed": seed, "errors": [row._asdict() for row in found]}
    path = save_network(folder, identify(subject), net, {**record, "provenance": provenance(seed=seed)})
    name = subject.found.shape.id()
    return LearntObject(name, path, _rows(name, found), steps, time.monotonic() - began)


def errors(
    scene: Any, models: Sequence[str] = (KIND,), *, object: str | None = None, exits: int = EXITS, seed: int = 0,
    progress: NamedProgress | None = None,
) -> list[ObjectError]:  # fmt: skip
    """The errors of the network of an object over so many exits, its points from walks as it was trained."""
    for name in models:
        check_choice("model", name, (KIND,))
    subject = Subject.given(scene, None, None, object)
    net = load_network(subject)
    found = paper_errors(subject, net, reference(subject, exits, WALKS, seed), seed=seed)
    return _rows(subject.found.shape.id(), found)


def _rows(name: str, found: list[ModelError]) -> list[ObjectError]:
    channels = "RGB" if max(row.channel for row in found) == 2 else ["mono"]
    return [ObjectError(name, channels[e.channel], KIND, e.light, e.error, e.standard_error, e.ratio) for e in found]
