"""What a training may spend: time, or data."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

from halfspace_sss.checks import check_count, check_interval
from halfspace_sss.neural.training.fit import Fit, Spent, cosine

WARM_UP_SHARE = 0.02


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
