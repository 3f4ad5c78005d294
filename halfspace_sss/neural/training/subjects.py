"""What can be trained for one medium, by name."""

from __future__ import annotations

import math
from typing import Any

from halfspace_sss.neural import material_model, paper_model
from halfspace_sss.neural.hypernetwork import in_range
from halfspace_sss.neural.network import Network
from halfspace_sss.neural.paper_model import NeuralPaper
from halfspace_sss.neural.symmetric import SymmetricModel
from halfspace_sss.neural.training.learners import Small
from halfspace_sss.neural.training.paper_learner import PaperLearner
from halfspace_sss.neural.training.pool import MapPool
from halfspace_sss.neural.universal import load_hypernetwork, shipped_weights
from halfspace_sss.physics.medium import Medium

__all__ = ["SUBJECTS", "MaterialSubject", "PaperSubject", "Trial"]


WIDEST_IN_DRJIT = 64  # a network 256 wide runs three times as fast in NumPy


class Trial(SymmetricModel):
    """A network under training as a model."""

    name = "trial"
    source = "under training"

    def __init__(self, medium: Medium, network: Network) -> None:
        super().__init__(medium)
        self.networks = [network]
        if network.matrices[0].shape[1] > WIDEST_IN_DRJIT:
            self.fast_in = "numpy"


class MaterialSubject:
    """`neural_material`, started from what the universal network says of the medium, where it says anything.

    Args:
        warm: False to start from random numbers.
    """

    kind = material_model.KIND

    def __init__(self, warm: bool = True) -> None:
        self.warm = warm

    def learner(self, medium: Medium, pool: MapPool, seed: int) -> Small:
        start = None
        if self.warm and in_range(medium) and shipped_weights().exists():
            hyper = load_hypernetwork(shipped_weights())
            start = hyper.network(float(medium.albedo), float(medium.g), medium.eta)
        return Small(seed=seed, start=start)

    def model(self, medium: Medium, learner: Small) -> Trial:
        return Trial(medium, learner.network())

    def record(self, learner: Small) -> dict[str, Any]:
        return {"warm_start": self.warm}


class PaperSubject:
    """`neural_paper`: 3 x 256, raw S, squared error."""

    kind = paper_model.KIND

    def learner(self, medium: Medium, pool: MapPool, seed: int) -> PaperLearner:
        probe = PaperLearner(medium, 1.0, width=1)
        batch = pool.batch(64, 1024, _generator())
        S = probe.S_over_y(batch)[:, : batch.y.shape[1]] * batch.y
        return PaperLearner(medium, max(math.sqrt(float((S**2).mean())), 1e-20), seed=seed)

    def model(self, medium: Medium, learner: PaperLearner) -> NeuralPaper:
        return NeuralPaper(medium, [(learner.network(), learner.scale)])

    def record(self, learner: PaperLearner) -> dict[str, Any]:
        return {"scale": learner.scale}


def _generator() -> Any:
    import torch

    return torch.Generator().manual_seed(0)


SUBJECTS = {"neural_material": MaterialSubject(), "neural_paper": PaperSubject()}
