"""Learning a flow, or weights of patches, from the exits of walks; for any light or for a given one."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch

from full_geometry.features import n_side
from full_geometry.flow.chart import Chart
from full_geometry.flow.conditional import ConditionalFlow
from full_geometry.flow.context import N_CONTEXT
from full_geometry.flow.fitting import FlowNetwork
from full_geometry.flow.lights import Lighting
from full_geometry.flow.sampler import FlowSampler
from full_geometry.flow.walks import Walks, flow_walks
from full_geometry.learning.device import one_thread
from full_geometry.learning.learner import PatchLogits, patch_likelihood
from full_geometry.patches import PatchSampler
from full_geometry.storing import Learnt
from halfspace_sss.checks import check_count, check_interval

__all__ = ["FlowRecipe", "Schedule", "fit_flow", "fit_patches"]


@dataclass(frozen=True)
class FlowRecipe:
    """How a sampler is fitted.

    Args:
        seconds: of CPU time of this process, data included.
        steps: instead of the seconds, where the end is to be the same every time.
        batch, rate: of a step.
        chunk: walks that are made at once.
        reuse: times that each is used.
        hidden: widths of the flow's network.
        patch_hidden: of the network of patches.
    """

    seconds: float = 30.0
    steps: int | None = None
    batch: int = 2048
    rate: float = 4e-3
    chunk: int = 2**16
    reuse: int = 4
    hidden: tuple[int, ...] = (32, 32)
    patch_hidden: tuple[int, ...] = (64, 32)

    def __post_init__(self) -> None:
        check_interval("seconds", self.seconds, 1e-3, 1e6)
        check_interval("rate", self.rate, 1e-8, 1.0)
        for name in ("batch", "chunk", "reuse"):
            check_count(name, getattr(self, name), 1)
        check_count("steps", 1 if self.steps is None else self.steps, 1)


class Schedule:
    """Steps of Adam until the CPU seconds are spent, the rate falling by a cosine.

    Args:
        parameters: of the networks.
        recipe: seconds and rates.
    """

    def __init__(self, parameters: list, recipe: FlowRecipe) -> None:
        self.parameters, self.recipe = parameters, recipe
        self.adam = torch.optim.Adam(parameters, lr=recipe.rate, betas=(0.9, 0.99))
        self.started, self.steps = time.process_time(), 0

    @property
    def spent(self) -> float:
        """Share of the seconds, or steps, in [0, 1]."""
        if self.recipe.steps is not None:
            return min(self.steps / self.recipe.steps, 1.0)
        return min((time.process_time() - self.started) / self.recipe.seconds, 1.0)

    @one_thread()
    def run(self, data: Callable[[int], Walks], loss: Callable[[Walks, np.ndarray], torch.Tensor], seed: int) -> None:
        """Go through chunks of data."""
        chunk, batch = 0, self.recipe.batch
        while self.spent < 1:
            walks, order = data(chunk), np.random.default_rng([seed, chunk])
            n = len(walks.T)
            for _ in range(self.recipe.reuse if n else 0):
                shuffled = order.permutation(n)
                for k in range(max(n // batch, 1)):
                    self._step(loss(walks, shuffled[k * batch : (k + 1) * batch]))
                    if self.spent >= 1:
                        return
            chunk += 1

    def _step(self, loss: torch.Tensor) -> None:
        for group in self.adam.param_groups:
            decay = 0.02 + 0.98 * 0.5 * (1 + math.cos(math.pi * self.spent))
            group["lr"] = self.recipe.rate * min(1.0, (self.steps + 1) / 50) * decay
        self.adam.zero_grad(set_to_none=True)
        loss.backward()
        torch.nn.utils.clip_grad_norm_(self.parameters, 1.0)
        self.adam.step()
        self.steps += 1


def _weights(walks: Walks, rows: np.ndarray) -> torch.Tensor:
    """T of rows over the mean of all, mean over the channels that carry light."""
    mean = walks.total.mean(axis=0)
    live = mean > 0
    scaled = walks.T[rows][:, live] / mean[live]
    # a light leaves a few walks with very large values; the rest of them is noise to the fit
    return torch.from_numpy(np.minimum(scaled.mean(axis=1), 50.0).astype(np.float32))


def fit_patches(
    learnt: Learnt, recipe: FlowRecipe | None = None, *, light: Lighting | None = None, seed: int = 0
) -> PatchSampler:
    """Weights of the patches of a trained object by walks alone, or by walks times the light where they left.

    Args:
        learnt: the object.
        recipe: sizes and rates.
        light: that falls on the object; None fits to S itself.
        seed: of everything.
    """
    recipe, (model, sampler, _) = recipe or FlowRecipe(), learnt
    chart = Chart(model.subject, sampler.frame, sampler.patches)
    net = PatchLogits(n_side(len(model.subject.media)), sampler.patches.areas, recipe.patch_hidden, seed)
    schedule = Schedule(list(net.parameters()), recipe)

    def loss(walks: Walks, rows: np.ndarray) -> torch.Tensor:
        x, patch = torch.from_numpy(walks.exit[rows].T.copy()), torch.from_numpy(walks.patch[rows])
        return patch_likelihood(net(x), _weights(walks, rows), patch)

    schedule.run(_source(learnt, chart, recipe, light, seed), loss, seed)
    return PatchSampler(sampler.frame, sampler.patches, net.arrays())


def fit_flow(
    learnt: Learnt, recipe: FlowRecipe | None = None, *, light: Lighting | None = None, seed: int = 0
) -> FlowSampler:
    """A flow inside the patches of a trained object, by -E[T log p(u | exit, patch)].

    Args:
        learnt: the object, with its patches; their weights stay as they are.
        recipe, light, seed: as for `fit_patches`.
    """
    recipe, (model, sampler, _) = recipe or FlowRecipe(), learnt
    chart = Chart(model.subject, sampler.frame, sampler.patches)
    net = FlowNetwork(2, N_CONTEXT, recipe.hidden, seed)
    schedule = Schedule(list(net.parameters()), recipe)

    def loss(walks: Walks, rows: np.ndarray) -> torch.Tensor:
        told, u = torch.from_numpy(walks.told[rows]), torch.from_numpy(walks.u[rows, :2])
        return -(_weights(walks, rows) * net.log_density(told, u)).mean()

    schedule.run(_source(learnt, chart, recipe, light, seed), loss, seed)
    return FlowSampler(sampler, chart, ConditionalFlow(2, net.arrays()))


def _source(
    learnt: Learnt, chart: Chart, recipe: FlowRecipe, light: Lighting | None, seed: int
) -> Callable[[int], Walks]:
    subject, sampler = learnt.model.subject, learnt.sampler
    return lambda k: flow_walks(subject, sampler.frame, sampler.patches, chart, recipe.chunk, (seed, 61, k), light)
