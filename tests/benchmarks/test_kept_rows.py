"""Long tables that are ended in the middle and started again."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from benchmarks import __main__ as cli
from benchmarks import truths_commands
from benchmarks.kept_rows import KeptRows


def test_rows_of_the_same_run_are_found_again_and_others_dropped(tmp_path: Path) -> None:
    path = tmp_path / "deep" / "rows.part"
    first = KeptRows(path, {"seed": 1})
    assert not path.parent.exists()  # nothing is written before there is a row
    first["a"], first["b"] = {"R": 0.1}, [1.5, None]
    assert KeptRows(path, {"seed": 1}) == {"a": {"R": 0.1}, "b": [1.5, None]}
    assert KeptRows(path, {"seed": 2}) == {}
    with path.open("a") as file:
        file.write('["c", {"R": 0.')  # cut off
    again = KeptRows(path, {"seed": 1})
    again["d"] = 2
    assert list(KeptRows(path, {"seed": 1})) == ["a", "b", "d"]
    again.finish()
    assert not path.exists()


def _truths(out: Path) -> Any:
    return CliRunner().invoke(cli.app, ["truths", "--model", "better_dipole", "--out", str(out)])


@pytest.mark.slow
def test_truths_go_on_after_what_is_kept(tmp_path: Path, monkeypatch: Any) -> None:
    found, asked, (rows, left_out) = truths_commands._reflectance, [], truths_commands.read_truths()
    few = [row for row in rows if row.measure == "R_d"][:60:6]
    monkeypatch.setattr(truths_commands, "read_truths", lambda: (few, left_out))

    def ended(model: Any, mu_i: Any) -> list[float]:
        asked.append(mu_i)
        if len(asked) == 5:
            raise KeyboardInterrupt
        return found(model, mu_i)

    monkeypatch.setattr(truths_commands, "_reflectance", ended)
    assert _truths(tmp_path).exit_code != 0
    assert not (tmp_path / "truths.csv").exists()
    n = len(KeptRows(tmp_path / "truths.part", {"what": "truths"}))
    assert n == 4
    whole = _truths(tmp_path)
    assert whole.exit_code == 0 and f"goes on after {n} reflectances that were kept" in whole.stderr
    all_but_one = len(asked) - 1  # that was interrupted
    assert not (tmp_path / "truths.part").exists()
    fresh = _truths(tmp_path / "fresh")
    assert "kept" not in fresh.stderr and len(asked) == 1 + 2 * all_but_one
    assert (tmp_path / "fresh" / "truths.csv").read_text() == (tmp_path / "truths.csv").read_text()
