"""A part of a figure: what it depends on, what its function gets and gives.

It depends on the code that its function comes to: the files of this project that are imported, those whose address
stands as a text in them, and models, transports and learners, which are found by name. What is rendered may find any of
these by name: in a scene, as a default, as a start of a training, one after another. It comes to all of them, unless it
is declared `unmodelled`. Code that renders nothing comes to those named in its parameters or in a text of its files.
"""

from __future__ import annotations

import ast
import functools
import hashlib
import json
import os
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from figures import figure_modules
from full_geometry.capabilities import AUTO
from full_geometry.learning.learners import LEARNERS
from full_geometry.plugins import TRADE
from full_geometry.transport.models import lookup, model_names
from halfspace_sss.checks import check_choice, check_interval
from halfspace_sss.interface.model import no_models
from halfspace_sss.progress import Progress

PACKAGES = ("benchmarks", "figures", "full_geometry", "analytic_models", "halfspace_sss")
MACHINERY = "figures.parts"  # keeps and orders what parts compute, and computes nothing of it
RENDERS = "full_geometry.transport.models"  # is imported by all that finds models of objects
NAMES = "halfspace_sss.extensions"  # knows the names of packages, and asks for none of what they offer
ADDRESS = re.compile(r"[a-z_]\w*(?:\.\w+)+(?::\w+)?")  # "package.module" or "package.module:function"


class _Source(NamedTuple):
    """Code: its hash, what it imports by dotted name, its texts, and the lazy names of a package."""

    digest: str
    imports: tuple[str, ...]
    texts: frozenset[str]
    doors: dict[str, str]


def code_hash(module: str, function: str, params: str = "", unmodelled: bool = False) -> str:
    """SHA-256 of the code of a function and of all that it comes to in this project.

    Of its own file only those definitions count that it uses, so that what draws a figure may change. Comments,
    docstrings and layout do not count. A name that a package imports when it is asked for counts with its module.

    Args:
        module, function: dotted name of a module, and name of a function at its top.
        params: text in which models may be named.
        unmodelled: the function finds nothing by name.
    """
    path = _path(module)
    if path is None:  # of nobody's file, as in a notebook: only its name is known
        return hashlib.sha256(f"{module} {function}".encode()).hexdigest()
    lines = [f"{name} {_found(name).digest}" for name in modules_reached(module, function, params, unmodelled)]
    return hashlib.sha256("\n".join([_found(f"{module}:{function}").digest, *lines]).encode()).hexdigest()


def modules_reached(module: str, function: str, params: str = "", unmodelled: bool = False) -> list[str]:
    """What a function comes to, as `modules_of`; arguments as for `code_hash`."""
    own = _found(f"{module}:{function}")
    result = modules_of(_resolved(own))
    if unmodelled:
        return result
    sources = [own, *(_found(name) for name in result if name != NAMES and _path(name).stem != "__init__")]
    texts = {text for source in sources for text in source.texts}
    named = {name: homes for name, homes in found_by_name().items() if RENDERS in result or name in texts}
    named |= {name: homes for name, homes in found_by_name().items() if name in re.findall(r"\w+", params)}
    addressed = {text.partition(":")[0] for text in texts if ADDRESS.fullmatch(text)}
    return modules_of([*result, *(home for homes in named.values() for home in homes), *addressed])


@functools.cache
def found_by_name() -> dict[str, tuple[str, ...]]:
    """Modules of models, of the half-space and of objects, and of what learns them, by name."""
    known = {name: (lookup(name).module,) for name in model_names()} | {AUTO: (TRADE,)}
    return known | {name: (*known.get(name, ()), place) for name, place in LEARNERS.items()}


def modules_of(roots: Iterable[str]) -> list[str]:
    """Modules of this project that modules import, themselves included, sorted.

    Of a figure only that counts which is imported from it, as "module:name", for it draws too.
    """
    return list(_modules_of(frozenset(roots)))


@functools.lru_cache(maxsize=1024)
def _modules_of(roots: frozenset[str]) -> tuple[str, ...]:
    results: set[str] = set()
    ahead = list(roots)
    while ahead:
        name = ahead.pop()
        if name not in results and _path(name):
            results.add(name)
            ahead += _next(name)
    return tuple(sorted(results))


@functools.cache
def _next(name: str) -> tuple[str, ...]:
    """Modules that a module imports."""
    return tuple(dict.fromkeys(_resolved(_found(name))))


