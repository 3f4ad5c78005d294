"""S of any shape: what its form guarantees whatever the weights say, and what the shipped ones bring."""

from __future__ import annotations

import numpy as np
import pytest

from halfspace_sss import Medium

dr = pytest.importorskip("drjit")
mi = pytest.importorskip("mitsuba")
pytest.importorskip("igl")

from benchmarks.modelling.meshes import Box, surface  # noqa: E402
from benchmarks.random_shapes import make_shape  # noqa: E402
from full_geometry.geometry.points import SurfacePoint, cosine_direction  # noqa: E402
from full_geometry.learning.model_errors import errors_of, transport_of  # noqa: E402
from full_geometry.objects.objects import TranslucentObject, object_of  # noqa: E402
from full_geometry.transport.any_shape import Backbone, NeuralShape, most, transport  # noqa: E402
from full_geometry.transport.descriptors import (  # noqa: E402
    CURVED_OWN,
    CURVED_SHARED,
    N_MEDIUM,
    N_OWN,
    N_SHARED,
    Pair,
    describe,
    end,
    mixed,
)
from halfspace_sss.tracing.walk import generator, pass_seed  # noqa: E402

pytestmark = pytest.mark.usefixtures("mono")

WAX = Medium(0.95, 0.05, 0.3, 1.4)
N = 512


def random_weights(seed: int = 0, width: int = 16) -> dict[str, np.ndarray]:
    """Numbers with which f is of order one."""
    pytest.importorskip("torch")
    from benchmarks.shape_training import ShapeNetwork, ShapeRecipe

    rng = np.random.default_rng(seed)
    arrays = ShapeNetwork(ShapeRecipe(width=width, depth=2), seed).arrays()
    return arrays | {"W_2": rng.normal(0, 1, arrays["W_2"].shape).astype(np.float32)}


def mesh(vertices: np.ndarray, faces: np.ndarray) -> object:
    """A Mitsuba mesh with flat normals."""
    found = mi.Mesh("mesh", len(vertices), len(faces))
    parameters = mi.traverse(found)
    parameters["vertex_positions"] = vertices.astype(np.float32).ravel()
    parameters["faces"] = faces.astype(np.uint32).ravel()
    parameters.update()
    return found


def pairs(obj: TranslucentObject, n: int = N, seed: int = 5) -> tuple[SurfacePoint, SurfacePoint]:
    """Exits and entries, each with a random direction."""
    rng = generator(mi, n, pass_seed(seed))
    found = obj.random_points(rng), obj.random_points(rng)
    dr.eval(found)
    return found


def told(obj: TranslucentObject, o: SurfacePoint, i: SurfacePoint) -> list[Pair]:
    """Descriptors of pairs for each channel."""
    exit, entry = end(obj, o), end(obj, i)
    half_space = Backbone(obj, mixed(obj))
    return describe(obj, exit, entry, half_space.shares(half_space(exit, entry), exit, entry))


def S(model: NeuralShape, o: SurfacePoint, i: SurfacePoint) -> np.ndarray:
    return np.array(model.S(model.prepare(o), i))


def moved(at: SurfacePoint, turn: mi.ScalarTransform4f, scale: float) -> SurfacePoint:
    """A point of a surface after it was turned and scaled."""
    R = np.array(turn.matrix, dtype=float)[:3, :3]
    rows = [mi.Vector3f(*row.tolist()) for row in R]

    def turned(v: object) -> object:
        return type(v)(*(dr.dot(row, mi.Vector3f(v)) for row in rows))

    p, n, n_out, w = (turned(v) for v in at[:4])
    return SurfacePoint(p * scale, n, n_out, w)


