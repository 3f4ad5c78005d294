"""The model of one object: learning it, its files, whom they belong to, and how its error is measured."""

from __future__ import annotations

import json
import shutil
import warnings
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest

from halfspace_sss import Medium

dr = pytest.importorskip("drjit")
mi = pytest.importorskip("mitsuba")
torch = pytest.importorskip("torch")

import full_geometry  # noqa: E402
from full_geometry.geometry.points import SurfacePoint  # noqa: E402
from full_geometry.learning import training  # noqa: E402
from full_geometry.learning.model_errors import (  # noqa: E402  # noqa: E402
    EVEN_SKY,
    LIGHTS,
    ExitRadiance,
    compare,
    modelled,
    reference,
    transport_of,
)
from full_geometry.learning.network_fitting import Correction, Recipe  # noqa: E402
from full_geometry.learning.training import Trained, train, train_unattended  # noqa: E402
from full_geometry.objects.objects import object_of  # noqa: E402
from full_geometry.transport import storing  # noqa: E402
from full_geometry.transport.exit_pairs import EntryProposals  # noqa: E402
from full_geometry.transport.features import (  # noqa: E402
    Side,
    first_event,  # noqa: E402
    n_pair,
    n_side,
    pair_features,
    reverse,
    side_features,
)
from full_geometry.transport.one_object import (  # noqa: E402
    FullGeometry,
    HalfSpace,
)
from full_geometry.transport.storing import frame_of  # noqa: E402
from halfspace_sss.neural.store import load_weights, save_weights  # noqa: E402
from halfspace_sss.tracing.walk import generator, pass_seed  # noqa: E402

pytestmark = pytest.mark.usefixtures("rgb")

QUICK, CHUNKS = Recipe(width=24, depth=2, batch=1024, chunk=2**14, reuse=4), 4
FEW = replace(QUICK, chunk=2**12)
WAX = Medium([0.95, 0.8, 0.6], [0.05, 0.2, 0.4], 0.0, 1.4)


def bunny(scale: float = 1.0, turn: float = 0.0, shift: float = 0.0) -> dict:
    """The bunny, as it stands or moved."""
    at = mi.ScalarTransform4f().translate([shift, 0, -shift]).rotate([0.6, 0.8, 0], turn).scale(2.0 * scale)
    return {"type": "ply", "filename": str(BUNNY), "to_world": at}


BUNNY = Path(__file__).parents[2] / "figures" / "assets" / "bunny.ply"


def ball(radius: float = 2.0) -> object:
    return mi.load_dict({"type": "sphere", "radius": radius})


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Trained:
    mi.set_variant("llvm_ad_rgb")
    folder = tmp_path_factory.mktemp("trained")
    return train(ball(), WAX, chunks=CHUNKS, recipe=QUICK, folder=folder / "weights", work=folder / "work")


@pytest.fixture
def few_exits(monkeypatch: pytest.MonkeyPatch) -> None:
    """Errors of a training that nothing but their size is asked of, by fewer walks."""
    for name, value in {"EXITS": 64, "WALKS": 512, "SAMPLES": 256}.items():
        monkeypatch.setattr(training, name, value)


def constant(found: list) -> np.ndarray:
    return np.array([row.error for row in found if row.light == LIGHTS[0]])


@pytest.mark.slow
def test_training_halves_the_error_of_the_half_space(trained: Trained) -> None:
    obj = trained.model.object
    proposals = EntryProposals(obj, HalfSpace(obj, "better_dipole"))
    truth = reference(obj)
    plane = compare(modelled(transport_of(obj, "better_dipole"), proposals, truth.exits, 1024), truth.truth)
    assert np.all(constant(trained.errors) < 0.5 * constant(plane))
    assert all(abs(row.ratio - 1) < 0.03 for row in trained.errors)


@pytest.mark.slow
def test_after_an_edit_of_the_medium_training_starts_from_what_is_known_of_the_shape(
    trained: Trained, tmp_path: Path
) -> None:
    folder, recipe = trained.path.parent, asdict(QUICK)
    edited = object_of(ball(), Medium([0.9, 0.85, 0.65], [0.1, 0.25, 0.45], 0.0, 1.4))
    start = storing.nearest(edited, recipe, folder)
    assert start.path == trained.path
    for other in (object_of(ball(2.5), WAX), object_of(ball(), Medium(WAX.sigma_s, WAX.sigma_a, 0.3, 1.4))):
        assert storing.nearest(other, recipe, folder) is None
    assert storing.nearest(edited, {**recipe, "width": 32}, folder) is None
    as_many = replace(QUICK, chunk=QUICK.refining().chunk)
    anew = train(edited, chunks=2, recipe=as_many, folder=tmp_path / "anew")
    shutil.copytree(folder, tmp_path / "refined")
    refined = train(edited, chunks=2, recipe=QUICK, folder=tmp_path / "refined", refine=True)
    assert refined.steps == anew.steps
    assert np.max(constant(refined.errors)) < 0.6 * np.max(constant(anew.errors))


