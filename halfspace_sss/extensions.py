"""What packages add to the command line and to the results, found by entry points so that no import goes back.

- `halfspace_sss.commands`: name -> function with typer annotations, a further command of `halfspace-sss`.
- `halfspace_sss.figures`: kind of result -> function that takes the result and returns {file ending: bytes}.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from importlib.metadata import entry_points
from typing import Any

__all__ = ["COMMANDS", "FIGURES", "commands", "renderer"]

COMMANDS, FIGURES = "halfspace_sss.commands", "halfspace_sss.figures"
Renderer = Callable[[Any], dict[str, bytes]]


def commands() -> Iterator[tuple[str, Callable | str]]:
    """Name and function of every command that a package adds; a text instead of the function says why there is none."""
    for entry in entry_points(group=COMMANDS):
        try:
            yield entry.name, entry.load()
        except Exception as error:  # a package of somebody else may fail in any way and must not stop the others
            yield entry.name, f"{entry.value} cannot be loaded: {type(error).__name__}: {error}"


def renderer(kind: str) -> Renderer | None:
    """The function that draws results of a kind, e.g. "curves"; None if it or the drawing library is not installed."""
    for entry in entry_points(group=FIGURES, name=kind):
        try:
            return entry.load()
        except ModuleNotFoundError as error:
            if (error.name or "").split(".")[0] not in ("matplotlib", "figures"):
                raise
    return None
