"""The walk itself: media that differ from lane to lane, and kernels that serve all media."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.stats import chi2

from halfspace_sss import Layers, Medium, trace
from halfspace_sss.backend import array_types
from halfspace_sss.maps.noisy_maps import CellGrid, draw_directions, trace_groups
from halfspace_sss.physics.fresnel import F_t, mu_internal
from halfspace_sss.tracing.passes import FluxTally
from halfspace_sss.tracing.walk import WalkConstants, generator, pass_seed, walk

MIXTURES = {
    "all differ": [(0.9, 0.0, 1.0), (0.8, 0.7, 1.4), (0.95, -0.4, 0.75), (0.7, 1e-4, 1.3)],
    "matched": [(0.9, 0.5, 1.0), (0.5, -0.2, 1.0)],
    "isotropic": [(0.9, 0.0, 1.3), (0.6, 0.0, 1.0)],
}
MU_I = 0.8


def lane_reflectances(media: list[tuple], lanes: int, per_lane: int) -> np.ndarray:
    """Total reflectance of each lane, media taking turns over the lanes; axes (group of lanes, medium)."""
    types = array_types()
    columns = np.tile(np.array(media), (lanes // len(media), 1))
    albedo, g, eta = columns.T
    mu = np.full(len(eta), MU_I)
    constants = WalkConstants.per_lane(types, albedo, g, eta)
    (sums,), _ = walk(types, constants, types.Float(mu_internal(mu, eta)), per_lane, pass_seed(5), [FluxTally(types)])
    R = sum(v.numpy().astype(np.float64) for v in sums) / per_lane * F_t(mu, eta)
    return R.reshape(-1, len(media))


@pytest.mark.parametrize("mixture", MIXTURES)
def test_lanes_with_media_of_their_own_reflect_like_each_medium_alone(mixture):
    media = MIXTURES[mixture]
    R = lane_reflectances(media, 16384, 32)
    value, error = R.mean(axis=0), R.std(axis=0, ddof=1) / math.sqrt(len(R))
    alone = [trace(Medium.from_albedo(a, 1.0, g, eta), MU_I, 200_000, 6).reflectance() for a, g, eta in media]
    z = (value - [a.value for a in alone]) / np.hypot(error, [a.standard_error for a in alone])
    assert np.all(np.abs(z) < 4) and np.all(error < 0.02 * value)


def test_one_medium_per_lane_gives_the_walks_of_that_medium():
    types, m = array_types(), Medium.from_albedo(0.8, 1.0, 0.3, 1.4)
    beam, seed = types.Float(np.full(256, 0.9)), pass_seed(7)
    lanes = WalkConstants.per_lane(types, *(np.full(256, v) for v in (0.8, 0.3, 1.4)))
    media = (m, WalkConstants.uniform(types, m), lanes)
    runs = [walk(types, c, beam, 8, seed, [FluxTally(types)])[0][0] for c in media]
    one, opaque, many = (np.stack([v.numpy() for v in run]) for run in runs)
    assert np.array_equal(one, opaque) and np.array_equal(one, many)


def test_another_medium_or_seed_compiles_no_other_kernel():
    import drjit as dr

    def compiled(medium: Medium, seed: int) -> int:
        dr.kernel_history_clear()
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
            trace(medium, 0.7, 1024, seed, directions=[(0.6, 0.1 * seed)], radii=[0.0, 1.0 + seed])
        return sum(not k["cache_hit"] for k in dr.kernel_history() if k["type"] == dr.KernelType.JIT)

    compiled(Medium(0.9, 0.1, 0.5, 1.3), 0)
    assert compiled(Medium(0.7, 0.2, -0.3, 1.5), 1) == compiled(Medium(2.0, 0.1, 0.9, 0.8), 2) == 0


def _maps() -> list[np.ndarray]:
    rng = np.random.default_rng(3)
    groups = draw_directions(np.array([0.9, 0.99]), np.array([0.2, 0.8]), np.array([1.0, 1.4]), rng)
    (launch,) = trace_groups(groups, CellGrid(8, 4), 1e6, (1,))
    return [launch.trace()]


def _reflected() -> list[np.ndarray]:
    run = trace(Medium.from_albedo(0.999, 1.0, 0.5, 1.4), 0.7, 4096, 1, radii=[0.0, 1.0, 9.0])
    return [*run.reflectance(), *run.exitance()]


def _reflected_by_layers() -> list[np.ndarray]:
    return [*trace(Layers([Medium(1.0, 0.0, 0.5, 1.4), Medium(1.0, 0.01)], [2.0]), 0.7, 4096, 1).reflectance()]


@pytest.mark.parametrize("traced", [_maps, _reflected, _reflected_by_layers])
def test_lanes_that_go_on_are_put_together_and_give_the_same_bits(monkeypatch, traced):
    import drjit as dr

    def widths() -> set[int]:
        return {k["size"] for k in dr.kernel_history() if k["type"] == dr.KernelType.JIT and k["size"] > 1}

    runs = []
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
        for seconds in (1e9, 0.0):
            monkeypatch.setattr("halfspace_sss.tracing.walk.LAUNCH_SECONDS", seconds)
            dr.kernel_history_clear()
            runs.append((traced(), widths()))
    (apart, wide), (together, narrow) = runs
    assert all(np.array_equal(a, b) for a, b in zip(apart, together))
    assert min(narrow - wide) < 64


def test_lanes_are_independent():
    """Over 400 seeds the mean of 16384 lanes spreads as that of independent numbers, at each draw (1e-4 in all)."""
    import drjit as dr

    types, lanes, draws = array_types(), 16384, 12
    spread = np.zeros(draws)
    for seed in range(400):
        random = generator(types, lanes, pass_seed(seed, 1))
        u = [random.next_float32() for _ in range(draws)]
        dr.eval(u)
        spread += [12 * lanes * (v.numpy().mean(dtype=np.float64) - 0.5) ** 2 for v in u]
    assert np.all(spread > chi2.ppf(5e-5 / draws, 400)) and np.all(spread < chi2.isf(5e-5 / draws, 400))


@pytest.mark.parametrize(
    ("parameter", "value", "bound"),
    [
        ("albedo", 1.5, r"\[0, 1\]"),
        ("albedo", math.nan, r"\[0, 1\]"),
        ("g", -1.0, r"\(-1, 1\)"),
        ("eta", 0.0, r"in \[0.01, 100\]"),
        ("eta", math.inf, r"in \[0.01, 100\]"),
    ],
)
def test_media_out_of_range_are_refused_with_name_bound_and_value(parameter, value, bound):
    columns = {"albedo": np.full(4, 0.5), "g": np.zeros(4), "eta": np.ones(4)}
    columns[parameter][2] = value
    with pytest.raises(ValueError, match=f"{parameter} must be.*{bound}, got {value}"):
        WalkConstants.per_lane(array_types(), **columns)


def test_lanes_of_another_number_are_refused():
    types = array_types()
    with pytest.raises(ValueError, match=r"one shape \(lanes,\), got \(4,\), \(3,\), \(4,\)"):
        WalkConstants.per_lane(types, np.ones(4), np.zeros(3), np.ones(4))
    constants = WalkConstants.per_lane(types, np.ones(4), np.zeros(4), np.ones(4))
    with pytest.raises(ValueError, match="medium must have one value or 8.*got 4"):
        walk(types, constants, types.Float(np.ones(8)), 1, (0, 0), [])
