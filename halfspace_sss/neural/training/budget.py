"""Training until a budget is spent: of time, for networks that share a deadline, or of samples."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import torch

from halfspace_sss.checks import check_count, check_interval
from halfspace_sss.neural.training.fit import BETAS, CLIP, LAST_RATE, Fit
from halfspace_sss.neural.training.pool import MapPool

__all__ = ["Budget", "Samples", "Seconds", "Spent", "train_within"]

WARM_UP = 0.02  # of the budget; the rate rises over it, and then falls by a cosine


class Spent(NamedTuple):
    """Steps of the optimiser, samples (cells seen, of which each shows two points) and seconds of a training."""

    steps: int
    samples: int
    seconds: float


class Budget(Protocol):
    """What a training may spend; its text is the name it has in tables."""

    def share(self, spent: Spent) -> float:
        """The part of it that is spent, 1 or more once nothing is left."""


@dataclass(frozen=True)
class Seconds:
    """Wall-clock time.

    Args:
        seconds: of each training.

    Raises:
        ValueError: it is not in [0.01, 1e6].
    """

    seconds: float

    def __post_init__(self) -> None:
        check_interval("seconds", self.seconds, 0.01, 1e6)

    def __str__(self) -> str:
        return f"{self.seconds:g} s"

    def share(self, spent: Spent) -> float:
        return spent.seconds / self.seconds


@dataclass(frozen=True)
class Samples:
    """Data seen.

    Args:
        samples: of each training, which its last batch fills up.

    Raises:
        ValueError: it is not a whole number >= 1.
    """

    samples: int

    def __post_init__(self) -> None:
        check_count("samples", self.samples, 1)

    def __str__(self) -> str:
        return f"{self.samples:,} samples"

    def share(self, spent: Spent) -> float:
        return spent.samples / self.samples


def train_within(budget: Budget, learner: Any, pool: MapPool, how: Fit, seed: int) -> Spent:
    """Fit in place as `fit` does, with the share of a budget in the place of the share of steps.

    Args:
        budget: when to stop; the rate falls as it is spent.
        learner: a torch module with `loss`.
        pool: maps to draw batches from.
        how: batches and largest rate; its number of steps does not count.
        seed: of the batches, which are the same for every learner.
    """
    parameters = list(learner.parameters())
    adam = torch.optim.Adam(parameters, lr=how.rate, betas=BETAS)
    generator = torch.Generator().manual_seed(seed)
    spent, started = Spent(0, 0, 0.0), time.monotonic()
    while (share := budget.share(spent)) < 1:
        decay = LAST_RATE + (1 - LAST_RATE) * 0.5 * (1 + math.cos(math.pi * share))
        adam.param_groups[0]["lr"] = how.rate * max(min(1.0, share / WARM_UP), 0.01) * decay
        adam.zero_grad(set_to_none=True)
        learner.loss(pool.batch(how.n_groups, how.n_queries, generator)).backward()
        torch.nn.utils.clip_grad_norm_(parameters, CLIP)
        adam.step()
        steps = spent.steps + 1
        spent = Spent(steps, steps * how.n_groups * how.n_queries, time.monotonic() - started)
    return spent
