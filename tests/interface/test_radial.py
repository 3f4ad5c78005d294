"""Distances of points of entry: how they are distributed, where their table ends, which uniform numbers are taken."""

from __future__ import annotations

import numpy as np
import pytest

from halfspace_sss import Medium, bssrdf
from halfspace_sss.arrays import library
from halfspace_sss.interface.model import TAIL_MASS, RadialSampler

LIB = library(0.0)


def exponential(r, *directions):
    return np.exp(-np.broadcast_arrays(r, *directions)[0])


def test_distances_are_distributed_as_light_is() -> None:
    """∫ r e^(-r) dr up to r is 1 - (1 + r) e^(-r); what the tail of the table takes is missing."""
    u = (np.arange(4096) + 0.5) / 4096
    r = RadialSampler(exponential).sample(LIB, u)
    np.testing.assert_allclose((1 - (1 + r) * np.exp(-r)) * (1 - TAIL_MASS), u, atol=TAIL_MASS + 3e-4)


def test_the_table_ends_where_next_to_no_light_comes() -> None:
    """r² e^(-r) is 1e-7 of its maximum at r = 22.9."""
    assert 21.5 < RadialSampler(exponential).r_max < 24.5


def test_uniform_numbers_may_be_a_pair_or_lie_on_a_last_axis() -> None:
    model, u = bssrdf("standard_dipole", Medium(1.0, 0.1)), np.random.default_rng(1).random((16, 2))
    for a, b in zip(model.sample_position(0.8, u), model.sample_position(0.8, (u[:, 0], u[:, 1]))):
        np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize(
    ("u", "message"),
    [
        (np.zeros((2, 3)), r"u must have a last axis of length 2, got shape \(2, 3\)"),
        ((0.1, 0.2, 0.3), "u must be a pair of arrays, got 3 of them"),
    ],
)
def test_other_numbers_of_uniform_numbers_are_refused(u, message) -> None:
    with pytest.raises(ValueError, match=message):
        bssrdf("standard_dipole", Medium(1.0, 0.1)).sample_position(0.8, u)
