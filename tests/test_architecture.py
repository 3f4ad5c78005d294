"""Imports go one way, from room to room without a circle, the package is light to import, and functions stay short."""

from __future__ import annotations

import ast
import functools
import re
import subprocess
import sys
from pathlib import Path

import pytest

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

ROOT = Path(__file__).resolve().parent.parent
ORDER = ["benchmarks", "figures", "full_geometry", "halfspace_sss"]  # imports go to the right
BESIDE = "analytic_models"  # a room of the plane with a folder of its own
SOURCES = sorted(path for package in (*ORDER, BESIDE) for path in (ROOT / package).rglob("*.py"))
HEAVY = ["torch", "mitsuba", "matplotlib", "drjit", "pandas", "xarray"]
FLOORS = {  # of each package, a room or file may import those to its left; "" is all other files
    "halfspace_sss": [
        "", "physics", "interface", "neural", BESIDE, "registry", "tracing", "maps", "measure", "materials",
        "comparison", "neural.training", "cli",
    ],
    "full_geometry": [
        "", "geometry", "surface", "objects", "walk", "transport", "precomputed", "integrators", "scenes",
        "learning", "inverse", "trade", "viewing", "plugins", "cli",
    ],
    "figures": ["parts", "computing", "drawing", ""],
}  # fmt: skip
HIDING = {"bssrdf", "curves", "models", "trace"}  # public functions: a folder of that name would hide one
LONGEST_BODY = 60
ADDRESS = re.compile(r"[a-z_]\w*(?:\.\w+)+(?::\w+)?")  # "package.module" or "package.module:name"
MOST_ANY = 40  # parameters in `full_geometry` whose type is left open


@functools.cache
def _nodes(path: Path) -> list[ast.AST]:
    """All of a file; each is read once."""
    return list(ast.walk(ast.parse(path.read_text(encoding="utf-8"))))


def _imported_packages(path: Path) -> set[str]:
    """First parts of the absolute names that a file imports anywhere, also inside functions."""
    found = set()
    for node in _nodes(path):
        if isinstance(node, ast.Import):
            found |= {alias.name.split(".")[0] for alias in node.names}
        if isinstance(node, ast.ImportFrom) and not node.level:
            found.add(node.module.split(".")[0])
    return found


def _name(path: Path) -> str:
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


MODULES = {_name(path): path for path in SOURCES}


def _room(module: str) -> str:
    """The folder of a module below its package, or its name if it is a floor itself; a package within is in itself."""
    package, _, name = module.partition(".")
    if package == BESIDE:
        return BESIDE
    folder = MODULES[module].parent.relative_to(ROOT).parts
    return name if name in FLOORS.get(package, ()) else ".".join(folder[1:])


def _package(module: str) -> str:
    return module.partition(".")[0].replace(BESIDE, "halfspace_sss")


def _module(name: str) -> str | None:
    """The module that holds a dotted name; None outside this project."""
    while name and name not in MODULES:
        name = name.rpartition(".")[0]
    return name or None


def _arrows(path: Path) -> set[str]:
    """Modules of this project that a file imports, also inside functions, or names in a text of its code.

    The doors of a package do not count: names that an `__init__` imports for type checkers and opens when they are
    asked for.
    """
    doors = {
        inner
        for node in _nodes(path)
        if path.name == "__init__.py" and isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING"
        for inner in ast.walk(node)
    }
    names = set()
    for node in _nodes(path):
        if node in doors:
            continue
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        if isinstance(node, ast.ImportFrom) and not node.level:
            names |= {f"{node.module}.{alias.name}" for alias in node.names}
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and ADDRESS.fullmatch(node.value):
            names |= {node.value.replace(":", ".")} - {_name(path).rpartition(".")[0]}  # whose files it reads
    return {found for name in names if (found := _module(name))} - {_name(path)}


@functools.cache
def _all_arrows() -> dict[str, set[str]]:
    return {module: _arrows(path) for module, path in MODULES.items()}


def _circles(arrows: dict[str, set[str]]) -> set[str]:
    """What is left when all that leads nowhere has been taken away again and again."""
    left = {module: set(targets) for module, targets in arrows.items()}
    while ends := {module for module, targets in left.items() if not targets & left.keys()}:
        left = {module: targets for module, targets in left.items() if module not in ends}
    return set(left)


def _body_lines(function: ast.FunctionDef | ast.AsyncFunctionDef) -> int:
    """Lines of a function without its signature, docstring and classes, whose methods count alone."""
    body = function.body[1:] if ast.get_docstring(function) is not None else function.body
    classes = sum(node.end_lineno - node.lineno + 1 for node in body if isinstance(node, ast.ClassDef))
    return function.end_lineno - body[0].lineno + 1 - classes if body else 0


def _loaded_by(statement: str) -> set[str]:
    code = f"import sys; {statement}; print(*(m for m in {HEAVY} if m in sys.modules))"
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return set(run.stdout.split())


