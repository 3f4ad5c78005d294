"""One network for every shape and every medium: S of an object by what rays measure of the surface around two points.

S = S_0 P_o P_i exp f, with the half-space S_0, the exact chances P to be scattered before light leaves, and a network f
of descriptors that have neither place, turn nor scale. No object and no material needs training; `train_shapes` makes
the weights that come with the package.
"""

from __future__ import annotations

from halfspace_sss.lazy import lazy_names

__all__ = ["Recipe", "make_shape", "shipped_weights", "train_shapes", "transport"]
__getattr__, __dir__ = lazy_names(
    __name__,
    {
        "Recipe": "learning.fitting",
        "make_shape": "shapes.generators",
        "shipped_weights": "storing",
        "train_shapes": "learning.training",
        "transport": "storing",
    },
)
