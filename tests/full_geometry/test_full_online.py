"""Scenes with objects that are not trained: walks that learn and make the image, and how such renders end and go on.

Means of walks are compared at four standard errors.
"""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

mi = pytest.importorskip("mitsuba")
pytest.importorskip("torch")

import drjit as dr  # noqa: E402

import full_geometry  # noqa: E402
from figures import app as cli  # noqa: E402
from full_geometry.learning import training  # noqa: E402
from full_geometry.learning.network_fitting import Recipe  # noqa: E402
from full_geometry.learning.online import combined  # noqa: E402
from full_geometry.learning.training import CameraSchedule  # noqa: E402
from full_geometry.objects.objects import object_of  # noqa: E402
from full_geometry.scenes import camera_walks, reference  # noqa: E402
from full_geometry.scenes.reference_store import Reference  # noqa: E402
from full_geometry.scenes.scene_files import open_scene  # noqa: E402
from full_geometry.transport.exit_pairs import trace_exits  # noqa: E402
from halfspace_sss.neural import store as known_weights  # noqa: E402
from halfspace_sss.neural.store import load_weights  # noqa: E402

QUICK = Recipe(width=24, depth=2, batch=1024, chunk=2**13, reuse=4)
TRAIN = training.train
SURFACE = """<bsdf type="translucent"><string name="model" value="full_geometry"/>
  <string name="sigma_s" value="0.95,0.8,0.6"/><string name="sigma_a" value="0.05,0.2,0.4"/></bsdf>"""
BALL = f"""<shape type="sphere" id="ball"><float name="radius" value="1"/>{SURFACE}</shape>"""
XML = f"""<scene version="3.0.0">
  <integrator type="bssrdf"><float name="mm_per_unit" value="2"/></integrator>
  <emitter type="constant"/>
  {BALL}
  <sensor type="perspective"><transform name="to_world"><lookat origin="0,0,5" target="0,0,0" up="0,1,0"/></transform>
    <film type="hdrfilm"><integer name="width" value="12"/><integer name="height" value="12"/>
      <rfilter type="box"/></film>
  </sensor>
</scene>
"""
IMAGE, WALKS, MODEL = (Path("render") / f"ball_scene.{ending}" for ending in ("exr", "walks.exr", "model.exr"))


def _patch(patch: pytest.MonkeyPatch, folder: Path) -> None:
    """A recipe of seconds and a scene, in an empty folder, where weights are looked for too."""
    mi.set_variant("llvm_ad_rgb")
    full_geometry.register()
    patch.setattr(training, "train", lambda *a, **how: TRAIN(*a, **{**how, "recipe": QUICK, "chunks": 4}))
    for name, value in {"CHECKPOINT_EVERY": 0.0, "EXITS": 32, "WALKS": 256, "SAMPLES": 64}.items():
        patch.setattr(training, name, value)
    patch.setattr(cli, "drawers", lambda: None)
    patch.setenv(known_weights.ENVIRONMENT_VARIABLE, str(folder / "weights"))
    patch.chdir(folder)
    Path("ball.xml").write_text(XML)


