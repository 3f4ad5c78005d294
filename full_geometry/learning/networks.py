"""Networks of one object as torch modules over columns (inputs, lanes), their losses, and where they are fitted."""

from __future__ import annotations

import math
from typing import Any

import mitsuba as mi
import numpy as np
import torch
from torch import nn

from full_geometry.models.object_model import BOUND
from full_geometry.object.features import entering, n_pair, reverse

# ---- Where networks are fitted: beside the walks that are their data -------------------------------


def device_of_walks() -> torch.device:
    """The GPU if Mitsuba's variant runs there and torch can, else the CPU."""
    there = (mi.variant() or "").startswith("cuda") and torch.cuda.is_available()
    return torch.device("cuda" if there else "cpu")


def tensor(array: np.ndarray, device: torch.device) -> torch.Tensor:
    """An array where networks are fitted; on the CPU without a copy."""
    return torch.from_numpy(array).to(device)


LEAST_SHARE = 1e-5  # of F_t P that comes back


class DenseLayers(nn.Module):
    """A perceptron with hard swish between its layers; 0 initially."""

    def __init__(self, sizes: list[int], generator: torch.Generator) -> None:
        super().__init__()
        self.matrices, self.biases = nn.ParameterList(), nn.ParameterList()
        last = len(sizes) - 2
        for k, (i, j) in enumerate(zip(sizes, sizes[1:])):
            gain = math.sqrt((1.0 if k == 0 else 2.0) / i) if k < last else 0.0
            self.matrices.append(gain * torch.randn(j, i, generator=generator))
            self.biases.append(torch.zeros(j, 1))

    def forward(self, x: torch.Tensor, first: torch.Tensor | None = None) -> torch.Tensor:
        """Of columns x; `first` takes the place of the first matrix."""
        return torch.addmm(self.biases[-1], self.matrices[-1], self.units(x, first))

    def units(self, x: torch.Tensor, first: torch.Tensor | None = None) -> torch.Tensor:
        """What the last layer is told."""
        matrices = list(self.matrices) if first is None else [first, *self.matrices[1:]]
        for W, b in list(zip(matrices, self.biases))[:-1]:
            x = nn.functional.hardswish(torch.addmm(b, W, x))
        return x

    def arrays(self, matrix: str, bias: str) -> dict[str, np.ndarray]:
        arrays: dict[str, Any] = {}
        for k, (W, b) in enumerate(zip(self.matrices, self.biases)):
            W, b = (v.detach().cpu().numpy().copy() for v in (W, b))
            arrays |= {f"{matrix}_{k}": W, f"{bias}_{k}": b[:, 0].copy()}
        return arrays