@pytest.mark.slow
def test_weights_of_a_number_of_chunks_are_the_same_bits_by_one_thread_and_by_three(tmp_path: Path) -> None:
    before, found = dr.thread_count(), []
    for threads in (1, 3):
        dr.set_thread_count(threads)
        try:
            path = train_unattended(object_of(ball(), WAX), tmp_path / str(threads), chunks=2, recipe=FEW).path
        finally:
            dr.set_thread_count(before)
        found.append(path.read_bytes())
    assert found[0] == found[1]


@pytest.mark.slow
def test_the_file_gives_the_same_model_again(trained: Trained) -> None:
    obj = object_of(ball(), WAX)
    again = storing.load(storing.find_weights(obj, trained.path.parent), obj).model
    assert np.array_equal(S_of(again), S_of(trained.model))
    record = json.loads(trained.path.with_suffix(".json").read_text())
    assert record["orders"] == "multiple" and len(record["errors"]) == 6 and record["steps"] == trained.steps


def points_of(model: FullGeometry, n: int = 4096) -> list[SurfacePoint]:
    rng = generator(mi, n, pass_seed(7))
    return [model.object.random_points(rng) for _ in range(2)]


def S_of(model: FullGeometry, points: list[SurfacePoint] | None = None) -> np.ndarray:
    exits, entries = points or points_of(model)
    return np.array(model.S(model.prepare(exits), entries))


def test_features_of_the_way_back_are_those_of_exit_and_entry_exchanged() -> None:
    obj = object_of(mi.load_dict(bunny()), WAX)
    frame, rng = frame_of(obj), generator(mi, 256, pass_seed(8))
    a, b = (Side(at, first_event(obj, at)) for at in (obj.random_points(rng), obj.random_points(rng)))

    def features(exit: Side, entry: Side) -> np.ndarray:
        columns = [*side_features(frame, exit), *side_features(frame, entry), *pair_features(frame, exit, entry)]
        dr.eval(columns)  # or each has a kernel of its own
        return np.stack([np.array(column) for column in columns])

    order, signs = reverse(n_side(3), 3)
    assert np.allclose(features(a, b)[order] * signs[:, None], features(b, a), atol=1e-5)


def test_a_network_reads_pairs_backwards_as_it_reads_pairs_that_are_turned_round() -> None:
    n = n_side(3)
    net = Correction(2 * n + n_pair(3), 3, width=16, depth=2)
    with torch.no_grad():
        net.layers.matrices[-1].normal_()
    x = torch.from_numpy(np.random.default_rng(2).standard_normal((2 * n + n_pair(3), 64)).astype(np.float32))
    order, signs = reverse(n, 3)
    turned = x[order] * torch.from_numpy(signs)[:, None]
    assert torch.allclose(net(x, back=True), net(turned), atol=1e-5)
    assert not torch.allclose(net(x), net(turned), atol=1e-2)


@pytest.mark.slow
def test_S_is_positive_and_finite(trained: Trained) -> None:
    S = S_of(trained.model)
    assert np.all(np.isfinite(S)) and np.all(S >= 0) and np.mean(S > 0) > 0.9


@pytest.mark.slow
def test_work_of_another_object_is_refused(trained: Trained) -> None:
    folder = trained.path.parents[1]
    with pytest.raises(ValueError, match="size_in_mfp"):
        train(ball(2.5), WAX, chunks=CHUNKS, recipe=QUICK, folder=folder / "weights", work=folder / "work")


@pytest.mark.slow
def test_a_run_stops_where_its_error_is_small_enough(few_exits: None, tmp_path: Path) -> None:
    found = train(ball(), WAX, chunks=8, recipe=QUICK, target_error=0.9, folder=tmp_path)
    assert found.steps < 0.5 * 8 * QUICK.reuse * QUICK.chunk / QUICK.batch


def test_no_training_gives_the_half_space_with_a_warning(tmp_path: Path) -> None:
    with pytest.warns(UserWarning, match="rendered by better_dipole"):
        found = train(ball(200.0), WAX, seconds=0, folder=tmp_path)
    assert found.path is None and not list(tmp_path.iterdir())
    plane = transport_of(found.model.object, "better_dipole")
    exits, entries = (found.model.object.random_points(generator(mi, 64, pass_seed(k))) for k in (1, 2))
    n = mi.Normal3f(dr.normalize(exits.p + 0.5 * mi.Vector3f(mi.coordinate_system(exits.n)[0])))  # on the ball
    near = entries._replace(p=mi.Point3f(200 * n), n=n, n_out=n, w=mi.Vector3f(n))
    S, S_0 = (np.array(t.S(t.prepare(exits), near)) for t in (found.model, plane))
    assert np.allclose(S, S_0, rtol=2e-2)


