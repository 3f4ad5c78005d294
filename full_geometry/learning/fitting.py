"""Fitting the correction of one object: Adam by a cosine, a running average of the numbers, checkpoints."""

from __future__ import annotations

import copy
import math
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch

from full_geometry.features import n_pair
from full_geometry.learning.device import device_of_walks, one_thread, tensor
from full_geometry.learning.ends import Ends
from full_geometry.learning.learner import (
    Correction,
    EvenLight,
    PatchLogits,
    likelihood,
    mean_likelihood,
    patch_likelihood,
)
from full_geometry.learning.pairs import ENOUGH, Pairs, PairSource
from full_geometry.neural_shape.storing import KIND as SHAPES
from full_geometry.patches import Patches
from halfspace_sss.checks import check_choice, check_count, check_interval
from halfspace_sss.interface.model import models
from halfspace_sss.neural.training import checkpoint

__all__ = ["ALPHA_HIDDEN", "PROPOSED", "STANDARD", "Fitting", "Recipe"]

BETAS, CLIP, LAST_RATE, WARM_UP = (0.9, 0.99), 1.0, 0.01, 100
AVERAGE = 0.998  # of the numbers, each step
PROPOSED = 2  # proposals for a walk that is kept
SOLVED = 0.5  # chunks of proposals, of those of a training, by which functions of ends are solved for
BEYOND = 2**30  # number of the first of these chunks
BLOCK = 4096  # pairs whose layers stay in the cache
LEAST = 0.05  # chance of a proposal: f moves while the chunk is used
PATCH_HIDDEN, PATCH_BATCH = (64, 32), 1024
ALPHA_HIDDEN = (32, 16)
RATES = {SHAPES: 1.5e-3}  # by start: noise of walks leads large steps away from a near one


@dataclass(frozen=True)
class Recipe:
    """How an object is learnt.

    Args:
        width, depth: hidden layers of the network.
        batch: walks, and proposals, of a step.
        rate: largest learning rate.
        chunk: walks that are kept of those made at once, with twice as many proposals.
        reuse: times that each is used.
        start: what is corrected: the name of a half-space model, or `neural_shape`.
    """

    width: int = 48
    depth: int = 3
    batch: int = 2048
    rate: float = 6e-3
    chunk: int = 2**17
    reuse: int = 2
    start: str = "better_dipole"

    def __post_init__(self) -> None:
        for name in ("width", "depth", "batch", "chunk", "reuse"):
            check_count(name, getattr(self, name), 1)
        check_interval("rate", self.rate, 1e-8, 1.0)
        check_choice("start", self.start, (SHAPES, *models()))

    def begun(self, start: str) -> Recipe:
        """The same from another start, with the rate that suits it."""
        return replace(self, start=start, rate=RATES.get(start, self.rate))


STANDARD = Recipe()