@functools.cache
def _found(name: str) -> _Source:
    """The code of a module, or of "module:name" what that definition uses of it, as it was looked at last."""
    path = _path(name)
    return _source(path, path.stat().st_mtime_ns, name.partition(":")[2])


def _look_again() -> None:
    """Files may have been edited since: what follows from them is forgotten; those that were not stay read."""
    for known in (_modules_of, _next, _found):
        known.cache_clear()


@functools.cache
def _path(name: str) -> Path | None:
    """The file of a module of this project; None for any other name, and for the machinery of parts itself."""
    name = name.partition(":")[0]
    if name.partition(".")[0] not in PACKAGES or name.startswith(MACHINERY):
        return None
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
            yield f"{package}:{last}" if package in _figures() else package
            door = _found(package).doors.get(last)
            if door:
                yield door if _path(door) else door.rpartition(".")[0]


@functools.cache
def _figures() -> frozenset[str]:
    return frozenset(figure_modules().values())


@functools.lru_cache(maxsize=1024)
def _source(path: Path, changed: int, definition: str) -> _Source:
    """The file as it is; `changed`, when it was written last, lets an edited one be read again."""
    tree, doors = ast.parse(path.read_text(encoding="utf-8")), {}
    if definition:
        return _digested(_used_by(definition, tree))
    if path.name == "__init__.py":
        for node in [n for n in tree.body if isinstance(n, ast.If) and ast.unparse(n.test) == "TYPE_CHECKING"]:
            for each in [n for n in node.body if isinstance(n, ast.ImportFrom)]:
                doors |= {alias.name: f"{each.module}.{alias.name}" for alias in each.names}
            tree.body.remove(node)
    return _digested(tree)._replace(doors=doors)


def _digested(tree: ast.Module) -> _Source:
    digest = hashlib.sha256(_bare(tree).encode()).hexdigest()
    nodes = list(ast.walk(tree))
    texts = [node.value for node in nodes if isinstance(node, ast.Constant) and isinstance(node.value, str)]
    return _Source(digest, tuple(dict.fromkeys(_imported(nodes))), frozenset(texts), {})


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


def _imported(nodes: list[ast.AST]) -> Iterator[str]:
    """Dotted names that are imported anywhere in a file, and those taken from imported packages as `package.name`."""
    bound: dict[str, str] = {}
    for node in nodes:
        if isinstance(node, ast.Import):
            for alias in node.names:
                yield alias.name
                bound[alias.asname or alias.name] = alias.name
        elif isinstance(node, ast.ImportFrom) and not node.level:
            for alias in node.names:
                yield f"{node.module}.{alias.name}"
                bound[alias.asname or alias.name] = f"{node.module}.{alias.name}"
    for node in nodes:
        if isinstance(node, ast.Attribute) and (owner := _dotted(node.value)) in bound:
            yield f"{bound[owner]}.{node.attr}"


def _dotted(node: ast.expr) -> str:
    """The text of a name such as `package.module`; empty for any other expression."""
    last = []
    while isinstance(node, ast.Attribute):
        last.append(node.attr)
        node = node.value
    return ".".join([node.id, *reversed(last)]) if isinstance(node, ast.Name) else ""


def _bare(tree: ast.Module) -> str:
    """The code without comments and docstrings, in one layout."""
    for node in ast.walk(tree):
        if isinstance(node, (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)):
            if ast.get_docstring(node, clean=False) is not None:
                node.body = node.body[1:] or [ast.Pass()]
    return ast.unparse(tree)


QUALITIES = ("draft", "paper")


@dataclass(frozen=True)
class Result:
    """What a part gave.

    Attributes:
        images: by name, float32 arrays (H, W) or (H, W, 3).
        numbers: by name, everything else, as JSON holds it.
        seconds: that it took. work: as the part estimated it.
    """

    images: Mapping[str, np.ndarray]
    numbers: Mapping[str, Any]
    seconds: float
    work: float


def _no_progress(done: int, total: int) -> None:
    pass


@dataclass(frozen=True)
class Task:
    """What the function of a part is called with.

    Attributes:
        params: those of the part.
        folder: where it may keep what it has done so far; an interrupted run finds it again, a finished one does not.
        needed: results of the parts that it needs, by name.
        inputs: the files that it depends on.
        progress: called with (steps done, steps in all).
    """

    params: Mapping[str, Any]
    folder: Path
    needed: Mapping[str, Result] = field(default_factory=dict)
    inputs: tuple[Path, ...] = ()
    progress: Progress = _no_progress


