"""How walks are shared out, and what is told of independent samples."""

from __future__ import annotations

import numpy as np
import pytest

from halfspace_sss import Medium
from halfspace_sss.tracing import walk
from halfspace_sss.tracing.passes import BATCHES, MAX_LANES, PATHS_PER_LANE, Estimate, estimate, launch_shape
from halfspace_sss.tracing.tracer import trace


@pytest.mark.parametrize("n_paths", [256, 1000, 16_384, 32_769, 10**6, 8_388_609, 10**9])
def test_walks_are_as_many_as_asked_for_in_whole_batches_and_no_pass_is_idle(n_paths: int) -> None:
    lanes, per_lane, passes = launch_shape(n_paths)
    assert lanes % BATCHES == 0 and lanes <= MAX_LANES and 1 <= per_lane <= PATHS_PER_LANE
    assert (passes - 1) * lanes * per_lane < n_paths <= passes * lanes * per_lane
    assert passes == 1 or lanes == MAX_LANES


def test_an_estimate_is_the_mean_and_the_error_of_the_mean() -> None:
    assert estimate(np.array([1.0, 2.0, 6.0])) == pytest.approx((3.0, np.sqrt(7 / 3)))
    columns = estimate(np.array([[1.0, 0.0], [2.0, 4.0], [6.0, 8.0]]))
    np.testing.assert_allclose(columns.value, [3.0, 4.0])
    np.testing.assert_allclose(columns.standard_error, np.sqrt([7 / 3, 16 / 3]))


def test_arithmetic_of_estimates_carries_the_errors_of_independent_numbers() -> None:
    rng = np.random.default_rng(4)
    a, b = Estimate(3.0, 0.02), Estimate(np.array([2.0, 5.0]), np.array([0.03, 0.01]))
    x = a.value + a.standard_error * rng.normal(size=(200_000, 1))
    y = b.value + b.standard_error * rng.normal(size=(200_000, 2))
    cases = ((a + b, x + y), (a - b, x - y), (a * b, x * y), (a / b, x / y), (2 * a - 1, 2 * x - 1), (1 / b, 1 / y),
             (1 - np.array([1.0, 2.0]) * b, 1 - np.array([1.0, 2.0]) * y), (sum([a, b]), x + y))  # fmt: skip
    for found, spread in cases:
        np.testing.assert_allclose(found.value, spread.mean(axis=0), rtol=1e-3, atol=1e-3)
        np.testing.assert_allclose(found.standard_error, spread.std(axis=0), rtol=0.01)


@pytest.mark.parametrize("turns", [1, 7])
def test_launches_of_other_lengths_trace_the_same_walks(turns: int, monkeypatch: pytest.MonkeyPatch) -> None:
    medium = Medium.from_albedo(0.9, 1.0, 0.5, 1.4)
    how = {"mu_i": 0.7, "n_paths": 2**15, "seed": 3, "radii": [0.0, 1.0, 2.0], "directions": [(1.0, 0.0)]}
    whole = trace(medium, **how)
    monkeypatch.setattr(walk, "FIRST_TURNS", turns)
    monkeypatch.setattr(walk, "FEWEST_TURNS", turns)
    monkeypatch.setattr(walk, "LAUNCH_SECONDS", 0.0)
    parts = trace(medium, **how)
    np.testing.assert_array_equal(parts._lanes, whole._lanes)
    assert parts.exitance()[0].tolist() == whole.exitance()[0].tolist()
    assert parts.n_events == whole.n_events
