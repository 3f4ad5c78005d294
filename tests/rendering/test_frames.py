"""Frames of an animation: what is refused, what of the light stays, and images that do not flicker."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from render_files import XML
from typer.testing import CliRunner

from figures import app as cli

mi = pytest.importorskip("mitsuba")

NAMED = XML.replace('<emitter type="constant"', '<emitter id="light" type="constant"')
NAMED = NAMED.replace('<shape type="sphere"', '<shape id="ball" type="sphere"').replace('"16"', '"12"')
NAMED = NAMED.replace("<sensor type", '<sensor id="sensor" type')
ORBIT = [[0, 0, 40, 0, 0, 0, 0, 1, 0], [4, 0, 40, 0, 0, 0, 0, 1, 0]]


@pytest.fixture
def dim(quiet_rgb: None, little_light: None) -> dict:
    """A cube beside a lamp, in gathered light."""
    medium = {"type": "translucent", "sigma_s": 2.0, "sigma_a": 0.2, "model": "better_dipole"}
    lens = {"to_world": mi.ScalarTransform4f().look_at([0, 0, 9], [0, 0, 0], [0, 1, 0]), "fov": 25.0}
    film = {"type": "hdrfilm", "width": 12, "height": 12, "rfilter": {"type": "box"}}
    return {
        "type": "scene",
        "integrator": {"type": "bssrdf", "light": "gathered"},
        "light": {"type": "point", "position": [2, 4, 6], "intensity": 20.0},
        "cube": {"type": "cube", "bsdf": medium},
        "sensor": {"type": "perspective", **lens, "film": film},
    }


def _gathered(scene: mi.Scene) -> Any:
    return scene.integrator().prepare(scene)[0].gathered


@pytest.mark.slow
def test_light_is_found_anew_only_where_something_changed_and_does_not_flicker(dim: dict) -> None:
    from full_geometry.scenes.scene_files import open_scene
    from full_geometry.viewing.frames import frames

    scene, found = open_scene(dim), []
    near, far = [0, 0, 9, 0, 0, 0, 0, 1, 0], [2, 0, 9, 0, 0, 0, 0, 1, 0]
    rows = {
        "sensor.to_world": [near, far, near, near, near],
        "light.position": [[2, 4, 6]] * 2 + [[2.02, 4, 6], [2, 4, 6], [2, 4, 6]],
        "cube.bsdf.sigma_t": [2.2] * 4 + [4.4],
        "cube.to_world": [np.eye(4)] * 5,
        "light.sampling_weight": [1.0] * 5,
    }
    images = []
    for image in frames(scene, rows, spp=4):
        images.append(image)
        found.append(_gathered(scene))
    values = [np.array(light.values) for light in found]

    # a camera alone keeps the light, a lamp keeps the transport matrix, a medium nothing
    assert found[1] is found[0] and found[2] is not found[1]
    assert found[3].matrix is found[0].matrix and found[4].matrix is not found[3].matrix
    assert np.array_equal(values[3], values[0]) and np.array_equal(images[3], images[0])
    assert not np.array_equal(images[1], images[0]) and not np.array_equal(images[4], images[3])
    # a lamp that moves by a hundredth changes light by about as much, and no noise of its own comes with it
    B, moved = (v.reshape(len(found[0].points), -1, found[0].terms)[:, :, 0] for v in (values[0], values[2]))
    assert 0 < np.sqrt(np.square(moved - B).mean()) < 0.01 * B.mean()


def test_a_mesh_moves_from_where_it_stands_as_if_it_were_loaded_there(dim: dict) -> None:
    from full_geometry.scenes.scene_files import open_scene
    from full_geometry.viewing.frames import Animation

    shift = mi.ScalarTransform4f().translate([0.5, 0, 0]).rotate([0, 1, 0], 30).scale([1, 2, 1])
    scene = open_scene(dim)
    Animation(scene, [{"cube.to_world": [0, 0, 9, 0, 0, 0, 0, 1, 0]}, {"cube.to_world": shift}]).show(1)
    dim["cube"]["to_world"] = shift
    moved, there = mi.traverse(scene), mi.traverse(open_scene(dim))
    for key in ("cube.vertex_positions", "cube.vertex_normals"):
        np.testing.assert_allclose(np.array(moved[key]), np.array(there[key]), atol=1e-6)


def test_a_mesh_is_moved_once_for_a_frame_on_the_command_line(tmp_path: Path, monkeypatch: Any) -> None:
    found = []
    monkeypatch.setattr(cli, "drawers", lambda: None)
    monkeypatch.setattr("full_geometry.cli.render._image", lambda way, *_: found.append(_height(way.scene)))
    ball = '<shape id="ball" type="sphere"><float name="radius" value="5"/>'
    assert ball in NAMED
    rows = [{"ball.to_world": np.diag([1, 1, z, 1]).tolist()} for z in (2.0, 3.0)]
    result = _run(tmp_path, json.dumps(rows), xml=NAMED.replace(ball, '<shape id="ball" type="cube">'), rows="a.json")
    assert result.exit_code == 0 and found == [2.0, 3.0]


def _height(scene: mi.Scene) -> float:
    return float(np.array(mi.traverse(scene)["ball.vertex_positions"])[2::3].max())


BAD = {
    "light.postion": ([[0, 0, 1]], "did you mean 'light.position'?"),
    "light.position": ([[0, 0]], "light.position of frame 1 must be 3 numbers, got 2"),
    "light.intensity.value": ([1.0, np.nan], "light.intensity.value of frame 2 must be finite"),
    "sensor.to_world": ([[0, 0, 9, 0, 0, 0, 0, 0, 1]], "with an up that is not the view of a camera"),
    "cube.to_world": ([np.eye(4), np.diag([1.0, 1, -1, 1])], "cube.to_world of frame 2 must be an invertible matrix"),
    "light.sampling_weight": ([[1.0, 2.0]], "must be 1 numbers, got 2"),
    "cube.bsdf.sigma_t": ([1.0, -1.0], "frame 2: "),
    "cube.bsdf.boundary.eta": ([1.3], "by its id, got 'cube.bsdf.boundary.eta'"),
}


def test_wrong_rows_are_refused_before_any_image(dim: dict, monkeypatch: Any) -> None:
    from full_geometry.viewing.frames import frames

    monkeypatch.setattr("full_geometry.viewing.frames.image_of", None)
    for key, (values, message) in BAD.items():
        with pytest.raises(ValueError) as error:
            frames(dim, {key: values})
        assert message in str(error.value), (message, str(error.value))
    for rows, message in (
        ({"a": [1, 2], "b": [1]}, "columns must have a value for each frame, got {'a': 2, 'b': 1}"),
        ([{"a": 1, "b": 1}, {"a": 1}], "b must have a value in each frame, got none in frame 2"),
        ([], "at least one"),
    ):
        with pytest.raises(ValueError) as error:
            frames(dim, rows)
        assert message in str(error.value)


def _run(folder: Path, text: str, *more: str, xml: str = NAMED, rows: str = "rows.csv") -> Any:
    (folder / "ball.xml").write_text(xml)
    (folder / rows).write_text(text)
    files = [str(folder / "ball.xml"), "--frames", str(folder / rows), "--out", str(folder / "out")]
    return CliRunner().invoke(cli.app, ["render", *files, "--spp", "2", *more])


def test_an_interrupt_keeps_frames_that_resume_skips(tmp_path: Path, monkeypatch: Any) -> None:
    monkeypatch.setattr(cli, "drawers", lambda: None)
    done, calls = mi.render, []
    rows = "sensor.to_world,light.radiance.value\n" + "".join(
        f"{' '.join(map(str, o))},{k + 1}\n" for k, o in enumerate(ORBIT)
    )

    def render(*arguments: Any, **more: Any) -> Any:
        calls.append(0)
        if len(calls) == 3:
            raise KeyboardInterrupt
        return done(*arguments, **more)

    monkeypatch.setattr(mi, "render", render)
    assert _run(tmp_path, rows).exit_code == 130
    first = tmp_path / "out" / "ball_scene_0001.exr"
    kept = first.read_bytes()
    assert not first.with_name("ball_scene_0002.exr").exists()
    result = _run(tmp_path, rows, "--resume")
    assert result.exit_code == 0 and "0001.exr is finished" in result.stdout.replace("\n", "")
    one, two = (np.array(mi.Bitmap(str(first.with_name(f"ball_scene_000{k}.exr")))) for k in (1, 2))
    assert first.read_bytes() == kept and len(calls) == 5 and two[0, 0, :3].mean() == 2 * one[0, 0, :3].mean()
    for csv, message in (
        ("light.radiance.value\n1 x\n", "light.radiance.value of frame 1 must be numbers, got ['1', 'x']"),
        ("a,b\n1\n", "b must have a value in each frame, got none in frame 1"),
        ("a\n1,2\n", "frame 1 must have as many cells as the header"),
        (rows.replace("40", "41"), "must be of the same render"),
    ):
        result = _run(tmp_path, csv, "--resume")
        assert result.exit_code == 2 and message in result.stderr.replace("\n", " "), result.stderr
