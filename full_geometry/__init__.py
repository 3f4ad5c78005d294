"""The full geometry: S of one object, learnt from the exits of walks inside it.

S = S_0 P_o P_i exp f, with the half-space S_0, the exact chances P to be scattered before light leaves, and a small
network f. `train` learns it, `errors` says how wrong it is.
"""

from __future__ import annotations

import importlib
from typing import Any

_HOME = {
    "Recipe": "learning.fitting",
    "Subject": "subject",
    "errors": "learning.model_errors",
    "load": "storing",
    "train": "learning.training",
    "transport": "storing",
}
TRANSPORTS = {"full_geometry": "full_geometry.scene:learnt_means"}
__all__ = ["TRANSPORTS", "Recipe", "Subject", "errors", "load", "train", "transport"]


def __getattr__(name: str) -> Any:
    if name in _HOME:
        return getattr(importlib.import_module(f"full_geometry.{_HOME[name]}"), name)
    raise AttributeError(f"module 'full_geometry' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
