"""What the training of an object cost, by the learners' own records."""

from __future__ import annotations

from typing import Any

from halfspace_sss.extensions import LEARNERS, offered

__all__ = ["training_seconds"]


def training_seconds(scene: Any, object: str, model: str) -> float:
    """Seconds that the weights of a model of an object took to learn; 0 for what needs no training.

    A learner of the group `halfspace_sss.learners` tells them by a function `cost(scene, object)`.
    """
    for name, found in offered(LEARNERS):
        if name == model and callable(getattr(found, "cost", None)):
            return float(found.cost(scene, object))
    return 0.0
