"""The flow inside patches: its chart, round trips, densities, and that they are those of zuko.

Chi-square tests fail at 1e-3, with fixed seeds.
"""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

mi = pytest.importorskip("mitsuba")
dr = pytest.importorskip("drjit")
torch = pytest.importorskip("torch")
pytest.importorskip("zuko")

from waxen import random_patches, wax_bunny  # noqa: E402

from benchmarks.flow import (  # noqa: E402  # noqa: E402  # noqa: E402
    N_CONTEXT,
    Chart,
    ConditionalFlow,  # noqa: E402
    FlowProposals,
    FlowSampler,
    direction_square,
)
from benchmarks.flow_training import FlowNetwork  # noqa: E402
from full_geometry.geometry.points import SurfacePoint  # noqa: E402
from full_geometry.transport.features import (  # noqa: E402
    PreparedExit,
    Side,
    first_event,  # noqa: E402
)
from full_geometry.transport.patches import LearntProposals, PatchTable, mesh_faces  # noqa: E402
from halfspace_sss.tracing.walk import generator, pass_seed  # noqa: E402

pytestmark = pytest.mark.usefixtures("rgb")

N_PATCHES = 24


@pytest.fixture(scope="module")
def sampler() -> FlowSampler:
    """With random weights: densities hold for any."""
    obj = wax_bunny()
    points = random_patches(obj, N_PATCHES, np.random.default_rng(2))
    flow = ConditionalFlow(2, shaken(2).arrays())
    return FlowSampler(points, Chart(obj, points.frame, points.patches), flow)


def shaken(n: int, strength: float = 2.0) -> FlowNetwork:
    """A flow far from the uniform one that it starts as."""
    net, numbers = FlowNetwork(n, N_CONTEXT, (16, 16), 1), torch.Generator().manual_seed(3)
    with torch.no_grad():
        layer = net.transform.hyper[-1]
        layer.weight.copy_(strength * torch.randn(layer.weight.shape, generator=numbers))
        layer.bias.copy_(torch.randn(layer.bias.shape, generator=numbers))
    return net


def uniform(n: int, d: int, seed: int) -> np.ndarray:
    return np.random.default_rng(seed).random((d, n)).astype(np.float32)


def told(n: int, seed: int = 0, same: bool = False) -> np.ndarray:
    rows = np.random.default_rng(seed).standard_normal((N_CONTEXT, 1 if same else n))
    return np.broadcast_to(0.5 * rows, (N_CONTEXT, n)).astype(np.float32)


def floats(rows: np.ndarray) -> list:
    return [mi.Float(np.ascontiguousarray(row)) for row in rows]


@pytest.mark.parametrize("d", [2, 4])
def test_densities_are_those_of_zuko(d: int) -> None:
    net, x, c = shaken(d), uniform(4096, d, 5), told(4096)
    with torch.no_grad():
        wanted = net.log_density(torch.from_numpy(c.T.copy()), torch.from_numpy(x.T.copy())).exp().numpy()
    found = np.array(ConditionalFlow(d, net.arrays()).density(floats(c), floats(x)))
    assert np.allclose(found, wanted, rtol=2e-3)
    assert wanted.max() > 3 and wanted.min() < 0.3  # far from uniform


@pytest.mark.parametrize("d", [2, 4])
def test_the_density_of_a_sample_is_the_one_that_it_came_with(d: int) -> None:
    flow, c, u = ConditionalFlow(d, shaken(d, 6.0).arrays()), floats(told(2**15)), uniform(2**15, d, 7)
    x, density = flow.sample(c, floats(u))
    ratio = np.array(flow.density(c, x)) / np.array(density)
    assert np.quantile(np.abs(ratio - 1), 0.999) < 1e-2


def test_samples_of_a_flow_follow_its_density() -> None:
    flow, n, m = ConditionalFlow(2, shaken(2).arrays()), 2**17, 16
    x, _ = flow.sample(floats(told(n, same=True)), floats(uniform(n, 2, 8)))
    counts, _, _ = np.histogram2d(*(np.array(v) for v in x), bins=m, range=[[0, 1], [0, 1]])
    fine = (np.indices((8 * m, 8 * m)).reshape(2, -1) + 0.5) / (8 * m)
    density = np.array(flow.density(floats(told(fine.shape[1], same=True)), floats(fine.astype(np.float32))))
    expected = n * density.reshape(m, 8, m, 8).mean(axis=(1, 3)) / m**2
    assert abs(density.mean() - 1) < 1e-2
    chi2 = np.sum((counts - expected) ** 2 / expected)
    assert stats.chi2.sf(chi2 * expected.sum() / n, m * m - 1) > 1e-3


def test_no_slope_leaves_its_bounds() -> None:
    density = np.array(
        ConditionalFlow(2, shaken(2, 1e4).arrays()).density(floats(told(4096)), floats(uniform(4096, 2, 9)))
    )
    assert np.isfinite(density).all() and density.min() > 0


def test_coordinates_of_a_patch_come_back(sampler: FlowSampler) -> None:
    n = 2**15
    patch = dr.arange(mi.UInt32, n) % N_PATCHES
    u = uniform(n, 2, 10)
    at = sampler.chart.point(patch, tuple(floats(u)))
    assert np.array_equal(np.array(sampler.patches.patches.row("patch", at.prim_index)), np.array(patch))
    back = np.stack([np.array(v) for v in sampler.chart.coordinates(at.prim_index, at.p)])
    assert np.quantile(np.abs(back - u).max(axis=0), 0.999) < 2e-3


