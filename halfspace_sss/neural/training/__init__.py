"""Training of the networks; needs torch, which evaluation does not."""

from __future__ import annotations

from typing import TYPE_CHECKING

from halfspace_sss.lazy import lazy_names

if TYPE_CHECKING:
    from halfspace_sss.neural.training.fit import Fit
    from halfspace_sss.neural.training.train_material import FAST, STANDARD, MaterialRecipe, train

__all__ = ["FAST", "STANDARD", "Fit", "MaterialRecipe", "train"]

MODULES = {"fit": ["Fit"], "train_material": ["FAST", "STANDARD", "MaterialRecipe", "train"]}
__getattr__, __dir__ = lazy_names(__name__, MODULES)
