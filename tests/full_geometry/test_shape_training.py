"""Training on shapes without end: the shapes, the data, the same weights after a kill, the record, the command."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

mi = pytest.importorskip("mitsuba")
pytest.importorskip("igl")
torch = pytest.importorskip("torch")

from benchmarks import __main__ as cli  # noqa: E402
from benchmarks import shape_training as training  # noqa: E402
from benchmarks.held_out import HELD_OUT  # noqa: E402
from benchmarks.random_shapes import TRAINING, make_shape  # noqa: E402
from benchmarks.shape_training import (  # noqa: E402
    GROUPS,
    GroupedPairs,
    PairData,
    ShapeFit,
    ShapeRecipe,
    draw_medium,
    draw_object,
    grouped,
    make_data,
    mean_events,
)
from full_geometry.transport.any_shape import ALBEDO, ETA, SIZE, WEIGHTS, G, load, shipped_weights  # noqa: E402

pytestmark = pytest.mark.usefixtures("mono")

QUICK = ShapeRecipe(width=16, depth=2, objects=4, pairs=64)
PLAN = (4, 12)


@pytest.mark.parametrize("family", [*TRAINING, *HELD_OUT])
def test_shapes_are_closed_differ_by_seed_and_repeat(family: str) -> None:
    one, same, other = (
        make_shape(family, seed, 20, {**TRAINING, **HELD_OUT}) for seed in (1, 1, 2)
    )  # a mesh that is not closed is refused
    assert np.array_equal(one.vertices, same.vertices) and np.array_equal(one.faces, same.faces)
    assert one.vertices.shape != other.vertices.shape or not np.allclose(one.vertices, other.vertices)


def test_families_that_are_held_out_are_not_trained_on() -> None:
    assert not set(TRAINING) & set(HELD_OUT)


def test_objects_are_drawn_over_the_whole_range_and_not_beyond() -> None:
    media = np.array([draw_medium(np.random.default_rng(k)) for k in range(2000)])
    albedo, g, eta = media.T
    reduced = albedo * (1 - g) / (1 - albedo * g)
    for values, (low, high) in ((reduced, ALBEDO), (g, G), (eta, ETA)):
        assert low - 1e-9 <= values.min() < low + 0.1 * (high - low)
        assert high - 0.1 * (high - low) < values.max() <= high + 1e-9
    sizes = [draw_object((3, k)).object.mean_free_paths()[0] for k in range(12)]
    assert SIZE[0] <= min(sizes) < 30 < max(sizes) <= SIZE[1]


@pytest.mark.slow
def test_data_repeat_and_have_a_mean_throughput_of_one() -> None:
    obj = draw_object((0, 4)).object
    one, two = (make_data(obj, mean_events(obj), (0, 4)) for _ in range(2))
    assert np.array_equal(one.walks, two.walks) and np.array_equal(one.W, two.W)
    assert np.isclose(one.T.mean() * one.share, 1.0, rtol=0.05)
    assert np.isfinite(one.walks).all() and (one.W >= 0).all()


@pytest.mark.slow
def test_a_run_that_was_killed_ends_with_the_same_weights(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(training, "CHECKPOINT_EVERY", 0.0)
    how = {"recipe": QUICK, "plan": PLAN, "seed": 2}
    whole = training.train_shapes(tmp_path / "a", **how)

    def kill(what: str, done: int, total: int) -> None:
        if done == 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        training.train_shapes(tmp_path / "b", work=tmp_path / "work", progress=kill, **how)
    again = training.train_shapes(tmp_path / "b", work=tmp_path / "work", **how)
    assert whole.steps == again.steps == PLAN[1]
    left, right = (load(run.path) for run in (whole, again))
    assert all(np.array_equal(left[name], right[name]) for name in left)
    with pytest.raises(ValueError, match="seed must be 3 to go on with this work"):
        training.train_shapes(tmp_path / "b", work=tmp_path / "work", **{**how, "seed": 3})


def data_of(k: int) -> PairData:
    """Of object k of seed 1."""
    obj = draw_object((1, k)).object
    return make_data(obj, mean_events(obj), (1, k))


def test_groups_hold_every_pair_once_and_their_light_sums_up_to_that_of_the_object() -> None:
    data = data_of(0)
    groups = grouped(data)
    for found, wanted in ((groups.data.W, data.W), (groups.data.T, data.T)):
        assert np.array_equal(np.sort(found), np.sort(wanted))
    assert groups.proposals[-1] == len(data.W) and groups.walks[-1] == len(data.T)
    known = groups.weight > 0
    assert known.sum() >= GROUPS / 2 and np.isclose(groups.share.sum(), 1)
    light = (groups.share * groups.light)[known].sum()
    walks = [data.share * groups.data.T[a:b].sum() / len(data.T) for a, b in zip(groups.walks, groups.walks[1:])]
    assert np.isclose(light, np.array(walks)[known].sum(), rtol=1e-5)


def test_exits_of_a_group_are_more_alike_than_those_of_the_object() -> None:
    groups = grouped(data_of(0))
    depth = groups.data.proposals[:, 5].astype(float)
    within = [depth[a:b].var() for a, b in zip(groups.proposals, groups.proposals[1:])]
    assert np.mean(within) < 0.7 * depth.var()


def test_parts_of_groups_are_samples_of_the_means_over_the_object() -> None:
    data, rng = data_of(0), np.random.default_rng(5)
    groups = grouped(data)
    parts = [groups.part(64, rng) for _ in range(4000)]
    for found, wanted in (
        (np.array([p.share * p.W.mean() for p in parts]), data.W.mean()),
        (np.array([p.T.sum() for p in parts]), data.T.mean() * data.share),
    ):
        assert abs(found.mean() - wanted) < 4 * found.std() / np.sqrt(len(found))  # z-test, 6e-5


@pytest.mark.slow
def test_a_fit_follows_the_light_of_groups() -> None:
    def brightness(weight: float) -> float:
        own = grouped(data_of(0))
        pool = [GroupedPairs(own.data, own.proposals, own.walks, own.share, 1.5 * own.light, weight * (own.weight > 0))]
        fitting, rng = ShapeFit(QUICK, 0), np.random.default_rng(0)
        for k in range(150):
            fitting.advance(pool, rng, k / 150)
        with torch.no_grad():
            x = torch.from_numpy(own.data.proposals).float()
            f = fitting.average(x, torch.from_numpy(own.data.medium).expand(len(x), -1)).numpy()
        return float((own.data.W * np.exp(f)).mean())

    assert brightness(50.0) > 1.15 * brightness(0.0)


def test_a_step_lowers_the_loss() -> None:
    pool = [grouped(data_of(k)) for k in range(2)]
    fitting, rng = ShapeFit(QUICK, 0), np.random.default_rng(0)
    losses = [fitting.advance(pool, rng, k / 150) for k in range(150)]
    assert np.mean(losses[-20:]) < np.mean(losses[:20]) - 0.02


def test_the_command_writes_weights_with_their_record(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(training, "STANDARD", QUICK)
    monkeypatch.setattr(training._ShapeTraining, "_plan", lambda run, seconds, plan: (3, 4))
    result = CliRunner().invoke(cli.app, ["train-shapes", "--seconds", "5", "--seed", "1"])
    assert result.exit_code == 0, result.output
    record = json.loads(Path("shapes", WEIGHTS).with_suffix(".json").read_text(encoding="utf-8"))
    assert record["kind"] == "neural_shape" and record["steps"] == 4 and sum(record["families"].values()) <= 3


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--seconds", "0"], "seconds must be a number in [1, 1e+07]"),
        (["--mesh", "none.ply"], "meshes must be PLY files"),
    ],
)
def test_bad_input_meets_a_sentence(words: list[str], message: str) -> None:
    result = CliRunner().invoke(cli.app, ["train-shapes", *words])
    assert result.exit_code == 2 and message in " ".join(result.stderr.split())


def test_shipped_weights_are_small_and_say_how_they_were_made() -> None:
    path = shipped_weights()
    record = json.loads(path.with_suffix(".json").read_text(encoding="utf-8"))
    assert path.stat().st_size <= 300_000 and load(path)
    assert record["objects"] > 0 and record["steps"] > 0 and "provenance" in record


def test_damaged_weights_are_refused_by_name(tmp_path: Path) -> None:
    for suffix in (".safetensors", ".json"):
        (tmp_path / WEIGHTS).with_suffix(suffix).write_bytes(shipped_weights().with_suffix(suffix).read_bytes())
    data = bytearray((tmp_path / WEIGHTS).read_bytes())
    data[-3] ^= 1
    (tmp_path / WEIGHTS).write_bytes(bytes(data))
    with pytest.raises(ValueError, match=WEIGHTS):
        load(tmp_path / WEIGHTS)
