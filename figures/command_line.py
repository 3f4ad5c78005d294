"""The command `halfspace-sss`: what it can do.

A command is a function with typer annotations in the folder `cli` of a package; it joins by one line in `_OWN`.
Packages of others add theirs by an entry point of the group `halfspace_sss.commands`.
How commands end is in `cli.shared`.
"""

from __future__ import annotations

import functools
import importlib
import os
import sys
from typing import TYPE_CHECKING, Any

from halfspace_sss.cli.interrupts import interrupts

if TYPE_CHECKING:
    import typer

    app: typer.Typer

_OWN = {
    "bench": "halfspace_sss.cli.bench:bench_command",
    "curves": "halfspace_sss.cli.curves:curves_command",
    "errors": "full_geometry.cli.errors:errors_command",
    "figures": "figures.parts.command:figures_command",
    "fit": "full_geometry.cli.fit:fit_command",
    "maps": "halfspace_sss.cli.maps:maps_command",
    "materials": "halfspace_sss.cli.lists:materials_command",
    "models": "halfspace_sss.cli.lists:models_command",
    "render": "full_geometry.cli.render:render_command",
    "trade": "full_geometry.cli.trade:trade_command",
    "validate": "halfspace_sss.cli.validate:validate_command",
}
_LISTS = ("materials", "models")  # which are asked for what they print


def __getattr__(name: str) -> Any:
    if name != "app":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return _app()


@functools.cache
def _app() -> Any:
    """The commands; made when they are needed, so that an interrupt is heard from the first moment on."""
    import typer

    from full_geometry.cli.train import trainings
    from halfspace_sss.cli.shared import Commands, with_quiet

    app = typer.Typer(
        cls=Commands, no_args_is_help=True, add_completion=False, pretty_exceptions_enable=False,
        context_settings={"help_option_names": ["-h", "--help"]},
        help="Half-space subsurface scattering: compare path tracing and models of the BSSRDF.",
    )  # fmt: skip
    app.callback()(_options(typer))
    for name, place in _OWN.items():
        module, _, function = place.partition(":")
        result = getattr(importlib.import_module(module), function)
        app.command(name)(result if name in _LISTS else with_quiet(result))
    _add_commands(app)
    app.add_typer(trainings(), name="train")
    return app


def _options(typer: Any) -> Any:
    def show_version(wanted: bool) -> None:
        if wanted:
            import halfspace_sss

            typer.echo(f"halfspace-sss {halfspace_sss.__version__}")
            raise typer.Exit()

    def options(version: bool = typer.Option(False, "--version", callback=show_version, is_eager=True)) -> None:
        pass

    options.__annotations__ = {"version": bool, "return": None}
    return options


def _add_commands(app: Any) -> None:
    """The commands of other packages."""
    from halfspace_sss.cli.shared import with_quiet
    from halfspace_sss.extensions import COMMANDS, FAILURES, commands, warn_left_out

    for name, function in commands():
        try:
            _check_command(name, function)
        except FAILURES as error:
            warn_left_out(COMMANDS, name, error)
        else:
            app.command(name)(with_quiet(function))


def _check_command(name: str, function: Any) -> None:
    """Raises, in whichever way typer does, if the function cannot be a command beside the others."""
    import typer

    if name in (*_OWN, "train"):
        raise ValueError(f"name must be new, got {name!r}")
    alone = typer.Typer()
    alone.command(name)(function)
    typer.main.get_command(alone)


def main() -> None:
    """Run the command line; the entry point of `halfspace-sss`."""
    for stream in (sys.stdout, sys.stderr):  # a terminal without ± shows ? there, and nothing is lost
        if hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="replace")
    with interrupts:
        try:
            _app()()
        except BaseException as end:
            if interrupts.received is None:
                raise
            _leave(end)


def _leave(end: BaseException) -> None:
    """End at once: Mitsuba's and Dr.Jit's own ends are not made for the middle of work."""
    if not interrupts.told:
        from halfspace_sss.cli.shared import tell_interrupt

        tell_interrupt(end)
    for stream in (sys.stdout, sys.stderr):
        stream.flush()
    os._exit(interrupts.exit_code)


if __name__ == "__main__":
    main()
