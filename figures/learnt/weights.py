"""Where renders of figures find what was learnt: the results of parts of training, and nothing else."""

from __future__ import annotations

import base64
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

from figures.computing.learnt_objects import weights_in
from figures.parts.part import Result
from halfspace_sss.provenance import check_folder

__all__ = ["FULL_GEOMETRY", "TRAINING", "training_of", "with_weights"]

FULL_GEOMETRY = "full_geometry"
TRAINING = "training"


def training_of(name: str) -> str:
    """The name of the part in which an object is learnt."""
    return f"{name}, {TRAINING}"


@contextmanager
def with_weights(folder: Path, needed: Mapping[str, Result]) -> Iterator[None]:
    """Renders find what was learnt in the parts of training among the needed ones, and no other weights.

    Args:
        folder: of the task, where the files are put.
        needed: results that the task was given.
    """
    place = check_folder(folder) / "weights"
    place.mkdir(parents=True, exist_ok=True)
    for name, result in needed.items():
        for file, data in result.numbers["files"].items() if name.endswith(f", {TRAINING}") else ():
            (place / file).write_bytes(base64.b64decode(data))
    with weights_in(place):
        yield
