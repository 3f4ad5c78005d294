"""Which models there are for a medium, and the files that their results depend on."""

from __future__ import annotations

from pathlib import Path

from halfspace_sss import bssrdf, models
from halfspace_sss.neural.symmetric import channels
from halfspace_sss.physics.medium import Medium

__all__ = ["accepting", "weight_files"]


def accepting(medium: Medium) -> list[str]:
    """Names of the models that can be made for the medium: a learnt one without weights for it is not among them."""
    found = []
    for name in models():
        try:
            bssrdf(name, medium)
        except ValueError:
            continue
        found.append(name)
    return found


def weight_files(model: str, medium: Medium) -> tuple[Path, ...]:
    """The files of weights that a model reads for a medium, for `Part.inputs`; none for an analytic model.

    Raises:
        ValueError: the model is not trained for the medium.
    """
    from halfspace_sss.neural import material_model, paper_model
    from halfspace_sss.neural.universal import shipped_weights

    trained = {module.KIND: module for module in (material_model, paper_model)}
    if model in trained:
        return tuple(dict.fromkeys(trained[model].find_weights(model, m) for m in channels(medium)))
    if model == "neural_shape":
        from full_geometry.models import neural_shape

        return (neural_shape.shipped_weights(),)
    return (shipped_weights(),) if model == "neural" else ()
