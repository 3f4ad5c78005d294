"""Wishes to the command `render`: a sensor, values of parameters, a time, an image without noise, a page."""

from __future__ import annotations

import base64
import re
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from render_files import INTEGRATOR, SENSOR, XML
from typer.testing import CliRunner

from figures import app as cli
from full_geometry.cli import render as cli_render
from full_geometry.scenes import reference

mi = pytest.importorskip("mitsuba")


@pytest.fixture
def scene(tmp_path: Path, monkeypatch: Any) -> Path:
    """A scene file."""
    file = tmp_path / "ball.xml"
    file.write_text(XML)
    return file


def _render(file: Path, *arguments: str, out: str = "out") -> Any:
    return CliRunner().invoke(cli.app, ["render", str(file), *arguments, "--out", str(file.parent / out)])


def _names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


SET = ["ball_scene.exr", "ball_scene.html", "ball_scene.json", "ball_scene.png"]
DENOISED = ["ball_scene.denoised.exr", "ball_scene.denoised.png"]


def test_a_page_that_holds_all_it_shows_lies_beside_the_render(scene: Path) -> None:
    result = _render(scene, "--spp", "2")
    assert result.exit_code == 0 and _names(scene.parent / "out") == SET
    page = (scene.parent / "out" / "ball_scene.html").read_text()
    (image,) = re.findall(r"data:image/\w+;base64,([\w+/=]+)", page)
    assert Image.open(BytesIO(base64.b64decode(image))).size == tuple(
        mi.Bitmap(str(scene.parent / "out" / SET[0])).size()
    )
    assert "http" not in page.replace("http://www.w3.org", "")
    assert str(scene.parent / "out" / "ball_scene.html") in result.stdout


@pytest.mark.slow
def test_a_denoised_image_lies_beside_the_other_and_on_the_page(scene: Path) -> None:
    pytest.importorskip("mitsuba_oidn")
    result = _render(scene, "--spp", "4", "--denoise")
    assert result.exit_code == 0 and "the film has no box filter" in result.stderr
    out = scene.parent / "out"
    assert _names(out) == sorted([*SET, *DENOISED])
    long = _render(scene, "--spp", "256", out="long")
    assert long.exit_code == 0
    truth = reference.load(scene.parent / "long" / "ball_scene.exr").mean
    noisy = reference.load(out / "ball_scene.exr").mean
    clean = np.array(mi.Bitmap(str(out / "ball_scene.denoised.exr")))
    assert np.sum((clean - truth) ** 2) < np.sum((noisy - truth) ** 2)
    assert re.search(r"error of the denoised image [\d.]+% ± [\d.]+%, bias of denoising included", result.stdout)
    assert len(re.findall("data:image/", (out / "ball_scene.html").read_text())) == 2


def test_a_denoised_image_of_before_does_not_outlive_its_render(scene: Path) -> None:
    pytest.importorskip("mitsuba_oidn")
    for arguments in (["--denoise"], []):
        assert _render(scene, "--spp", "1", *arguments).exit_code == 0
    assert _names(scene.parent / "out") == SET


def test_without_the_denoiser_nothing_is_rendered_in_vain(scene: Path, monkeypatch: Any) -> None:
    monkeypatch.setattr(cli_render, "find_spec", lambda name: None)
    result = _render(scene, "--denoise")
    assert result.exit_code == 1 and "denoising needs mitsuba-oidn" in result.stderr
    assert not (scene.parent / "out").exists()


def test_without_figures_there_are_image_and_picture(scene: Path, monkeypatch: Any) -> None:
    monkeypatch.setattr(cli, "drawers", lambda: None)
    assert _render(scene, "--spp", "1").exit_code == 0
    assert _names(scene.parent / "out") == [name for name in SET if not name.endswith("html")]


def test_another_sensor_has_files_of_its_own(scene: Path) -> None:
    other = SENSOR.replace("0,0,40", "0,40,1").replace('"width" value="16"', '"width" value="24"')
    scene.write_text(XML.replace("</scene>", other + "</scene>"))
    for k in ("0", "1"):
        assert _render(scene, "--spp", "1", "--sensor", k).exit_code == 0
    shapes = [reference.load(scene.parent / "out" / f"ball_scene{end}.exr").mean.shape for end in ("", "_sensor1")]
    assert shapes == [(16, 16, 3), (16, 24, 3)]
    refused = _render(scene, "--sensor", "2")
    assert refused.exit_code == 2
    assert "sensor must be below 2, the number of sensors of the scene, got 2" in refused.stderr


@pytest.mark.parametrize("asked", ["1,0", "all"])
def test_several_sensors_are_rendered_by_one_command(asked: str, scene: Path, monkeypatch: Any) -> None:
    monkeypatch.setattr(cli, "drawers", lambda: None)
    scene.write_text(XML.replace("</scene>", SENSOR.replace("0,0,40", "0,40,1") + "</scene>"))
    assert _render(scene, "--spp", "1", "--sensor", asked).exit_code == 0
    found = {path.name: reference.load(path) for path in (scene.parent / "out").glob("*.exr")}
    assert {name: one.about["sensor"] for name, one in found.items()} == {
        "ball_scene.exr": 0,
        "ball_scene_sensor1.exr": 1,
    }


