"""Training of the networks; needs torch, which evaluation does not."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from halfspace_sss.neural.training.fit import Fit
    from halfspace_sss.neural.training.recipes import (
        FAST,
        STANDARD,
        MaterialRecipe,
        UniversalRecipe,
        train,
        train_universal,
    )

__all__ = ["FAST", "STANDARD", "Fit", "MaterialRecipe", "UniversalRecipe", "train", "train_universal"]


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    home = "fit" if name == "Fit" else "recipes"
    return getattr(importlib.import_module(f"{__name__}.{home}"), name)
