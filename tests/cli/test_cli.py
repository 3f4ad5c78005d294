"""The command line: what it prints and writes, and how it ends."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

import halfspace_sss
from figures import app as cli
from halfspace_sss.backend import BackendError

QUICK = ["curves", "--paths", "4096", "--theta-i", "0,60", "--model", "better_dipole"]
START = [sys.executable, "-c", "from figures.command_line import main; main()"]


def _invoke(*arguments: str) -> Any:
    return CliRunner().invoke(cli.app, list(arguments))


def _run(*arguments: str, folder: Path) -> subprocess.CompletedProcess:
    return subprocess.run([*START, *arguments], capture_output=True, text=True, cwd=folder)


@pytest.fixture(scope="module")
def finished(tmp_path_factory: Any) -> tuple[Any, Path]:
    """One run of a small comparison, and its folder."""
    folder = tmp_path_factory.mktemp("run") / "deep" / "out"
    return _invoke(*QUICK, "--seed", "5", "--out", str(folder)), folder


@pytest.mark.slow
def test_curves_end_well_and_write_every_file(finished: tuple[Any, Path]) -> None:
    result, folder = finished
    assert result.exit_code == 0
    names = ["curves.csv", "curves.json", "curves.pdf", "curves.png", "curves_errors.csv"]
    assert sorted(path.name for path in folder.iterdir()) == names


def test_curves_name_every_file_that_they_wrote(finished: tuple[Any, Path]) -> None:
    result, folder = finished
    for path in folder.iterdir():
        assert str(path) in result.stdout


def test_curves_print_a_table_with_every_direction_and_series(finished: tuple[Any, Path]) -> None:
    table = finished[0].stdout
    for text in ("θi = 0°", "θi = 60°", "path_traced", "better_dipole", "10 mm", "±"):
        assert text in table


def test_progress_goes_to_stderr(finished: tuple[Any, Path]) -> None:
    assert "tracing" in finished[0].stderr
    assert "tracing" not in finished[0].stdout


def test_curves_use_the_options(finished: tuple[Any, Path]) -> None:
    parameters = json.loads((finished[1] / "curves.json").read_text())["parameters"]
    assert parameters["seed"] == 5
    assert parameters["theta_i_deg"] == [0, 60]
    assert parameters["series"] == ["path_traced", "better_dipole"]


def test_given_coefficients_replace_those_of_fig_10(tmp_path: Path) -> None:
    options = ["--sigma-t", "2", "--albedo", "0.9", "--theta-i", "0", "--r-min", "0.1", "--r-max", "3"]
    assert _invoke(*QUICK, *options, "--out", str(tmp_path)).exit_code == 0
    parameters = json.loads((tmp_path / "curves.json").read_text())["parameters"]
    assert parameters["medium"]["sigma_t"] == pytest.approx(2)
    assert parameters["medium"]["albedo"] == pytest.approx(0.9)
    assert parameters["medium"]["eta"] == 1.3
    assert (parameters["r_edges_mm"][0], parameters["r_edges_mm"][-1]) == pytest.approx((0.1, 3))


@pytest.mark.slow
def test_a_material_is_compared_by_name_and_channel(tmp_path: Path) -> None:
    assert _invoke(*QUICK, "ketchup", "--channel", "B", "--out", str(tmp_path)).exit_code == 0
    assert json.loads((tmp_path / "curves.json").read_text())["parameters"]["title"] == "ketchup B"


def test_without_matplotlib_there_are_tables_and_a_hint(tmp_path: Path, monkeypatch: Any) -> None:
    monkeypatch.setattr("halfspace_sss.comparison.curve_set.find_spec", lambda name: None)
    result = _invoke(*QUICK, "--out", str(tmp_path))
    assert result.exit_code == 0
    assert "pip install halfspace-sss[figures]" in result.stdout
    assert sorted(path.name for path in tmp_path.iterdir()) == ["curves.csv", "curves.json", "curves_errors.csv"]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["marbel"], "did you mean 'marble'?"),
        (["marble", "--channel", "X"], "channel must be one of R, G, B"),
        (["marble", "--albedo", "0.5"], "albedo must be left out for a named material, got 0.5"),
        (["--albedo", "2"], "albedo must be in [0, 1]"),
        (["--g", "1"], "g must be in the open interval (-1, 1)"),
        (["--theta-i", "0,abc"], "theta_i must be numbers separated by commas, got '0,abc'"),
        (["--theta-i", "90"], "theta_i_deg must be a number in [0, 90) degrees, got 90.0"),
        (["--r-min", "30"], "r_min must be < r_max = 25 mm, got 30"),
        (["--model", "beter_dipole"], "did you mean 'better_dipole'?"),
        (["--orders", "single"], "'single' is not one of 'multiple', 'total'"),
        (["--line", "0", "--orders", "total"], "orders must be 'multiple' on a line where the refracted rays meet"),
        (["--paths", "3"], "n_paths must be a whole number >= 256, got 3"),
        (["--backend", "metal"], "'metal' is not one of 'llvm', 'cuda'"),
    ],
)
def test_bad_input_gives_one_line_and_exit_code_2_and_no_file(
    arguments: list[str], message: str, tmp_path: Path, monkeypatch: Any
) -> None:
    monkeypatch.chdir(tmp_path)
    result = _invoke("curves", *arguments)
    assert result.exit_code == 2
    assert message in result.stderr
    assert result.stderr.startswith("error: ") and result.stderr.count("\n") == 1
    assert result.stdout == ""
    assert not list(tmp_path.iterdir())


def test_an_output_folder_that_is_a_file_is_refused_before_tracing(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("x")
    result = _invoke(*QUICK, "--paths", "1000000000", "--out", str(tmp_path / "file"))
    assert result.exit_code == 2
    assert "folder must be a folder or new" in result.stderr


@pytest.mark.parametrize("command", ["curves", "maps"])
def test_a_folder_that_cannot_be_written_to_is_refused_before_any_work(command: str, monkeypatch: Any) -> None:
    def refuse(dir: Path) -> None:
        raise PermissionError(13, "Permission denied", str(dir))

    monkeypatch.setattr("tempfile.TemporaryFile", refuse)
    result = _invoke(command, "--out", "/nowhere/new")
    assert result.exit_code == 2
    message = "error: folder must be one that can be written to, got '/nowhere/new': Permission denied\n"
    assert result.stderr == message


def test_bad_input_ends_the_process_with_2_and_no_traceback(tmp_path: Path) -> None:
    run = _run("curves", "marbel", folder=tmp_path)
    assert (run.returncode, run.stdout) == (2, "")
    assert "did you mean 'marble'?" in run.stderr
    assert "Traceback" not in run.stderr


@pytest.mark.parametrize(
    ("arguments", "message"),
    [(["curvs"], "curves"), (["curves", "--pahts", "5"], "--paths"), (["curves", "--paths", "many"], "--paths")],
)
def test_typing_mistakes_end_with_2_and_name_what_was_meant(arguments: list[str], message: str, tmp_path: Path) -> None:
    run = _run(*arguments, folder=tmp_path)
    assert run.returncode == 2
    assert message in run.stderr
    assert not list(tmp_path.iterdir())


@pytest.mark.skipif(os.name == "nt", reason="POSIX signals")
def test_an_interrupted_run_ends_with_130_and_leaves_no_file(tmp_path: Path) -> None:
    code = "import figures.app; from figures.command_line import main; print('ready', flush=True); main()"
    command = [sys.executable, "-c", code, "curves", "--paths", "4000000000"]
    process = subprocess.Popen(command, cwd=tmp_path, stderr=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    assert process.stdout.readline() == "ready\n"
    time.sleep(2)
    process.send_signal(signal.SIGINT)
    _, messages = process.communicate(timeout=60)
    assert process.returncode == 130
    assert "interrupted" in messages and "Traceback" not in messages
    assert not list(tmp_path.iterdir())


def _ends_with(error: BaseException, monkeypatch: Any) -> Any:
    def fail(*_: Any, **__: Any) -> None:
        raise error

    monkeypatch.setattr("halfspace_sss.comparison.reflectance_curves.curves", fail)
    return _invoke("curves")


def test_an_interrupt_ends_with_130(monkeypatch: Any) -> None:
    assert _ends_with(KeyboardInterrupt(), monkeypatch).exit_code == 130


def test_a_missing_backend_ends_with_1_and_its_message(monkeypatch: Any) -> None:
    result = _ends_with(BackendError("no LLVM here"), monkeypatch)
    assert (result.exit_code, result.stderr) == (1, "error: no LLVM here\n")


def test_a_reader_that_closes_the_pipe_hears_no_complaint(tmp_path: Path) -> None:
    reader, writer = os.pipe()
    os.close(reader)
    run = subprocess.run([*START, "materials", "show", "marble"], stdout=writer, stderr=subprocess.PIPE, text=True)
    os.close(writer)
    assert (run.returncode, run.stderr) == (1, "")


def test_a_mistake_in_the_library_is_not_hidden(monkeypatch: Any) -> None:
    assert isinstance(_ends_with(TypeError("a bug"), monkeypatch).exception, TypeError)


def test_models_are_listed_with_orders_and_source() -> None:
    result = _invoke("models")
    assert result.exit_code == 0
    for name in halfspace_sss.models():
        assert name in result.stdout
    assert "d'Eon 2012" in result.stdout


def test_materials_are_listed() -> None:
    result = _invoke("materials", "list")
    assert result.exit_code == 0
    for name in ("marble", "ketchup", "fig10"):
        assert name in result.stdout


def test_one_material_is_shown_with_its_source() -> None:
    result = _invoke("materials", "show", "Marble")
    assert "SIGGRAPH 2001" in result.stdout
    assert "sigma_t 2.1921" in result.stdout


def test_an_unknown_material_is_refused_with_a_near_name() -> None:
    result = _invoke("materials", "show", "marbel")
    assert result.exit_code == 2
    assert "did you mean 'marble'?" in result.stderr


def test_the_version_is_that_of_the_package() -> None:
    assert halfspace_sss.__version__ in _invoke("--version").stdout


def test_help_names_every_command() -> None:
    text = _invoke("--help").stdout
    for name in ("curves", "maps", "materials", "models"):
        assert name in text


def test_help_shows_what_is_taken_by_default() -> None:
    text = " ".join(_invoke("curves", "--help").stdout.split())
    for default in ("0.241", "first", "from the medium", "all"):
        assert f"[default: ({default})]" in text
