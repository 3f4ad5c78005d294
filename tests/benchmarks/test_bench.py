"""The study `bench`: what it measures, prints and writes, and how it ends."""

from __future__ import annotations

import csv
import json
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

import halfspace_sss
from benchmarks import __main__ as cli
from benchmarks import bench, bench_renders
from benchmarks import bench_command as cli_bench
from halfspace_sss import Medium

pytestmark = pytest.mark.slow


OF_CPU = cli_bench.OF_BACKEND["llvm"]


def _invoke(*arguments: str) -> Any:
    return CliRunner().invoke(cli.app, ["bench", *arguments])


def _rows(path: Path) -> list[dict[str, str]]:
    with path.open(encoding="utf-8") as file:
        return list(csv.DictReader(file))


@pytest.fixture(scope="module")
def finished(tmp_path_factory: Any) -> tuple[Any, Path]:
    """One quick run of all parts, and its folder."""
    folder = tmp_path_factory.mktemp("run") / "bench"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(bench, "REPEATS", 1)
        return _invoke("--quick", "--out", str(folder)), folder


def test_every_part_has_a_file_and_all_are_in_the_json(finished: tuple[Any, Path]) -> None:
    result, folder = finished
    assert result.exit_code == 0
    names = [f"bench_{part}.csv" for part in OF_CPU]
    assert sorted(path.name for path in folder.iterdir()) == sorted([*names, "bench.json"])
    content = json.loads((folder / "bench.json").read_text())
    for part in OF_CPU:
        assert len(content[part]) == len(_rows(folder / f"bench_{part}.csv")) == cli_bench._lengths(quick=True)[part]


def test_every_file_is_named_and_progress_goes_to_stderr(finished: tuple[Any, Path]) -> None:
    result, folder = finished
    for path in folder.iterdir():
        assert str(path) in result.stdout
    assert "measuring" in result.stderr and "measuring" not in result.stdout


def test_the_json_says_where_the_numbers_come_from(finished: tuple[Any, Path]) -> None:
    content = json.loads((finished[1] / "bench.json").read_text())
    assert content["provenance"]["parameters"] == {"quick": True, "parts": list(OF_CPU), "backend": "llvm"}
    assert content["provenance"]["versions"]["drjit"]
    assert content["machine"]["threads"] >= 1
    assert content["peak_memory_gib"] > 0.05


def test_every_rate_is_positive(finished: tuple[Any, Path]) -> None:
    folder = finished[1]
    for row in _rows(folder / "bench_walk.csv") + _rows(folder / "bench_maps.csv"):
        assert float(row["events_per_s"]) > 0
    for row in _rows(folder / "bench_volpath.csv"):
        assert float(row["equal_error_ratio"]) > 0
    models = _rows(folder / "bench_models.csv")
    assert [row["model"] for row in models] == list(halfspace_sss.models())
    for row in models:
        assert min(float(row[library]) for library in ("numpy", "torch", "drjit")) > 0
        assert min(float(row[what]) for what in ("reflectance_s", "from_reflectance_s")) > 0


def test_without_mitsuba_volpath_is_left_out_with_a_sentence(tmp_path: Path, monkeypatch: Any) -> None:
    monkeypatch.setattr(cli_bench, "find_spec", lambda name: None if name == "mitsuba" else name)
    result = _invoke("--quick", "--only", "volpath", "--out", str(tmp_path))
    assert result.exit_code == 0
    assert "volpath is left out: Mitsuba is not installed (`pip install halfspace-sss[render]`)" in result.stdout
    assert sorted(path.name for path in tmp_path.iterdir()) == ["bench.json", "bench_walk.csv"]


def test_rows_of_an_interrupted_run_are_written(tmp_path: Path, monkeypatch: Any) -> None:
    def rows(part: str, *_: Any) -> Any:
        if part == "edits":
            raise KeyboardInterrupt
        yield {"albedo": 0.5, "events_per_s": 1e8}

    monkeypatch.setattr(cli_bench, "_rows", rows)
    result = _invoke("--only", "trace", "--only", "edits", "--out", str(tmp_path))
    assert result.exit_code == 130 and "1.00e+08" in result.stdout
    assert [path.name for path in sorted(tmp_path.iterdir())] == ["bench.json", "bench_trace.csv"]


def test_a_gpu_has_parts_of_its_own_and_refuses_those_of_the_cpu() -> None:
    assert cli_bench.chosen_parts(None, "cuda") == list(cli_bench.OF_BACKEND["cuda"])
    with pytest.raises(ValueError, match="only must be one of trace, .* with --backend cuda, got 'maps'"):
        cli_bench.chosen_parts(["trace", "maps"], "cuda")


def test_guided_walks_have_the_reflectance_of_plain_ones(tmp_path: Path) -> None:
    assert _invoke("--quick", "--only", "guided", "--out", str(tmp_path)).exit_code == 0
    for row in _rows(tmp_path / "bench_guided.csv"):
        R = Medium.from_albedo(float(row["albedo"]), 1.0, 0.0, float(row["eta"])).reflectance(1.0)
        assert abs(float(row["mean"]) - R) <= 4 * float(row["standard_error"]) < 0.1 * R


@pytest.mark.slow
def test_traces_and_edits_are_measured_on_a_cpu_too(
    tmp_path: Path, little_light: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(bench_renders, "REPEATS", 1)
    assert _invoke("--quick", "--only", "trace", "--only", "edits", "--out", str(tmp_path)).exit_code == 0
    assert [row["way"] for row in _rows(tmp_path / "bench_edits.csv")] == ["better_dipole, gathered", "walk"]
    (row,) = _rows(tmp_path / "bench_trace.csv")
    assert float(row["events_per_s"]) > 1e6


@pytest.mark.parametrize(
    ("text", "parts"),
    [
        (None, ["walk", "volpath", "models", "maps"]),
        (["maps", "models"], ["models", "maps"]),
        (["volpath"], ["walk", "volpath"]),
        (["walk", "walk"], ["walk"]),
    ],
)
def test_parts_are_chosen_in_order_and_volpath_brings_the_walk(text: list[str] | None, parts: list[str]) -> None:
    assert cli_bench.chosen_parts(text) == parts


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--only", "walks"], "'walks' is not one of 'walk', 'volpath', 'models', 'maps', 'trace'"),
        (["--out", "file"], "folder must be a folder or new, got 'file'"),
    ],
)
def test_bad_input_ends_with_2_and_writes_nothing(
    arguments: list[str], message: str, tmp_path: Path, monkeypatch: Any
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file").write_text("x")
    result = _invoke(*arguments)
    assert result.exit_code == 2
    assert message in result.stderr
    assert result.stderr.startswith("error: ") and result.stderr.count("\n") == 1
    assert [path.name for path in tmp_path.iterdir()] == ["file"]
