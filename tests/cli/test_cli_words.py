"""What the command line says: help without gaps, progress where nobody looks, numbers as people write and read them."""

from __future__ import annotations

import re
import warnings
from pathlib import Path
from typing import Any

import pytest
import typer
from command_list import COMMANDS
from typer.testing import CliRunner

import halfspace_sss
from figures import app as cli
from halfspace_sss import interrupts as cli_interrupts
from halfspace_sss import materials
from halfspace_sss.cli import errors as cli_errors
from halfspace_sss.cli import shared
from halfspace_sss.materials import Material
from halfspace_sss.physics.medium import Medium


def _invoke(*arguments: str) -> Any:
    return CliRunner().invoke(cli.app, list(arguments), env={"COLUMNS": "300"})


def _helps(command: str) -> list[str]:
    """The help of every option and argument."""
    found = [parameter.help for parameter in COMMANDS[command].params if parameter.help]
    assert found
    return found


@pytest.mark.parametrize("command", COMMANDS)
def test_help_shows_every_word(command: str) -> None:
    shown = " ".join(re.sub(r"[│\s]+", " ", _invoke(*command.split(), "--help").stdout).split())
    for text in _helps(command):
        assert " ".join(text.split()) in shown


@pytest.mark.parametrize("command", COMMANDS)
def test_h_is_help(command: str) -> None:
    assert _invoke(*command.split(), "-h").stdout == _invoke(*command.split(), "--help").stdout != ""


@pytest.mark.parametrize(("text", "number"), [("1e6", 10**6), ("7", 7), ("9007199254740993", 2**53 + 1), (5, 5)])
def test_whole_numbers_may_be_written_with_an_exponent(text: str, number: int) -> None:
    from halfspace_sss.cli.shared import whole

    assert whole(text) == number


@pytest.mark.parametrize("text", ["1.5", "many", "nan", "inf", "1e-3", ""])
def test_what_is_no_whole_number_is_refused(text: str) -> None:
    from halfspace_sss.cli.shared import whole

    with pytest.raises(typer.BadParameter, match="is not a whole number"):
        whole(text)


def test_walks_may_be_written_with_an_exponent(tmp_path: Path) -> None:
    result = _invoke(
        "curves", "--paths", "4.096e3", "--theta-i", "0", "--model", "better_dipole", "--out", str(tmp_path)
    )
    assert result.exit_code == 0 and "4,096 walks" in result.stdout


@pytest.mark.slow
def test_quiet_prints_nothing_and_writes_all(tmp_path: Path) -> None:
    options = ["--paths", "4096", "--theta-i", "0", "--model", "better_dipole", "--out", str(tmp_path)]
    result = _invoke("curves", "--quiet", *options)
    assert (result.exit_code, result.stdout, result.stderr) == (0, "", "")
    assert (tmp_path / "curves.csv").exists()
    assert _invoke("curves", *options).stdout


def test_quiet_still_says_what_is_wrong() -> None:
    result = _invoke("curves", "marbel", "--quiet")
    assert result.exit_code == 2 and "did you mean 'marble'?" in result.stderr


def _progress(steps: list[tuple[float, int]], monkeypatch: Any, capsys: Any, error: bool = False) -> list[str]:
    """Lines on stderr of a bar that is moved at given seconds to given parts of 10."""
    now = [0.0]
    monkeypatch.setattr(shared.time, "monotonic", lambda: now[0])
    try:
        with shared.Bar("work") as bar:
            for now[0], done in steps:
                bar.show(done, 10, f"step {done}")
            if error:
                raise ValueError
    except ValueError:
        pass
    return capsys.readouterr().err.splitlines()


def test_where_no_terminal_is_a_line_is_printed_now_and_then(monkeypatch: Any, capsys: Any) -> None:
    lines = _progress([(0, 0), (10, 1), (20, 2), (40, 4), (45, 5), (80, 8)], monkeypatch, capsys)
    first, second, last = (
        "work 40 % after 40 s, about 60 s left  step 4",
        "work 80 % after 80 s",
        "work 100 % after 80 s",
    )
    assert lines[0] == first and lines[1].startswith(second) and lines[2:] == [last]