@pytest.mark.parametrize("package", ORDER)
def test_a_package_imports_only_packages_below_it(package: str) -> None:
    above = set(ORDER[: ORDER.index(package)])
    back = {
        str(path.relative_to(ROOT)): bad
        for path in (MODULES[module] for module in MODULES if _package(module) == package)
        if (bad := _imported_packages(path) & above)
    }
    assert not back


@pytest.mark.parametrize("package", FLOORS)
def test_a_room_imports_only_rooms_below_it(package: str) -> None:
    floors = FLOORS[package]
    up = {
        f"{module} -> {target}"
        for module, targets in _all_arrows().items()
        for target in targets - set(FLOORS)
        if not module.endswith(".__main__")  # the command line's other name
        and _package(module) == _package(target) == package
        and floors.index(_room(target)) > floors.index(_room(module))
    }
    assert not up


def test_a_module_that_is_named_in_a_text_counts_as_imported() -> None:
    assert "full_geometry.transport.lambert" in _all_arrows()["full_geometry.transport.models"]
    assert "full_geometry.trade.automatic" in _all_arrows()["full_geometry.plugins"]


def test_the_project_has_no_entry_points_but_its_command() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert "entry-points" not in project and set(project["scripts"]) == {"halfspace-sss"}


def test_no_modules_import_each_other_in_a_circle() -> None:
    assert not _circles(_all_arrows())


def test_a_circle_is_found() -> None:
    arrows = {"a": {"b"}, "b": {"c"}, "c": {"b", "d"}, "d": set()}
    assert _circles(arrows) == {"a", "b", "c"}  # with what leads to it
    assert not _circles({"a": {"b", "d"}, "b": {"d"}, "d": set()})


def test_every_room_has_its_floor() -> None:
    for package, floors in FLOORS.items():
        rooms = {_room(module) for module in MODULES if _package(module) == package}
        assert rooms == set(floors)


def test_no_folder_hides_a_public_function() -> None:
    assert not [path for path in (ROOT / "halfspace_sss").rglob("*") if path.is_dir() and path.name in HIDING]


def test_every_top_level_package_is_in_the_order() -> None:
    packages = {path.parent.name for path in ROOT.glob("*/__init__.py")}
    assert packages - {"tests"} == {*ORDER, BESIDE}


def test_importing_the_package_loads_nothing_heavy() -> None:
    assert not _loaded_by("import halfspace_sss")


def test_importing_the_command_line_loads_nothing_heavy() -> None:
    assert not _loaded_by("import halfspace_sss.cli")


def test_models_load_neither_renderer_nor_learning_nor_drawing_library() -> None:
    statement = "import halfspace_sss as h; h.bssrdf('better_dipole', h.Medium(1, 0.1)).eval(1.0, 1.0, 0.0, 1.0, 0.0)"
    assert not _loaded_by(statement)


def test_function_bodies_have_at_most_60_lines() -> None:
    long = {
        f"{path.relative_to(ROOT)}:{node.name}": n
        for path in SOURCES
        for node in _nodes(path)
        if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef)) and (n := _body_lines(node)) > LONGEST_BODY
    }
    assert not long


def test_the_ways_through_the_house_are_short_and_name_functions_that_are_there() -> None:
    text = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    house = text[text.index("## The house") : text.index("## To add")]
    assert len(house.splitlines()) <= 60
    for way in ("### The way of a ray", "### The way of a medium"):
        rows = [line.split("|")[1:3] for line in house.partition(way)[2].partition("###")[0].splitlines()[4:]]
        steps, file = [], ""
        for names, place in (row for row in rows if row):
            file = (re.findall(r"`([\w/]+\.py)`", place) or [file])[0]
            code = (ROOT / "full_geometry" / file).read_text(encoding="utf-8")
            steps += (found := re.findall(r"`(\w+)`", names))
            assert found and all(f"def {name}(" in code for name in found), (names, file)
        assert 5 <= len(steps) <= 9


def test_no_file_is_named_utils() -> None:
    assert not [path for path in SOURCES if path.stem in ("utils", "util", "helpers", "misc", "common")]


def test_few_parameters_of_full_geometry_leave_their_type_open() -> None:
    left_open = [
        f"{path.relative_to(ROOT)}:{argument.lineno} {argument.arg}"
        for path in (ROOT / "full_geometry").rglob("*.py")
        for argument in _nodes(path)
        if isinstance(argument, ast.arg) and argument.annotation and ast.unparse(argument.annotation) == "Any"
    ]
    assert len(left_open) <= MOST_ANY, left_open


def test_no_class_name_stands_for_two_things() -> None:
    homes: dict[str, list[str]] = {}
    for path in SOURCES:
        for node in _nodes(path):
            if isinstance(node, ast.ClassDef):
                homes.setdefault(node.name, []).append(str(path.relative_to(ROOT)))
    assert not {name: files for name, files in homes.items() if len(files) > 1}
