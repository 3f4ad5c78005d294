"""One network for every shape and every medium: S of an object by what rays measure of the surface around two points.

S = S_0 P_o P_i exp f, with the half-space S_0, the exact chances P to be scattered before light leaves, and a network f
of descriptors that have neither place, turn nor scale. No object and no material needs training; `train_shapes` makes
the weights that come with the package.
"""

from __future__ import annotations

import importlib
from typing import Any

_HOME = {
    "Recipe": "learning.fitting",
    "make_shape": "shapes.generators",
    "shipped_weights": "storing",
    "train_shapes": "learning.training",
    "transport": "storing",
}
TRANSPORTS = {"neural_shape": "neural_shape.scene:shape_means"}
__all__ = ["TRANSPORTS", "Recipe", "make_shape", "shipped_weights", "train_shapes", "transport"]


def __getattr__(name: str) -> Any:
    if name in _HOME:
        return getattr(importlib.import_module(f"neural_shape.{_HOME[name]}"), name)
    raise AttributeError(f"module 'neural_shape' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
