"""Training of the networks; needs torch, which evaluation does not."""

from halfspace_sss.neural.training.fit import Fit
from halfspace_sss.neural.training.train_material import FAST, STANDARD, MaterialRecipe, train
from halfspace_sss.neural.training.train_universal import UniversalRecipe, train_universal

__all__ = ["FAST", "STANDARD", "Fit", "MaterialRecipe", "UniversalRecipe", "train", "train_universal"]