@pytest.mark.parametrize("asked", ["0,2", "-1", "1.5", "both", ""])
def test_sensors_that_are_not_there_are_refused_before_any_is_rendered(asked: str, scene: Path) -> None:
    scene.write_text(XML.replace("</scene>", SENSOR.replace("0,0,40", "0,40,1") + "</scene>"))
    result = _render(scene, "--spp", "1", f"--sensor={asked}")
    assert result.exit_code == 2 and result.stderr.startswith("error: sensor must be ")
    assert not list((scene.parent / "out").glob("*.exr"))


AOV = '<integrator type="aov"><string name="aovs" value="albedo:albedo,d:depth"/>{}</integrator>'


def test_channels_of_aovs_have_their_names(scene: Path, monkeypatch: Any) -> None:
    monkeypatch.setattr(cli, "drawers", lambda: None)
    scene.write_text(XML.replace(INTEGRATOR, AOV.format(INTEGRATOR)))
    for more in ((), ("--resume",)):
        assert _render(scene, "--spp", "2", *more).exit_code == 0
        file = scene.parent / "out" / "ball_scene.exr"
        names = {channel.name for channel in mi.Bitmap(str(file)).struct_()}
        assert {"R", "G", "B", "albedo.R", "albedo.G", "albedo.B", "d.T", "variance.d.T"} <= names
        found = reference.load(file)
        assert found.about["channels"] == ["R", "G", "B", "albedo.R", "albedo.G", "albedo.B", "d.T"]
        assert 30 < found.mean[8, 8, 6] < 40  # from the camera to the ball


def test_parameters_of_the_scene_are_given_by_name(scene: Path) -> None:
    scene.write_text(XML.replace('name="width" value="16"', 'name="width" value="$w"'))
    assert _render(scene, "--spp", "1", "-D", "w=9").exit_code == 0
    assert reference.load(scene.parent / "out" / "ball_scene.exr").mean.shape == (16, 9, 3)


@pytest.mark.parametrize(
    ("given", "message"),
    [("w", "define must be NAME=VALUE, got 'w'"), ("=3", "define must be NAME=VALUE"), ("nope=3", "nope")],
)
def test_a_parameter_that_the_scene_does_not_have_is_refused(given: str, message: str, scene: Path) -> None:
    result = _render(scene, "-D", given)
    assert result.exit_code == 2
    assert message in result.stderr and result.stderr.count("\n") == 1
    assert not (scene.parent / "out").exists()


def test_a_render_ends_after_its_time(scene: Path) -> None:
    assert _render(scene, "--seconds", "0.5").exit_code == 0
    found = reference.load(scene.parent / "out" / "ball_scene.exr")
    assert 0.5 <= found.seconds < 10
    assert _render(scene, "--seconds", "0").exit_code == 2


def test_a_mono_render_has_a_page_too(scene: Path) -> None:
    scene.write_text(XML.replace('value="marble"/>', 'value="marble"/><string name="channel" value="G"/>'))
    result = _render(scene, "--spp", "1", "--variant", "llvm_ad_mono")
    assert result.exit_code == 0, result.stderr
    assert _names(scene.parent / "out") == SET


def test_a_spectral_render_has_a_page_too(scene: Path) -> None:
    spectrum = '<spectrum name="albedo" value="360:0.8, 830:0.95"/> <float name="sigma_t" value="3"/>'
    material = '<string name="material" value="marble"/>'
    assert material in XML
    scene.write_text(XML.replace(material, spectrum))
    result = _render(scene, "--spp", "1", "--variant", "llvm_ad_spectral")
    assert result.exit_code == 0, result.stderr
    assert _names(scene.parent / "out") == SET


@pytest.mark.parametrize("command", ["errors materials", "train material"])
def test_only_the_chosen_channels_are_taken(command: str, monkeypatch: Any, tmp_path: Path) -> None:
    seen = []

    def stop(media: Any, *_: Any, **__: Any) -> None:
        seen.extend(media if isinstance(media, list) else [media])
        if len(seen) == 4:
            raise ValueError("enough")
        return []

    monkeypatch.setattr("halfspace_sss.comparison.model_errors.references", stop)
    monkeypatch.setattr("halfspace_sss.neural.train", stop)
    result = CliRunner().invoke(
        cli.app, [*command.split(), "marble", "ketchup", "--channel", "B,R", "--out", str(tmp_path)]
    )
    assert result.stderr.endswith("enough\n")
    from halfspace_sss import materials

    marble, ketchup = (materials.load(name).medium for name in ("marble", "ketchup"))
    assert seen == [marble.channel(2), marble.channel(0), ketchup.channel(2), ketchup.channel(0)]
    refused = CliRunner().invoke(cli.app, [*command.split(), "--channel", "B"])
    assert refused.exit_code == 2 and "channel must be left out unless materials are named" in refused.stderr
