"""How long a learner is fitted, and at which rate: for a number of steps, or until a budget is spent."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple, Protocol

from halfspace_sss.checks import check_count, check_interval

__all__ = ["Budget", "Fit", "Samples", "Schedule", "Seconds", "Spent", "CpuSchedule", "Within", "cosine", "warm_up"]

LAST_RATE = 0.002  # of the largest
WARM_UP_STEPS, WARM_UP_SHARE = 200, 0.02  # of a number of steps, of a budget


def warm_up(steps: int, over: int = WARM_UP_STEPS) -> float:
    """What the rate is multiplied by after some steps: it rises evenly over the first ones."""
    return min(1.0, (steps + 1) / over)


def cosine(rate: float, share: float, last: float = LAST_RATE) -> float:
    """A rate that falls by a cosine to a part `last` of it, when a share of the fit is done."""
    return rate * (last + (1 - last) * 0.5 * (1 + math.cos(math.pi * min(share, 1.0))))


class Spent(NamedTuple):
    """Steps of the optimiser, samples (cells seen, of which each shows two points), seconds and CPU seconds."""

    steps: int
    samples: int
    seconds: float
    cpu_seconds: float


class Schedule(Protocol):
    """When a fit ends, and the learning rate until then."""

    per_step: int  # samples
    checkpoint_every: float
    validate_every: int

    def share(self, spent: Spent) -> float:
        """The part of the fit that is done, 1 or more at its end."""

    def rate_at(self, spent: Spent) -> float:
        """Learning rate of the next step."""

    def done(self, spent: Spent) -> tuple[int, int]:
        """What is done, and what there is to do."""


@dataclass(frozen=True)
class Fit:
    """A number of steps.

    Args:
        steps: of the optimiser, each on one batch.
        n_groups, n_queries: groups of a batch, and cells of each group, of which two points are asked.
        rate: largest learning rate; it rises over the first 200 steps and falls by a cosine.
        checkpoint_every: seconds between checkpoints.
        validate_every: steps between two calls of the validation.
    """

    steps: int
    n_groups: int = 32
    n_queries: int = 128
    rate: float = 4e-3
    checkpoint_every: float = 20.0
    validate_every: int = 2000

    def __post_init__(self) -> None:
        for name in ("steps", "n_groups", "n_queries", "validate_every"):
            check_count(name, getattr(self, name), 1)
        check_interval("rate", self.rate, 1e-8, 1.0)
        check_interval("checkpoint_every", self.checkpoint_every, 0.0, 1e9)

    @property
    def per_step(self) -> int:
        return self.n_groups * self.n_queries

    def share(self, spent: Spent) -> float:
        return spent.steps / self.steps

    def rate_at(self, spent: Spent) -> float:
        return cosine(self.rate * warm_up(spent.steps), self.share(spent))

    def done(self, spent: Spent) -> tuple[int, int]:
        return spent.steps, self.steps


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


@dataclass(frozen=True)
class Within:
    """As much as a budget allows; the rate rises over the first 2 % of it and falls by a cosine.

    Args:
        budget: when to stop.
        how: batches and largest rate; its number of steps does not count.
    """

    budget: Budget
    how: Fit

    checkpoint_every = math.inf
    validate_every = 1

    @property
    def per_step(self) -> int:
        return self.how.per_step

    def share(self, spent: Spent) -> float:
        return self.budget.share(spent)

    def rate_at(self, spent: Spent) -> float:
        share = self.share(spent)
        return cosine(self.how.rate * max(min(1.0, share / WARM_UP_SHARE), 0.01), share)

    def done(self, spent: Spent) -> tuple[int, int]:
        return round(100 * self.share(spent)), 100


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
