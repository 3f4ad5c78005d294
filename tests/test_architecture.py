"""Imports go one way, the package is light to import, and files and functions stay short."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
ORDER = ["figures", "full_geometry", "analytic_models", "halfspace_sss"]  # a package may import those to its right
SOURCES = sorted(path for package in ORDER for path in (ROOT / package).rglob("*.py"))
HEAVY = ["torch", "mitsuba", "matplotlib", "drjit", "pandas", "xarray"]
LONGEST_FILE, LONGEST_BODY = 300, 45


def _tree(path: Path) -> ast.Module:
    return ast.parse(path.read_text(encoding="utf-8"))


def _imported_packages(path: Path) -> set[str]:
    """First parts of the absolute names that a file imports anywhere, also inside functions."""
    found = set()
    for node in ast.walk(_tree(path)):
        if isinstance(node, ast.Import):
            found |= {alias.name.split(".")[0] for alias in node.names}
        if isinstance(node, ast.ImportFrom) and not node.level:
            found.add(node.module.split(".")[0])
    return found


def _body_lines(function: ast.FunctionDef | ast.AsyncFunctionDef) -> int:
    """Lines of a function without its signature and docstring."""
    body = function.body[1:] if ast.get_docstring(function) is not None else function.body
    return function.end_lineno - body[0].lineno + 1 if body else 0


def _loaded_by(statement: str) -> set[str]:
    code = f"import sys; {statement}; print(*(m for m in {HEAVY} if m in sys.modules))"
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return set(run.stdout.split())


@pytest.mark.parametrize("package", ORDER)
def test_a_package_imports_only_packages_below_it(package: str) -> None:
    above = set(ORDER[: ORDER.index(package)])
    back = {
        str(path.relative_to(ROOT)): bad
        for path in (ROOT / package).rglob("*.py")
        if (bad := _imported_packages(path) & above)
    }
    assert not back


def test_every_top_level_package_is_in_the_order() -> None:
    packages = {path.parent.name for path in ROOT.glob("*/__init__.py")}
    assert packages - {"tests"} == set(ORDER)


def test_importing_the_package_loads_nothing_heavy() -> None:
    assert not _loaded_by("import halfspace_sss")


def test_importing_the_command_line_loads_nothing_heavy() -> None:
    assert not _loaded_by("import halfspace_sss.cli")


def test_models_load_neither_renderer_nor_learning_nor_drawing_library() -> None:
    statement = "import halfspace_sss as h; h.bssrdf('better_dipole', h.Medium(1, 0.1)).eval(1.0, 1.0, 0.0, 1.0, 0.0)"
    assert not _loaded_by(statement)


def test_files_have_at_most_300_lines() -> None:
    files = [*SOURCES, *sorted((ROOT / "tests").rglob("*.py"))]
    lengths = {str(path.relative_to(ROOT)): len(path.read_text(encoding="utf-8").splitlines()) for path in files}
    assert not {name: n for name, n in lengths.items() if n > LONGEST_FILE}


def test_function_bodies_have_at_most_45_lines() -> None:
    long = {
        f"{path.relative_to(ROOT)}:{node.name}": n
        for path in SOURCES
        for node in ast.walk(_tree(path))
        if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef)) and (n := _body_lines(node)) > LONGEST_BODY
    }
    assert not long


def test_no_file_is_named_utils() -> None:
    assert not [path for path in SOURCES if path.stem in ("utils", "util", "helpers", "misc", "common")]
