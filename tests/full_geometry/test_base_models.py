"""What the network of one object begins with: the network of all shapes beside the half-space."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from waxen import WAX

mi = pytest.importorskip("mitsuba")
pytest.importorskip("torch")

from full_geometry.geometry.points import SurfacePoint  # noqa: E402
from full_geometry.learning import training  # noqa: E402
from full_geometry.learning.model_errors import (  # noqa: E402
    LIGHTS,
    measure,
    reference,  # noqa: E402
)
from full_geometry.learning.network_fitting import Recipe  # noqa: E402
from full_geometry.learning.training import Trained, train  # noqa: E402
from full_geometry.objects.objects import TranslucentObject, object_of  # noqa: E402
from full_geometry.settings import Settings  # noqa: E402
from full_geometry.transport import any_shape as shapes  # noqa: E402
from full_geometry.transport import storing  # noqa: E402
from full_geometry.transport.exit_pairs import EntryProposals  # noqa: E402
from full_geometry.transport.one_object import HalfSpace  # noqa: E402
from full_geometry.transport.storing import learnt_model  # noqa: E402
from halfspace_sss import Medium  # noqa: E402
from halfspace_sss.neural import store as known_weights  # noqa: E402
from halfspace_sss.neural.store import load_weights, save_weights  # noqa: E402
from halfspace_sss.tracing.walk import generator, pass_seed  # noqa: E402

pytestmark = pytest.mark.usefixtures("mono")

QUICK, CHUNKS = Recipe(width=24, depth=2, batch=1024, chunk=2**13, reuse=2), 4
SHAPE = shapes.KIND


def obj(radius: float = 3.0) -> TranslucentObject:
    return object_of(mi.load_dict({"type": "sphere", "radius": radius}), WAX.channel(1))


def learnt(folder: Path, base_model: str = SHAPE, **more) -> Trained:
    return train(obj(), chunks=CHUNKS, recipe=QUICK, base_model=base_model, folder=folder, **more)


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Trained:
    mi.set_variant("llvm_ad_mono")
    with pytest.MonkeyPatch.context() as patch:  # nobody asks for its errors
        for name, value in {"EXITS": 64, "WALKS": 512, "SAMPLES": 256}.items():
            patch.setattr(training, name, value)
        return learnt(tmp_path_factory.mktemp("weights"))


def points(of: TranslucentObject, n: int = 1024) -> list[SurfacePoint]:
    rng = generator(mi, n, pass_seed(7))
    return [of.random_points(rng) for _ in range(2)]


def S_of(model, of: TranslucentObject) -> np.ndarray:
    exits, entries = points(of)
    return np.array(model.S(model.prepare(exits), entries))


def test_before_any_step_it_is_the_network_of_all_shapes(tmp_path: Path) -> None:
    with pytest.warns(UserWarning, match="rendered by neural_shape"):
        found = train(obj(), seconds=0, base_model=SHAPE, folder=tmp_path)
    S = S_of(shapes.transport(obj()), obj())
    assert np.mean(S > 0) > 0.9 and np.allclose(S_of(found.model, obj()), S, rtol=1e-5)


@pytest.mark.slow
def test_few_steps_from_it_are_worth_more_than_from_the_half_space(trained: Trained, tmp_path: Path) -> None:
    truth = reference(obj(), 128, 8192, seed=5)
    proposals = EntryProposals(obj(), HalfSpace(obj(), "better_dipole"))
    models = {SHAPE: trained.model, "better_dipole": learnt(tmp_path, "better_dipole").model}
    constant = {}
    for name, model in models.items():
        rows = measure(obj(), model, proposals, truth=truth, samples=4096)
        (constant[name],) = (row for row in rows if row.light == LIGHTS[0])
    a, b = constant[SHAPE], constant["better_dipole"]
    assert a.error + 4 * np.hypot(a.standard_error, b.standard_error) < b.error


def test_the_file_says_where_it_began_and_gives_the_same_model_again(trained: Trained) -> None:
    record = json.loads(trained.path.with_suffix(".json").read_text())
    assert record["recipe"]["base_model"] == SHAPE and record["recipe"]["rate"] < QUICK.rate
    assert tuple(record[storing.CHECKSUMS]) == shapes.checksums(obj())
    again = storing.load(storing.find_weights(obj(), trained.path.parent), obj()).model
    assert np.array_equal(S_of(again, obj()), S_of(trained.model, obj()))
    assert not np.allclose(S_of(again, obj()), S_of(shapes.transport(obj()), obj()), rtol=1e-3)


def test_renders_ask_the_model_that_was_trained(trained: Trained, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(known_weights.ENVIRONMENT_VARIABLE, str(trained.path.parent))
    surface = {"type": "translucent", "sigma_s": 0.8, "sigma_a": 0.2, "eta": 1.4, "model": "full_geometry"}
    shape = mi.load_dict({"type": "sphere", "radius": 3.0, "bsdf": surface})
    here = object_of(shape, WAX.channel(1))
    transport = learnt_model(here, Settings()).transport
    o, i = points(here)
    rendered = np.array(transport.S(transport.prepare(o), i))
    assert np.allclose(rendered, S_of(trained.model, here), rtol=1e-5)
    assert set(shapes.checksums(here)) < set(transport.checksums)


@pytest.mark.slow
def test_a_killed_run_ends_with_the_same_weights(trained: Trained, tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr(training, "CHECKPOINT_EVERY", 0.0)

    def kill(what: str, done: int, total: int) -> None:
        if done == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        learnt(tmp_path, work=tmp_path / "work", progress=kill)
    with pytest.raises(ValueError, match="to go on with this work"):
        learnt(tmp_path, "better_dipole", work=tmp_path / "work")
    again = learnt(tmp_path, work=tmp_path / "work")
    assert all(np.array_equal(v, again.model.weights[name]) for name, v in trained.model.weights.items())


def test_weights_that_began_with_another_network_of_all_shapes_are_refused(
    trained: Trained, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    arrays, record = load_weights(shapes.shipped_weights(), SHAPE)
    other = save_weights(tmp_path / shapes.WEIGHTS, SHAPE, {**arrays, "b_0": arrays["b_0"] + 1}, record)
    monkeypatch.setattr(shapes, "shipped_weights", lambda: other)
    monkeypatch.setenv(known_weights.ENVIRONMENT_VARIABLE, str(trained.path.parent))
    assert not storing.trained(obj())
    with pytest.raises(ValueError, match="weights of the base model neural_shape must be those of training"):
        storing.load(trained.path, obj())


def test_weights_that_do_not_say_where_they_began_are_refused(trained: Trained, tmp_path: Path) -> None:
    arrays, record = load_weights(trained.path, storing.KIND)
    path = save_weights(tmp_path / trained.path.name, storing.KIND, arrays, {**record, "recipe": {}})
    with pytest.raises(ValueError, match="base_model must be recorded"):
        storing.load(path, obj())


@pytest.mark.parametrize(
    ("medium", "base_model", "message"),
    [
        (WAX.channel(1), "neural_shap", "base_model must be one of neural_shape, .*got 'neural_shap'"),
        (Medium(0.8, 0.2, 0.0, 5.0), SHAPE, "eta must"),
    ],
)
def test_a_base_model_that_is_none_is_refused_before_any_walk(
    medium: Medium, base_model: str, message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(training, "PairSource", None)
    with pytest.raises(ValueError, match=message):
        train(mi.load_dict({"type": "sphere"}), medium, base_model=base_model, folder=tmp_path)