def test_work_that_was_done_before_does_not_shorten_the_time_left(monkeypatch: Any, capsys: Any) -> None:
    assert "work 60 % after 40 s, about 160 s left  step 6" in _progress([(0, 5), (40, 6)], monkeypatch, capsys)


def test_work_that_fails_does_not_end_at_100_per_cent(monkeypatch: Any, capsys: Any) -> None:
    assert _progress([(0, 0), (1, 5)], monkeypatch, capsys, error=True) == []


def test_progress_passes_every_part_of_the_work_and_ends_with_it(tmp_path: Path, monkeypatch: Any) -> None:
    seen = []
    monkeypatch.setattr(shared.Bar, "show", lambda self, done, total, text="": seen.append((done / total, text)))
    arguments = ["errors", "materials", "--model", "better_dipole", "--events", "1e4"]
    assert _invoke(*arguments, "--out", str(tmp_path)).exit_code == 0
    shares = [share for share, _ in seen]
    assert shares == sorted(shares) and shares[-1] == 1


def test_an_error_below_the_noise_is_shown_as_less_than_the_noise() -> None:
    assert cli_errors.told_error(dict(zip(cli_errors.SQUARE, (0.0, 0.018)))).startswith("< ")
    assert cli_errors.told_error(dict(zip(cli_errors.SQUARE, (0.25, 0.018)))).startswith("50")


def test_values_that_differ_in_one_channel_are_all_listed(monkeypatch: Any) -> None:
    medium = Medium(sigma_s=[1.0, 1.0, 1.0], sigma_a=[0.1, 0.2, 0.3], g=[0.8, 0.8, 0.7], eta=1.3)
    table = materials.table
    one = table().iloc[:3].assign(material="odd", set="test", channel=list("RGB"), g=medium.g, eta=1.3)
    monkeypatch.setattr(materials, "table", lambda: one)
    line = next(line for line in _invoke("materials", "list").stdout.splitlines() if "odd" in line)
    assert "0.8 0.8 0.7" in line and line.rstrip(" │").split()[-1] == "1.3"


def test_a_material_stands_for_its_medium() -> None:
    medium = Medium.from_albedo(0.75, 0.241)
    material = Material("mine", medium)
    assert halfspace_sss.bssrdf("better_dipole", material).medium == medium
    traced = [halfspace_sss.trace(m, n_paths=2048).reflectance().value for m in (medium, material)]
    assert traced[0] == traced[1]
    result = halfspace_sss.curves(materials.load("marble"), channel="G", n_paths=1024, theta_i_deg=[0.0], models=[])
    assert result.title == "marble G" and result.medium == materials.load("marble").medium.channel(1)


def test_a_warning_is_one_line_without_source_and_shown_once(monkeypatch: Any) -> None:
    def table() -> Any:
        for _ in range(2):
            warnings.warn("the object is\n not closed", stacklevel=2)
        raise ValueError("enough")

    monkeypatch.setattr(materials, "table", table)
    assert _invoke("materials", "list").stderr == "warning: the object is not closed\nerror: enough\n"


def test_figures_ask_for_what_they_are_drawn_with_before_they_are_computed(tmp_path: Path, monkeypatch: Any) -> None:
    from figures.parts import command as cli_figures

    monkeypatch.setattr(cli_figures, "find_spec", lambda name: None if name == "matplotlib" else name)
    monkeypatch.setattr("figures.parts.runner.compute", lambda *_: pytest.fail("computed"))
    result = _invoke("figures", "all", "fig10", "--out", str(tmp_path))
    assert result.exit_code == 1
    assert 'figures need matplotlib: pip install "halfspace-sss[figures,render]"' in result.stderr


def test_the_watch_for_interrupts_ends_with_the_command() -> None:
    import signal

    before = signal.getsignal(signal.SIGINT)
    _invoke("materials", "show", "marble")
    assert signal.getsignal(signal.SIGINT) is before and cli_interrupts.interrupts.received is None
