"""The code that the result of a part depends on: what its function uses of its file, and all that is imported.

Files count without comments, docstrings and layout. An address in a text, as "package.module:name", is an import.
Models are found by name: all of them count. For a function that is declared `unmodelled` they do not, nor do addresses.
"""

from __future__ import annotations

import ast
import functools
import hashlib
import re
from collections.abc import Iterable
from importlib.util import find_spec
from pathlib import Path
from typing import NamedTuple

PACKAGES = ("benchmarks", "figures", "full_geometry", "analytic_models", "halfspace_sss")
IDLE = {"cli", "curve_plot", "drawing", "parts", "style"}  # rooms and modules that compute nothing of a result
MODELS = ("analytic_models", "halfspace_sss.neural")
REGISTRY = "halfspace_sss.registry"  # imports the list of networks, which is no use of them
OBJECT_MODELS = ("full_geometry.transport", "full_geometry.learning", "full_geometry.trade.automatic")
ADDRESS = re.compile(r"([a-z_]\w*(?:\.\w+)+)(?::\w+)?")


class _Source(NamedTuple):
    """A file: hash, names that it imports, addresses in texts, and what is behind names that a package imports late."""

    digest: str
    imports: frozenset[str]
    addresses: frozenset[str]
    doors: dict[str, str]


def code_hash(module: str, function: str, unmodelled: bool = False) -> str:
    """SHA-256 of the code that a function at the top of a module comes to; of nobody's file, of its name."""
    path = _path(module)
    if path is None:
        return hashlib.sha256(f"{module} {function}".encode()).hexdigest()
    own = _source(path, path.stat().st_mtime_ns, function)
    roots = own.imports | own.addresses
    lines = [own.digest, *(f"{name} {_file(name).digest}" for name in modules_of(roots, unmodelled))]
    return hashlib.sha256("\n".join(lines).encode()).hexdigest()


def modules_of(names: Iterable[str], unmodelled: bool = False) -> list[str]:
    """Modules of this project behind names, and all that they import, sorted."""
    found: set[str] = set()
    ahead = [*names, *([] if unmodelled else _members(MODELS))]
    while ahead:
        name = ahead.pop()
        if name in found or IDLE & set(name.split(".")):
            continue
        if _path(name):
            found.add(name)
            source = _file(name)
            used = (
                source.imports if name != REGISTRY else {each for each in source.imports if not each.startswith(MODELS)}
            )
            ahead += [*used, *(() if unmodelled else source.addresses)]
            if name.startswith("full_geometry") and not unmodelled:
                ahead += _members(OBJECT_MODELS)
            continue
        package, _, last = name.rpartition(".")
        if _path(package):  # a name in a module, or one that a package imports late
            ahead += [package, *filter(None, [_file(package).doors.get(last)])]
    return sorted(found)


@functools.cache
def _members(names: tuple[str, ...]) -> tuple[str, ...]:
    """Modules of packages, and modules."""
    folders = {name: path.parent for name in names if (path := _path(name)).name == "__init__.py"}
    files = [f"{name}.{path.stem}" for name, folder in folders.items() for path in sorted(folder.glob("[!_]*.py"))]
    return (*files, *(name for name in names if name not in folders))


@functools.cache
def _path(name: str) -> Path | None:
    """The file of a module of this project; None for any other name."""
    if name.partition(".")[0] not in PACKAGES:
        return None
    try:
        spec = find_spec(name)
    except ModuleNotFoundError:
        return None
    return Path(spec.origin) if spec and spec.origin and spec.origin.endswith(".py") else None


def _file(name: str) -> _Source:
    path = _path(name)
    return _source(path, path.stat().st_mtime_ns)


@functools.lru_cache(maxsize=1024)
def _source(path: Path, changed: int, function: str = "") -> _Source:
    """The file, or what a function uses of it; `changed`, when it was written, lets an edited one be read again."""
    tree, doors = ast.parse(path.read_text(encoding="utf-8")), {}
    if function:
        tree.body = _used_by(function, tree.body)
    for block in [n for n in tree.body if isinstance(n, ast.If) and ast.unparse(n.test) == "TYPE_CHECKING"]:
        for node in [n for n in block.body if isinstance(n, ast.ImportFrom) and path.name == "__init__.py"]:
            doors |= {alias.name: f"{node.module}.{alias.name}" for alias in node.names}
        tree.body.remove(block)
    imports, addresses = set(), set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            imports |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and not node.level:
            imports |= {f"{node.module}.{alias.name}" for alias in node.names}
        elif isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id in PACKAGES:
            imports.add(f"{node.value.id}.{node.attr}")
        elif isinstance(node, ast.Constant) and isinstance(node.value, str) and (at := ADDRESS.fullmatch(node.value)):
            addresses.add(at[1])
    for node in ast.walk(tree):
        if isinstance(node, (ast.Module, ast.ClassDef, ast.FunctionDef)) and ast.get_docstring(node, clean=False):
            node.body = node.body[1:] or [ast.Pass()]
    digest = hashlib.sha256(ast.unparse(tree).encode()).hexdigest()
    return _Source(digest, frozenset(imports), frozenset(addresses), doors)


def _used_by(function: str, body: list[ast.stmt]) -> list[ast.stmt]:
    """Statements at the top of a file that a function comes to by the names that they bind."""
    bound: dict[str, list[ast.stmt]] = {}
    for statement in body:
        names = [statement.name] if isinstance(statement, (ast.FunctionDef, ast.ClassDef)) else [
            (node.asname or node.name).partition(".")[0] if isinstance(node, ast.alias) else node.id
            for node in ast.walk(statement)
            if isinstance(node, ast.alias) or (isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store))
        ]  # fmt: skip
        for name in names:
            bound.setdefault(name, []).append(statement)
    ahead, seen, kept = [function], set(), []
    while ahead:
        name = ahead.pop()
        for statement in () if name in seen else bound.get(name, ()):
            kept.append(statement)
            ahead += [node.id for node in ast.walk(statement) if isinstance(node, ast.Name)]
        seen.add(name)
    return [statement for statement in body if statement in kept]
