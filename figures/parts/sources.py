"""The code that a part runs: its function, what that uses of its file, and the files of this project it imports."""

from __future__ import annotations

import ast
import functools
import hashlib
import re
from collections.abc import Iterable, Iterator
from importlib.util import find_spec
from pathlib import Path
from typing import NamedTuple

from halfspace_sss.interface.model import model_class
from halfspace_sss.rendering.surface.transports import model_names, object_transport

__all__ = ["PACKAGES", "code_hash", "models_named", "modules_of"]

PACKAGES = ("figures", "full_geometry", "analytic_models", "halfspace_sss")
MACHINERY = "figures.parts"  # keeps and orders what parts compute, and computes nothing of it


class _Source(NamedTuple):
    """Code: its hash, what it imports by dotted name, and the lazy names of a package."""

    digest: str
    imports: tuple[str, ...]
    doors: dict[str, str]


def code_hash(module: str, function: str, named: Iterable[str] = ()) -> str:
    """SHA-256 of the code of a function and of all that it imports from this project.

    Of its own file only those definitions count that it uses, so that what draws a figure may change. Comments,
    docstrings and layout do not count. A name that a package imports when it is asked for counts with its module;
    models, which are found by name, count where they are named.

    Args:
        module, function: dotted name of a module, and name of a function at its top.
        named: models that the code asks for.
    """
    path = _path(module)
    if path is None:  # of nobody's file, as in a notebook: only its name is known
        return hashlib.sha256(f"{module} {function}".encode()).hexdigest()
    own = _digested(_used_by(function, _parsed(path)))
    roots = [*_resolved(own), *(_module_of_model(name) for name in named)]
    lines = [f"{name} {_source(path, path.stat().st_mtime_ns).digest}" for name, path in modules_of(roots).items()]
    return hashlib.sha256("\n".join([own.digest, *lines]).encode()).hexdigest()


def modules_of(roots: Iterable[str]) -> dict[str, Path]:
    """Files of this project that modules import, themselves included, sorted by dotted name."""
    found: dict[str, Path] = {}
    ahead = list(roots)
    while ahead:
        name = ahead.pop()
        path = _path(name)
        if path is None or name in found:
            continue
        found[name] = path
        ahead += _resolved(_source(path, path.stat().st_mtime_ns))
    return dict(sorted(found.items()))


def _path(name: str) -> Path | None:
    """The file of a module of this project; None for any other name, and for the machinery of parts itself."""
    if name.partition(".")[0] not in PACKAGES or name.startswith(MACHINERY):
        return None
    return _located(name)


@functools.cache
def _located(name: str) -> Path | None:
    try:
        spec = find_spec(name)
    except ModuleNotFoundError:
        return None
    return Path(spec.origin) if spec and spec.origin and spec.origin.endswith(".py") else None


def _resolved(source: _Source) -> Iterator[str]:
    """Modules behind the names that a file imports: a module, a lazy name of a package, or what a module defines."""
    for name in source.imports:
        if _path(name):
            yield name
            continue
        package, _, last = name.rpartition(".")
        path = _path(package)
        if path:
            yield package
            door = _source(path, path.stat().st_mtime_ns).doors.get(last)
            if door:
                yield door if _path(door) else door.rpartition(".")[0]


@functools.lru_cache(maxsize=1024)
def _source(path: Path, changed: int) -> _Source:
    """The file as it is; `changed`, when it was written last, lets an edited one be read again."""
    tree, doors = _parsed(path), {}
    if path.name == "__init__.py":
        for node in [n for n in tree.body if isinstance(n, ast.If) and ast.unparse(n.test) == "TYPE_CHECKING"]:
            for found in [n for n in node.body if isinstance(n, ast.ImportFrom)]:
                doors |= {alias.name: f"{found.module}.{alias.name}" for alias in found.names}
            tree.body.remove(node)
    return _digested(tree)._replace(doors=doors)


def _parsed(path: Path) -> ast.Module:
    return ast.parse(path.read_text(encoding="utf-8"))


def _digested(tree: ast.Module) -> _Source:
    imports = tuple(dict.fromkeys(_imported(tree)))
    return _Source(hashlib.sha256(_bare(tree).encode()).hexdigest(), imports, {})


def _used_by(function: str, tree: ast.Module) -> ast.Module:
    """The statements at the top of a module that bind what a function uses, near and far, in their order."""
    binding: dict[str, list[ast.stmt]] = {}
    for statement in tree.body:
        for name in _bound_by(statement):
            binding.setdefault(name, []).append(statement)
    ahead, seen, kept = [function], set(), []
    while ahead:
        name = ahead.pop()
        for statement in [] if name in seen else binding.get(name, []):
            kept.append(statement)
            ahead += [node.id for node in ast.walk(statement) if isinstance(node, ast.Name)]
        seen.add(name)
    return ast.Module([statement for statement in tree.body if statement in kept], [])


def _bound_by(statement: ast.stmt) -> Iterator[str]:
    if isinstance(statement, (ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef)):
        yield statement.name
        return
    for node in ast.walk(statement):
        if isinstance(node, ast.alias):
            yield (node.asname or node.name).partition(".")[0]
        elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            yield node.id


def _imported(tree: ast.Module) -> Iterator[str]:
    """Dotted names that are imported anywhere in a file, and those taken from imported packages as `package.name`."""
    bound: dict[str, str] = {}
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            for alias in node.names:
                yield alias.name
                bound[alias.asname or alias.name] = alias.name
        elif isinstance(node, ast.ImportFrom) and not node.level:
            for alias in node.names:
                yield f"{node.module}.{alias.name}"
                bound[alias.asname or alias.name] = f"{node.module}.{alias.name}"
    for node in ast.walk(tree):
        if isinstance(node, ast.Attribute) and (owner := ast.unparse(node.value)) in bound:
            yield f"{bound[owner]}.{node.attr}"


def _bare(tree: ast.Module) -> str:
    """The code without comments and docstrings, in one layout."""
    for node in ast.walk(tree):
        if isinstance(node, (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)):
            if ast.get_docstring(node, clean=False) is not None:
                node.body = node.body[1:] or [ast.Pass()]
    return ast.unparse(tree)


def models_named(text: str) -> list[str]:
    """The models, of the half-space and of objects, whose names stand in a text."""
    words = set(re.findall(r"\w+", text))
    return [name for name in model_names() if name in words]


def _module_of_model(name: str) -> str:
    return (object_transport(name) or model_class(name)).__module__
