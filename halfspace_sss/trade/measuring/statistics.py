"""Errors of radiance over exits from noisy estimates, without the bias that noise has in a square.

With estimates a of a way and b of walks at n exits and C channels, and their variances,

    bias² = Σ_k,c [(a - b)² - var a - var b] / (n C),  over (mean b)²,

whose mean over all samples is the true one; standard errors are those of the jackknife over exits.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

__all__ = ["Estimate", "Number", "mean_square", "ratio_of_means", "relative_variance"]


class Number(NamedTuple):
    """A value and its standard error."""

    value: float
    error: float


class Estimate:
    """Radiance of exits from sums over samples: (channels, n)."""

    def __init__(self, channels: int, n: int) -> None:
        self.first, self.second, self.samples = np.zeros((channels, n)), np.zeros((channels, n)), 0

    def add(self, first: np.ndarray, second: np.ndarray, samples: int) -> None:
        """Sums of values and of squares over further samples of each exit."""
        self.first += first
        self.second += second
        self.samples += samples

    @property
    def mean(self) -> np.ndarray:
        return self.first / max(self.samples, 1)

    @property
    def sample_variance(self) -> np.ndarray:
        """Of one sample."""
        n = self.samples
        return np.maximum(self.second / n - self.mean**2, 0) * (n / (n - 1))

    @property
    def variance(self) -> np.ndarray:
        """Of the mean."""
        return self.sample_variance / self.samples


def mean_square(a: Estimate, b: Estimate) -> Number:
    """Mean squared difference over the square of the mean radiance of b; may come out below 0 in noise."""
    square = ((a.mean - b.mean) ** 2 - a.variance - b.variance).mean(axis=0)
    return _ratio(square, b.mean.mean(axis=0), 2)


def relative_variance(a: Estimate, b: Estimate) -> Number:
    """Variance of one sample of a, mean over exits and channels, over the square of the mean radiance of b."""
    return _ratio(a.sample_variance.mean(axis=0), b.mean.mean(axis=0), 2)


def ratio_of_means(a: Estimate, b: Estimate, channel: int) -> Number:
    """Mean of a over that of b in a channel."""
    return _ratio(a.mean[channel], b.mean[channel], 1)


def _ratio(top: np.ndarray, bottom: np.ndarray, power: int) -> Number:
    """mean(top) / mean(bottom)^power with its standard error by the jackknife; nan where nothing shines."""
    n = len(top)
    if not bottom.mean() > 0:
        return Number(float("nan"), float("nan"))
    whole = top.mean() / bottom.mean() ** power
    tops, bottoms = (top.sum() - top) / (n - 1), (bottom.sum() - bottom) / (n - 1)
    parts = tops / np.maximum(bottoms, 1e-300) ** power
    return Number(float(whole), float(np.sqrt((n - 1) * np.mean((parts - parts.mean()) ** 2))))
