"""The lists of model classes that installed packages offer, each taken as a whole or left out with a warning."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from contextlib import contextmanager
from typing import Any

from halfspace_sss.extensions import FAILURES, MODELS, offered, warn_left_out

__all__ = ["check_allowed", "check_model_class", "listed_models", "no_models"]

_closed_for: list[str] = []


def check_model_class(cls: Any, base: type) -> None:
    """ValueError if it is no class of a model, or has no usable name or orders."""
    if not (isinstance(cls, type) and issubclass(cls, base)):
        raise ValueError(f"a model must be a subclass of {base.__name__}, got {cls!r}")
    name, orders = getattr(cls, "name", None), getattr(cls, "orders", None)
    if not isinstance(name, str) or not name:
        raise ValueError(f"name of a model must be a text that is not empty, got {name!r}")
    if orders not in ("multiple", "total"):
        raise ValueError(f"orders of a model must be multiple or total, got {orders!r}")


@contextmanager
def no_models(who: str) -> Iterator[None]:
    """Within it, in every thread, asking for a model by its name is an error: `who` is known to need none."""
    _closed_for.append(who)
    try:
        yield
    finally:
        _closed_for.pop()


def check_allowed(name: str) -> None:
    """RuntimeError within `no_models`."""
    if _closed_for:
        raise RuntimeError(f"{_closed_for[-1]} is declared to find no model by name, and asks for {name!r}")


def listed_models(base: type) -> dict[str, type]:
    """The model classes of all lists by name, those of this project first."""
    found: dict[str, type] = {}
    for name, classes in offered(MODELS):
        try:
            found |= _new_models(classes, base, found)
        except FAILURES as error:
            warn_left_out(MODELS, name, error)
    return found


def _new_models(classes: Any, base: type, known: Collection[str]) -> dict[str, type]:
    new: dict[str, type] = {}
    for cls in classes:
        check_model_class(cls, base)
        if cls.name in known or cls.name in new:
            raise ValueError(f"model name must be new, got {cls.name!r}, which is registered already")
        new[cls.name] = cls
    return new
