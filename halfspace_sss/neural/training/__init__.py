"""Training of the networks; needs torch, which evaluation does not."""

from __future__ import annotations

from typing import TYPE_CHECKING

from halfspace_sss.lazy import lazy_names

if TYPE_CHECKING:
    from halfspace_sss.neural.training.fit import Fit
    from halfspace_sss.neural.training.train_material import FAST, STANDARD, MaterialRecipe, train
    from halfspace_sss.neural.training.train_universal import UniversalRecipe, train_universal

__all__ = ["FAST", "STANDARD", "Fit", "MaterialRecipe", "UniversalRecipe", "train", "train_universal"]

_MATERIAL = dict.fromkeys(("FAST", "STANDARD", "MaterialRecipe", "train"), "train_material")
_UNIVERSAL = dict.fromkeys(("UniversalRecipe", "train_universal"), "train_universal")
__getattr__, __dir__ = lazy_names(__name__, {"Fit": "fit", **_MATERIAL, **_UNIVERSAL})
