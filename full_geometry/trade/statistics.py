"""Errors of radiance over exits from noisy estimates, without the bias that noise has in a square.

With estimates a of a way and b of walks at n exits and C channels, and their variances,

    bias² = Σ_k,c [(a - b)² - var a - var b] / (n C),  over (mean b)²,

whose mean over all samples is the true one. Gathered light has noise of its own, which more samples do not take away:
two independent parts tell it (`mean_square`), with `kept` the share of the variance of a part that gathering with all
samples has. Standard errors are those of the jackknife over exits.

The brightest of 10⁴ samples are fireflies, such as lamps that are mirrored after a walk: one of them may carry a
hundredth of all light. Variances of a sample are without them, as no assessment can tell their share, and images are
rid of them by filters rather than by samples. In biases they count as much as the next brightest sample, and what they
carry beyond goes to all exits by their radiance: its mean is kept, where it belongs is not. The noise e of that mean,
which all exits share, is taken from bias² like other noise and adds sqrt(2) e² and 2 e bias to its standard error.
Fireflies may be most of the light of some exits and none of that of others: with m what an exit gained less what it
lost, g² = Σ_k,c (m² - var m) / (n C) over (mean b)² adds g² and 2 g bias.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

FIREFLIES = 1e-4  # share of samples, the brightest, that variances of a sample leave out


class Number(NamedTuple):
    """A value and its standard error."""

    value: float
    error: float


class RadianceEstimate:
    """Radiance of exits from sums over samples: (channels, n)."""

    def __init__(self, channels: int, n: int) -> None:
        self.first, self.second, self.samples = np.zeros((channels, n)), np.zeros((channels, n)), 0
        self.bright = [(np.zeros(0), np.zeros(0, dtype=int)) for _ in range(channels)]  # values, their exits

    def add(self, first: np.ndarray, second: np.ndarray, samples: int) -> None:
        """Sums of values and of squares over further samples of each exit."""
        self.first += first
        self.second += second
        self.samples += samples

    def add_bright(self, values: np.ndarray, each: int) -> None:
        """Keep the brightest samples of a launch, (channels, n each) with those of an exit next to each other."""
        keep = min(int(4 * FIREFLIES * values.shape[1]) + 8, values.shape[1])
        for c, row in enumerate(values):
            index = np.argpartition(row, -keep)[-keep:]
            self.bright[c] = tuple(np.concatenate(p) for p in zip(self.bright[c], (row[index], index // each)))

    def of_first(self, n: int) -> RadianceEstimate:
        result = RadianceEstimate(len(self.first), n)
        result.add(self.first[:, :n], self.second[:, :n], self.samples)
        result.bright = [(values[exits < n], exits[exits < n]) for values, exits in self.bright]
        return result

    @property
    def mean(self) -> np.ndarray:
        return self.first / max(self.samples, 1)

    @property
    def sample_variance(self) -> np.ndarray:
        n = self.samples
        return np.maximum(self.second / n - self.mean**2, 0) * (n / (n - 1))

    @property
    def steady_variance(self) -> np.ndarray:
        """The variance of one sample without fireflies."""
        channels, n = self.first.shape
        first, second, samples = self.first.copy(), self.second.copy(), np.full((channels, n), float(self.samples))
        for c in range(channels):
            values, exits, _ = self._fireflies(c)
            for table, lost in ((first, values), (second, values**2), (samples, 1.0)):
                np.subtract.at(table[c], exits, lost)
        samples = np.maximum(samples, 2)
        return np.maximum(second / samples - (first / samples) ** 2, 0) * (samples / (samples - 1))

    @property
    def variance(self) -> np.ndarray:
        """The variance of the mean."""
        return self.sample_variance / self.samples

    def _fireflies(self, channel: int) -> tuple[np.ndarray, np.ndarray, float]:
        """The brightest samples of a channel, the exits that they are of, and the next brightest sample."""
        values, exits = self.bright[channel]
        order = np.argsort(values)[::-1][: int(FIREFLIES * self.samples * self.first.shape[1]) + 1]
        if len(order) < 2:
            return values[:0], exits[:0], 0.0
        return values[order[:-1]], exits[order[:-1]], float(values[order[-1]])

    @property
    def limits(self) -> np.ndarray:
        """The brightest samples of each channel that are no fireflies; infinite where too few are known."""
        return np.array([self._fireflies(c)[2] or np.inf for c in range(len(self.first))])

    @property
    def doubt(self) -> float:
        """Standard error of the mean of `steady_variance`, as which samples are left out is chance: each counts as
        the square of the next brightest."""
        channels, n = self.first.shape
        squares = [limit**2 for _, _, limit in map(self._fireflies, range(channels))]
        return float(np.mean(squares) * np.sqrt(FIREFLIES / max(self.samples * n, 1)))

    @property
    def steady(self) -> SteadyMean:
        """The mean whose fireflies are shared by all exits."""
        channels, n = self.first.shape
        rest, mean = RadianceEstimate(channels, n), np.empty((channels, n))
        shared, moved = np.zeros(channels), np.zeros((channels, n))
        rest.add(self.first, self.second, self.samples)
        for c in range(channels):
            values, exits, limit = self._fireflies(c)
            np.subtract.at(rest.first[c], exits, values - limit)
            np.subtract.at(rest.second[c], exits, values**2 - limit**2)
            beyond, light = (values - limit) / max(self.samples, 1), max(self.mean[c].sum(), 1e-300)
            shared[c] = ((beyond / light) ** 2).sum()
            mean[c] = rest.mean[c] * self.first[c].sum() / max(rest.first[c].sum(), 1e-300)
            moved[c] = (mean[c] - self.mean[c]) ** 2
            np.subtract.at(moved[c], exits, beyond**2)
        return SteadyMean(mean, rest.variance, shared, moved)


class SteadyMean(NamedTuple):
    """Means of exits, (channels, n), with the variance of each alone, the relative variance of all, (channels,), and
    the squares of what sharing fireflies added to each, less their noise."""

    mean: np.ndarray
    variance: np.ndarray
    shared: np.ndarray
    moved: np.ndarray

    @property
    def noise(self) -> np.ndarray:
        """Variance of the mean at each exit."""
        return self.variance + self.shared[:, None] * self.mean**2

    @property
    def displacement(self) -> float:
        """Mean square of what sharing fireflies moved, one standard error above its estimate, over that of radiance."""
        found = _ratio(self.moved.mean(axis=0), self.mean.mean(axis=0), 2)
        return max(found.value + found.error, 0.0) if np.isfinite(found.error) else 0.0


def mean_square(parts: Sequence[RadianceEstimate], walks: Sequence[RadianceEstimate], kept: float = 0.0) -> Number:
    """Mean squared difference of one or two independent parts a from one or two independent parts b of walks,

        bias² = Σ_k,c [(a_1 - b_1)(a_2 - b_2) + (a_1 - b_2)(a_2 - b_1) + kept (a_1 - a_2)²] / (2 n C),

    over the square of the mean radiance of b. Products of independent parts have no noise: the variance of what is one
    part alone is taken off, and that of a_1 and a_2 off the last square. It may come out below 0.
    """
    found, known = [each.steady for each in parts], [each.steady for each in walks]
    (one, two), (b, c) = ((of[0], of[-1]) for of in (found, known))
    square = 0.5 * ((one.mean - b.mean) * (two.mean - c.mean) + (one.mean - c.mean) * (two.mean - b.mean))
    if len(parts) == 1:
        square -= one.noise
    if len(walks) == 1:
        square -= b.noise
    if len(parts) == 2:
        square += kept * _variance_between(one, two)
    mean = 0.5 * (b.mean + c.mean).mean(axis=0)
    return _with_shared(_ratio(square.mean(axis=0), mean, 2), *([] if len(parts) > len(walks) else [one]), *known)


def _variance_between(one: SteadyMean, two: SteadyMean) -> np.ndarray:
    """Variance of what two parts are made of beside their samples."""
    return 0.5 * ((one.mean - two.mean) ** 2 - one.noise - two.noise)


def _with_shared(found: Number, *noisy: SteadyMean) -> Number:
    """With the errors of noise that all exits share and of light that fireflies moved between them."""
    e2, g2 = (sum(values) for values in zip(*((float(each.shared.mean()), each.displacement) for each in noisy)))
    beside = 2 * e2**2 + g2**2 + 4 * max(found.value, 0.0) * (e2 + g2)
    return Number(found.value, float(np.sqrt(found.error**2 + beside)))


def mean_square_of(difference: RadianceEstimate, b: RadianceEstimate) -> Number:
    """Mean square of differences over the square of the mean radiance of b; may come out below 0 in noise."""
    square = (difference.mean**2 - difference.variance).mean(axis=0)
    return _ratio(square, b.mean.mean(axis=0), 2)


def noise_of_parts(parts: Sequence[RadianceEstimate], b: RadianceEstimate) -> Number:
    """Variance of what two parts are made of beside their samples, over the square of the mean radiance of b."""
    one, two = (part.steady for part in parts)
    found = _with_shared(_ratio(_variance_between(one, two).mean(axis=0), b.mean.mean(axis=0), 2), one, two)
    return Number(max(found.value, 0.0), found.error)


def with_prior(found: Number, error: float) -> Number:
    """With 0 ± `error` that was known before, by weights 1 / error²; alone where it is three of its errors off."""
    if not abs(found.value) < 3 * found.error:
        return found
    share = error**2 / (error**2 + found.error**2)
    return Number(share * found.value, found.error * share**0.5)


def joined(parts: Sequence[RadianceEstimate]) -> RadianceEstimate:
    """All samples of several estimates at the same exits."""
    result = RadianceEstimate(*parts[0].first.shape)
    for part in parts:
        result.add(part.first, part.second, part.samples)
        result.bright = [tuple(map(np.concatenate, zip(*both))) for both in zip(result.bright, part.bright)]
    return result


def relative_variance(a: RadianceEstimate, b: RadianceEstimate) -> Number:
    """Variance of one sample of a, mean over exits and channels, over the square of the mean radiance of b."""
    value, error = _ratio(a.steady_variance.mean(axis=0), b.mean.mean(axis=0), 2)
    return Number(value, float(np.hypot(error, a.doubt / b.mean.mean() ** 2)) if np.isfinite(error) else error)


def ratio_of_means(a: RadianceEstimate, b: RadianceEstimate, channel: int) -> Number:
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