class Fitting:
    """The state of a fit, which follows from recipe, seed, number of steps, data and device, see `device_of_walks`.

    Args:
        n_in: features of a pair.
        channels: of the medium.
        eta: relative index.
        recipe: sizes and rates.
        seed: of the numbers at the start and of the order of the data.
        patches: of the surface, for whose weights a network is fitted beside; None for a shape without faces.
    """

    def __init__(
        self, n_in: int, channels: int, eta: float, recipe: Recipe, seed: int, patches: Patches | None = None
    ) -> None:
        self.recipe, self.patches, self.n_side = recipe, patches, (n_in - n_pair(channels)) // 2
        parts = {
            "S": Correction(n_in + 2 * ALPHA_HIDDEN[-1], channels, recipe.width, recipe.depth, seed),
            "alpha": EvenLight(self.n_side, channels, ALPHA_HIDDEN, eta, seed),
        }
        if patches is not None:
            parts["patches"] = PatchLogits(self.n_side, patches.areas, PATCH_HIDDEN, seed)
        self.device = device_of_walks()
        self.ends = Ends(channels, self.n_side, self.device)
        self.modules = torch.nn.ModuleDict(parts).to(self.device)
        self.average = copy.deepcopy(self.modules)
        self.parameters = list(self.modules.parameters())
        self.adam = torch.optim.Adam(self.parameters, lr=recipe.rate, betas=BETAS, fused=True)
        ones = torch.ones(2 * channels, 1, device=self.device)
        self.step, self.scale, self.even_scale = 0, ones[:channels].clone(), ones

    def set_scale(self, walks: Pairs) -> None:
        """Divide each channel by its mean throughput, so that all count alike; alpha begins with the mean.

        Order one counts as a part of all light: where it hardly leaves, its few large values would drown the rest.
        """
        self.scale = _inverse(self._tensor(walks.values.sum(axis=1) / walks.drawn))
        exits, T = (self._tensor(v) for v in walks.even)
        mean = T.mean(dim=1)
        once, more = mean.split(len(mean) // 2)
        self.even_scale = _inverse(torch.cat([once + more, more]))
        for networks in (self.modules, self.average):
            networks["alpha"].begin(exits, mean)

    def use(self, walks: Pairs, proposals: Pairs, steps: int | None, order: np.random.Generator) -> None:
        """Steps on all batches of a chunk, `reuse` times over, every other time with exit and entry exchanged.

        As S is reciprocal and exits are drawn by area and cosine, a pair read backwards is as good a sample.

        Args:
            walks, proposals: the chunk.
            steps: of the whole fit, for the decay of the rate; None for no decay.
            order: of the batches, in which walks meet other proposals each time, and of the proposals that are used.
        """
        batch = self.recipe.batch
        x, T = (self._tensor(v) for v in (walks.features, walks.values))
        y, W = self._worthy(proposals, order)
        exits, even = (self._tensor(v) for v in walks.even)
        patch = None
        if self.patches is not None:
            patch = self._tensor(self.patches.of_face[walks.faces].astype(np.int64))
        n_x, n_y = max(T.shape[1] // batch, 1), max(W.shape[1] // batch, 1)
        kept, n_even = T.shape[1] / walks.drawn, max(even.shape[1] // n_x, 1)
        T, W = T * self.scale, W * self.scale
        with torch.no_grad(), one_thread():
            self.ends.add_walks(*walks.of_random_exits(x, T))
        with one_thread():
            for k in range(self.recipe.reuse):
                back = k % 2 == 1
                for i, j in zip(order.permutation(n_x), order.integers(0, n_y, n_x)):
                    a, b, e = (slice(k * m, (k + 1) * m) for k, m in ((i, batch), (j, batch), (i, n_even)))
                    loss = likelihood((self._f(x[:, a], back), T[:, a]), (self._f(y[:, b], back), W[:, b]), kept)
                    loss = loss + mean_likelihood(self.modules["alpha"](exits[:, e]), even[:, e], self.even_scale)
                    if patch is not None and not back:
                        loss = loss + self._patch_loss(x[:, a], T[:, a], patch[a])
                    self._advance(loss, steps)

    def solve(self, source: PairSource, chunks: int, seed: int) -> None:
        """Find what the averaged fit lacks of exits and entries, see `Ends`, by proposals that it has not seen.

        Args:
            source: of the proposals.
            chunks: of the training, half as many of which are made.
            seed: of the training.
        """
        for k in range(max(round(SOLVED * chunks), 1)):
            made = source.proposed(PROPOSED * self.recipe.chunk, (seed, BEYOND + k))
            with torch.no_grad(), one_thread():
                y, _, V = self._light(made, self.average)
                self.ends.add_proposals(y, V)

    def _tensor(self, array: np.ndarray) -> torch.Tensor:
        return tensor(array, self.device)

    def _f(self, x: torch.Tensor, back: bool = False, of: torch.nn.ModuleDict | None = None) -> torch.Tensor:
        """Of features of pairs: S knows what even light makes of both ends."""
        of = of or self.modules
        return of["S"](of["alpha"].joined(x), back)

    def _light(self, proposals: Pairs, of: torch.nn.ModuleDict) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Features and values W of proposals, and their light W exp f by some networks, scaled."""
        y, W = self._tensor(proposals.features), self._tensor(proposals.values)
        f = [self._f(part, of=of) for part in y.split(BLOCK, dim=1)]
        return y, W, W * self.scale * torch.exp(torch.cat(f, dim=1))

    def _worthy(self, proposals: Pairs, order: np.random.Generator) -> tuple[torch.Tensor, torch.Tensor]:
        """Features and values of some proposals, kept by chance as walks are: by W exp f as the fit has it now."""
        with torch.no_grad(), one_thread():
            y, W, V = self._light(proposals, self.modules)
            value = V.mean(dim=0)
            p = (value / (ENOUGH * value.mean().clamp_min(1e-30))).clamp(LEAST, 1.0)
            kept = torch.nonzero(self._tensor(order.random(len(p), np.float32)) < p)[:, 0]
            return y[:, kept], W[:, kept] * (len(kept) / len(p)) / p[kept]

    def _patch_loss(self, x: torch.Tensor, T: torch.Tensor, patch: torch.Tensor) -> torch.Tensor:
        """Of a part of a batch."""
        T = T[:, :PATCH_BATCH].mean(dim=0)
        return patch_likelihood(self.modules["patches"](x[: self.n_side, :PATCH_BATCH]), T, patch[:PATCH_BATCH])

    def arrays(self) -> dict[str, np.ndarray]:
        """The averaged numbers of all networks by name, and what is solved for beside them."""
        found = {name: value for module in self.average.values() for name, value in module.arrays().items()}
        return {**found, "Q": self.ends.solved()}

    def _advance(self, loss: torch.Tensor, steps: int | None) -> None:
        at = min(self.step / max(steps, 1), 1.0) if steps is not None else 0.0
        decay = LAST_RATE + (1 - LAST_RATE) * 0.5 * (1 + math.cos(math.pi * at))
        for group in self.adam.param_groups:
            group["lr"] = self.recipe.rate * min(1.0, (self.step + 1) / WARM_UP) * decay
        self.adam.zero_grad(set_to_none=True)
        loss.backward()
        for module in self.modules.values():
            torch.nn.utils.clip_grad_norm_(module.parameters(), CLIP)
        self.adam.step()
        self.step += 1
        with torch.no_grad():
            share = 1 - min(AVERAGE, (1 + self.step) / (10 + self.step))
            torch._foreach_lerp_(list(self.average.parameters()), self.parameters, share)

    def _tensors(self) -> dict[str, torch.Tensor]:
        """Everything the next step depends on, by name; changing the tensors in place changes the fit."""
        means = {f"{k}.mean": mean.data for k, mean in enumerate(self.average.parameters())}
        scales = {"scale": self.scale, "even_scale": self.even_scale, **self.ends.tensors()}
        return {**scales, **checkpoint.tensors_of(self.adam, self.parameters), **means}

    def save(self, path: Path, done: int, history: list) -> None:
        """Write a checkpoint after `done` chunks."""
        rows = torch.tensor([list(row) for row in history], dtype=torch.float64).reshape(-1, 3)
        counters = torch.tensor([self.step, done], dtype=torch.float64)
        checkpoint.write(path, self._tensors(), counters=counters, history=rows)

    def load(self, path: Path) -> tuple[int, list]:
        """Go on from a checkpoint; returns its chunks and history.

        Raises:
            ValueError: it is damaged or of another recipe.
        """
        with checkpoint.gone_on_with(path, self._tensors()) as stored:
            self.step, done = (int(v) for v in stored["counters"].tolist())
            history = [(int(k), error, spread) for k, error, spread in stored["history"].tolist()]
        return done, history


def _inverse(mean: torch.Tensor) -> torch.Tensor:
    """1/mean as a column, 0 where there is nothing."""
    return torch.where(mean > 0, 1 / mean.clamp_min(1e-30), torch.zeros_like(mean))[:, None].float()
