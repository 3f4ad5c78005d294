"""Fitting the network of all shapes by the likelihood of exits and the light of groups of them.

Adam by a cosine, a running average, checkpoints.
"""

from __future__ import annotations

import copy
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import nn

from full_geometry.neural_shape.descriptors import CURVED_OWN, CURVED_SHARED, N_MEDIUM, N_OWN, N_SHARED
from full_geometry.neural_shape.learning.groups import Grouped
from full_geometry.neural_shape.model import LEAST, PLACE_OF_G, most
from halfspace_sss.checks import check_count, check_interval
from halfspace_sss.neural.training import checkpoint

__all__ = ["STANDARD", "Fitting", "Network", "Recipe"]

BETAS, CLIP, LAST_RATE, WARM_UP, AVERAGE = (0.9, 0.99), 1.0, 0.01, 100, 0.9985
MOST_OFF = 3.0  # of the light of a group: what is far too bright has its say by the likelihood


@dataclass(frozen=True)
class Recipe:
    """How the network is fitted.

    Args:
        width, depth: hidden layers.
        objects: of a batch.
        pairs: walks, and proposals, of each; at least two.
        rate: largest learning rate.
    """

    width: int = 64
    depth: int = 3
    objects: int = 32
    pairs: int = 64
    rate: float = 4e-3

    def __post_init__(self) -> None:
        for name, least in (("width", 1), ("depth", 1), ("objects", 1), ("pairs", 2)):
            check_count(name, getattr(self, name), least)
        check_interval("rate", self.rate, 1e-8, 1.0)


STANDARD = Recipe()


class Network(nn.Module):
    """f of `model.NeuralShape` in torch; 0 at the start.

    Args:
        recipe: its size.
        seed: of the numbers at the start.
    """

    def __init__(self, recipe: Recipe, seed: int = 0) -> None:
        super().__init__()
        generator = torch.Generator().manual_seed(seed)
        curved = len(range(N_OWN)[CURVED_OWN]) + len(range(N_SHARED)[CURVED_SHARED])
        sizes = [N_OWN + N_SHARED + N_MEDIUM, *[recipe.width] * recipe.depth, curved]
        self.matrices, self.biases = nn.ParameterList(), nn.ParameterList()
        for k, (i, j) in enumerate(zip(sizes, sizes[1:])):
            gain = math.sqrt((1.0 if k == 0 else 2.0) / i) if k < recipe.depth else 0.0
            self.matrices.append(gain * torch.randn(j, i, generator=generator))
            self.biases.append(torch.zeros(j))

    def forward(self, x: torch.Tensor, medium: torch.Tensor) -> torch.Tensor:
        """f (n,) of descriptors (n, numbers) and the numbers of media (n, 16)."""
        linear, swish = nn.functional.linear, nn.functional.hardswish
        o, i, shared = x[:, :N_OWN], x[:, N_OWN : 2 * N_OWN], x[:, 2 * N_OWN :]
        W = self.matrices[0]
        rest = linear(torch.cat((shared, medium), dim=1), W[:, N_OWN:], self.biases[0])
        h = swish(linear(o, W[:, :N_OWN]) + rest) + swish(linear(i, W[:, :N_OWN]) + rest)
        for k in range(1, len(self.matrices)):
            h = linear(h, self.matrices[k], self.biases[k])
            h = swish(h) if k < len(self.matrices) - 1 else h
        u = torch.cat((o[:, CURVED_OWN] + i[:, CURVED_OWN], shared[:, CURVED_SHARED]), dim=1)
        g = (h * torch.tanh(u)).sum(dim=1)
        bound = torch.where(g > 0, most(torch, medium[:, PLACE_OF_G]), -LEAST)
        return bound * torch.tanh(g / bound)

    def arrays(self) -> dict[str, np.ndarray]:
        """Matrices (outputs, inputs) and biases by name."""
        found = {f"W_{k}": W.detach().numpy().copy() for k, W in enumerate(self.matrices)}
        return found | {f"b_{k}": b.detach().numpy().copy() for k, b in enumerate(self.biases)}


