"""The commands `train object` and `errors object`: files, exit codes, what they refuse, and how they go on."""

from __future__ import annotations

import errno
import functools
import os
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pandas
import pytest
from typer.testing import CliRunner

pytest.importorskip("mitsuba")
pytest.importorskip("torch")

from figures import app as cli  # noqa: E402
from full_geometry.learning import (  # noqa: E402
    learners,  # noqa: E402
    model_errors,
    training,
)
from full_geometry.learning.network_fitting import Recipe  # noqa: E402
from full_geometry.objects.objects import object_of  # noqa: E402
from halfspace_sss.neural import store as known_weights  # noqa: E402
from halfspace_sss.neural.store import load_weights  # noqa: E402

QUICK = Recipe(width=24, depth=2, batch=1024, chunk=2**13, reuse=4)
TRAIN, REFERENCE = training.train, model_errors.reference
BALL = """<shape type="sphere" id="NAME"><float name="radius" value="1"/><bsdf type="translucent">
  <string name="sigma_s" value="0.95,0.8,0.6"/><string name="sigma_a" value="0.05,0.2,0.4"/></bsdf></shape>
"""
XML = f"""<scene version="3.0.0">
  <integrator type="bssrdf"><float name="mm_per_unit" value="2"/></integrator>
  <emitter type="constant"/>
  {BALL.replace("NAME", "ball")}
  <sensor type="perspective"><transform name="to_world"><lookat origin="0,0,5" target="0,0,0" up="0,1,0"/></transform>
    <film type="hdrfilm"><integer name="width" value="8"/><integer name="height" value="8"/></film></sensor>
</scene>
"""


@pytest.fixture(autouse=True)
def _small(monkeypatch: Any, tmp_path: Path) -> None:
    """A recipe of seconds and a scene, in an empty folder, where weights are looked for too."""
    monkeypatch.setattr(training, "train", functools.partial(TRAIN, recipe=QUICK, chunks=4))
    for name, value in {"CHECKPOINT_EVERY": 0.0, "EXITS": 64, "WALKS": 512, "SAMPLES": 128}.items():
        monkeypatch.setattr(training, name, value)
    monkeypatch.setenv(known_weights.ENVIRONMENT_VARIABLE, str(tmp_path / "weights"))
    monkeypatch.chdir(tmp_path)
    Path("ball.xml").write_text(XML)


def _invoke(*arguments: str) -> Any:
    return CliRunner().invoke(cli.app, list(arguments))


def _weights(folder: str = "weights") -> list[Path]:
    return sorted(Path(folder).glob("*"))


@pytest.mark.slow
def test_an_object_is_trained_measured_and_rendered(monkeypatch: Any) -> None:
    result = _invoke("train", "object", "--scene", "ball.xml", "--seconds", "2")
    assert result.exit_code == 0, result.output
    (record, path) = _weights()
    assert path.name in result.stdout and record.suffix == ".json"
    for words in ("ball", "constant", "lobes", "full_geometry", "mean / traced mean"):
        assert words in result.stdout
    traced = []
    monkeypatch.setattr(model_errors, "reference", lambda *a: traced.append(a) or REFERENCE(a[0], 32, 512, *a[3:]))
    chosen = [word for name in ("full_geometry", "better_dipole", "standard_dipole") for word in ("--model", name)]
    result = _invoke("errors", "object", "--scene", "ball.xml", "--object", "ball", *chosen)
    assert result.exit_code == 0, result.output
    table = pandas.read_csv("errors/errors.csv")
    assert list(table.columns) == ["object", "channel", "model", "light", "error", "standard_error", "ratio"]
    assert len(table) == 21 and len(traced) == 1  # three models, one truth; images of an even sky of one
    assert set(table[table.light == "even sky"].model) == {"full_geometry"}
    mean = table.groupby("model")["error"].mean()
    assert mean["full_geometry"] < 0.5 * mean["better_dipole"]
    result = _invoke("render", "ball.xml", "--model", "full_geometry", "--spp", "4")
    assert result.exit_code == 0 and Path("render/ball_full_geometry.exr").exists(), result.output


ASIDE = BALL.replace("NAME", "other").replace('value="1"/>', 'value="2"/><point name="center" x="5" y="0" z="0"/>')
TWO = XML.replace("  <sensor", f"{ASIDE}  <sensor")


