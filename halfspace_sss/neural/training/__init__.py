"""Training of the networks; needs torch, which evaluation does not."""

from __future__ import annotations

from typing import TYPE_CHECKING

from halfspace_sss.lazy import lazy_names

if TYPE_CHECKING:
    from halfspace_sss.neural.training.recipes import (
        FAST,
        STANDARD,
        MaterialRecipe,
        UniversalRecipe,
        train,
        train_universal,
    )
    from halfspace_sss.neural.training.schedules import Fit

__all__ = ["FAST", "STANDARD", "Fit", "MaterialRecipe", "UniversalRecipe", "train", "train_universal"]

__getattr__, __dir__ = lazy_names(__name__, {name: "schedules" if name == "Fit" else "recipes" for name in __all__})
