"""`python -m benchmarks`: every study has help, and refuses bad input in a line before any work."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
from typer.testing import CliRunner

pytest.importorskip("mitsuba")

from benchmarks.__main__ import COMMANDS, app  # noqa: E402

WRONG = {
    "ablation": ["marbel"],
    "bench": ["--only", "nope"],
    "disturbed": ["none.xml", "--images", "none.json", "--case", "nope"],
    "figures": ["all", "marbel"],
    "furnace": ["--size", "1"],
    "gathered": ["--object", "marbel"],
    "inversion": ["--size", "0"],
    "media-errors": ["--held-out", "0"],
    "rivals": ["--scene", "none.xml"],
    "shapes": ["--objects", "-1"],
    "time-to-error": ["--blocks", "0"],
    "total-error": ["--object", "marbel"],
    "trade-check": ["--scenes", "-1"],
    "train-shapes": ["--seconds", "0"],
    "train-universal": ["--steps", "0"],
    "truths": ["--model", "nope"],
    "validate": ["--rows", "nope"],
}


@pytest.mark.parametrize("study", COMMANDS)
def test_bad_input_ends_with_2_in_a_line(study: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    result = CliRunner().invoke(app, [study, *WRONG[study]])
    assert result.exit_code == 2, result.output
    assert result.stderr.startswith("error: ") and result.stderr.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_it_runs_from_the_repository() -> None:
    root = Path(__file__).resolve().parents[2]
    run = subprocess.run([sys.executable, "-m", "benchmarks", "-h"], capture_output=True, text=True, cwd=root)
    assert run.returncode == 0, run.stderr
    assert all(name in run.stdout for name in COMMANDS)


def test_the_wheel_leaves_it_out() -> None:
    tomllib = pytest.importorskip("tomllib")
    root = Path(__file__).resolve().parents[2]
    settings = tomllib.loads((root / "pyproject.toml").read_text(encoding="utf-8"))
    packages = settings["tool"]["setuptools"]["packages"]["find"]["include"]
    assert packages == ["halfspace_sss*", "analytic_models*", "full_geometry*", "figures*"]
