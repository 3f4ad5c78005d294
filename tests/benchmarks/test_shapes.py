"""The tables of the network of all shapes, and pictures of the worst held-out ones."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

mi = pytest.importorskip("mitsuba")
pytest.importorskip("igl")

from benchmarks import shape_errors as pictures  # noqa: E402
from benchmarks.__main__ import app  # noqa: E402
from benchmarks.shape_errors import Row  # noqa: E402

pytestmark = pytest.mark.usefixtures("mono")


def row(error: float) -> Row:
    errors = {"neural_shape": {"constant": (error, 0.0)}, "better_dipole": {"constant": (2 * error, 0.0)}}
    return Row("", 1.0, 0.5, 0.0, 1.3, 1.0, errors)


def test_the_worst_shapes_come_first_each_with_walks_network_and_half_space(monkeypatch: pytest.MonkeyPatch) -> None:
    asked = []

    def picture(case: object, model: str) -> np.ndarray:
        asked.append((case.name, model))
        return np.full((4, 4), len(asked) / 10)

    monkeypatch.setattr(pictures, "picture", picture)
    monkeypatch.setattr(pictures, "WORST", 2)
    found = pictures.worst_pictures([row(0.1), row(0.5), row(0.3)])
    models = ("path_traced", "neural_shape", "better_dipole")
    assert asked == [(name, model) for name in ("leaves", "hourglasses") for model in models]
    assert found.shape == (2 * (4 + pictures.GAP), 3 * (4 + pictures.GAP)) and found.max() == 1


def test_a_picture_shows_the_object_on_black(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pictures, "SPP", 16)
    (case,) = [case for k, case in enumerate(pictures.held_out(3)) if k == 2]
    image = pictures.picture(case, "better_dipole", 24)
    assert image.shape == (24, 24) and 0.05 < (image > 0).mean() < 0.8
    assert (image[[0, -1]] == 0).all() and (image[:, [0, -1]] == 0).all()


@pytest.mark.parametrize(
    ("place", "message"), [("worst.jpg", "pictures must end in .png"), ("", "pictures must be a file")]
)
def test_a_place_for_pictures_is_checked_before_anything_is_measured(tmp_path: Path, place: str, message: str) -> None:
    words = ["shapes", "--out", str(tmp_path / "x.md"), "--pictures", str(tmp_path / place)]
    result = CliRunner().invoke(app, words)
    assert result.exit_code == 2 and message in " ".join(result.stderr.split())
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("words", "message"),
    [(["--out", "."], "out must be a file, got the folder '.'"),
     (["--out", "file/t.md"], "folder must be a folder or new, got 'file'"),
     (["--mm-per-unit", "0"], "mm_per_unit must be a number in"),
     (["--seconds", "nan"], "seconds must be a number in")],
)  # fmt: skip
def test_tables_without_a_place_or_with_wrong_numbers_are_refused_before_anything_is_traced(
    words: list[str], message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("file").write_text("")
    result = CliRunner().invoke(app, ["shapes", *words])
    assert result.exit_code == 2 and message in result.stderr and result.stderr.count("\n") == 1
