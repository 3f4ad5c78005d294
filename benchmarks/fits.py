"""Fits of studies: any module with its loss as a learner, for a stated CPU time."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass

import torch

from halfspace_sss.checks import check_count, check_interval
from halfspace_sss.neural.training.fit import Batch, Spent, cosine, warm_up

ADAM = (0.9, 0.999)  # the betas of Kingma and Ba 2015, which published networks are fitted with


@dataclass(frozen=True)
class CpuSchedule:
    """CPU seconds of this process, data included, or a number of steps where the end is to be the same every time.

    Args:
        seconds: of CPU time.
        steps: instead of them.
        rate: largest learning rate.
        warm_up: steps over which it rises.
        last: part of it at the end of a cosine; 1 for a rate that stays.

    Raises:
        ValueError: an argument is out of range.
    """

    seconds: float
    steps: int | None = None
    rate: float = 4e-3
    warm_up: int = 1
    last: float = 1.0

    per_step = 1
    checkpoint_every = math.inf
    validate_every = 1

    def __post_init__(self) -> None:
        check_interval("seconds", self.seconds, 1e-3, 1e6)
        check_interval("rate", self.rate, 1e-8, 1.0)
        check_count("steps", 1 if self.steps is None else self.steps, 1)

    def share(self, spent: Spent) -> float:
        return spent.cpu_seconds / self.seconds if self.steps is None else spent.steps / self.steps

    def rate_at(self, spent: Spent) -> float:
        return cosine(self.rate * warm_up(spent.steps, self.warm_up), self.share(spent), self.last)

    def done(self, spent: Spent) -> tuple[int, int]:
        if self.steps is not None:
            return spent.steps, self.steps
        return min(int(spent.cpu_seconds), int(self.seconds)), int(self.seconds)


@dataclass(frozen=True, eq=False)
class Objective:
    """A module as a learner, with its loss for a batch."""

    module: torch.nn.Module
    loss: Callable[[Batch], torch.Tensor]

    def parameters(self) -> Iterable[torch.nn.Parameter]:
        return self.module.parameters()
