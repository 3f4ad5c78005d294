"""Where renders of figures find what was learnt: the results of parts of training, and nothing else."""

from __future__ import annotations

import base64
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

from figures.parts.part import Result
from halfspace_sss.neural.trained import ENVIRONMENT_VARIABLE
from halfspace_sss.provenance import check_folder

__all__ = ["FULL_GEOMETRY", "TRAINING", "known_weights", "training_of", "with_weights"]

FULL_GEOMETRY = "full_geometry"
TRAINING = "training"


def training_of(name: str) -> str:
    """The name of the part in which an object is learnt."""
    return f"{name}, {TRAINING}"


@contextmanager
def known_weights(folder: Path) -> Iterator[None]:
    """Renders look for weights in a folder of the part, and nowhere else."""
    before = os.environ.get(ENVIRONMENT_VARIABLE)
    os.environ[ENVIRONMENT_VARIABLE] = str(folder)
    try:
        yield
    finally:
        if before is None:
            del os.environ[ENVIRONMENT_VARIABLE]
        else:
            os.environ[ENVIRONMENT_VARIABLE] = before


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
    with known_weights(place):
        yield
