"""Random numbers of paths: uniform, independent of each other and of other seeds, stratified over samples."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import chi2

mi = pytest.importorskip("mitsuba")

PIXELS, SPP, BINS = 4096, 16, 8


def numbers(seed: int, first: int = 0, spp: int = SPP) -> np.ndarray:
    """A single number, a pair and another single number, (4, pixels, samples)."""
    from full_geometry.geometry.sensors import path_numbers

    mi.set_variant("llvm_ad_rgb")
    sampler = path_numbers(seed, PIXELS, first, spp)
    one, pair, other = sampler.next_1d(), sampler.next_2d(), sampler.next_1d()
    return np.array([np.array(v, dtype=float).reshape(PIXELS, spp) for v in (one, pair.x, pair.y, other)])


def test_samples_are_stratified_in_each_number_and_each_pair() -> None:
    u = numbers(1)
    assert (np.sort(np.floor(SPP * u), axis=2) == np.arange(SPP)).all()
    for nx in (2, 4, 8):
        ny = SPP // nx
        cells = np.floor(nx * u[1]) * ny + np.floor(ny * u[2])
        assert (np.sort(cells, axis=1) == np.arange(SPP)).all()


def test_a_later_launch_takes_the_samples_that_follow() -> None:
    np.testing.assert_array_equal(np.concatenate([numbers(1, 0, 4), numbers(1, 4, 12)], axis=2), numbers(1))


def test_numbers_of_a_sample_are_independent_of_each_other_and_of_other_seeds() -> None:
    """Chi-square tests of all pairs of numbers of sample 5 over the pixels, of 63 degrees of freedom."""
    u = np.concatenate([numbers(1)[:, :, 5], numbers(2)[:, :, 5]])
    cell, expected = np.floor(BINS * u).astype(int), PIXELS / BINS**2
    pairs = [(a, b) for a in range(len(u)) for b in range(a)]
    counts = [np.bincount(cell[a] * BINS + cell[b], minlength=BINS**2) for a, b in pairs]
    largest = max(((n - expected) ** 2 / expected).sum() for n in counts)
    assert largest < chi2.isf(1e-4 / len(pairs), BINS**2 - 1)
