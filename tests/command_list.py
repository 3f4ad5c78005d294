"""All commands of the command line by their words, those of groups too."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import typer

from figures.app import app


def _members(command: Any, words: tuple[str, ...] = ()) -> Iterator[tuple[str, Any]]:
    for name, member in getattr(command, "commands", {}).items():
        yield from _members(member, (*words, name))
    if not hasattr(command, "commands"):
        yield " ".join(words), command


COMMANDS: dict[str, Any] = dict(_members(typer.main.get_command(app)))