Function = Callable[[Task], Mapping[str, Any]]


@dataclass(frozen=True)
class Part:
    """One piece of the work of a figure, kept under the hash of what it depends on.

    Args:
        name: unlike the others of the figure, e.g. "marble, neural".
        function: at the top of a module; called with a Task, returns {name: array or JSON value}.
        params: all that the result depends on, ready for JSON.
        work: estimated, in a unit of the function's own, e.g. samples; seconds go with it.
        needs: names of parts earlier in the list whose results it gets.
        inputs: files whose content it depends on.
        like: which of the parts of a function take the same time for the same work; by default all do.

    Raises:
        ValueError: the name is empty, params are not ready for JSON, or work is not above 0.
    """

    name: str
    function: Function
    params: Mapping[str, Any]
    work: float
    needs: tuple[str, ...] = ()
    inputs: tuple[str | os.PathLike, ...] = ()
    like: str = ""

    def __post_init__(self) -> None:
        if not self.slug:
            raise ValueError(f"name of a part must hold a letter or digit, got {self.name!r}")
        canonical(self.params, f"params of part {self.name!r}")
        check_interval(f"work of part {self.name!r}", self.work, 1e-9, 1e18)

    @property
    def slug(self) -> str:
        """The name as folders are called."""
        return re.sub(r"[^a-z0-9.]+", "-", self.name.lower()).strip("-.")

    @property
    def kind(self) -> str:
        """Name of the function and what the part is like: parts of a kind take the same time for the same work."""
        name = f"{self.function.__module__}.{self.function.__qualname__}"
        return f"{name}, {self.like}" if self.like else name


_UNMODELLED: set[Function] = set()


def unmodelled(function: Function) -> Function:
    """Declare that a function of parts finds no model by name, as path tracing does not; one that does is stopped.

    Its result then does not depend on the code of models.

    Raises:
        RuntimeError: from the function, when it asks for a model.
    """

    @functools.wraps(function)
    def closed(task: Task) -> Mapping[str, Any]:
        with no_models(f"{function.__module__}.{function.__qualname__}"):
            return function(task)

    _UNMODELLED.add(closed)
    return closed


def canonical(value: Any, what: str) -> str:
    """The one JSON text of a value; ValueError names `what` if it has none, as NaN has none."""
    try:
        return json.dumps(value, sort_keys=True, allow_nan=False, separators=(",", ":"))
    except (TypeError, ValueError) as error:
        raise ValueError(f"{what} must be finite and ready for JSON: {error}") from error


def check_quality(quality: str) -> None:
    """ValueError unless the quality is "draft" or "paper"."""
    check_choice("quality", quality, QUALITIES)


def keys_of(parts: Sequence[Part]) -> dict[str, str]:
    """The hash of what each part depends on, by name.

    Raises:
        ValueError: two names give the same folder, a part needs one that does not stand before it, or an input cannot
            be read.
    """
    _look_again()
    keys: dict[str, str] = {}
    slugs: dict[str, str] = {}
    for part in parts:
        if part.slug in slugs:
            raise ValueError(
                f"names of parts must differ in letters or digits, got {slugs[part.slug]!r}, {part.name!r}"
            )
        slugs[part.slug] = part.name
        for name in part.needs:
            if name not in keys:
                raise ValueError(f"part {part.name!r} must need parts that stand before it, got {name!r}")
        params = canonical(part.params, f"params of part {part.name!r}")
        about = {"function": part.function.__qualname__, "params": part.params}
        unmodelled = part.function in _UNMODELLED
        about |= {"code": code_hash(part.function.__module__, part.function.__qualname__, params, unmodelled)}
        about |= {"inputs": [_file_hash(part, path) for path in part.inputs]}
        about |= {"needs": {name: keys[name] for name in part.needs}}
        keys[part.name] = hashlib.sha256(canonical(about, part.name).encode()).hexdigest()
    return keys


def _file_hash(part: Part, path: str | os.PathLike) -> str:
    try:
        return hashlib.sha256(Path(path).read_bytes()).hexdigest()
    except OSError as error:
        raise ValueError(f"inputs of part {part.name!r} must be files, got {os.fspath(path)!r}: {error}") from error
