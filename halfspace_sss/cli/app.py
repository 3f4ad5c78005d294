"""The command `halfspace-sss`: what it can do, and the one place where errors become messages and exit codes.

A command is a function with typer annotations in a file `cli_*.py`; it joins by one line in `_OWN`. Packages above
add theirs by an entry point of the group `halfspace_sss.commands`. Exit codes: 0 done, 1 failed, 2 bad input, 130
interrupted.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import typer
from typer.core import TyperGroup

import halfspace_sss
from halfspace_sss.backend import BackendError
from halfspace_sss.cli.ablation import ablation_command
from halfspace_sss.cli.bench import bench_command
from halfspace_sss.cli.curves import curves_command
from halfspace_sss.cli.errors import errors_command
from halfspace_sss.cli.lists import materials_command, models_command
from halfspace_sss.cli.maps import maps_command
from halfspace_sss.cli.render import render_command
from halfspace_sss.cli.train import train_command
from halfspace_sss.cli.validate import validate_command
from halfspace_sss.extensions import COMMANDS, FAILURES, commands, warn_left_out

__all__ = ["app"]

_OWN = {
    "ablation": ablation_command,
    "bench": bench_command,
    "curves": curves_command,
    "errors": errors_command,
    "maps": maps_command,
    "materials": materials_command,
    "models": models_command,
    "render": render_command,
    "train": train_command,
    "validate": validate_command,
}


def _end(message: str, code: int) -> typer.Exit:
    """The exit that ends the command, after one line on stderr."""
    typer.echo(" ".join(message.split()), err=True)
    return typer.Exit(code)


class _Group(TyperGroup):
    """The commands; what the library refuses becomes a line on stderr and an exit code here and nowhere else."""

    def invoke(self, ctx: Any) -> Any:
        try:
            return super().invoke(ctx)
        except KeyboardInterrupt:
            raise _end("interrupted; files that were being written are whole or absent", 130) from None
        except ValueError as error:
            raise _end(f"error: {error}", 2) from error
        except BrokenPipeError:
            raise  # the reader, `head` for instance, has what it wanted: typer ends in silence
        except (BackendError, OSError) as error:
            raise _end(f"error: {error}", 1) from error


app = typer.Typer(
    cls=_Group, no_args_is_help=True, add_completion=False, pretty_exceptions_enable=False,
    help="Half-space subsurface scattering: compare path tracing and models of the BSSRDF.",
)  # fmt: skip


def _show_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"halfspace-sss {halfspace_sss.__version__}")
        raise typer.Exit()


@app.callback()
def _options(version: bool = typer.Option(False, "--version", callback=_show_version, is_eager=True)) -> None:
    pass


def _check_command(name: str, function: Callable) -> None:
    """Raises, in whichever way typer does, if the function cannot be a command beside the others."""
    if name in _OWN:
        raise ValueError(f"name must be new, got {name!r}")
    alone = typer.Typer()
    alone.command(name)(function)
    typer.main.get_command(alone)


def _add_commands() -> None:
    for name, function in _OWN.items():
        app.command(name)(function)
    for name, function in commands():
        try:
            _check_command(name, function)
        except FAILURES as error:
            warn_left_out(COMMANDS, name, error)
        else:
            app.command(name)(function)


_add_commands()
