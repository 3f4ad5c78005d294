"""What other packages offer by entry points: taken if it is sound, else left out with one line that names it."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

import halfspace_sss
from analytic_models import MODELS
from analytic_models.standard_dipole import StandardDipole
from halfspace_sss import Medium, extensions, registry

OWN = [cls.name for cls in (*MODELS, *halfspace_sss.neural.MODELS)]
START = [sys.executable, "-c", "from figures.command_line import main; main()"]
QUICK = ["curves", "--theta-i", "0", "--paths", "0", "--model", "standard_dipole", "--out", "out"]


class Entry:
    """An entry point of another package."""

    def __init__(self, name: str, offered: Any, value: str = "other.package:thing") -> None:
        self.name, self.value, self._offered = name, value, offered
        self.group, self.dist = "other", SimpleNamespace(name="other" if value.startswith("other") else extensions.OWN)

    def load(self) -> Any:
        if isinstance(self._offered, BaseException):
            raise self._offered
        return self._offered


@pytest.fixture
def offer(monkeypatch: pytest.MonkeyPatch):
    """`offer(*entries)`: what is installed."""
    return lambda *entries: monkeypatch.setattr(extensions, "entry_points", lambda **_: list(entries))


def test_packages_add_commands(offer: Any) -> None:
    offer(Entry("greet", print))
    assert dict(extensions.commands()) == {"greet": print}


@pytest.mark.parametrize("wrong", [ImportError("no such\nthing"), SystemExit("no such thing"), 3], ids=repr)
def test_a_command_that_cannot_be_loaded_does_not_stop_the_others(offer: Any, wrong: Any) -> None:
    offer(Entry("broken", wrong), Entry("sound", print))
    with pytest.warns(
        UserWarning, match="^entry point 'broken' is left out: .*(no such thing|function, got 3)$"
    ) as found:
        assert dict(extensions.commands()) == {"sound": print}
    assert len(found) == 1


def _model(**members: Any) -> type:
    return type("Other", (StandardDipole,), {"name": "other", **members})


@pytest.mark.parametrize(
    ("wrong", "why"),
    [
        (ImportError("no such thing"), "ImportError: no such thing"),
        (3, "TypeError: 'int' object is not iterable"),
        ([_model(), dict], "ValueError: a model must be a subclass of BSSRDF, got <class 'dict'>"),
        ([_model(name=None)], "ValueError: name of a model must be a text that is not empty, got None"),
        ([_model(orders="all")], "ValueError: orders of a model must be multiple or total, got 'all'"),
        ([_model(name="standard_dipole")], "ValueError: model name must be new, got 'standard_dipole', which is"),
        ([_model(), _model()], "ValueError: model name must be new, got 'other', which is"),
    ],
)
def test_models_that_are_none_are_left_out(offer: Any, wrong: Any, why: str) -> None:
    offer(Entry("broken", wrong))
    with pytest.warns(UserWarning) as found:
        models = registry._installed.__wrapped__()
    assert list(models) == OWN
    assert [str(w.message).startswith(f"entry point 'broken' is left out: {why}") for w in found] == [True]


def test_models_of_other_packages_join_behind(offer: Any) -> None:
    offer(Entry("more", [_model()]))
    assert list(registry._installed.__wrapped__()) == [*OWN, "other"]


def _install(folder: Path, code: str, *entries: str) -> dict[str, str]:
    """An environment in which a package with these entry points is installed."""
    about = folder / "site" / "broken_package-1.0.dist-info"
    about.mkdir(parents=True)
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: broken-package\nVersion: 1.0\n")
    lines = [line for entry in entries for line in (f"[halfspace_sss.{entry.split()[0]}]", entry.split(maxsplit=1)[1])]
    (about / "entry_points.txt").write_text("\n".join(lines) + "\n")
    (folder / "site" / "broken_package.py").write_text(code)
    path = os.pathsep.join([str(folder / "site"), os.environ.get("PYTHONPATH", "")])
    return {**os.environ, "PYTHONPATH": path}


BROKEN = {
    "models": "models broken = broken_package:absent",
    "materials": "materials broken = broken_package:absent",
    "commands": "commands broken = broken_package:number",
    "command that typer refuses": "commands odd = broken_package:odd",
    "command of a name that is taken": "commands models = broken_package:draw",
}
CODE = "number = 3\ndef draw(result):\n    pass\ndef odd(x: list[list[int]]):\n    pass\n"


@pytest.mark.slow
@pytest.mark.parametrize("arguments", [["models"], ["materials", "list"], QUICK], ids=lambda a: a[0])
def test_no_command_falls_with_a_broken_package(tmp_path: Path, arguments: list[str]) -> None:
    env = _install(tmp_path, CODE, *BROKEN.values())
    run = subprocess.run([*START, *arguments], capture_output=True, text=True, env=env, cwd=tmp_path, timeout=300)
    assert run.returncode == 0, run.stderr
    lines = run.stderr.splitlines()
    assert all(" is left out: " in line or line.startswith("tracing ") for line in lines), run.stderr
    # three commands, and one sentence for the other groups, which is the same for models and materials
    also = {"models": 1, "materials": 1, "curves": 1}
    assert sum(" is left out: " in line for line in lines) == 3 + also[arguments[0]], run.stderr
    if arguments[0] == "curves":
        assert {"curves.csv", "curves_errors.csv", "curves.json"} <= {
            path.name for path in (tmp_path / "out").iterdir()
        }


def test_a_material_of_a_broken_package_costs_a_line(tmp_path: Path) -> None:
    env = _install(tmp_path, CODE, BROKEN["materials"])
    run = subprocess.run([*START, "materials", "show", "marble"], capture_output=True, text=True, env=env, timeout=300)
    (line,) = run.stderr.splitlines()
    assert run.returncode == 0 and "entry point 'broken' is left out: AttributeError: " in line


def test_a_command_of_another_package_runs(tmp_path: Path) -> None:
    env = _install(tmp_path, "def greet():\n    print('hello')\n", "commands greet = broken_package:greet")
    run = subprocess.run([*START, "greet"], capture_output=True, text=True, env=env, timeout=300)
    assert (run.returncode, run.stdout, run.stderr) == (0, "hello\n", "")


def test_a_class_without_orders_cannot_be_registered() -> None:
    with pytest.raises(ValueError, match="orders of a model must be multiple or total, got 'all'"):
        halfspace_sss.register_model(_model(orders="all"))
    assert "other" not in halfspace_sss.models()


def test_a_sound_model_of_a_package_answers(offer: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    offer(Entry("more", [_model()]))
    monkeypatch.setattr(registry, "_installed", registry._installed.__wrapped__)
    assert halfspace_sss.bssrdf("other", Medium(1.0, 0.1)).eval(1.0, 0.9, 0.0, 0.8, 0.0) > 0