class Correction(nn.Module):
    """f = 6 tanh(g/6) per channel, g a perceptron; 0 initially.

    Args:
        n_in: features.
        channels: outputs.
        width, depth: hidden layers.
        seed: of the initial weights.
    """

    def __init__(self, n_in: int, channels: int, width: int = 64, depth: int = 3, seed: int = 0) -> None:
        super().__init__()
        self.layers = DenseLayers([n_in, *[width] * depth, channels], torch.Generator().manual_seed(seed))
        order, signs = reverse((n_in - n_pair(channels)) // 2, channels)
        back = np.argsort(order)
        self.register_buffer("order", torch.from_numpy(back), persistent=False)
        self.register_buffer("signs", torch.from_numpy(signs[back]), persistent=False)

    def forward(self, x: torch.Tensor, back: bool = False) -> torch.Tensor:
        """f (channels, n) of features (inputs, n); `back` reads pairs the other way round, exit and entry exchanged."""
        first = self.layers.matrices[0][:, self.order] * self.signs if back else None
        return BOUND * torch.tanh(self.layers(x, first) / BOUND)

    def arrays(self) -> dict[str, np.ndarray]:
        """Matrices (outputs, inputs) and biases by name."""
        return self.layers.arrays("W", "b")


def likelihood(walks: tuple, proposals: tuple, kept: float) -> torch.Tensor:
    """E_q[(S_0 mu_i / q) exp f] - E_walks[T f], sum over channels.

    Args:
        walks: f and T, (channels, n) both.
        proposals: f and S_0 mu_i / q, (channels, m) both.
        kept: share of all walks that the n stand for.
    """
    (f, T), (g, W) = walks, proposals
    return ((W * torch.exp(g)).mean(dim=1) - kept * (T * f).mean(dim=1)).sum()


class AlbedoNetwork(nn.Module):
    """F_t P sigmoid(a) of orders one, then two and more, per channel, a a perceptron of the exit.

    Args:
        n_in: features of an exit.
        channels: of the medium.
        hidden: widths of the hidden layers.
        eta: relative index.
        seed: of the initial weights.
    """

    def __init__(self, n_in: int, channels: int, hidden: tuple[int, ...], eta: float, seed: int = 0) -> None:
        super().__init__()
        self.eta, self.channels = eta, channels
        self.layers = DenseLayers([n_in, *hidden, 2 * channels], torch.Generator().manual_seed(seed))

    def _most(self, x: torch.Tensor) -> torch.Tensor:
        return torch.stack(entering(x, self.eta, self.channels)[1] * 2)

    def begin(self, x: torch.Tensor, mean: torch.Tensor) -> None:
        """Begin with a share of F_t P that is the same everywhere, and gives the mean over exits x."""
        share = (mean / self._most(x).mean(dim=1).clamp_min(1e-6)).clamp(LEAST_SHARE, 1 - LEAST_SHARE)
        with torch.no_grad():
            self.layers.biases[-1].copy_(torch.logit(share)[:, None])

    def forward(self, x: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Shares (2 channels, n) of features (inputs, n), and their logarithms up to that of F_t P."""
        a = self.layers(x)
        return self._most(x) * torch.sigmoid(a), nn.functional.logsigmoid(a)

    def joined(self, x: torch.Tensor) -> torch.Tensor:
        """Features of pairs, with the units before the last layer behind those of exit and entry."""
        n, lanes = self.layers.matrices[0].shape[1], x.shape[1]
        exit, entry, pair = x.split([n, n, len(x) - 2 * n])
        units = self.layers.units(torch.cat([exit, entry], dim=1)).split(lanes, dim=1)
        return torch.cat([exit, units[0], entry, units[1], pair])

    def arrays(self) -> dict[str, np.ndarray]:
        """Matrices (outputs, inputs) and biases by name."""
        return self.layers.arrays("A", "a")


def mean_likelihood(both: tuple, T: torch.Tensor, scale: torch.Tensor) -> torch.Tensor:
    """E[alpha - T log alpha] over walks, sum over channels times their scale; its minimum is alpha = E[T | exit].

    Args:
        both: from `AlbedoNetwork`.
        T: (2 channels, n).
        scale: (2 channels, 1).
    """
    alpha, log_alpha = both
    return (scale * (alpha - T * log_alpha)).mean(dim=1).sum()


class PatchLogits(nn.Module):
    """log p(patch | exit) up to a constant; initially the shares of the area.

    Args:
        n_in: features of an exit.
        areas: of the patches.
        hidden: widths of the hidden layers.
        seed: of the initial weights.
    """

    def __init__(self, n_in: int, areas: np.ndarray, hidden: tuple[int, ...], seed: int = 0) -> None:
        super().__init__()
        self.layers = DenseLayers([n_in, *hidden, len(areas)], torch.Generator().manual_seed(seed))
        shares = np.log(np.maximum(areas / areas.sum(), 1e-30))
        self.register_buffer("log_share", torch.from_numpy(shares.astype(np.float32))[:, None])

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return self.layers(x) + self.log_share

    def arrays(self) -> dict[str, np.ndarray]:
        """Matrices (outputs, inputs) and biases by name, without the shares of the area."""
        return self.layers.arrays("V", "c")


def patch_likelihood(logits: torch.Tensor, T: torch.Tensor, patch: torch.Tensor) -> torch.Tensor:
    """-E[T log p(patch of x_i | exit)] over walks, for T (n,) of one channel or a mean of them."""
    return (T * nn.functional.cross_entropy(logits.T, patch, reduction="none")).mean()
