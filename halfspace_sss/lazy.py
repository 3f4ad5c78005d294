"""What is imported or computed when it is first asked for, once, whoever asks and from however many threads."""

from __future__ import annotations

import functools
import importlib
import sys
import threading
from collections.abc import Callable, Iterable, Mapping
from typing import Any, ParamSpec, TypeVar

P, R = ParamSpec("P"), TypeVar("R")


def lazy_names(
    package: str, modules: Mapping[str, Iterable[str]]
) -> tuple[Callable[[str], object], Callable[[], list[str]]]:
    """`__getattr__` and `__dir__` of a package.
    `package`: its `__name__`. `modules`: public names by module within the package; "" for names that are themselves
    modules of the package."""
    homes = {name: home for home, names in modules.items() for name in names}

    def get(name: str) -> object:
        if name not in homes:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        module = importlib.import_module(f"{package}.{homes[name] or name}")
        return getattr(module, name) if homes[name] else module

    def names() -> list[str]:
        defined = vars(sys.modules[package])
        return sorted({*(name for name in defined if name.startswith("__")), *defined.get("__all__", ()), *homes})

    return get, names


class LazyModule:
    """A module that is imported when an attribute of it is first asked for: Dr.Jit, after `backend` has chosen an LLVM,
    which it loads as it is imported."""

    def __init__(self, name: str) -> None:
        self._name = name

    def __getattr__(self, attribute: str) -> Any:
        return getattr(importlib.import_module(self._name), attribute)


def once(f: Callable[P, R]) -> Callable[P, R]:
    """`functools.cache` under a lock: threads that ask while f runs wait for its result and do not run it again.
    Mitsuba makes the objects of a scene in parallel, and each asks for materials and models."""
    cached, lock = functools.cache(f), threading.RLock()

    @functools.wraps(f)
    def answer(*args: P.args, **named: P.kwargs) -> R:
        with lock:
            return cached(*args, **named)

    return answer
