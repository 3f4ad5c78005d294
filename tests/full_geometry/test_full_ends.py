"""What is solved for beside the network of one object: quadratic functions of exit and entry."""

from __future__ import annotations

import numpy as np
import pytest

mi = pytest.importorskip("mitsuba")
torch = pytest.importorskip("torch")

from full_geometry.learning import network_fitting as ends  # noqa: E402
from full_geometry.learning.network_fitting import Ends  # noqa: E402
from full_geometry.transport.exit_pairs import AlbedoSamples, Pairs, shuffled  # noqa: E402
from full_geometry.transport.features import Quadratic, Terms, n_side  # noqa: E402

N = n_side(1)


def features(n: int, seed: int) -> np.ndarray:
    """Of pairs: what is not an octave depends on two numbers of each end, as that of a surface does."""
    rng = np.random.default_rng(seed)
    ends = [rng.standard_normal((N, 3)) @ rng.standard_normal((3, n)) / 2 for rng in (rng, rng)]
    return np.concatenate([np.tanh(end) for end in ends]).astype(np.float32)


def terms(x: np.ndarray) -> np.ndarray:
    """Of both ends, (products, columns)."""
    heads, rows, cols = Terms.of(N)
    sides = [np.concatenate([np.ones((1, x.shape[1])), end]) for end in np.split(x, 2)]
    return sum(side[heads][rows] * side[cols] for side in sides)


def solved(n: int, scale: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    """h that walks ask for and h that is found, of the first of two channels; the second has no light."""
    rng = np.random.default_rng(1)
    known, x = 0.005 * rng.standard_normal(len(Terms.of(N).rows)), features(n, 0)
    T = np.stack([np.exp(known @ terms(x)), np.zeros(n)]).astype(np.float32)
    V = np.stack([np.ones(n), np.zeros(n)]).astype(np.float32)
    sums = Ends(2, N, torch.device("cpu"))
    sums.add_walks(torch.from_numpy(x), torch.from_numpy(scale * T), n)
    sums.add_proposals(torch.from_numpy(x), torch.from_numpy(scale * V))
    found = sums.solved()
    assert np.all(found[1] == 0)
    return known @ terms(x), found[0] @ terms(x)


@pytest.mark.slow
def test_what_proposals_lack_of_walks_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ends, "RIDGE", 10.0)
    asked, found = solved(2**16)
    assert asked.std() > 0.03
    assert np.sqrt(np.mean((asked - found) ** 2)) < 0.15 * asked.std()


def test_what_few_walks_do_not_tell_is_left_as_it_is() -> None:
    asked, found = solved(2**12)
    assert found.std() < 0.5 * asked.std()


def test_a_feature_that_hardly_varies_has_bounded_coefficients(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ends, "RIDGE", 10.0)
    x, rng = features(2**12, 0), np.random.default_rng(2)
    x[[3, N + 3]] = 5e-7 * rng.standard_normal((2, x.shape[1]))
    sums = Ends(1, N, torch.device("cpu"))
    T = torch.from_numpy(rng.exponential(size=(1, x.shape[1])).astype(np.float32))
    sums.add_walks(torch.from_numpy(x), T, x.shape[1])
    sums.add_proposals(torch.from_numpy(x), torch.ones(1, x.shape[1]))
    assert np.abs(sums.solved()).max() < 20


def test_units_of_light_do_not_count() -> None:
    assert np.allclose(solved(2**13)[1], solved(2**13, scale=1e-6)[1], rtol=1e-3, atol=1e-4)


def test_nothing_is_added_before_proposals_are_seen() -> None:
    sums = Ends(3, N, torch.device("cpu"))
    sums.add_walks(torch.from_numpy(features(64, 2)), torch.ones(3, 64), 64)
    assert not sums.solved().any()


def test_renders_evaluate_what_was_solved_for() -> None:
    mi.set_variant("llvm_ad_rgb")
    rng, x = np.random.default_rng(3), features(512, 4)
    numbers = rng.standard_normal((3, len(Terms.of(N).rows)))
    columns = [[mi.Float(row) for row in end] for end in np.split(x, 2)]
    ends = [np.array([v.numpy() for v in Quadratic(numbers, N)(side)]) for side in columns]
    wanted = numbers @ terms(x)
    assert np.allclose(sum(ends), wanted, atol=1e-4 * np.abs(wanted).max())


def test_of_several_sources_only_random_exits_are_solved_by() -> None:
    def pairs(n: int, value: float) -> Pairs:
        even = AlbedoSamples(np.zeros((N, n), np.float32), np.zeros((2, n), np.float32))
        return Pairs(np.full((2 * N, n), value, np.float32), np.full((1, n), value, np.float32), 3 * n, None, even)

    both = shuffled([pairs(30, 1.0), pairs(20, 2.0)], np.random.default_rng(5))
    x, T, drawn = both.of_random_exits(both.features, both.values)
    assert both.drawn == 150 and drawn == 60
    assert x.shape == (2 * N, 20) and np.all(x == 2.0) and np.all(T == 2.0)
    alone = pairs(4, 1.0)
    assert alone.of_random_exits(alone.features, alone.values)[2] == 12
