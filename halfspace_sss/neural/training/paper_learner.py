"""Training of the paper's network: squared error of S itself."""

from __future__ import annotations

import math

import torch
from torch import nn

from halfspace_sss.arrays import library
from halfspace_sss.neural.network import RELU, Network, layer_shapes
from halfspace_sss.neural.paper_model import N_INPUTS, paper_inputs
from halfspace_sss.neural.training.learners import apply_networks, initial_numbers
from halfspace_sss.neural.training.pool import Batch
from halfspace_sss.physics.backbone import backbone
from halfspace_sss.physics.fresnel import F_t
from halfspace_sss.physics.medium import Medium

__all__ = ["PaperLearner"]


class PaperLearner(nn.Module):
    """S of one medium by a plain perceptron: `NeuralPaper` as a torch module.

    Args:
        medium: scalar, in mean free paths.
        scale: S is divided by it, so that targets are of order one.
        width, depth: hidden layers.
        seed: of the numbers at the start.
    """

    def __init__(self, medium: Medium, scale: float, width: int = 256, depth: int = 3, seed: int = 0) -> None:
        super().__init__()
        self.medium, self.scale, self.width, self.depth = medium, scale, width, depth
        self.shapes = layer_shapes(N_INPUTS, width, depth)
        self.numbers = nn.Parameter(initial_numbers(self.shapes, torch.Generator().manual_seed(seed)))

    def inputs(self, batch: Batch) -> torch.Tensor:
        """The six inputs, each batch seen under a random azimuth of incidence, (B, S, 6)."""
        # drawn from the batch itself, so that the checkpointed generator decides it
        turn = 2 * math.pi * torch.frac(1e4 * batch.psi)
        sines = [self.medium.eta * torch.sqrt((1 - mu * mu).clamp_min(0.0)) for mu in (batch.mu_i, batch.mu_o)]
        # forward is the horizontal direction of travel: w_i points the other way
        w_i, w_o = (sines[0], turn + math.pi), (sines[1], turn + batch.delta_phi)
        parts = paper_inputs(library(batch.r), batch.r, turn + batch.psi, w_i, w_o, batch.L)
        return torch.stack(torch.broadcast_tensors(*parts), dim=-1)

    def S_over_y(self, batch: Batch) -> torch.Tensor:
        """What turns the ratio y = G/B into S / scale."""
        m = self.medium
        B = backbone(batch.r, float(m.albedo), float(m.g), m.eta)
        outside = [torch.sqrt((1 - m.eta**2 * (1 - mu * mu)).clamp_min(0.0)) for mu in (batch.mu_i, batch.mu_o)]
        return B * F_t(outside[0], m.eta) * F_t(outside[1], m.eta) / self.scale

    def loss(self, batch: Batch) -> torch.Tensor:
        S = apply_networks(self.inputs(batch).flatten(0, 1)[None], self.numbers[None], self.shapes, torch.relu)
        S_1, S_2 = S.view_as(batch.u).chunk(2, dim=1)
        scale_1, scale_2 = self.S_over_y(batch).chunk(2, dim=1)
        # as `cell_loss` of S / scale with the weight scale_1 scale_2, but scale may be 0
        return ((S_1 - scale_1 * batch.y) * (S_2 - scale_2 * batch.y)).mean()

    def network(self) -> Network:
        return Network.from_vector(self.numbers.detach().numpy(), self.shapes, RELU)
