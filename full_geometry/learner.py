"""The network that corrects S_0, as a torch module over columns (inputs, lanes)."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from torch import nn

from full_geometry.model import BOUND

__all__ = ["Correction", "likelihood"]


class Correction(nn.Module):
    """f = 6 tanh(g/6) per channel, g a perceptron; 0 at the start.

    Args:
        n_in: features.
        channels: outputs.
        width, depth: hidden layers.
        seed: of the numbers at the start.
    """

    def __init__(self, n_in: int, channels: int, width: int = 64, depth: int = 3, seed: int = 0) -> None:
        super().__init__()
        generator = torch.Generator().manual_seed(seed)
        sizes = [n_in, *[width] * depth, channels]
        self.matrices, self.biases = nn.ParameterList(), nn.ParameterList()
        for k, (i, j) in enumerate(zip(sizes, sizes[1:])):
            gain = math.sqrt((1.0 if k == 0 else 2.0) / i) if k < depth else 0.0
            self.matrices.append(gain * torch.randn(j, i, generator=generator))
            self.biases.append(torch.zeros(j, 1))

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """f (channels, n) of features (inputs, n)."""
        for k, (W, b) in enumerate(zip(self.matrices, self.biases)):
            x = torch.addmm(b, W, x)
            if k < len(self.matrices) - 1:
                x = nn.functional.hardswish(x)
        return BOUND * torch.tanh(x / BOUND)

    def arrays(self) -> dict[str, np.ndarray]:
        """Matrices (outputs, inputs) and biases by name."""
        found: dict[str, Any] = {}
        for k, (W, b) in enumerate(zip(self.matrices, self.biases)):
            found |= {f"W_{k}": W.detach().numpy().copy(), f"b_{k}": b.detach().numpy()[:, 0].copy()}
        return found


def likelihood(f: torch.Tensor, walks: torch.Tensor, proposals: torch.Tensor, kept: float) -> torch.Tensor:
    """E_q[(S_0 mu_i / q) exp f] - E_walks[T f], sum over channels.

    Args:
        f: (channels, n + m) of n walks and then m proposals.
        walks: T (channels, n).
        proposals: S_0 mu_i / q (channels, m).
        kept: share of all walks that the n stand for.
    """
    n = walks.shape[1]
    gain = (proposals * torch.exp(f[:, n:])).mean(dim=1) - kept * (walks * f[:, :n]).mean(dim=1)
    return gain.sum()
