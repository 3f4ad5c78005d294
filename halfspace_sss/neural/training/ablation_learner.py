"""What lies between the paper's network and `neural_material`: an exponential of a perceptron, in all combinations."""

from __future__ import annotations

import copy
from typing import Any

import numpy as np
import torch
from torch import nn

from halfspace_sss.arrays import library
from halfspace_sss.interface.model import BSSRDF
from halfspace_sss.interface.query import Query
from halfspace_sss.maps.noisy_maps import radial_edges
from halfspace_sss.neural.features import N_FEATURES
from halfspace_sss.neural.network import RELU, SILU, Network, layer_shapes
from halfspace_sss.neural.paper_model import N_INPUTS, T_SMALLEST, NeuralPaper, query_inputs
from halfspace_sss.neural.training.learners import apply_networks, initial_numbers, relative_loss
from halfspace_sss.neural.training.paper_learner import PaperLearner
from halfspace_sss.neural.training.pool import Batch, MapPool
from halfspace_sss.neural.training.subjects import Trial
from halfspace_sss.physics.backbone import backbone, length_scale, unwarp
from halfspace_sss.physics.fresnel import F_t
from halfspace_sss.physics.medium import Medium

__all__ = ["Factored", "PlainTrial", "SharedTurn", "drawn_by_area", "model_of"]

LOG_RANGE = 40.0  # of log(G/B); its exponential squared is still a float32
DEPTH = 3


class SharedTurn(PaperLearner):
    """The paper's network, which sees both points of a cell under one random azimuth of incidence.

    With an azimuth for each point the loss fits no more than the mean over azimuths, see `learners.cell_loss`.
    """

    def inputs(self, batch: Batch) -> torch.Tensor:
        vectors = torch.view_as_complex(super().inputs(batch).unflatten(-1, (3, 2)))  # position, w_i, w_o
        heading = torch.sgn(vectors[..., 1:2])
        first = heading[:, : batch.y.shape[1]]
        turn = torch.cat((first, first), dim=1) * heading.conj()
        return torch.view_as_real(vectors * turn).flatten(-2)


class Factored(nn.Module):
    """log(S/scale) or log(G/B) of one medium by a perceptron, fitted by the relative error.

    Args:
        paper: gives the six inputs and the scale.
        symmetric: symmetric features instead of the six inputs; with them the backbone is always there.
        with_backbone: log(G/B) rather than log(S/scale).
        silu: SiLU rather than ReLU.
        width: hidden units of each of three layers.
        seed: of the numbers at the start.
    """

    def __init__(
        self, paper: PaperLearner, symmetric: bool, with_backbone: bool, silu: bool, width: int, seed: int
    ) -> None:  # fmt: skip
        super().__init__()
        self.frame = (paper,)  # in a tuple, which hides its numbers from the optimiser
        self.symmetric, self.with_backbone = symmetric, with_backbone
        self.activation = SILU if silu else RELU
        self.shapes = layer_shapes(N_FEATURES if symmetric else N_INPUTS, width, DEPTH)
        self.numbers = nn.Parameter(initial_numbers(self.shapes, torch.Generator().manual_seed(seed)))

    def loss(self, batch: Batch) -> torch.Tensor:
        x = batch.features() if self.symmetric else self.frame[0].inputs(batch)
        log_p = apply_networks(x.flatten(0, 1)[None], self.numbers[None], self.shapes, self.activation.torch)
        log_p = log_p.view_as(batch.u)
        if not self.with_backbone:
            log_p = log_p - torch.log(self.frame[0].S_over_y(batch).clamp_min(1e-30))
        return relative_loss(torch.exp(log_p.clamp(-LOG_RANGE, LOG_RANGE)), batch)

    def network(self) -> Network:
        return Network.from_vector(self.numbers.detach().numpy(), self.shapes, self.activation)


class PlainTrial(BSSRDF):
    """The exponential of a perceptron of the paper's six inputs as a model.

    Args:
        network: log(S/scale), or log(G/B) if scale is None.
    """

    name = "plain_trial"
    orders = "multiple"
    reciprocal = False
    mirror_invariant = False
    fast_in = "numpy"
    source = "under training"

    def __init__(self, medium: Medium, network: Network, scale: float | None) -> None:
        super().__init__(medium)
        self.network, self.scale = network, scale

    def G(self, q: Query) -> Any:
        lib, m = q.lib, self.medium
        log_factor = self.network(query_inputs(q, length_scale(m.albedo, m.g)))
        factor = lib.exp(lib.minimum(lib.maximum(log_factor, -LOG_RANGE), LOG_RANGE))
        if self.scale is None:
            return backbone(q.r, m.albedo, m.g, m.eta) * factor
        return self.scale * factor / lib.maximum(F_t(q.mu_i, m.eta) * F_t(q.mu_o, m.eta), T_SMALLEST)


def model_of(learner: Any, medium: Medium) -> BSSRDF:
    """A learner of this table as it is, as a model of its medium."""
    network = learner.network()
    if isinstance(learner, PaperLearner):
        return NeuralPaper(medium, [(network, learner.scale)])
    if not isinstance(learner, Factored) or learner.symmetric:
        return Trial(medium, network)
    return PlainTrial(medium, network, None if learner.with_backbone else learner.frame[0].scale)


def drawn_by_area(pool: MapPool) -> MapPool:
    """The same maps, of which batches show cells in proportion to their area."""
    r = pool.groups.L[:, None] * unwarp(library(0.0), radial_edges(pool.groups, pool.grid))
    drawn = copy.copy(pool)
    drawn.cdf = torch.from_numpy(((r**2 - r[:, :1] ** 2)[:, 1:] / (r[:, -1:] ** 2 - r[:, :1] ** 2)).astype(np.float32))
    return drawn
