"""The command `python -m benchmarks`: one command for each study, which ends as those of `halfspace-sss` do."""

from __future__ import annotations

import typer

import figures
from benchmarks.ablation_command import ablation_command
from benchmarks.inversion_command import inversion_command
from benchmarks.rivals_command import rivals_command
from benchmarks.shapes_command import shapes_command
from benchmarks.speeds_command import gathered_command, speeds_command
from benchmarks.total_error_command import total_error_command
from benchmarks.trade_check_command import check_command
from figures.parts.command import figures_command
from halfspace_sss.cli.shared import Commands, with_quiet

figures.ADDED |= {"equal_error": "benchmarks.equal_error", "trade": "benchmarks.trade_figure"}
COMMANDS = {
    "ablation": ablation_command,
    "figures": figures_command,
    "gathered": gathered_command,
    "inversion": inversion_command,
    "rivals": rivals_command,
    "shapes": shapes_command,
    "speeds": speeds_command,
    "total-error": total_error_command,
    "trade-check": check_command,
}

app = typer.Typer(
    cls=Commands, no_args_is_help=True, add_completion=False, pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
    help="Compare choices and rivals of the models: tables for the docs.",
)  # fmt: skip
for name, function in COMMANDS.items():
    app.command(name)(with_quiet(function))

if __name__ == "__main__":
    app(prog_name="python -m benchmarks")