@pytest.fixture(autouse=True)
def _small(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    _patch(monkeypatch, tmp_path)


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder in which a render of the scene has run undisturbed; what it told is in `told`."""
    folder = tmp_path_factory.mktemp("whole")
    with pytest.MonkeyPatch.context() as patch:
        _patch(patch, folder)
        result = _render()
        assert result.exit_code == 0, result.output
        Path("told").write_text(result.stderr)
    return folder


@pytest.fixture
def finished(whole: Path, tmp_path: Path) -> None:
    """A copy of that folder as the one to work in."""
    shutil.copytree(whole, tmp_path, dirs_exist_ok=True)


def _render(*arguments: str, file: str = "ball.xml", seconds: str = "60") -> Any:
    return CliRunner().invoke(cli.app, ["render", file, "--spp", "8", "--train-seconds", seconds, *arguments])


def _weights() -> list[Path]:
    return sorted(Path("weights").glob("*.safetensors"))


@pytest.mark.slow
def test_a_render_of_an_object_without_weights_says_so_learns_it_and_makes_one_image_of_both(finished: None) -> None:
    told = "object 'ball' has no weights of full_geometry yet: it is learnt for 60 s"
    assert Path("told").read_text().count(told) == 1
    image, walks, model = (reference.load(path) for path in (IMAGE, WALKS, MODEL))
    about = json.loads(IMAGE.with_suffix(".json").read_text())
    (trained,) = about["training"]
    assert trained["object"] == "ball" and trained["weights"] == _weights()[0].name and len(trained["errors"]) == 6
    assert about["combined"]["walks"]["spp"] == walks.spp and about["combined"]["model"]["spp"] == model.spp == 8
    assert 0 < about["combined"]["share_of_walks"] < 1 and walks.passes > 4
    assert image.relative_error < min(walks.relative_error, model.relative_error)
    low, high = np.minimum(walks.mean, model.mean), np.maximum(walks.mean, model.mean)
    assert np.all((low - 1e-6 <= image.mean) & (image.mean <= high + 1e-6))


@pytest.mark.slow
def test_the_second_render_needs_no_training(finished: None) -> None:
    result = _render()
    assert result.exit_code == 0 and "no weights" not in result.stderr
    assert "combined" not in json.loads(IMAGE.with_suffix(".json").read_text()) and not WALKS.exists()


@pytest.mark.slow
def test_a_finished_render_goes_on_to_more_samples_with_its_walks(finished: None) -> None:
    before = reference.load(WALKS)
    assert _render("--spp", "16", "--resume").exit_code == 0
    about = json.loads(IMAGE.with_suffix(".json").read_text())
    assert np.array_equal(reference.load(WALKS).mean, before.mean)
    assert about["combined"]["model"]["spp"] == 16 and about["training"]


def _stops(monkeypatch: Any, error: BaseException, owner: Any, name: str, when: int) -> None:
    """A function is struck once, at its call number `when`."""
    whole, calls = getattr(owner, name), []

    def strike(*arguments: Any, **more: Any) -> Any:
        calls.append(name)
        if len(calls) == when:
            raise error
        return whole(*arguments, **more)

    monkeypatch.setattr(owner, name, strike)


PHASES = {"learning": (training._ObjectTraining, "_chunk", 3), "rendering": (reference, "_pass", 3)}


@pytest.mark.slow
@pytest.mark.parametrize("phase", PHASES)
def test_an_interrupted_render_goes_on_to_the_same_weights_and_image(phase: str, whole: Path, monkeypatch: Any) -> None:
    with monkeypatch.context() as patch:
        _stops(patch, KeyboardInterrupt(), *PHASES[phase])
        result = _render()
    assert result.exit_code == 130 and "kept for --resume" in result.stderr and not IMAGE.exists()
    assert _render("--resume").exit_code == 0
    weights, again = (load_weights(path, "full_geometry")[0] for path in (whole / _weights()[0], _weights()[0]))
    assert all(np.array_equal(again[name], value) for name, value in weights.items())
    _same_image(whole)
    assert sorted(p.name for p in Path("render").iterdir() if "unfinished" in p.name) == []


def _same_image(whole: Path) -> None:
    found, wanted = reference.load(IMAGE), reference.load(whole / IMAGE)
    assert found.spp == wanted.spp and found.passes == wanted.passes
    assert np.allclose(found.mean, wanted.mean, rtol=1e-5, atol=1e-6)


def test_a_folder_of_weights_that_cannot_be_written_to_is_refused_before_anything_is_traced(monkeypatch: Any) -> None:
    Path("weights").write_text("")
    _refused(monkeypatch, "folder must be a folder or new", _render())


def _refused(monkeypatch: Any, message: str, result: Any) -> None:
    assert result.exit_code == 2 and message in result.stderr and result.stderr.count("\n") == 1, result.stderr
    assert not Path("render").exists()


@pytest.mark.parametrize(
    ("old", "new", "arguments", "message"),
    [
        ("", "", ["--train-seconds", "0"],
         "`halfspace-sss train object --scene SCENE.xml --object ball` trains it"),
        ("", "", ["--train-seconds", "-1"], "train_seconds must be a number in [0, 1e+07], got -1.0"),
        ("", "", ["--train-error", "0"], "train_error must be a number in [0.0001, 1], got 0.0"),
        ("</bsdf>", '<bsdf type="roughdielectric"><float name="int_ior" value="1.3"/><float name="ext_ior" value="1"/>'
         "</bsdf></bsdf>", [], "the boundary of object 'ball' must be smooth"),
        ('"sigma_s" value="0.95,0.8,0.6"', '"sigma_s" value="0.95,-1,0.6"', [], "sigma_s must be"),
    ],
)  # fmt: skip
def test_what_cannot_be_learnt_is_refused_before_anything_is_traced(
    old: str, new: str, arguments: list[str], message: str, monkeypatch: Any
) -> None:
    Path("ball.xml").write_text(XML.replace(old, new, 1) if old else XML)
    monkeypatch.setattr(training, "train", None)
    monkeypatch.setattr(camera_walks.CameraWalks, "exits", None)
    _refused(monkeypatch, message, _render(*arguments))


@pytest.mark.slow
def test_two_objects_are_learnt_one_after_the_other_and_copies_share_what_was_learnt(monkeypatch: Any) -> None:
    others = "".join(
        BALL.replace('id="ball"', f'id="{name}"').replace("<float", f'<point name="center" value="{x},0,0"/><float')
        .replace('"1"', f'"{radius}"')
        for name, x, radius in (("copy", 3, 1), ("small", -3, 0.7))
    )  # fmt: skip
    Path("ball.xml").write_text(XML.replace(BALL, BALL + others))
    result = _render()
    assert result.exit_code == 0, result.output
    about = json.loads(IMAGE.with_suffix(".json").read_text())
    assert (
        sorted(r["object"] for r in about["training"])[-1] == "small" and len(about["training"]) == len(_weights()) == 2
    )


@pytest.mark.slow
def test_an_object_with_a_model_of_the_half_space_keeps_walks_out_of_the_image() -> None:
    other = BALL.replace('id="ball"', 'id="plane"').replace("full_geometry", "better_dipole")
    other = other.replace("<float", '<point name="center" value="3,0,0"/><float')
    Path("ball.xml").write_text(XML.replace(BALL, BALL + other))
    result = _render()
    assert result.exit_code == 0 and "cannot join the image" in result.stderr and not WALKS.exists() and _weights()


@pytest.mark.parametrize("render", [lambda scene: mi.render(scene, spp=4), lambda scene: _render(seconds="0")])
def test_a_render_starts_no_training(render: Any, monkeypatch: Any) -> None:
    monkeypatch.setattr(training, "train", None)
    monkeypatch.setattr(training, "_ObjectTraining", None)
    monkeypatch.setattr(camera_walks.CameraWalks, "exits", None)
    command = "must be trained for full_geometry.*`halfspace-sss train object --scene SCENE.xml --object ball`"
    try:
        told = render(open_scene("ball.xml")).stderr
    except RuntimeError as error:  # of `mi.render`
        told = str(error)
    assert re.search(command, told)
    assert not Path("weights").exists()


def test_first_exits_of_paths_from_the_camera_are_those_of_walks_from_where_they_enter(tmp_path: Path) -> None:
    scene = open_scene("ball.xml")
    settings = scene.integrator().settings
    walks = camera_walks.CameraWalks(scene, settings, 0, 3, tmp_path / "walks.exr", {})
    (found,) = walks.exits(scene.shapes()[0], 0, 256)
    own, other = found.exits, trace_exits(object_of(scene, None), found.start, (5,))
    T, T_other = np.array(dr.select(own.order >= 2, own.T, 0)), np.array(other.T)
    assert T.shape[1] > 5000 and abs(walks.hits(scene.shapes()[0]) - T.shape[1] / 256) < 12
    for f in (lambda x, w: 1.0, lambda x, w: x[2] ** 2, lambda x, w: np.maximum(w[1], 0), lambda x, w: w[2] ** 4):
        a = T * f(np.array(own.at.p), np.array(own.at.w))
        b = T_other * f(np.array(other.at.p), np.array(other.at.w))
        error = np.sqrt((a.var(axis=1) + b.var(axis=1)) / a.shape[1])
        assert np.all(np.abs(a.mean(axis=1) - b.mean(axis=1)) < 4 * error)


def test_passes_of_the_camera_are_at_most_half_of_the_walks_and_few_where_the_object_is_small() -> None:
    assert CameraSchedule.of(1000, 0, 100) is None
    assert CameraSchedule.of(8000, 100, 200) == (10, 4, 1)  # 40 x 100 of 8000
    assert CameraSchedule.of(8000, 1, 200) == (20, 4, 1)  # 4 x 20 x 200 = 2 x 8000 rays at most
    assert CameraSchedule.of(1000, 2000, 10000) == (1, 1, 5)
    assert CameraSchedule(1, 1, 5).numbers(3) == [] and CameraSchedule(2, 4, 1).numbers(1) == [4, 5, 6, 7]


def _noisy(rng: np.random.Generator, passes: int, spread: float) -> Reference:
    """Passes of an image of 1 with a heavy tail."""
    found = Reference(np.zeros((32, 32, 3)), np.zeros((32, 32, 3)), 0, 0, 0.0)
    for _ in range(passes):
        image = rng.lognormal(-0.5 * spread**2, spread, (32, 32, 3))
        found = found.add(image, 4, 1.0)
    return found


def test_the_combination_of_two_images_is_not_biased_and_has_less_variance_than_either() -> None:
    rng, means, variances = np.random.default_rng(4), [], []
    for _ in range(40):
        walks, model = _noisy(rng, 4, 1.0), _noisy(rng, 6, 1.5)
        found = combined(walks, model)
        means.append(found.mean.mean())
        variances.append([image.variance.sum() for image in (found, walks, model)])
    assert abs(np.mean(means) - 1) < 4 * np.std(means, ddof=1) / np.sqrt(len(means))
    together, *alone = np.mean(variances, axis=0)
    assert together < 0.9 * min(alone)
    assert found.spp == 40 and found.passes == 10
