"""Learnt BSSRDFs of a half-space, order >= 2, and their training.

- `neural`: one network for media of albedo in [0, 1], g in [-0.5, 0.98], eta in [1, 2]; needs no training.
- `neural_material`: a small network of one medium, trained in seconds by `train`.
- `neural_paper`: the architecture and loss of the paper, to compare with.

`train(material)` trains a material or medium; its weights are then found by `halfspace_sss.bssrdf`. Training needs
torch, evaluation does not.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from halfspace_sss.backend import BackendError
from halfspace_sss.interface.model import BSSRDF
from halfspace_sss.lazy import lazy_names
from halfspace_sss.neural.material_model import NeuralMaterial
from halfspace_sss.neural.paper_model import NeuralPaper
from halfspace_sss.neural.universal import Neural

if TYPE_CHECKING:
    from halfspace_sss.neural.training.train_material import train

__all__ = ["MODELS", "Neural", "NeuralMaterial", "NeuralPaper", "train"]

MODELS: list[type[BSSRDF]] = [Neural, NeuralMaterial, NeuralPaper]

_found, __dir__ = lazy_names(__name__, {"training.train_material": ["train"]})


def __getattr__(name: str) -> object:
    try:
        return _found(name)
    except ModuleNotFoundError as error:
        if error.name != "torch":
            raise
        raise BackendError(f'{name} needs torch: pip install "halfspace-sss[train]"') from error