@pytest.mark.slow
def test_on_a_plane_it_is_the_half_space_whatever_the_weights() -> None:
    box = mi.load_dict({"type": "cube", "to_world": mi.ScalarTransform4f().scale(2000.0)})
    obj = object_of(box, WAX)
    rng = generator(mi, N, pass_seed(1))
    place = [mi.Point3f(12 * rng.next_float32(), 12 * rng.next_float32(), 2000.0) for _ in range(2)]
    n = mi.Normal3f(dr.zeros(mi.Float, N), dr.zeros(mi.Float, N), dr.full(mi.Float, 1.0, N))
    o, i = (SurfacePoint(p, n, n, cosine_direction(n, n, rng)) for p in place)
    model = NeuralShape.of(obj, random_weights())
    plane = np.array(model.half_space(*(_side(end(obj, at)) for at in (o, i))))
    assert np.allclose(S(model, o, i), plane, rtol=2e-3)
    for pair in told(obj, o, i):
        sums = [a + b for a, b in zip(pair.exit[CURVED_OWN], pair.entry[CURVED_OWN])] + pair.shared[CURVED_SHARED]
        assert max(float(np.abs(v.numpy()).max()) for v in sums) < 2e-3


def _side(e: object) -> object:
    from full_geometry.transport.features import Side

    return Side(e.at, e.event)


def test_a_sphere_that_grows_becomes_the_half_space() -> None:
    spread = []
    for radius in (30.0, 1000.0, 30000.0):
        obj = object_of(mi.load_dict({"type": "sphere", "radius": radius}), WAX)
        model = NeuralShape.of(obj, random_weights())
        o, _ = pairs(obj)
        step = mi.Vector3f(cosine_direction(o.n, o.n, generator(mi, N, pass_seed(2))))
        n = mi.Normal3f(dr.normalize(mi.Vector3f(o.p + 3 * dr.normalize(dr.cross(o.n, step)))))
        i = SurfacePoint(mi.Point3f(n * radius), n, n, cosine_direction(n, n, generator(mi, N, pass_seed(3))))
        plane = np.array(model.half_space(_side(end(obj, o)), _side(end(obj, i))))
        spread.append(float(np.abs(np.log(S(model, o, i) / plane)).mean()))
    assert spread[0] > 5 * spread[1] > 10 * spread[2] and spread[2] < 0.01


def test_light_may_take_the_way_back() -> None:
    obj = object_of(make_shape("blobs", 3, 24).mitsuba("blob"), WAX.scaled(20.0))
    model, (o, i) = NeuralShape.of(obj, random_weights()), pairs(obj)
    there, back = S(model, o, i), S(model, i, o)
    assert (there > 0).mean() > 0.9
    assert np.allclose(there, back, rtol=5e-3, atol=1e-6 * there.max())


def test_scale_turn_and_order_of_triangles_do_not_count() -> None:
    shape, scale = make_shape("ribbons", 4, 24), 7.0
    turn = mi.ScalarTransform4f().rotate([0.36, 0.8, 0.48], 77.0)
    R = np.array(turn.matrix, dtype=float)[:3, :3]
    order = np.random.default_rng(0).permutation(len(shape.faces))
    one = object_of(mesh(shape.vertices, shape.faces), WAX.scaled(10.0))
    other = object_of(mesh(scale * shape.vertices @ R.T, shape.faces[order]), WAX.scaled(10.0 / scale))
    weights, (o, i) = random_weights(), pairs(one)
    first = S(NeuralShape.of(one, weights), o, i)
    second = S(NeuralShape.of(other, weights), moved(o, turn, scale), moved(i, turn, scale))
    ratio = second * scale**2 / first
    assert np.quantile(np.abs(ratio - 1), 0.97) < 0.01  # a ray that meets an edge may go to either side


@pytest.mark.slow
def test_resolution_does_not_count() -> None:
    def ball(p: np.ndarray) -> np.ndarray:
        return np.linalg.norm(p, axis=-1) - 1

    found = []
    for resolution in (20, 80):
        obj = object_of(surface(ball, Box((-1.1,) * 3, (1.1,) * 3), resolution).mitsuba("ball"), WAX.scaled(5.0))
        o, i = pairs(obj, 2**13)
        pair = told(obj, o, i)[0]
        columns = [np.broadcast_to(v.numpy(), 2**13) for v in (*pair.exit, *pair.shared)]
        found.append(np.array([(c.mean(), c.std()) for c in columns]))
    scatter = np.maximum(found[1][:, 1], 0.02)
    assert (np.abs(found[0][:, 0] - found[1][:, 0]) / scatter).max() < 0.15