def test_uniform_coordinates_are_uniform_over_a_patch(sampler: FlowSampler) -> None:
    n, k = 2**17, 5
    at = sampler.chart.point(mi.UInt32(k), tuple(floats(uniform(n, 2, 11))))
    faces = np.flatnonzero(sampler.patches.patches.of_face == k)
    areas = mesh_faces(sampler.chart.object)[2][faces]
    counts = np.bincount(np.array(at.prim_index), minlength=len(sampler.patches.patches.of_face))
    assert counts.sum() == counts[faces].sum()
    expected = n * areas / areas.sum()
    assert stats.chi2.sf(np.sum((counts[faces] - expected) ** 2 / expected), len(faces) - 1) > 1e-3


def draws(sampler: FlowSampler, n: int) -> tuple:
    obj = sampler.chart.object
    at = obj.random_points(generator(mi, 1, pass_seed(4))).gather(dr.zeros(mi.UInt32, n))
    side = Side(at, first_event(obj, at))
    weights = sampler.patches.prepare(side)
    u = floats(uniform(n, 3, 12))
    return side, weights, *sampler.sample(side, weights, u[0], (u[1], u[2]))


def test_the_density_of_an_entry_can_be_asked_for(sampler: FlowSampler) -> None:
    side, weights, at, density = draws(sampler, 2**14)
    again = np.array(sampler.density(side, weights, at.prim_index, at.p))
    assert np.quantile(np.abs(again / np.array(density) - 1), 0.99) < 2e-2


REGIONS = {
    "everywhere": lambda p, n: np.ones(p.shape[1]),
    "above": lambda p, n: p[1] > 5.0,
    "to one side": lambda p, n: n[0] > 0,
}


@pytest.mark.slow
@pytest.mark.parametrize("region", REGIONS)
def test_entries_weighted_by_their_density_cover_the_area(sampler: FlowSampler, region: str) -> None:
    obj, n = sampler.chart.object, 2**18
    _, _, at, density = draws(sampler, n)
    flat = obj.points.sample(floats(uniform(n, 1, 15))[0], mi.Point2f(uniform(n, 2, 16)), True)
    weight = REGIONS[region](np.array(at.p), np.array(at.n)) / np.array(density, dtype=float)
    wanted = obj.geometry.area * REGIONS[region](np.array(flat.p), np.array(flat.n))
    assert abs(weight.mean() - wanted.mean()) < 4 * np.hypot(weight.std(), wanted.std()) / np.sqrt(n) + 1e-6


def test_directions_by_the_cosine_are_uniform_in_their_square() -> None:
    n, m = 2**16, 16
    rng = generator(mi, n, pass_seed(13))
    square = mi.Point2f(rng.next_float32(), rng.next_float32())
    normal, towards = mi.Vector3f(0.48, 0.8, 0.36), mi.Vector3f(1, -2, 0.5)
    w = mi.Frame3f(normal).to_world(mi.warp.square_to_cosine_hemisphere(square))
    u = [np.array(v) for v in direction_square(normal, towards, w)]
    counts = np.histogram2d(*u, bins=m, range=[[0, 1], [0, 1]])[0]
    assert stats.chi2.sf(np.sum((counts - n / m**2) ** 2) * m**2 / n, m * m - 1) > 1e-3


class Numbers:
    """Uniform numbers as Mitsuba's samplers name them."""

    def __init__(self, n: int, seed: int) -> None:
        self.rng = generator(mi, n, pass_seed(seed))

    def next_1d(self):
        return self.rng.next_float32()

    def next_2d(self):
        return mi.Point2f(self.rng.next_float32(), self.rng.next_float32())


@pytest.mark.slow
def test_proposals_of_the_flow_and_of_patches_give_the_same_estimate(sampler: FlowSampler) -> None:
    obj, n = sampler.chart.object, 2**18
    at = obj.points.sample(floats(uniform(n, 1, 20))[0], mi.Point2f(uniform(n, 2, 21)), True)
    sign = obj.geometry.sign
    n_out = mi.Normal3f(at.n_shading * sign)
    exit = Side(SurfacePoint(at.p, mi.Normal3f(at.n * sign), n_out, mi.Vector3f(n_out)), None)
    exit = exit._replace(event=first_event(obj, exit.at))
    out, on, table = exit.at._replace(sign=mi.Float(sign)), mi.Bool(True), PatchTable(sampler.patches)
    means, errors = [], []
    for k, proposals in enumerate(
        (FlowProposals(sampler, sign), FlowProposals(sampler, sign, table),
         LearntProposals(sampler.patches, None, 1.0, sign, table))
    ):  # fmt: skip
        where = proposals.prepare(out, PreparedExit(exit, []), on)
        entry = proposals.sample(out, at.prim_index, where, Numbers(n, 22 + k), on)
        near = dr.exp(-0.05 * dr.squared_norm(entry.p - at.p))
        values = np.array(near * entry.weight, dtype=float)
        means.append(values.mean())
        errors.append(values.std() / np.sqrt(n))
    for a, b in ((0, 1), (0, 2), (1, 2)):
        assert abs(means[a] - means[b]) < 4 * np.hypot(errors[a], errors[b])
    assert max(errors) < 0.03 * means[0]
