"""The commands of `halfspace-sss`: a command is a function with typer annotations and a line in `_commands`.

Packages of others add theirs by an entry point of the group `halfspace_sss.commands`. How commands end is in
`halfspace_sss.cli.shared`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from importlib.util import find_spec
from typing import Annotated

import typer

import halfspace_sss
from figures.parts.command import COMMANDS as FIGURES
from full_geometry.cli.fit import fit
from full_geometry.cli.render import render, view
from full_geometry.cli.trade import trade
from full_geometry.cli.train import errors_object, train_object
from full_geometry.cli.variants import Drawers
from halfspace_sss.cli.curves import curves, materials_import, materials_list, materials_show, models
from halfspace_sss.cli.errors import errors_materials
from halfspace_sss.cli.shared import Commands, add, group
from halfspace_sss.cli.train import maps, train_material
from halfspace_sss.extensions import COMMANDS, FAILURES, commands, warn_left_out
from halfspace_sss.lazy import LazyModule

page, trade_plot = LazyModule("figures.drawing.page"), LazyModule("figures.drawing.trade_plot")

GROUPS: Mapping[str, tuple[str, Mapping[str, Callable]]] = {
    "materials": (
        "Show registered materials, or import them from files of other programs.",
        {"list": materials_list, "show": materials_show, "import": materials_import},
    ),
    "train": (
        "Train networks on path tracing; models find their weights by medium and object.",
        {"material": train_material, "object": train_object},
    ),
    "errors": (
        "Measure errors of models against path tracing.",
        {"materials": errors_materials, "object": errors_object},
    ),
    "figures": ("Compute changed parts of the paper's figures, and draw them.", FIGURES),
}
SINGLE = {
    "curves": curves, "fit": fit, "maps": maps, "models": models,
    "render": render, "trade": trade, "view": view,
}  # fmt: skip


def _show_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"halfspace-sss {halfspace_sss.__version__}")
        raise typer.Exit()


def start(
    context: typer.Context,
    version: Annotated[
        bool, typer.Option("--version", callback=_show_version, is_eager=True, help="Show the version.")
    ] = False,
) -> None:
    """Half-space subsurface scattering: compare path tracing and models of the BSSRDF."""
    context.obj = drawers()


def drawers() -> Drawers | None:
    """What draws results of commands; None where the libraries for it are not installed."""
    if any(find_spec(name) is None for name in ("PIL", "matplotlib")):
        return None
    return Drawers(
        lambda picture: page.render(picture),
        lambda found: {"html": page.fit(found)},
        lambda picture: trade_plot.render(picture),
    )


def make() -> typer.Typer:
    """All commands, those of other packages too."""
    app = group("Compare, train, render and fit models of subsurface scattering.", cls=Commands, completion=True)
    app.callback()(start)
    for name, function in SINGLE.items():
        add(app, name, function)
    for name, (about, members) in GROUPS.items():
        inner = group(about)
        for word, function in members.items():
            add(inner, word, function)
        app.add_typer(inner, name=name)
    for name, function in commands():
        try:
            _check_command(name, function)
        except FAILURES as error:
            warn_left_out(COMMANDS, name, error)
        else:
            add(app, name, function)
    return app


def _check_command(name: str, function: Callable) -> None:
    """Raises, in whichever way typer does, if the function cannot be a command beside the others."""
    if name in SINGLE or name in GROUPS:
        raise ValueError(f"name must be new, got {name!r}")
    alone = typer.Typer()
    add(alone, name, function)
    typer.main.get_command(alone)


app = make()