def _halves(values: torch.Tensor, counts: list[int]) -> torch.Tensor:
    """Means of every second one of so many values, and of the others, (len(counts), 2)."""
    place = np.concatenate([2 * k + np.arange(n) % 2 for k, n in enumerate(counts)])
    size = np.maximum(np.bincount(place, minlength=2 * len(counts)), 1)
    sums = torch.zeros(len(size)).index_add(0, torch.from_numpy(place), values)
    return (sums / torch.from_numpy(size).float()).view(-1, 2)


class Fitting:
    """The state of a fit, which follows from recipe, seed, number of steps and data.

    Args:
        recipe: sizes and rates.
        seed: of the numbers at the start.
        network: another network to fit, for comparisons.
    """

    def __init__(self, recipe: Recipe, seed: int, network: nn.Module | None = None) -> None:
        self.recipe = recipe
        self.network = network or Network(recipe, seed)
        self.average = copy.deepcopy(self.network)
        self.parameters = list(self.network.parameters())
        self.adam = torch.optim.Adam(self.parameters, lr=recipe.rate, betas=BETAS, foreach=True)
        self.step = 0

    def advance(self, pool: list[Grouped], rng: np.random.Generator, part: float) -> float:
        """One step on random parts of random objects; returns the loss.

        Args:
            pool: data to draw from.
            rng: that draws.
            part: of the whole fit that is done, for the decay of the rate.
        """
        rate = LAST_RATE + (1 - LAST_RATE) * 0.5 * (1 + math.cos(math.pi * min(part, 1.0)))
        for group in self.adam.param_groups:
            group["lr"] = self.recipe.rate * min(1.0, (self.step + 1) / WARM_UP) * rate
        loss = self.loss([pool[k] for k in rng.integers(0, len(pool), self.recipe.objects)], rng)
        self.adam.zero_grad(set_to_none=True)
        loss.backward()
        nn.utils.clip_grad_norm_(self.parameters, CLIP)
        self.adam.step()
        self.step += 1
        with torch.no_grad():
            share = 1 - min(AVERAGE, (1 + self.step) / (10 + self.step))
            torch._foreach_lerp_(list(self.average.parameters()), self.parameters, share)
        return float(loss.detach())

    def loss(self, batch: list[Grouped], rng: np.random.Generator) -> torch.Tensor:
        """E_q[(S_0 mu_i / q) exp f] - E_walks[T f] over the mean of T, and what `groups` adds; a mean over objects.

        Of each object a part of one group of its exits is taken.
        """
        parts = [data.part(self.recipe.pairs, rng) for data in batch]
        T, W = (torch.from_numpy(np.concatenate(v)).float() for v in zip(*((p.T, p.W) for p in parts)))
        counts = [len(p.T) for p in parts] + [len(p.W) for p in parts]
        media = np.repeat(np.stack([p.medium for p in parts] * 2), counts, axis=0)
        x = np.concatenate([p.walks for p in parts] + [p.proposals for p in parts])
        f = self.network(torch.from_numpy(x).float(), torch.from_numpy(media))
        Z = _halves(W * torch.exp(f[len(T) :]), [len(p.W) for p in parts])
        share, light, weight = torch.tensor([(p.share, p.light, p.weight) for p in parts]).float().T
        off = torch.clamp(Z / light[:, None] - 1, max=MOST_OFF)
        likelihood = (share * Z.mean(dim=1)).sum() - (T * f[: len(T)]).sum()
        return (likelihood + (0.5 * weight * off[:, 0] * off[:, 1]).sum()) / len(batch)

    def arrays(self) -> dict[str, np.ndarray]:
        """The averaged numbers."""
        return self.average.arrays()

    def _tensors(self) -> dict[str, torch.Tensor]:
        """Everything the next step depends on, by name; changing the tensors in place changes the fit."""
        means = {f"{k}.mean": mean.data for k, mean in enumerate(self.average.parameters())}
        return {**checkpoint.tensors_of(self.adam, self.parameters), **means}

    def save(self, path: Path, done: int) -> None:
        """Write a checkpoint after `done` chunks."""
        checkpoint.write(path, self._tensors(), counters=torch.tensor([self.step, done], dtype=torch.float64))

    def load(self, path: Path) -> int:
        """Go on from a checkpoint; returns its chunks.

        Raises:
            ValueError: it is damaged or of another recipe.
        """
        with checkpoint.gone_on_with(path, self._tensors()) as stored:
            self.step, done = (int(v) for v in stored["counters"].tolist())
        return done
