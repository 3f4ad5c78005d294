"""One network for every shape and every medium: S of an object by what rays measure of the surface around two points.

S = S_0 P_o P_i exp f, with the half-space S_0, the exact chances P to be scattered before light leaves, and a network f
of descriptors that have neither place, turn nor scale. No object and no material needs training; `train_shapes` makes
the weights that come with the package.
"""

from __future__ import annotations

from typing import Any


def train_shapes(*arguments: Any, **options: Any) -> Any:
    """As `learning.shape_training.train_shapes`, which loads torch: the learner of the command `train shapes`."""
    from full_geometry.learning.shape_training import train_shapes as learn

    return learn(*arguments, **options)
