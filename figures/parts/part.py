"""A part of a figure: what it depends on, what its function gets and gives."""

from __future__ import annotations

import functools
import hashlib
import importlib
import inspect
import json
import os
import re
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from halfspace_sss.checks import check_choice, check_interval
from halfspace_sss.progress import Progress

QUALITIES = ("draft", "paper")
COMPUTING = ("analytic_models", "figures/computing", "full_geometry", "halfspace_sss")
Params = Mapping[str, Any]  # parameters, or numbers, of a part
Row = dict[str, float | str | None]  # of a table
SceneDict = dict[str, Any]  # a scene, or a part of it, as `mitsuba.load_dict` takes it


@dataclass(frozen=True)
class Result:
    """What a part gave.

    Attributes:
        images: by name, float32 arrays (H, W) or (H, W, 3).
        numbers: by name, everything else, as JSON holds it.
        seconds: that it took. work: as the part estimated it.
    """

    images: Mapping[str, np.ndarray]
    numbers: Params
    seconds: float
    work: float


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

    params: Params
    folder: Path
    needed: Mapping[str, Result] = field(default_factory=dict)
    inputs: tuple[Path, ...] = ()
    progress: Progress = lambda done, total: None


Function = Callable[[Task], Params]


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
    params: Params
    work: float
    needs: tuple[str, ...] = ()
    inputs: tuple[str | os.PathLike[str], ...] = ()
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


def canonical(value: object, what: str) -> str:
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
        about = {"function": part.function.__qualname__, "code": code_hash(part.function), "params": part.params}
        about |= {"inputs": [_file_hash(part, path) for path in part.inputs]}
        about |= {"needs": {name: keys[name] for name in part.needs}}
        keys[part.name] = hashlib.sha256(canonical(about, part.name).encode()).hexdigest()
    return keys


@functools.cache
def code_hash(function: Function) -> str:
    """SHA-256 of all code that the result of a part may come from.

    That of `COMPUTING` but for commands, and the module of the function, or its package where that is another one,
    without what is called `draw`.
    """
    module = sys.modules[function.__module__]
    text, draw = inspect.getsource(module), getattr(module, "draw", None)
    digest = hashlib.sha256(text.replace(inspect.getsource(draw) if draw else "", "").encode())
    home = module.__name__.partition(".")[0]
    for package in (*COMPUTING, *([home] if home not in COMPUTING and home != "figures" else ())):
        digest.update(_package_hash(package).encode())
    return digest.hexdigest()


@functools.cache
def _package_hash(name: str) -> str:
    """Of the files of a package, or of a room of it; of nothing for a module that is in none."""
    digest, (package, _, room) = hashlib.sha256(), name.partition("/")
    for folder in (Path(each) / room for each in getattr(importlib.import_module(package), "__path__", ())):
        for path in sorted(folder.rglob("*.py")):
            if "cli" not in path.relative_to(folder).parts:
                digest.update(path.read_bytes())
    return digest.hexdigest()


def _file_hash(part: Part, path: str | os.PathLike[str]) -> str:
    try:
        return hashlib.sha256(Path(path).read_bytes()).hexdigest()
    except OSError as error:
        raise ValueError(f"inputs of part {part.name!r} must be files, got {os.fspath(path)!r}: {error}") from error