@pytest.mark.parametrize(
    ("shape", "medium", "message"),
    [
        ({"type": "sphere", "radius": 2.5}, WAX, "about 1.25 times as large"),
        ({"type": "sphere", "radius": 2.0}, WAX.scaled(1.1), "size_in_mfp of the medium"),
        ({"type": "sphere", "radius": 2.0}, Medium(WAX.sigma_s, WAX.sigma_a, 0.0, 1.5), "must be trained"),
        ({"type": "cube"}, WAX, "must be trained"),
    ],
)
@pytest.mark.slow
def test_weights_of_another_object_are_refused(trained: Trained, shape: dict, medium: Medium, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        storing.find_weights(object_of(mi.load_dict(shape), medium), trained.path.parent)


@pytest.mark.slow
def test_an_altered_file_is_refused(trained: Trained, tmp_path: Path) -> None:
    for path in (trained.path, trained.path.with_suffix(".json")):
        shutil.copy(path, tmp_path)
    path = tmp_path / trained.path.name
    path.write_bytes(path.read_bytes()[:-4] + b"abcd")
    with pytest.raises(ValueError, match="sha256"):
        storing.load(path, trained.model.object)


@pytest.mark.slow
def test_weights_of_other_inputs_are_refused(trained: Trained, tmp_path: Path) -> None:
    arrays, record = load_weights(trained.path, storing.KIND)
    path = tmp_path / trained.path.name
    save_weights(path, storing.KIND, {**arrays, "W_0": arrays["W_0"][:, :-6]}, record)
    with pytest.raises(ValueError, match="W_0 must have 166 inputs, got 160"):
        storing.load(path, trained.model.object)


@pytest.mark.slow
@pytest.mark.parametrize("changed", [{"base_model": "neural"}, {"reflections": 1}])
def test_weights_that_multiply_something_else_are_refused(trained: Trained, changed: dict, tmp_path: Path) -> None:
    arrays, record = load_weights(trained.path, storing.KIND)
    path = save_weights(tmp_path / trained.path.name, storing.KIND, arrays, {**record, **changed})
    ((key, value),) = changed.items()
    with pytest.raises(ValueError, match=f"{key} must be .*, got {value}: of another version, to be trained again"):
        storing.load(path, trained.model.object)


@pytest.mark.slow
def test_a_moved_and_turned_mesh_is_the_same_object(few_exits: None, tmp_path: Path) -> None:
    model = train(mi.load_dict(bunny()), WAX, chunks=2, recipe=FEW, folder=tmp_path).model
    moved = object_of(mi.load_dict(bunny(turn=40.0, shift=3.0)), WAX)
    again = storing.load(storing.find_weights(moved, tmp_path), moved).model
    turn = mi.Transform4f().translate([3, 0, -3]).rotate([0.6, 0.8, 0], 40)
    turned = [SurfacePoint(*(turn @ v for v in point[:4])) for point in points_of(model)]
    a, b = S_of(model), S_of(again, turned)
    seen = a > 1e-3 * a.max()
    assert np.median(np.abs(b[seen] / a[seen] - 1)) < 1e-3
    with pytest.raises(ValueError, match="times as large"):
        storing.find_weights(object_of(mi.load_dict(bunny(scale=1.2)), WAX), tmp_path)


def test_the_error_leaves_noise_out() -> None:
    rng = np.random.default_rng(5)
    truth = 1 + rng.random((1, 256, 5))
    found = []
    for bias in (0.0, 0.1):
        noisy = [truth * (1 + bias * k) + 0.05 * rng.standard_normal(truth.shape) for k in (1, 0)]
        found.append(compare(*(ExitRadiance(value, np.full(truth.shape, 0.05**2)) for value in noisy)))
    assert all(row.error < max(4 * row.standard_error, 0.01) for row in found[0])
    expected = 0.1 * np.sqrt(np.mean(truth[0] ** 2)) / truth[0].mean()
    assert all(abs(row.error - expected) < 4 * row.standard_error for row in found[1])


def test_the_truth_has_no_error_against_itself() -> None:
    a, b = (reference(object_of(ball(), WAX), 64, 2048, seed=1) for _ in range(2))
    assert np.array_equal(a.truth.mean, b.truth.mean)


@pytest.mark.parametrize(
    ("bad", "message"),
    [
        ({"seconds": -1.0}, "seconds must be"),
        ({"target_error": 2.0}, "target_error must be"),
        ({"seed": -1}, "seed must"),
    ],
)
def test_bad_arguments_are_refused_before_any_walk(bad: dict, message: str, tmp_path: Path) -> None:
    with warnings.catch_warnings(), pytest.raises(ValueError, match=message):
        warnings.simplefilter("error")
        train(ball(), WAX, folder=tmp_path, **bad)


@pytest.mark.slow
def test_errors_of_models_are_asked_by_name(trained: Trained) -> None:
    few = {"exits": 32, "walks": 512, "samples": 512}
    rows = full_geometry.errors(ball(), WAX, folder=trained.path.parent, **few)
    assert sorted((r.channel, r.light) for r in rows) == [(c, k) for c in range(3) for k in sorted((*LIGHTS, EVEN_SKY))]
    assert np.all(constant(rows) < constant(full_geometry.errors(ball(), WAX, "better_dipole", **few)))
    with pytest.raises(ValueError, match="model must be one of"):
        full_geometry.errors(ball(), WAX, "no_such_model", **few)


def test_an_object_of_a_scene_is_found_by_its_id() -> None:
    full_geometry.register()
    surface = {"type": "translucent", "sigma_s": "0.95,0.8,0.6", "sigma_a": "0.05,0.2,0.4", "eta": 1.4}
    one, two = ({"type": "sphere", "radius": r, "center": [4 * r, 0, 0], "bsdf": surface} for r in (1.0, 2.0))
    scene = mi.load_dict({"type": "scene", "one": one, "two": two})
    with pytest.raises(ValueError, match="one of one, two, got None"):
        object_of(scene, None)
    found = object_of(scene, None, 2.0, "two")
    assert np.isclose(found.geometry.area, 16 * np.pi) and np.isclose(float(found.media[0].sigma_t), 2.0)
    rough = {**surface, "boundary": {"type": "roughdielectric", "alpha": 0.2, "int_ior": 1.4, "ext_ior": 1.0}}
    with pytest.raises(ValueError, match="must be smooth"):
        object_of(mi.load_dict({"type": "scene", "one": {**one, "bsdf": rough}}), None)


@pytest.mark.slow
def test_one_exit_gathers_many_entries_in_one_loop(trained: Trained) -> None:
    model, n, times = trained.model, 512, 4
    exits, entries = points_of(model, n)[0], points_of(model, n * times)[1]
    prepared = model.prepare(exits)
    lanes = dr.arange(mi.UInt32, n)

    def add(k: mi.UInt32, total: mi.Spectrum) -> tuple:
        return k + 1, total + model.S(prepared, entries.gather(lanes * times + k))

    _, gathered = dr.while_loop((mi.UInt32(0), dr.zeros(mi.Spectrum, n)), lambda k, _: k < times, add)
    repeated = exits.gather(dr.arange(mi.UInt32, n * times) // times)
    alone = np.array(model.S(model.prepare(repeated), entries)).reshape(3, n, times).sum(axis=2)
    assert np.allclose(np.array(gathered), alone, rtol=1e-4, atol=1e-7 * alone.max())


@pytest.mark.slow
def test_a_plan_by_time_is_kept_by_the_run_that_goes_on(few_exits: None, tmp_path: Path) -> None:
    found = train(ball(), WAX, seconds=1.0, recipe=QUICK, folder=tmp_path, work=tmp_path / "work")
    planned = json.loads((tmp_path / "work" / training.PLAN).read_text())["chunks"]
    record = json.loads(found.path.with_suffix(".json").read_text())
    assert record["chunks"] == planned >= 2


@pytest.mark.slow
def test_a_mono_variant_learns_one_channel(few_exits: None, tmp_path: Path) -> None:
    mi.set_variant("llvm_ad_mono")
    found = train(ball(), WAX.channel(1), chunks=2, recipe=QUICK, folder=tmp_path)
    assert len(found.errors) == 2 and all(row.error < 0.2 for row in found.errors)
    assert S_of(found.model).shape == (1, 4096)


def test_a_channel_that_does_not_scatter_carries_nothing(few_exits: None, tmp_path: Path) -> None:
    black = Medium([0.95, 0.0, 0.6], [0.05, 1.0, 0.4], 0.0, 1.4)
    model = train(ball(), black, chunks=2, recipe=FEW, folder=tmp_path).model
    S, albedo = S_of(model), np.array(model.alpha(points_of(model)[0])[1])
    assert np.all(albedo[1] == 0) and np.all(S[1] == 0) and np.all(np.isfinite(S)) and np.mean(S[0] > 0) > 0.9
