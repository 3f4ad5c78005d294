"""The light that leaves an object on the mean, by walks, to which S as a whole is held.

Where light is 1 from everywhere, the radiance of two events and more, over exits uniform over the area and by the
cosine, is the mean throughput B of walks. With <S> the mean of S mu_i over the density of entries of such exits,

    scale = (B/<S>)^w,    w = max(1 - sigma_t' c/1000, 0),

one number for a channel, c the mean chord: what is as good as flat stays the half-space. Seeds are fixed, so an object
has the same scale wherever it is asked.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from full_geometry.learning.exits import trace_exits
from full_geometry.learning.pairs import Proposals
from full_geometry.neural_shape.mixing import Mixed
from full_geometry.neural_shape.model import NeuralShape
from full_geometry.subject import Subject
from halfspace_sss.tracing.walk import generator, pass_seed

__all__ = ["held", "weight"]

SEED = 37
FLAT = 1000.0  # mean chord in transport mean free paths
WALKS, PAIRS = (2**15, 2**18), (2**17, 2**18)  # fewest, most: few pairs miss what is rare and bright
ENOUGH = 5e-3  # relative standard error
MOST_SCALE = 4.0


def held(model: NeuralShape) -> NeuralShape:
    """The same S with such scales that as much light leaves as by walks; of what is flat or does not scatter as it is.

    Args:
        model: of an object, any weights.
    """
    weights = np.array([weight(mixture) for mixture in model.half_space.mixtures])
    if not weights.any():
        return model
    proposals = Proposals(model.subject, model.half_space)
    B = _mean(lambda n, k: _walks(model.subject, n, k), *WALKS)
    S = _mean(lambda n, k: _pairs(model, proposals, n, k), *PAIRS)
    known = (B > 0) & (S > 0)
    ratio = np.clip(np.where(known, B, 1) / np.where(known, S, 1), 1 / MOST_SCALE, MOST_SCALE)
    return replace(model, scales=tuple((np.array(model.scales or 1.0) * ratio**weights).tolist()))


def weight(mixture: Mixed) -> float:
    """w of a channel; 0 where there is no scattering or no volume."""
    return max(1 - mixture.chord / FLAT, 0.0) if mixture.m_2 > 0 else 0.0


def _mean(sample: Callable[[int, int], np.ndarray], fewest: int, most: int) -> np.ndarray:
    """Mean of each channel of samples (channels, n), n doubled until it is known well enough."""
    found, k = sample(fewest, 0), 0
    while found.shape[1] < most and (_relative_error(found) > ENOUGH).any():
        k += 1
        found = np.concatenate([found, sample(found.shape[1], k)], axis=1)
    return found.mean(axis=1)


def _relative_error(found: np.ndarray) -> np.ndarray:
    return found.std(axis=1) / np.maximum(found.mean(axis=1), 1e-30) / np.sqrt(found.shape[1])


def _walks(subject: Subject, n: int, k: int) -> np.ndarray:
    """Throughputs of n walks."""
    import mitsuba as mi

    starts = subject.random_points(generator(mi, n, pass_seed(SEED, 0, k)))
    return _rows(trace_exits(subject, starts, (SEED, 1, k)).T)


def _pairs(model: NeuralShape, proposals: Proposals, n: int, k: int) -> np.ndarray:
    """S mu_i over the density of the entries of n random exits."""
    import drjit as dr
    import mitsuba as mi

    exits = model.subject.random_points(generator(mi, n, pass_seed(SEED, 2, k)))
    entries, over = proposals.sample(exits, generator(mi, n, pass_seed(SEED, 3, k)))
    dr.eval(exits, entries, over)
    return _rows(dr.select(over > 0, model.S(model.prepare(exits), entries) * over, 0))


def _rows(spectrum: object) -> np.ndarray:
    return np.array(spectrum, dtype=float).reshape(len(spectrum), -1)
