"""Training of the networks; needs torch, which evaluation does not."""

from __future__ import annotations

from typing import TYPE_CHECKING

from halfspace_sss.lazy import lazy_names

if TYPE_CHECKING:
    from halfspace_sss.neural.training.fit import Fit
    from halfspace_sss.neural.training.train_material import FAST, STANDARD, MaterialRecipe, train
    from halfspace_sss.neural.training.train_universal import UniversalRecipe, train_universal

__all__ = ["FAST", "STANDARD", "Fit", "MaterialRecipe", "UniversalRecipe", "train", "train_universal"]

MATERIAL, UNIVERSAL = ["FAST", "STANDARD", "MaterialRecipe", "train"], ["UniversalRecipe", "train_universal"]
MODULES = {"fit": ["Fit"], "train_material": MATERIAL, "train_universal": UNIVERSAL}
# lazily: train_universal is a module too, which the function must not hide from those who import that
__getattr__, __dir__ = lazy_names(__name__, MODULES)