def test_several_objects_are_each_trained_with_work_of_their_own(monkeypatch: Any) -> None:
    asked = []

    def learns(scene: Any, **how: Any) -> SimpleNamespace:
        asked.append((how["object"], how["work"]))
        model = SimpleNamespace(object=object_of(scene, None, None, how["object"]))
        return SimpleNamespace(model=model, path=None, errors=[], steps=0, seconds=0.0)

    monkeypatch.setattr(training, "train", learns)
    Path("two.xml").write_text(TWO)
    named = ("--object", "ball", "--object", "other", "--object", "ball")
    result = _invoke("train", "object", "--scene", "two.xml", *named, "--work", "work")
    assert result.exit_code == 0, result.output
    assert asked == [("ball", Path("work/ball")), ("other", Path("work/other"))]
    assert "ball: no weights" in result.stdout and "other: no weights" in result.stdout


def test_a_name_among_several_that_no_object_has_is_refused_before_any_is_trained(monkeypatch: Any) -> None:
    monkeypatch.setattr(training, "train", lambda *a, **how: pytest.fail("it began"))
    Path("two.xml").write_text(TWO)
    result = _invoke("train", "object", "--scene", "two.xml", "--object", "ball", "--object", "bell")
    assert result.exit_code == 2 and "bell" in result.stderr


def test_a_model_with_single_scattering_is_held_against_walks_with_it(monkeypatch: Any) -> None:
    fewest = []
    monkeypatch.setattr(model_errors, "reference", lambda *a: fewest.append(a[4]) or REFERENCE(a[0], 8, 64, *a[3:]))
    chosen = ("--model", "directional_dipole", "--model", "better_dipole", "--model", "normalized_diffusion")
    assert _invoke("errors", "object", "--scene", "ball.xml", *chosen).exit_code == 0
    assert fewest == [1, 2]


def test_as_many_exits_are_traced_as_are_asked_for(monkeypatch: Any) -> None:
    asked = []
    monkeypatch.setattr(model_errors, "reference", lambda *a: asked.append(a[1]) or REFERENCE(a[0], 8, 64, *a[3:]))
    for more in ((), ("--exits", "1024")):
        assert _invoke("errors", "object", "--scene", "ball.xml", "--model", "better_dipole", *more).exit_code == 0
    assert asked == [256, 1024]


@pytest.mark.slow
def test_all_models_that_take_an_object_are_measured_where_none_is_named(monkeypatch: Any) -> None:
    monkeypatch.setattr(model_errors, "reference", lambda *a: REFERENCE(a[0], 8, 64, *a[3:]))
    monkeypatch.setattr(learners, "errors_of", functools.partial(learners.errors_of, walks=64, samples=64))
    result = _invoke("errors", "object", "--scene", "ball.xml", "--exits", "8")
    assert result.exit_code == 0, result.output
    measured = set(pandas.read_csv("errors/errors.csv")["model"])
    assert measured >= {"neural", "neural_shape", "better_dipole", "photon_beam_diffusion"}
    assert not measured & {"auto", "lambert", "full_geometry"}


def test_a_render_says_what_trains_an_object() -> None:
    result = _invoke("render", "ball.xml", "--model", "full_geometry", "--train-seconds", "0")
    assert result.exit_code == 2 and "object 'ball' must be trained for full_geometry" in result.stderr
    assert "halfspace-sss train object --scene" in result.stderr and result.stderr.count("\n") == 1


def test_no_seconds_write_nothing_and_say_so() -> None:
    result = _invoke("train", "object", "--scene", "ball.xml", "--seconds", "0")
    assert result.exit_code == 0 and "no weights are written" in result.stdout
    assert "is rendered by better_dipole" in result.stderr and not _weights()


def _stops(monkeypatch: Any, error: BaseException) -> None:
    """Training is struck once, after its second chunk."""
    chunk, left = training._ObjectTraining._chunk, [1]

    def strike(run: Any, total: int) -> None:
        if run.done == 2 and left:
            left.pop()
            raise error
        chunk(run, total)

    monkeypatch.setattr(training._ObjectTraining, "_chunk", strike)


