"""Walks and proposals that are kept by chance: sums are those of all, and a pair tells more.

Statistical tests have fixed seeds; a z-test fails at 4 standard errors (two-sided 6e-5).
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from halfspace_sss import Medium

mi = pytest.importorskip("mitsuba")
torch = pytest.importorskip("torch")

from full_geometry.learning.network_fitting import STANDARD, ObjectFit  # noqa: E402
from full_geometry.objects.objects import object_of  # noqa: E402
from full_geometry.transport.exit_pairs import (  # noqa: E402
    ENOUGH,
    AlbedoSamples,
    EntryProposals,
    Pairs,
    PairSource,
    trace_exits,  # noqa: E402
)
from full_geometry.transport.features import n_pair, n_side  # noqa: E402
from full_geometry.transport.one_object import HalfSpace  # noqa: E402
from full_geometry.transport.storing import frame_of  # noqa: E402
from halfspace_sss.tracing.walk import generator, pass_seed  # noqa: E402

pytestmark = pytest.mark.usefixtures("rgb")

N = 2**16
BUNNY = Path(__file__).parents[2] / "figures" / "assets" / "bunny.ply"
SHAPES = {"ball": {"type": "sphere", "radius": 3.0}, "bunny": {"type": "ply", "filename": str(BUNNY)}}
MEDIA = {
    "dark": Medium(np.array([0.9, 0.2, 0.1]), np.array([0.1, 1.8, 3.9]), 0.0, 1.3),
    "forward": Medium(np.array([0.99, 0.9, 0.6]), np.array([0.01, 0.1, 0.4]), 0.8, 1.0),
}


def source_of(shape: str, medium: str) -> PairSource:
    obj = object_of(mi.load_dict(SHAPES[shape]), MEDIA[medium])
    start = HalfSpace(obj, "better_dipole")
    return PairSource(obj, frame_of(obj), start, EntryProposals(obj, start))


def with_scale(source: PairSource, pairs: Pairs) -> PairSource:
    mean = pairs.values.sum(axis=1) / pairs.drawn
    return replace(source, scale=mi.Spectrum((1 / mean).tolist()))


def moments(pairs: Pairs) -> np.ndarray:
    """What is summed, (functions, pairs): 1, all of the pair, and the position and direction of both ends."""
    return np.concatenate([np.ones((1, pairs.features.shape[1])), pairs.features])


def noise(pairs: Pairs) -> np.ndarray:
    """E[v²] / E[v]² of the pairs that are there, per channel."""
    v = pairs.values
    return (v.astype(float) ** 2).mean(axis=1) / v.astype(float).mean(axis=1) ** 2


def check_sums(every: Pairs, kept: Pairs, p: np.ndarray) -> None:
    """Sums of values times functions over those kept are those over all; p are the chances of all."""
    g, h = moments(every), moments(kept)
    for v, w in zip(every.values.astype(float), kept.values.astype(float)):
        expected, found = g @ v / every.drawn, h @ w / kept.drawn
        live = v > 0
        spread = np.sqrt((g[:, live] ** 2) @ (v[live] ** 2 * (1 - p[live]) / p[live])) / every.drawn
        assert np.all(np.abs(found - expected) < 4 * spread + 1e-4 * np.abs(expected) + 1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("medium", MEDIA)
def test_walks_that_are_kept_by_chance_carry_the_light_of_all(shape: str, medium: str) -> None:
    source = source_of(shape, medium)
    starts = source.object.random_points(generator(mi, N, pass_seed(1)))
    exits = trace_exits(source.object, starts, (2,))
    every = source.ended(starts, exits, (3,))
    mean = every.values.sum(axis=1, keepdims=True) / every.drawn
    p = np.minimum((every.values / mean).mean(axis=0) / ENOUGH, 1)
    kept = with_scale(source, every).ended(starts, exits, (5,))
    assert kept.drawn == every.drawn and kept.values.shape[1] < every.values.shape[1] == len(p)
    check_sums(every, kept, p)


def test_of_walks_that_are_kept_dark_channels_have_half_the_noise() -> None:
    source = source_of("bunny", "dark")
    every = source.walks(N, (4,))
    kept = with_scale(source, every).walks(N, (4,))
    assert np.all(noise(kept) < noise(every) * [1, 0.75, 0.75])


@pytest.mark.slow
def test_proposals_that_are_used_have_the_sums_of_all_and_less_noise() -> None:
    source = source_of("bunny", "dark")
    walks, proposals = source.walks(N // 8, (5,)), source.proposed(N, (5,))
    n_in = len(proposals.features)
    fitting = ObjectFit(n_in, 3, source.object.media[0].eta, STANDARD, 0)
    assert n_in == 2 * n_side(3) + n_pair(3)
    fitting.set_scale(walks)
    fitting.use(walks, source.proposed(N // 8, (6,)), None, np.random.default_rng(0))  # f is no more 0
    y, W = (v.numpy() for v in fitting._worthy(proposals, np.random.default_rng(1)))
    with torch.no_grad():
        f = fitting.modules["S"](fitting.modules["alpha"].joined(torch.from_numpy(proposals.features))).numpy()
    value = (proposals.values * fitting.scale.numpy() * np.exp(f)).mean(axis=0)
    p = np.clip(value / (ENOUGH * value.mean()), 0.05, 1)
    used = Pairs(y, W, W.shape[1])
    assert 0.2 * N < W.shape[1] < 0.8 * N
    # the share that is kept, which the values are multiplied by, is known and has no spread of its own
    check_sums(proposals, used, p)
    assert np.all(noise(used) < noise(proposals))


def test_order_one_of_even_light_counts_as_a_part_of_all_light_and_more_orders_by_themselves() -> None:
    n, rng = n_side(2), np.random.default_rng(3)
    features = rng.random((2 * n + n_pair(2), 64), dtype=np.float32)
    T = np.repeat(np.array([[0.001], [0.3], [0.599], [0.1]], np.float32), 64, axis=1)
    fitting = ObjectFit(len(features), 2, 1.3, STANDARD, 0)
    fitting.set_scale(Pairs(features, np.ones((2, 64), np.float32), 64, None, AlbedoSamples(features[:n], T)))
    assert np.allclose(fitting.alpha_scale.numpy()[:, 0], [1 / 0.6, 1 / 0.4, 1 / 0.599, 1 / 0.1], rtol=1e-5)
