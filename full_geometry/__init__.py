"""The full geometry: S of one object, learnt from the exits of walks inside it.

S = S_0 P_o P_i exp f, with the half-space S_0, the exact chances P to be scattered before light leaves, and a small
network f. `train` learns it, `errors` says how wrong it is.
"""

from __future__ import annotations

from halfspace_sss.lazy import lazy_names

__all__ = ["Recipe", "errors", "load", "object_of", "train", "transport_of"]
__getattr__, __dir__ = lazy_names(
    __name__,
    {
        "Recipe": "learning.fitting",
        "errors": "learning.model_errors",
        "load": "models.storing",
        "object_of": "learning.model_errors",
        "train": "learning.training",
        "transport_of": "learning.model_errors",
    },
)
