"""The command line and its commands of the plane import no Mitsuba, which takes a second and need not be installed."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

COMMANDS = {
    "--help": [],
    "curves": ["--paths", "0", "--theta-i", "0", "--model", "neural", "--out", "curves"],
    "maps": ["--grid", "2,16,4,4", "--paths", "1024", "--out", "maps"],
    "materials list": ["--json"],
    "materials show": ["marble"],
    "models": ["--json"],
    "train material": ["--steps", "5"],
}
RUN = """
import json, sys
import halfspace_sss.cli
found = {"import": ("mitsuba" in sys.modules, 0)}
from typer.testing import CliRunner
from figures.app import app
from halfspace_sss.maps.noisy_maps import CellGrid
from halfspace_sss.neural.training.fit import Fit
import halfspace_sss.neural.training.train_material
from halfspace_sss.comparison import model_errors, reflectance_curves, style
model_errors.GRID, model_errors.LAST_N_PSI = CellGrid(16, 8), model_errors.FIRST_N_PSI
reflectance_curves.REFLECTANCE_POINTS, style.saved.__defaults__ = 2**8, (60,)
training = sys.modules["halfspace_sss.neural.training.train_material"]  # its package has a function of that name
how = Fit(steps=20, n_groups=4, n_queries=32, validate_every=20)
training.STANDARD = training.MaterialRecipe(n_groups=8, events=1e5, grid=CellGrid(8, 4), how=how)
for command, arguments in json.loads(sys.argv[1]).items():
    result = CliRunner().invoke(app, [*command.split(), *arguments])
    found[command] = ("mitsuba" in sys.modules, result.exit_code)
print(json.dumps(found))
"""
HEAVY = ("drjit", "matplotlib", "mitsuba", "numpy", "pandas", "torch", "xarray")


@pytest.mark.slow
def test_commands_of_the_plane_run_without_mitsuba(tmp_path: Path) -> None:
    env = {**os.environ, "HALFSPACE_SSS_WEIGHTS": str(tmp_path / "weights")}
    command = [sys.executable, "-c", RUN, json.dumps(COMMANDS)]
    run = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, env=env)
    assert run.returncode == 0, run.stderr
    assert json.loads(run.stdout) == {name: [False, 0] for name in ("import", *COMMANDS)}
    assert {path.name for path in tmp_path.iterdir()} == {"curves", "maps", "weights"}


def test_help_and_version_import_nothing_heavy() -> None:
    code = f"import sys; from figures.app import app; print(*(name for name in {HEAVY} if name in sys.modules))"
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert run.stdout.strip() == ""
