"""Parts of figures notice that the code they run has changed, and nothing else."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import figures
from figures.computing.contenders import long_walk
from figures.parts.code import PACKAGES, modules_of
from figures.parts.part import Task, unmodelled
from full_geometry.transport.models import lookup
from halfspace_sss.registry import model_class

ROOT = Path(figures.__file__).resolve().parent.parent

# in a copy of the project: the keys of parts before and after each edit of one of its files
KEYS = """
import json, sys
from pathlib import Path
from figures import figure_modules
from figures.parts.part import keys_of
from figures.parts.runner import figure

parts = {name: figure(name).parts("draft") for name in figure_modules()}

def keys():
    return {f"{name}: {part}": key for name, each in parts.items() for part, key in keys_of(each).items()}

found = [keys()]
for edits in json.loads(sys.argv[1]):
    before = {}
    for file, text in edits:
        path = Path(sys.argv[2]) / file
        before[path] = path.read_text(encoding="utf-8")
        path.write_text(before[path] + text, encoding="utf-8")
    found.append(keys())
    for path, text in before.items():
        path.write_text(text, encoding="utf-8")
print(json.dumps(found))
"""
EDIT = "\nEDITED = 1\n"
EDITS = {
    "walk": [("full_geometry/integrators/walk_paths.py", EDIT)],
    "dipole": [("analytic_models/better_dipole.py", EDIT)],
    "network": [("halfspace_sss/neural/universal.py", EDIT)],
    "object": [("full_geometry/transport/one_object.py", EDIT)],
    "learner": [("full_geometry/learning/network_fitting.py", EDIT)],
    "far": [("halfspace_sss/physics/fresnel.py", EDIT)],
    "nothing": [  # last: what was edited before and is no more changes nothing either
        ("full_geometry/integrators/walk_paths.py", "\n# edited\n"),
        ("full_geometry/cli/render.py", EDIT),
        ("halfspace_sss/comparison/style.py", EDIT),
        ("figures/drawing/page.py", EDIT),
        ("figures/fig09.py", EDIT),
    ],
}
OF_MODELS = ("dipole", "network", "object", "learner")


@pytest.fixture(scope="module")
def changed(tmp_path_factory: pytest.TempPathFactory) -> dict[str, set[str]]:
    """ "FIGURE: PART" of the parts whose key is another one after each edit; "all" holds every one."""
    copy = tmp_path_factory.mktemp("project")
    for package in PACKAGES:
        shutil.copytree(ROOT / package, copy / package, ignore=shutil.ignore_patterns("__pycache__"))
    code = f"import sys; sys.path.insert(0, {str(copy)!r})" + KEYS
    command = [sys.executable, "-c", code, json.dumps(list(EDITS.values())), str(copy)]
    run = subprocess.run(command, capture_output=True, text=True, check=True)
    before, *after = json.loads(run.stdout)
    found = {name: {part for part in before if keys[part] != before[part]} for name, keys in zip(EDITS, after)}
    return found | {"all": set(before)}


def _of(parts: set[str], *figures: str) -> set[str]:
    return {part for part in parts if part.split(":")[0] in figures}


@pytest.mark.slow
def test_a_change_of_the_walk_changes_what_is_rendered_and_no_curve(changed: dict[str, set[str]]) -> None:
    assert "fig09: marble, path traced" in changed["walk"]
    assert not _of(changed["walk"], "fig10")


@pytest.mark.slow
@pytest.mark.parametrize("edit", OF_MODELS)
def test_a_change_of_what_is_found_by_name_changes_all_that_may_find_it(
    edit: str, changed: dict[str, set[str]]
) -> None:
    """Trainings start from a model, defaults and rivals are models, the trade tries all of them."""
    truths = {part for part in changed["all"] if re.search("path traced|truth|walk, surface", part)}
    rendered = changed["all"] - truths - _of(changed["all"], "fig10")
    assert len(rendered) > 100
    assert rendered <= changed[edit]


@pytest.mark.slow
@pytest.mark.parametrize("edit", OF_MODELS)
def test_what_is_traced_without_models_outlives_a_change_of_one(edit: str, changed: dict[str, set[str]]) -> None:
    traced = {"fig09: marble, path traced", "thin: dragon, path traced", "fig11: marble, truth"}
    traced |= {"fig05: potato, small light: truth", "fig10: path traced, 30 degrees"}
    assert traced <= changed["all"]
    assert not traced & changed[edit]


@pytest.mark.slow
def test_curves_of_models_outlive_a_change_of_models_of_objects(changed: dict[str, set[str]]) -> None:
    assert "fig10: better_dipole" in changed["network"]
    assert not _of(changed["object"] | changed["learner"], "fig10")


@pytest.mark.slow
def test_a_comment_and_what_draws_change_nothing(changed: dict[str, set[str]]) -> None:
    assert not changed["nothing"]


@pytest.mark.slow
def test_a_change_far_below_changes_everything(changed: dict[str, set[str]]) -> None:
    assert changed["far"] == changed["all"]


@pytest.mark.parametrize("ask", [lambda: model_class("neural"), lambda: lookup("lambert").transport])
def test_a_part_that_is_declared_to_find_no_model_cannot(ask: Callable[[], Any], tmp_path: Path) -> None:
    with pytest.raises(RuntimeError, match="is declared to find no model by name, and asks for '(neural|lambert)'"):
        unmodelled(lambda task: ask())(Task({}, tmp_path))
    assert ask()


def test_path_tracing_finds_no_model(tmp_path: Path) -> None:
    pytest.importorskip("mitsuba")
    params = {"material": "marble", "size": 4, "lights": "small light", "spp": 2, "seed": 0}
    assert long_walk(Task(params, tmp_path))["image"].shape == (4, 4, 3)


def test_a_name_that_a_package_imports_late_counts_with_its_module() -> None:
    assert "full_geometry.plugins" in modules_of(["figures.computing.scenes"])
