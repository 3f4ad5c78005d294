"""Figures in parts: what is computed again and what is not, what is refused, and what the command says."""

from __future__ import annotations

import json
import os
import re
import sys
from concurrent.futures import ThreadPoolExecutor
from importlib.metadata import EntryPoint
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

import figures
from figures import app as cli
from figures.parts import command
from figures.parts.part import Part, Result, Task
from figures.parts.runner import completed_plans, compute, draw, figure, plan

CALLS: list[str] = []  # which parts were computed, in turn


def shade(task: Task) -> dict[str, Any]:
    """An image and a number."""
    CALLS.append(task.params["name"])
    for k in range(3):
        task.progress(k + 1, 3)
    image = np.full((4, 6, 3), task.params["level"], dtype=np.float32)
    return {"image": image, "depth": image[..., 0], "mean": task.params["level"], "words": ["a", "b"]}


def compare(task: Task) -> dict[str, Any]:
    """The difference of two parts and what a file says."""
    CALLS.append("gap")
    first, second = (result.images["image"] for result in task.needed.values())
    return {"gap": float(abs(first - second).mean()), "text": [path.read_text() for path in task.inputs]}


class Toy(SimpleNamespace):
    """A figure of two images and their difference, with what a test changes about it."""

    def parts(self, quality: str) -> list[Part]:
        work = {"draft": 1.0, "paper": 8.0}[quality]
        a = Part("marble, A", self.function, {"name": "a", "level": self.level}, work)
        b = Part("marble, B", self.function, {"name": "b", "level": 0.5}, 2 * work)
        return [a, b, Part("gap", compare, {}, 1.0, needs=("marble, A", "marble, B"), inputs=self.inputs)]

    def draw(self, results: dict[str, Result]) -> dict[str, bytes | str]:
        return {"toy.txt": f"{results['gap'].numbers['gap']:g}"}


@pytest.fixture
def toy(monkeypatch: pytest.MonkeyPatch) -> Toy:
    module = Toy(TITLE="two images", function=shade, level=0.25, inputs=())
    monkeypatch.setattr(figures, "FIGURES", ("toy", "fig10"))
    monkeypatch.setitem(sys.modules, "figures.toy", module)
    monkeypatch.setattr(command, "cores", lambda: 1)  # other processes do not know the toy
    CALLS.clear()
    return module


