"""The learner `neural_shape` of the command `train --shapes`."""

from __future__ import annotations

from typing import Any

from halfspace_sss.rendering.scenes.learners import LearntShapes

__all__ = ["train_shapes"]


def train_shapes(*arguments: Any, **options: Any) -> LearntShapes:
    """As `learning.training.train_shapes`, which loads torch."""
    from full_geometry.neural_shape.learning.training import train_shapes as learn

    return learn(*arguments, **options)
