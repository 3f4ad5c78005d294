"""Parts of figures notice that the code they run has changed, and nothing else."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import figures
from figures.parts.sources import PACKAGES, modules_of

ROOT = Path(figures.__file__).resolve().parent.parent

# in a copy of the project: the keys of parts before and after each edit of one of its files
KEYS = """
import json, sys
from pathlib import Path
from figures import fig09, fig10
from figures.parts.part import keys_of

def keys():
    fig09.MATERIALS = ("marble",)
    return keys_of(fig09.parts("draft")) | keys_of(fig10.parts("draft"))

found = [keys()]
for file, text in json.loads(sys.argv[1]):
    path = Path(sys.argv[2]) / file
    before = path.read_text(encoding="utf-8")
    path.write_text(before + text, encoding="utf-8")
    found.append(keys())
    path.write_text(before, encoding="utf-8")
print(json.dumps([*found, keys()]))
"""
EDITS = {
    "walk": ("halfspace_sss/rendering/walk/tracing.py", "\nEDITED = 1\n"),
    "comment": ("halfspace_sss/rendering/walk/tracing.py", "\n# edited\n"),
    "dipoles": ("analytic_models/_diffusion.py", "\nEDITED = 1\n"),
    "drawing": ("figures/drawing/style.py", "\nEDITED = 1\n"),
    "figure": ("figures/fig09.py", "\nEDITED = 1\n"),
    "far": ("halfspace_sss/physics/fresnel.py", "\nEDITED = 1\n"),
}


@pytest.fixture(scope="module")
def changed(tmp_path_factory: pytest.TempPathFactory) -> dict[str, set[str]]:
    """Names of the parts whose key is another one after each edit."""
    copy = tmp_path_factory.mktemp("project")
    for package in PACKAGES:
        shutil.copytree(ROOT / package, copy / package, ignore=shutil.ignore_patterns("__pycache__"))
    code = f"import sys; sys.path.insert(0, {str(copy)!r})" + KEYS
    command = [sys.executable, "-c", code, json.dumps(list(EDITS.values())), str(copy)]
    run = subprocess.run(command, capture_output=True, text=True, check=True)
    before, *after, last = json.loads(run.stdout)
    assert last == before
    return {name: {part for part in before if keys[part] != before[part]} for name, keys in zip(EDITS, after)}


def test_a_change_of_the_walk_changes_what_is_rendered_and_no_curve(changed: dict[str, set[str]]) -> None:
    assert "marble, path traced" in changed["walk"]
    assert not any("degrees" in name for name in changed["walk"])


def test_a_comment_changes_nothing(changed: dict[str, set[str]]) -> None:
    assert not changed["comment"]


def test_a_change_of_a_model_changes_its_parts_alone(changed: dict[str, set[str]]) -> None:
    assert {"marble, better_dipole", "better_dipole"} <= changed["dipoles"]
    assert not changed["dipoles"] & {"marble, path traced", "marble, neural", "neural", "path traced, 30 degrees"}


def test_what_draws_is_not_what_computes(changed: dict[str, set[str]]) -> None:
    assert not changed["drawing"] and not changed["figure"]


def test_a_change_far_below_changes_everything(changed: dict[str, set[str]]) -> None:
    assert {"marble, path traced", "marble, neural", "better_dipole", "path traced, 30 degrees"} <= changed["far"]


def test_a_name_that_a_package_imports_late_counts_with_its_module() -> None:
    assert "halfspace_sss.rendering.plugins" in modules_of(["figures.computing.scenes"])