def test_another_package_adds_a_figure_by_an_entry_point(toy: Toy, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(figures, "FIGURES", ("fig10",))
    offers = [EntryPoint("ours", "figures.toy", figures.GROUP), EntryPoint("fig10", "figures.toy", figures.GROUP)]
    monkeypatch.setattr("importlib.metadata.entry_points", lambda group: offers)
    assert figure("ours") is toy
    assert figure("fig10").__name__ == "figures.fig10"


def _invoke(*arguments: str) -> Any:
    return CliRunner().invoke(cli.app, ["figures", *arguments])


def test_another_variant_is_refused_for_several_processes(toy: Toy) -> None:
    result = _invoke("compute", "--variant", "cuda_ad_rgb", "--workers", "2")
    assert result.exit_code == 2
    assert "variant must be llvm_ad_rgb with --workers or --scheduler, got 'cuda_ad_rgb'" in " ".join(
        result.output.split()
    )


def test_a_second_run_computes_nothing_and_gives_the_same(toy: Toy, tmp_path: Path) -> None:
    first = compute("toy", "draft", tmp_path)
    assert CALLS == ["a", "b", "gap"]
    second = compute("toy", "draft", tmp_path)
    assert CALLS == ["a", "b", "gap"]
    for name, result in first.items():
        assert second[name].numbers == result.numbers
        assert second[name].images.keys() == result.images.keys()
        for image in result.images:
            assert second[name].images[image].dtype == np.float32
            np.testing.assert_array_equal(second[name].images[image], result.images[image])


def test_parts_on_an_executor_come_after_what_they_need_and_give_the_same(toy: Toy, tmp_path: Path) -> None:
    first = compute("toy", "draft", tmp_path / "here")
    with ThreadPoolExecutor(2) as executor:
        second = compute("toy", "draft", tmp_path / "there", executor=executor)
    assert sorted(CALLS[3:5]) == ["a", "b"] and CALLS[5:] == ["gap"]
    for name, result in first.items():
        assert second[name].numbers == result.numbers
        assert all((second[name].images[key] == image).all() for key, image in result.images.items())


def test_a_part_that_another_figure_has_is_taken_from_there(toy: Toy, tmp_path: Path, monkeypatch: Any) -> None:
    first = compute("toy", "draft", tmp_path)
    monkeypatch.setattr(figures, "FIGURES", ("toy", "twin"))
    monkeypatch.setitem(sys.modules, "figures.twin", toy)
    assert plan("twin", "draft", tmp_path).seconds == {}
    again = compute("twin", "draft", tmp_path)
    assert CALLS == ["a", "b", "gap"]
    for name, result in first.items():
        assert again[name].numbers == result.numbers and again[name].seconds == result.seconds
        assert all((again[name].images[key] == image).all() for key, image in result.images.items())
    toy.level = 0.75
    assert compute("twin", "draft", tmp_path)["gap"].numbers["gap"] == 0.25
    assert CALLS[3:] == ["a", "gap"]
    for executor in (None, ThreadPoolExecutor(2)):
        CALLS.clear()
        both = [plan(name, "draft", tmp_path / str(executor is None)) for name in ("toy", "twin")]
        assert [done.name for done in completed_plans(both, executor=executor)] == ["toy", "twin"]
        assert sorted(CALLS) == ["a", "b", "gap"] and draw("twin", "draft", tmp_path / str(executor is None))


def test_what_depends_on_a_changed_parameter_is_computed_again_and_nothing_else(toy: Toy, tmp_path: Path) -> None:
    compute("toy", "draft", tmp_path)
    toy.level = 0.75
    assert compute("toy", "draft", tmp_path)["gap"].numbers["gap"] == 0.25
    assert CALLS[3:] == ["a", "gap"]


def test_the_content_of_an_input_counts_and_not_its_date(toy: Toy, tmp_path: Path) -> None:
    weights = tmp_path / "weights"
    weights.write_text("one")
    toy.inputs = (weights,)
    compute("toy", "draft", tmp_path / "out")
    os.utime(weights, (1, 1))
    compute("toy", "draft", tmp_path / "out")
    assert CALLS.count("gap") == 1
    weights.write_text("two")
    assert compute("toy", "draft", tmp_path / "out")["gap"].numbers["text"] == ["two"]
    assert CALLS[3:] == ["gap"]


def test_qualities_are_kept_apart(toy: Toy, tmp_path: Path) -> None:
    compute("toy", "draft", tmp_path)
    compute("toy", "paper", tmp_path)
    assert len(CALLS) == 6


def test_images_are_exr_and_every_file_says_how_it_was_made(toy: Toy, tmp_path: Path) -> None:
    from mitsuba import Bitmap

    compute("toy", "draft", tmp_path)
    folder = tmp_path / "toy" / "draft" / "parts" / "marble-a"
    assert sorted(path.name for path in folder.iterdir()) == ["depth.exr", "image.exr", "record.json"]
    in_header = json.loads(Bitmap(str(folder / "image.exr")).metadata()["provenance"])
    in_record = json.loads((folder / "record.json").read_text())["provenance"]
    for about in (in_header, in_record):
        assert about["parameters"]["level"] == 0.25 and "commit" in about and "numpy" in about["versions"]
    files = draw("toy", "draft", tmp_path)
    assert [path.name for path in files] == ["toy.txt", "toy.json"]
    assert json.loads(files[1].read_text())["parts"]["gap"]["key"] == plan("toy", "draft", tmp_path).keys["gap"]


def _damage_image(folder: Path) -> None:
    (folder / "image.exr").write_bytes((folder / "image.exr").read_bytes()[:-7])


def _damage_number(folder: Path) -> None:
    path = folder / "record.json"
    path.write_text(path.read_text().replace('"mean": 0.25', '"mean": 0.35'))


@pytest.mark.parametrize(
    ("damage", "file"),
    [
        (_damage_image, "image.exr"),
        (lambda folder: (folder / "depth.exr").unlink(), "depth.exr"),
        (_damage_number, "record.json"),
        (lambda folder: (folder / "record.json").write_text("{"), "record.json"),
    ],
)
def test_a_damaged_part_is_refused_by_name_and_computed_again(damage: Any, file: str, toy: Toy, tmp_path: Path) -> None:
    compute("toy", "draft", tmp_path)
    damage(tmp_path / "toy" / "draft" / "parts" / "marble-a")
    with (
        pytest.warns(UserWarning, match=f"part 'marble, A' is damaged.*marble-a.*{re.escape(file)}|delimiter|property"),
        pytest.raises(ValueError, match="1 of 3 are not: 'marble, A'"),
    ):
        draw("toy", "draft", tmp_path)
    with pytest.warns(UserWarning, match="part 'marble, A' is damaged"):
        results = compute("toy", "draft", tmp_path)
    assert CALLS[3:] == ["a"]
    assert results["marble, A"].numbers["mean"] == 0.25
    assert draw("toy", "draft", tmp_path)


def test_drawing_needs_all_parts(toy: Toy, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="parts of toy must be computed before it is drawn, 3 of 3 are not"):
        draw("toy", "draft", tmp_path)
    assert not list(tmp_path.iterdir())


def stops_halfway(task: Task) -> dict[str, Any]:
    """Adds one pass to those that it finds, and is interrupted after the first."""
    CALLS.append(task.params["name"])
    passes = task.folder / "passes"
    passes.write_text((passes.read_text() if passes.exists() else "") + "x")
    if len(passes.read_text()) < 2:
        raise KeyboardInterrupt
    return {"passes": len(passes.read_text())}


def test_an_interrupted_part_finds_what_it_had_done(toy: Toy, tmp_path: Path) -> None:
    toy.parts = lambda quality: [
        Part("first", shade, {"name": "a", "level": 0.5}, 1),
        Part("long", stops_halfway, {"name": "long"}, 1),
    ]
    with pytest.raises(KeyboardInterrupt):
        compute("toy", "draft", tmp_path)
    assert compute("toy", "draft", tmp_path)["long"].numbers["passes"] == 2
    assert CALLS == ["a", "long", "long"]
    assert not list(tmp_path.rglob("unfinished-*"))


@pytest.mark.parametrize(
    ("found", "message"),
    [
        ({"image": np.full((2, 2, 3), np.nan)}, "image of part 'p' must be finite, got nan at"),
        ({"image": np.full((2, 2), 1e39)}, "image of part 'p' must be finite"),
        ({"curve": np.zeros(5)}, r"curve of part 'p' must have the shape \(height, width\)"),
        ({"mean": float("nan")}, "numbers of part 'p' must be finite"),
        ({"thing": object()}, "numbers of part 'p' must be finite and ready for JSON"),
        ({"a/b": np.zeros((2, 2))}, "images of part 'p' must be named by letters"),
    ],
)
def test_bad_results_are_refused_with_the_part_and_not_kept(
    found: dict[str, Any], message: str, toy: Toy, tmp_path: Path
) -> None:
    toy.parts = lambda quality: [Part("p", lambda task: found, {}, 1)]
    with pytest.raises(ValueError, match="toy, part 'p': " + message):
        compute("toy", "draft", tmp_path)
    assert plan("toy", "draft", tmp_path).missing == ("p",)
    assert not list(tmp_path.rglob("*.exr")) and not list(tmp_path.rglob("*.json"))


def test_the_time_of_the_paper_quality_is_projected_from_the_draft(toy: Toy, tmp_path: Path) -> None:
    assert plan("toy", "paper", tmp_path).unmeasured == ("marble, A", "marble, B", "gap")
    taken = compute("toy", "draft", tmp_path)
    ahead = plan("toy", "paper", tmp_path)
    rate = np.mean([taken["marble, A"].seconds, taken["marble, B"].seconds / 2])
    assert ahead.seconds["marble, A"] == pytest.approx(8 * rate)
    assert ahead.seconds["marble, B"] == pytest.approx(16 * rate)
    toy.parts = lambda quality: [Part("marble, C", shade, {"name": "c", "level": 1.0}, 3.0)]
    assert plan("toy", "paper", tmp_path).projected_seconds == pytest.approx(3 * rate)


def test_progress_rises_to_its_end(toy: Toy, tmp_path: Path) -> None:
    steps: list[tuple[int, int, str]] = []
    compute("toy", "draft", tmp_path, lambda *step: steps.append(step))
    done = [step[0] for step in steps]
    assert done == sorted(done) and done[0] == 0 and done[-1] == steps[-1][1]
    assert {step[2] for step in steps} == {"marble, A", "marble, B", "gap"}


def test_the_command_computes_draws_and_says_what_there_is(toy: Toy, tmp_path: Path) -> None:
    out = ("toy", "--out", str(tmp_path))
    assert "no" in _invoke("list", *out).stdout
    result = _invoke("all", *out)
    assert result.exit_code == 0, result.output
    assert "3 of 3 parts to compute" in result.stdout and "toy.txt" in result.stdout
    assert "toy" in result.stderr  # the bar
    assert (tmp_path / "toy" / "draft" / "toy.txt").read_text() == "0.25"
    assert "all 3 parts are there" in _invoke("compute", *out).stdout
    assert len(CALLS) == 3


def test_the_command_states_the_time_of_the_paper_quality_before_it_is_spent(toy: Toy, tmp_path: Path) -> None:
    out = ("toy", "--out", str(tmp_path))
    measured_first = _invoke("list", *out, "--quality", "paper").stdout
    assert "3 parts not measured yet" in measured_first
    _invoke("compute", *out)
    said = _invoke("compute", *out, "--quality", "paper").stdout
    assert re.search(r"toy paper: 3 of 3 parts to compute, about [\d.e-]+ s\n", said)


@pytest.mark.parametrize(("module", "code"), [("matplotlib.figure", 1), ("tpyo", None)])
def test_a_missing_library_is_named_and_a_mistake_is_not_hidden(
    module: str, code: int | None, toy: Toy, tmp_path: Path
) -> None:
    def fail(_: Any) -> dict[str, bytes]:
        raise ModuleNotFoundError(f"No module named {module!r}", name=module)

    toy.draw = fail
    result = _invoke("all", "toy", "--out", str(tmp_path))
    if code is None:
        assert isinstance(result.exception, ModuleNotFoundError)
    else:
        assert result.exit_code == code
        assert 'figures need matplotlib.figure: pip install "halfspace-sss[figures,render]"' in result.stderr


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["compute", "fig100"], "did you mean 'fig10'?"),
        (["draw", "toy", "--quality", "drft"], "drft"),
        (["paint"], "paint"),
        (["draw", "toy"], "parts of toy must be computed before it is drawn"),
    ],
)
def test_bad_input_of_the_command_ends_with_2_and_no_file(
    arguments: list[str], message: str, toy: Toy, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    result = _invoke(*arguments)
    assert result.exit_code == 2
    assert message in result.stderr
    assert not list(tmp_path.iterdir())
