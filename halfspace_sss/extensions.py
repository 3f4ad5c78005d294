"""What packages of others add to the library and to the command line, found by entry points.

- `halfspace_sss.models`: list of model classes.
- `halfspace_sss.materials`: path of a material file or folder, or an iterable of `Material`.
- `halfspace_sss.commands`: name -> function with typer annotations, a further command of `halfspace-sss`.
- `halfspace_sss.transports`, `halfspace_sss.learners`: name of a model of objects -> what binds it to an object, what
  trains it; see `full_geometry.transport.models` and `full_geometry.learning.learners`.

What a package offers may fail in any way: it is left out with a warning in one line that names it, and nothing else is.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator
from importlib.metadata import EntryPoint, entry_points

COMMANDS, MODELS = "halfspace_sss.commands", "halfspace_sss.models"
LEARNERS, TRANSPORTS = "halfspace_sss.learners", "halfspace_sss.transports"
FAILURES = (Exception, SystemExit)  # what code of somebody else may end with


def warn_left_out(group: str, name: str, error: object) -> None:
    """Warn in one line, without the source line that `warnings.warn` would show, that something is left out."""
    why = f"{type(error).__name__}: {error}" if isinstance(error, BaseException) else error
    message = " ".join(f"entry point {name!r} is left out: {why}".split())
    warnings.warn_explicit(message, UserWarning, group, 0)


def offers(group: str) -> dict[str, EntryPoint]:
    """The entry points of packages of others in a group, the first of each name; none is loaded."""
    results: dict[str, EntryPoint] = {}
    for entry in entry_points(group=group):
        results.setdefault(entry.name, entry)
    return results


def loaded(entry: EntryPoint) -> object:
    """What an entry point names; None if it does not load, with a warning."""
    try:
        return entry.load()
    except FAILURES as error:
        warn_left_out(entry.group, entry.name, error)
        return None


def offered(group: str) -> Iterator[tuple[str, object]]:
    """Name and object of every entry point of a group that loads."""
    for entry in entry_points(group=group):
        if (result := loaded(entry)) is not None:
            yield entry.name, result


def commands() -> Iterator[tuple[str, Callable[..., object]]]:
    """Name and function of every command that a package adds."""
    for name, each in offered(COMMANDS):
        if callable(each):
            yield name, each
        else:
            warn_left_out(COMMANDS, name, f"it must be a function, got {each!r}")