@pytest.mark.slow
def test_a_channel_is_what_its_medium_is_alone() -> None:
    mi.set_variant("llvm_ad_rgb")
    shape = make_shape("combs", 6, 24).mitsuba("comb")
    columns = np.array([[19.0, 8.0, 1.0], [1.0, 2.0, 9.0], [0.6, 0.0, 0.0]])  # sigma_s, sigma_a, g of each channel
    whole = object_of(shape, Medium(*columns, 1.4))
    o, i = pairs(whole)
    weights = random_weights()
    together = S(NeuralShape.of(whole, weights), o, i)
    for k, (sigma_s, sigma_a, g) in enumerate(columns.T):
        alone = S(NeuralShape.of(object_of(shape, Medium(sigma_s, sigma_a, g, 1.4)), weights), o, i)
        floor = 1e-2 * alone[k].max()  # rays end where the light of no channel is left, which differs a little
        assert np.quantile(np.abs(together[k] - alone[k]) / (alone[k] + floor), 0.99) < 0.02


@pytest.mark.slow
def test_torch_and_drjit_say_the_same() -> None:
    torch = pytest.importorskip("torch")
    from benchmarks.shape_training import ShapeNetwork, ShapeRecipe

    obj = object_of(make_shape("shells", 2, 24).mitsuba("bowl"), WAX.scaled(8.0))
    weights, (o, i) = random_weights(1), pairs(obj)
    pair = told(obj, o, i)[0]
    columns = [np.broadcast_to(v.numpy(), N) for v in (*pair.exit, *pair.entry, *pair.shared)]
    x = torch.from_numpy(np.stack(columns, axis=-1).astype(np.float32))
    network, model = ShapeNetwork(ShapeRecipe(width=16, depth=2)), NeuralShape.of(obj, weights)
    with torch.no_grad():
        network.take(weights)
        wanted = network(x, torch.from_numpy(model.media[0]).expand(N, -1)).numpy()
    found = model._f(pair, model._media[0]).numpy()
    assert x.shape[1] == 2 * N_OWN + N_SHARED and len(model.media[0]) == N_MEDIUM
    assert np.allclose(found, wanted, atol=2e-3) and np.std(wanted) > 0.1


def test_f_is_bounded_below_by_less_where_light_is_scattered_forwards() -> None:
    bounds = [float(most(np, g)) for g in (-0.3, 0.0, 0.25, 0.5, 0.95)]
    assert bounds == [3.0, 3.0, 2.25, 1.5, 1.5]


def test_degenerate_triangles_needles_and_points_that_coincide_leave_no_nan() -> None:
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0.001, 0.001, 40.0], [0.5, 0.0, 0.0]], dtype=float)
    faces = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3], [0, 4, 1], [0, 4, 1], [2, 2, 2]])
    obj = object_of(mesh(vertices, faces), WAX)
    model = NeuralShape.of(obj, random_weights())
    o, i = pairs(obj, 2048)
    for at in (i, o, SurfacePoint(o.p, o.n, o.n_out, i.w)):
        value = S(model, o, at)
        assert np.isfinite(value).all() and (value >= 0).all()


@pytest.mark.slow
@pytest.mark.parametrize("ratios", [(0.02, 0.98, 0.0, 1.3), (1.0, 0.0, 0.0, 1.5), (0.9, 0.1, 0.9, 1.1)])
def test_media_at_the_ends_of_the_range_stay_finite(ratios: tuple[float, ...]) -> None:
    for size in (1.0, 1000.0):
        obj = object_of(mi.load_dict({"type": "sphere"}), Medium(*ratios).scaled(size))
        value = S(transport(obj), *pairs(obj))
        assert np.isfinite(value).all() and (value >= 0).all()


def test_shipped_weights_are_several_times_better_than_the_half_space_on_a_sphere() -> None:
    obj = object_of(mi.load_dict({"type": "sphere", "radius": 10.0}), Medium(0.95, 0.05, 0.0, 1.3))
    models = {"neural_shape": transport(obj), "neural": transport_of(obj, "neural")}
    found = errors_of(obj, models, exits=64, walks=2048, samples=1024)
    own, plane = (found[name][0].error for name in models)
    assert own < plane / 3
