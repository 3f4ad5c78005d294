"""The command `render`: what it refuses, how it goes on, and which files are there whenever it ends."""

from __future__ import annotations

import errno
import json
import os
import re
import shutil
import signal
import subprocess
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from render_files import BAD_SCENES, START, XML
from typer.testing import CliRunner

from figures import app as cli

mi = pytest.importorskip("mitsuba")


@pytest.fixture
def scene(tmp_path: Path, monkeypatch: Any) -> Path:
    monkeypatch.setattr(cli, "drawers", lambda: None)
    file = tmp_path / "ball.xml"
    file.write_text(XML)
    return file


@pytest.fixture(scope="module")
def rendered(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The files of a render of two samples."""
    file = tmp_path_factory.mktemp("rendered") / "ball.xml"
    file.write_text(XML)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(cli, "drawers", lambda: None)
        assert _render(file, "--spp", "2").exit_code == 0
    return file.parent / "out"


def _render(file: Path, *arguments: str, out: str = "out") -> Any:
    return CliRunner().invoke(cli.app, ["render", str(file), *arguments, "--out", str(file.parent / out)])


def _spp(file: Path) -> int:
    from full_geometry.scenes import reference

    return reference.load(file).spp


def _set(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in sorted(folder.iterdir())}


NAMES = ["ball_scene.exr", "ball_scene.json", "ball_scene.png"]


@pytest.mark.parametrize("case", BAD_SCENES)
def test_a_scene_that_cannot_be_rendered_ends_with_2_and_one_line(case: str, scene: Path) -> None:
    old, new, message = BAD_SCENES[case]
    assert old in XML
    scene.write_text(XML.replace(old, new))
    result = _render(scene, "--spp", "2")
    assert (result.exit_code, result.stdout) == (2, "")
    assert message in result.stderr and result.stderr.startswith("error: ") and result.stderr.count("\n") == 1
    assert not (scene.parent / "out").exists()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--orders", "nope"], "'nope' is not one of 'total', 'multiple', 'single'"),
        (["--model", "neurl"], "did you mean 'neural'?"),
        (["--variant", "llvm_ad_mono"], "channel must be given under a mono variant, got none for marble"),
        (["--variant", "scalar_rgb"], "'scalar_rgb' is not one of 'llvm_ad_rgb'"),
        (["--target-error", "4"], "target_error must be a number in [1e-06, 1], got 4.0"),
        (["--target-error", "-1"], "target_error must be a number in [1e-06, 1], got -1.0"),
        (["--target-error", "nan"], "target_error must be a number in [1e-06, 1], got nan"),
        (["--target-error", "0"], "target_error must be a number in [1e-06, 1], got 0.0"),
        (["--spp", "0"], "spp must be a whole number >= 1, got 0"),
        (["--seed", "-1"], "seed must be a whole number >= 0, got -1"),
    ],
)
def test_a_wrong_argument_ends_with_2_and_leaves_the_files_of_before(
    arguments: list[str], message: str, scene: Path, rendered: Path
) -> None:
    shutil.copytree(rendered, scene.parent / "out")
    before = _set(scene.parent / "out")
    result = _render(scene, *arguments)
    assert result.exit_code == 2
    assert message in result.stderr and result.stderr.count("\n") == 1
    assert _set(scene.parent / "out") == before


@pytest.mark.slow
def test_a_scene_without_ids_goes_on_to_more_samples_as_if_they_were_asked_for_at_once(tmp_path: Path) -> None:
    (tmp_path / "ball.xml").write_text(XML)
    for spp, out in (("4", "a"), ("64", "a"), ("64", "b")):
        run = [*START, "render", "ball.xml", "--spp", spp, "--resume", "--out", out]
        done = subprocess.run(run, capture_output=True, text=True, cwd=tmp_path)
        assert done.returncode == 0, done.stderr
    a, b = ({name: (tmp_path / out / name).read_bytes() for name in ("ball_scene.png",)} for out in "ab")
    assert a == b and _spp(tmp_path / "a" / "ball_scene.exr") == 64


def test_samples_are_as_many_as_asked_for(scene: Path) -> None:
    assert "100 samples a pixel" in _render(scene, "--spp", "1e2").stdout
    assert _spp(scene.parent / "out" / "ball_scene.exr") == 100


def test_only_finished_files_are_left(scene: Path) -> None:
    for _ in range(2):
        assert _render(scene, "--spp", "2").exit_code == 0
        assert list(_set(scene.parent / "out")) == NAMES


def _belong_together(folder: Path, stem: str) -> bool:
    """Whether the files of a stem are of one render: the JSON is the header of the EXR."""
    header = json.loads((folder / f"{stem}.json").read_text())
    return json.loads(mi.Bitmap(str(folder / f"{stem}.exr")).metadata()["halfspace_sss"]) == header


@pytest.mark.slow
def test_an_interrupt_keeps_the_files_of_before_and_what_is_done_under_another_name(
    scene: Path, monkeypatch: Any
) -> None:
    assert _render(scene, "--spp", "2").exit_code == 0
    out = scene.parent / "out"
    before, done = _set(out), mi.render

    def render(*arguments: Any, **more: Any) -> Any:
        if more["spp"] > 1:
            raise KeyboardInterrupt
        return done(*arguments, **more)

    with monkeypatch.context() as patch:
        patch.setattr(mi, "render", render)
        result = _render(scene, "--spp", "64", "--seed", "1")
    assert result.exit_code == 130
    assert "interrupted; 8 samples a pixel are kept for --resume in" in result.stderr.replace("\n", " ")
    after = _set(out)
    assert {name: after[name] for name in before} == before
    assert sorted(set(after) - set(before)) == ["ball_scene.unfinished.exr", "ball_scene.unfinished.json"]
    result = _render(scene, "--spp", "64", "--seed", "1", "--resume")
    assert result.exit_code == 0 and list(_set(out)) == NAMES and _belong_together(out, "ball_scene")
    assert _spp(out / "ball_scene.exr") == 64


@pytest.mark.parametrize("call", range(8))
def test_a_full_disk_at_any_write_leaves_files_of_one_render(
    call: int, scene: Path, rendered: Path, monkeypatch: Any
) -> None:
    out = shutil.copytree(rendered, scene.parent / "out")
    before, calls = _set(out), []

    def refuse(*_: Any, do: Any) -> Any:
        calls.append(do)
        if len(calls) == call + 1:
            raise OSError(errno.ENOSPC, "No space left on device")
        return do(*_)

    with monkeypatch.context() as patch:
        for name in ("fsync", "replace"):
            real = getattr(os, name)
            patch.setattr(f"halfspace_sss.provenance.os.{name}", lambda *a, real=real: refuse(*a, do=real))
        result = _render(scene, "--spp", "8", "--seed", "1")
    after = _set(out)
    if result.exit_code == 0:
        assert len(calls) <= call and list(after) == NAMES
    else:
        assert result.exit_code == 1
        assert "No space left on device: '" in result.stderr and result.stderr.count("\n") <= 2
        assert {name: after.get(name) for name in before} == before or "ball_scene.png" not in after
    if "ball_scene.json" in after:
        assert _belong_together(out, "ball_scene")
    assert not [name for name in after if name.startswith(".")]


@pytest.mark.parametrize("model", ["better_dipole", "path_traced"])
def test_a_model_takes_the_place_of_an_integrator_that_does_not_know_the_inside(model: str, scene: Path) -> None:
    images = []
    for kind in ("path", "bssrdf"):
        scene.write_text(XML.replace('"bssrdf"', f'"{kind}"'))
        result = _render(scene, "--spp", "4", "--model", model, out=kind)
        assert result.exit_code == 0
        told = "the integrator 'path' of the scene is replaced by"
        assert (told in result.stderr) == (kind == "path")
        images.append(np.array(mi.Bitmap(str(scene.parent / kind / f"ball_{model}.exr")))[..., :3])
    np.testing.assert_allclose(*images, rtol=1e-5, atol=1e-6)  # samples are added in any order


def test_orders_take_the_place_of_an_integrator_that_does_not_know_the_inside(scene: Path) -> None:
    scene.write_text(XML.replace('"bssrdf"', '"path"'))
    assert "replaced by 'bssrdf'" in _render(scene, "--spp", "1", "--orders", "single").stderr


def test_an_integrator_that_does_not_know_the_inside_is_warned_of(scene: Path) -> None:
    scene.write_text(XML.replace('"bssrdf"', '"path"'))
    result = _render(scene, "--spp", "1")
    (line,) = [line for line in result.stderr.splitlines() if line.startswith("warning: ")]
    assert "the integrator 'path' of the scene shows no light from inside" in line


def test_a_warning_of_mitsuba_is_a_line_on_stderr(scene: Path, monkeypatch: Any) -> None:
    from full_geometry.scenes import scene_files

    load = scene_files.open_scene

    def warned(*arguments: Any) -> Any:
        mi.Log(mi.LogLevel.Warn, "the lens is\n thick")
        return load(*arguments)

    monkeypatch.setattr(scene_files, "open_scene", warned)
    result = _render(scene, "--spp", "1")
    assert re.search(r"^warning: .*the lens is thick$", result.stderr, re.MULTILINE) and "thick" not in result.stdout


def test_a_scene_without_integrator_is_rendered_by_ours(scene: Path) -> None:
    text = XML[: XML.index("  <integrator")] + XML[XML.index("  <emitter") :]
    scene.write_text(text)
    assert _render(scene, "--spp", "1").exit_code == 0


SKY = XML.replace('origin="0,0,40" target="0,0,0"', 'origin="0,0,40" target="0,0,80"')
DARK = XML.replace('<emitter type="constant"/>', "")


@pytest.mark.parametrize(
    ("text", "message"),
    [(SKY, "the camera sees nothing that varies, such as the sky alone"), (DARK, "every pixel is black")],
    ids=["only sky", "black"],
)
@pytest.mark.parametrize("arguments", [["--target-error", "0.01"], ["--spp", "8"]])
def test_an_image_without_noise_ends_at_once_and_says_why(
    text: str, message: str, arguments: list[str], scene: Path
) -> None:
    scene.write_text(text)
    result = _render(scene, *arguments)
    assert result.exit_code == 0
    assert message in result.stdout and "8 samples a pixel" in result.stdout
    json.loads((scene.parent / "out" / "ball_scene.json").read_text(), parse_constant=pytest.fail)


def test_one_pass_claims_no_error(scene: Path) -> None:
    result = _render(scene, "--spp", "1")
    assert "one pass has no estimate of its error" in result.stdout
    assert "inf" not in result.stdout + result.stderr


@pytest.mark.parametrize(
    ("share", "error", "wanted", "told"),
    [(0.0, 0.1, 0.01, False), (0.004, 0.1, 0.01, False), (0.3, 0.1, 0.01, True), (0.3, 0.0026, 0.01, False),
     (0.3, 0.0026, 0.001, True)],
)  # fmt: skip
def test_light_met_by_chance_is_told_in_a_sentence_where_it_is_a_share_of_noise_that_matters(
    share: float, error: float, wanted: float, told: bool
) -> None:
    from full_geometry.cli.render import _error
    from full_geometry.scenes.reference_store import BY_CHANCE, Reference

    image = np.full((2, 2, 3), 1.0)
    whole = 4 * 3 * error**2  # of the variance of all pixels
    about = {BY_CHANCE: share * whole * 8**2}
    known = Reference(mean=image, variance=error**2 * image, passes=2, spp=8, seconds=1.0, about=about)
    sentence = "; up to 30% of the variance is from light that scattered at most once inside and then hit an emitter by"
    found = _error(known, wanted)
    assert f"error of the image {error:.2%}" in found
    assert (sentence in found) == told and "variance" not in found.replace(sentence, "")


@pytest.mark.slow
@pytest.mark.skipif(os.name == "nt", reason="POSIX signals")
@pytest.mark.parametrize(
    ("model", "after"),
    [
        ("better_dipole", 0.05),
        ("better_dipole", 1.0),
        ("better_dipole", 2.0),
        ("path_traced", 0.5),
        ("path_traced", 1.5),
    ],
)
def test_an_interrupt_at_any_moment_ends_with_130_and_one_line(model: str, after: float, scene: Path) -> None:
    run = [*START, "render", str(scene), "--model", model, "--spp", "1e7", "--out", str(scene.parent / "out")]
    code = run[2].replace("main()", "print('ready', flush=True); main()")  # before, Python itself listens
    process = subprocess.Popen([run[0], "-c", code, *run[3:]],
                               stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)  # fmt: skip
    assert process.stdout.readline() == "ready\n"
    time.sleep(0.1 + after)
    process.send_signal(signal.SIGINT)
    _, messages = process.communicate(timeout=60)
    assert process.returncode == 130
    lines = [line for line in messages.splitlines() if line and not line.startswith("rendering")]
    assert len(lines) == 1 and lines[0].startswith("interrupted; ")
    out = scene.parent / "out"
    left = sorted(path.name for path in out.iterdir()) if out.exists() else []
    assert left in ([], [f"ball_{model}.unfinished.exr", f"ball_{model}.unfinished.json"])
    if left:
        assert _spp(out / left[0]) > 0
