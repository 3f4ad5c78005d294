"""Images of a fit: what is refused before any work, and that results are written first."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from test_fit import XML
from typer.testing import CliRunner

mi = pytest.importorskip("mitsuba")

from figures import app as cli  # noqa: E402
from full_geometry.inverse.views import GivenView, read_views  # noqa: E402

pytestmark = pytest.mark.usefixtures("quiet_rgb")

WHOLE = np.full((8, 8, 3), 0.5, np.float32)
CAMERA = {"origin": [0, 0, 40], "target": [0, 0, 0], "up": [0, 1, 0], "fov": 14}


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ([{"image": "a.exr"}], r'must be an object {"views": \[...\]}, got a list'),
        ({"view": []}, "got the keys view"),
        ({"views": {}}, "views must be a list with an image or more"),
        ({"views": [{"image": 3}]}, "image must be a file, got 3"),
        ({"views": [{"image": "a.exr", "mask": 3}]}, "mask must be a file, got 3"),
        ({"views": [{"image": "a.exr", "held_out": "false"}]}, "held_out must be true or false, got 'false'"),
        ({"views": [{"image": "a.exr", "camera": 3}]}, "camera must be an object, got 3"),
        ({"views": [{"image": "a.exr", "camera": {"fov": 3}}]}, "must have origin, target, up, fov, got fov"),
        ({"views": [{"image": "a.exr", "camera": {**CAMERA, "up": [1]}}]}, "up of .* must be 3 finite numbers"),
        ({"views": [{"image": "a.exr", "camera": {**CAMERA, "up": [0, 0, 1]}}]}, "must not be along its view"),
        ({"views": [{"image": "a.exr", "camera": CAMERA, "sensor": 0}]}, "must have a sensor or a camera, got both"),
    ],
)
def test_a_file_of_views_that_is_none_is_refused_in_words(tmp_path: Path, content: Any, message: str) -> None:
    mi.Bitmap(WHOLE).write(str(tmp_path / "a.exr"))
    (tmp_path / "views.json").write_text(json.dumps(content))
    with pytest.raises(ValueError, match=message) as caught:
        read_views(tmp_path / "views.json")
    assert "Error" not in str(caught.value)


def test_a_view_with_its_own_camera_shows_the_part_that_counts_by_its_mask(tmp_path: Path) -> None:
    mask = np.zeros((8, 8, 1), np.float32)
    mask[2:5, 3:7] = 0.25
    for name, image in (("a.exr", WHOLE), ("mask.exr", mask)):
        mi.Bitmap(image).write(str(tmp_path / name))
    row = {"image": "a.exr", "mask": "mask.exr", "camera": CAMERA, "edits": {"lamp.position": [1, 2, 3]}}
    (tmp_path / "views.json").write_text(json.dumps({"views": [row]}))
    (view,) = read_views(tmp_path / "views.json")
    film = view.sensor.film()
    assert (list(film.size()), list(film.crop_size()), list(film.crop_offset())) == ([8, 8], [4, 3], [3, 2])
    assert view.image.shape == (3, 4, 3) and (view.counts == 0.25).all() and view.edits == row["edits"]


@pytest.mark.parametrize(
    ("image", "mask", "message"),
    [
        (-WHOLE, None, "image a must have a mean above 0, got -0.5"),
        (0 * WHOLE, None, "image a must have a mean above 0, got 0"),
        (WHOLE * np.inf, None, "image a must be finite, got 64 pixels that are not"),
        (WHOLE, np.zeros((8, 8)), "image a must have a pixel that counts, got none of 64"),
    ],
)
def test_images_without_light_are_refused(image: np.ndarray, mask: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        GivenView.of("a", 0, image, mask)


def test_pixels_below_0_are_told_and_fitted_and_results_are_there_if_the_page_fails(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Noise about black has them, after a dark frame is subtracted."""
    image = WHOLE.copy()
    image[0, 0] = -0.001
    with pytest.warns(UserWarning, match="image a: 1 pixels below 0 count as they are"):
        GivenView.of("a", 0, image)
    mi.Bitmap(image).write(str(tmp_path / "a.exr"))
    (tmp_path / "a.xml").write_text(XML)
    (tmp_path / "views.json").write_text(json.dumps({"views": [{"image": "a.exr"}]}))
    arguments = ["fit", str(tmp_path / "a.xml"), "--images", str(tmp_path / "views.json"), "--parameter", "albedo"]
    arguments += ["--steps", "1", "--spp", "4"]
    done = CliRunner().invoke(cli.app, [*arguments, "--out", str(tmp_path / "whole")])
    assert done.exit_code == 0, done.output
    names = {"a_fit.json", "a_fit.toml", "a_fit.xml", "a_fit.html"}
    assert {path.name for path in (tmp_path / "whole").iterdir()} == names

    def broken(*_: Any) -> bytes:
        raise ValueError("no page")

    monkeypatch.setattr("figures.drawing.page.fit", broken)
    done = CliRunner().invoke(cli.app, [*arguments, "--out", str(tmp_path / "rest")])
    assert done.exit_code == 2 and "no page" in done.output
    assert {path.name for path in (tmp_path / "rest").iterdir()} == names - {"a_fit.html"}