def _same(a: str, b: str) -> bool:
    (_, one), (_, two) = _weights(a), _weights(b)
    left, right = (load_weights(path, "full_geometry")[0] for path in (one, two))
    return left.keys() == right.keys() and all(np.array_equal(left[name], right[name]) for name in left)


@pytest.mark.slow
def test_an_interrupted_training_goes_on_to_the_same_weights(monkeypatch: Any) -> None:
    arguments = ("train", "object", "--scene", "ball.xml", "--seed", "3")
    assert _invoke(*arguments, "--out", "whole").exit_code == 0
    _stops(monkeypatch, KeyboardInterrupt())
    again = (*arguments, "--work", "work", "--out", "parts")
    assert _invoke(*again).exit_code == 130 and not _weights("parts")
    assert _invoke(*again).exit_code == 0 and _same("whole", "parts")


@pytest.mark.slow
def test_a_disk_that_fills_up_leaves_no_half_weights_and_work_to_go_on_from(monkeypatch: Any) -> None:
    arguments = ("train", "object", "--scene", "ball.xml", "--work", "work")
    sync = os.fsync

    def full(handle: int) -> None:
        if "safetensors" in os.readlink(f"/proc/self/fd/{handle}") and Path("work/checkpoint.safetensors").exists():
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        sync(handle)

    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", full)
        result = _invoke(*arguments)
    assert result.exit_code == 1 and "No space left on device" in result.stderr and not _weights()
    assert [path.name for path in Path("work").iterdir() if path.name.startswith(".")] == []
    assert _invoke(*arguments).exit_code == 0 and len(_weights()) == 2


TRAIN_BALL = ("train", "object", "--scene", "ball.xml")
ERRORS = ("errors", "object", "--scene", "ball.xml")
REFUSED = [
    (["train", "object", "--scene", "bal.xml"], "got 'bal.xml', which does not exist; did you mean 'ball.xml'?"),
    (["trade", "ball.xml", "--tolerance", "5"], "tolerance must be a number in [0.0001, 1], got 5.0"),
    ([*TRAIN_BALL, "--object", "cube"], "object must be one of ball, got 'cube'"),
    (["train", "object", "--scene", "two.xml"], "object must be one of ball, other, got None"),
    ([*TRAIN_BALL, "--seconds", "-1"], "seconds must be a number in [0, 1e+07], got -1.0"),
    (
        [*TRAIN_BALL, "--target-error", "2"],
        "target_error must be a number in [0.0001, 1], got 2.0",
    ),
    ([*TRAIN_BALL, "--seed", "-1"], "seed must be a whole number >= 0, got -1"),
    (
        [*TRAIN_BALL, "--model", "neural"],
        "model must be one of full_geometry, got 'neural'",
    ),
    ([*TRAIN_BALL, "--out", "ball.xml"], "folder must be a folder or new, got 'ball.xml'"),
    ([*TRAIN_BALL, "--define", "x"], "define must be NAME=VALUE, got 'x'"),
    ([*ERRORS, "--model", "no_model"], "model must be one of"),
    ([*ERRORS, "--model", "neural_shap"], "did you mean 'neural_shape'?"),
    (
        ["errors", "object", "--scene", "ball.xml", "--model", "full_geometry"],
        "object 'ball' must be trained for full_geometry",
    ),
    ([*ERRORS, "--model", "auto"], "has S for two points of a surface, got 'auto'"),
    (
        ["errors", "object", "--scene", "ball.xml", "--model", "lambert"],
        "has S for two points of a surface, got 'lambert'",
    ),
    ([*ERRORS, "--exits", "1"], "exits must be a whole number >= 2, got 1"),
    ([*ERRORS, "--seed", "-1"], "seed must be a whole number >= 0, got -1"),
]


@pytest.mark.parametrize(("arguments", "message"), REFUSED, ids=[" ".join(a) for a, _ in REFUSED])
def test_bad_input_is_refused_before_anything_is_traced(arguments: list[str], message: str, monkeypatch: Any) -> None:
    Path("two.xml").write_text(TWO)
    before = sorted(Path().iterdir())
    monkeypatch.setattr(training, "reference", None)
    monkeypatch.setattr(model_errors, "reference", None)
    result = _invoke(*arguments)
    assert result.exit_code == 2, result.output
    assert message in result.stderr and result.stderr.count("\n") == 1
    assert sorted(Path().iterdir()) == before
