"""Records of a training and of the errors of a model of an object, as commands print them."""

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
    """The result of a training: the file of its weights (None: there are none), their errors, and the cost."""

    object: str
    path: Path | None
    errors: list[ObjectError]
    steps: int
    seconds: float


class LearntShapes(NamedTuple):
    """The result of a training on random shapes: the file of its weights, the number of objects, and the cost."""

    path: Path
    objects: int
    steps: int
    seconds: float
