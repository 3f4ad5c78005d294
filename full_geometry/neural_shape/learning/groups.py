"""Exits of one object in groups of those that look alike, whose light a fit holds to that of walks.

The likelihood of pairs cares little for what leaves in sum: where things are thick, most of what f brings is a choice
between entries, and the sum over them is off by some percent. So for a group of exits, B the mean throughput of its
walks, Z and Z' the means of (S_0 mu_i / q) exp f of two halves of its proposals, whose product has no bias,

    w (Z/B - 1)(Z'/B - 1)/2,    w = 4/(1 + v/0.03),

stands beside the likelihood, v the squared noise of Z/B.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from full_geometry.neural_shape.descriptors import ALONE
from full_geometry.neural_shape.learning.source import PairData

__all__ = ["GROUPS", "Grouped", "Part", "grouped"]

HALVINGS = 4
GROUPS = 2**HALVINGS
AXIS_FROM = 512  # exits
EMPHASIS = 4.0  # 16 is better for what is thick and worse for what is not
NOISE, PAIRS = 0.03, 64  # squared, of the mean of so many proposals
LEAST_LIGHT, FEWEST_PROPOSALS, FEWEST_WALKS = 1e-3, 128, 32


class Part(NamedTuple):
    """Some pairs of one group.

    Args:
        walks, proposals: descriptors (pairs, numbers).
        T: of walks, so that their sum is a sample of the mean over the whole object.
        W: of proposals.
        medium: its numbers.
        share: of the mean of W in the mean over the whole object.
        light: B of the group.
        weight: w.
    """

    walks: np.ndarray
    T: np.ndarray
    proposals: np.ndarray
    W: np.ndarray
    medium: np.ndarray
    share: float
    light: float
    weight: float


@dataclass(frozen=True, eq=False)
class Grouped:
    """Data in the order of groups.

    Args:
        data: of an object.
        proposals, walks: where groups begin and end among them, (GROUPS + 1,).
        share: of the exits that a group has, (GROUPS,).
        light: B over the mean of all walks, (GROUPS,).
        weight: w, (GROUPS,); 0 where too little is known.
    """

    data: PairData
    proposals: np.ndarray
    walks: np.ndarray
    share: np.ndarray
    light: np.ndarray
    weight: np.ndarray

    def part(self, n: int, rng: np.random.Generator) -> Part:
        """n walks and proposals, or all there are, of a random group."""
        data, u = self.data, rng.random(3)
        k = int(u[0] * GROUPS)
        i, j = _some(self.proposals, k, n, u[1]), _some(self.walks, k, n, u[2], repeated=False)
        among = data.share * (self.walks[k + 1] - self.walks[k]) / len(data.T)
        T = data.T[j] * (among * GROUPS / max(len(j), 1))
        numbers = float(self.share[k] * GROUPS), float(self.light[k]), float(self.weight[k])
        return Part(data.walks[j], T, data.proposals[i], data.W[i], data.medium, *numbers)


def grouped(data: PairData) -> Grouped:
    """The data of an object in 16 groups of exits, halved four times at the median of their first principal axis."""
    exits = [v[:, ALONE].astype(np.float32) for v in (data.proposals, data.walks)]
    mean, spread = exits[0].mean(axis=0), exits[0].std(axis=0) + 1e-6
    labels = [np.zeros(len(v), np.int16) for v in exits]
    _halve([(v - mean) / spread for v in exits], labels, [np.arange(len(v)) for v in exits], HALVINGS, 0)
    (i, j), counts = (
        [np.argsort(v, kind="stable") for v in labels],
        [np.bincount(v, minlength=GROUPS) for v in labels],
    )
    data = replace(data, proposals=data.proposals[i], W=data.W[i], walks=data.walks[j], T=data.T[j])
    bounds = [np.concatenate([[0], np.cumsum(v)]) for v in counts]
    share = counts[0] / len(data.W)
    W, T = (_moments(v, at) for v, at in zip((data.W, data.T), bounds))
    light = T[0] * counts[1] * data.share / len(data.T) / np.maximum(share, 1e-9)
    known = (light > LEAST_LIGHT) & (counts[0] >= FEWEST_PROPOSALS) & (counts[1] >= FEWEST_WALKS)
    noise = W[1] / PAIRS + (1 + T[1]) / np.maximum(counts[1], 1)
    weight = np.where(known, EMPHASIS / (1 + noise / NOISE), 0.0)
    return Grouped(data, *bounds, share, np.where(known, light, 1.0), weight)


def _halve(exits: list[np.ndarray], labels: list[np.ndarray], kept: list[np.ndarray], times: int, first: int) -> None:
    """Label the kept rows of proposals and walks, the axis and the median those of proposals."""
    if times == 0:
        for label, k in zip(labels, kept):
            label[k] = first
        return
    own = exits[0][kept[0]]
    axis = np.linalg.eigh(np.cov(own[:AXIS_FROM].T))[1][:, -1] if len(own) > 1 else np.ones(len(ALONE))
    along = [v[k] @ axis for v, k in zip(exits, kept)]
    middle = float(np.median(along[0])) if len(own) else math.inf
    lower, upper = ([k[side] for k, side in zip(kept, sides)]
                    for sides in ([v <= middle for v in along], [v > middle for v in along]))  # fmt: skip
    _halve(exits, labels, lower, times - 1, first)
    _halve(exits, labels, upper, times - 1, first + 2 ** (times - 1))


def _moments(values: np.ndarray, bounds: np.ndarray) -> np.ndarray:
    """Mean, and variance over its square, of each group, (2, GROUPS); 0 of what is empty."""
    parts = [values[a:b].astype(float) for a, b in zip(bounds, bounds[1:])]
    means, variances = (np.array([float(f(v)) if len(v) else 0.0 for v in parts]) for f in (np.mean, np.var))
    return np.stack([means, variances / np.maximum(means, 1e-6) ** 2])


def _some(bounds: np.ndarray, k: int, n: int, u: float, repeated: bool = True) -> np.ndarray:
    """n neighbours of group k from a random one on, in a circle; of fewer than n none twice unless it is allowed."""
    first, count = int(bounds[k]), int(bounds[k + 1] - bounds[k])
    if count == 0:
        return np.zeros(0, int)
    return first + (int(u * count) + np.arange(n if repeated else min(n, count))) % count
