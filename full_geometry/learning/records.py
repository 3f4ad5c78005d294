"""What came of a training, and how wrong a model of an object is, as commands print them."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple


class ObjectError(NamedTuple):
    """How wrong a model of an object is: relative RMSE of the radiance of its exits, and the ratio of the means."""

    object: str
    channel: str
    model: str
    light: str
    error: float
    standard_error: float
    ratio: float


class LearntObject(NamedTuple):
    """What came of a training: where its weights lie (None: there are none), how wrong they are, and its cost."""

    object: str
    path: Path | None
    errors: list[ObjectError]
    steps: int
    seconds: float


class LearntShapes(NamedTuple):
    """What came of a training on shapes without end: where its weights lie, objects that were drawn, and its cost."""

    path: Path
    objects: int
    steps: int
    seconds: float
