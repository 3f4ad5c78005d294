"""All commands of the command line by their words, those of `train` too."""

from __future__ import annotations

from collections.abc import Callable

from figures import command_line as cli

COMMANDS: dict[str, Callable] = {info.name: info.callback for info in cli.app.registered_commands} | {
    f"{group.name} {info.name}": info.callback
    for group in cli.app.registered_groups
    for info in group.typer_instance.registered_commands
}
