"""The command `python -m benchmarks`: one command for each study, which ends as those of `halfspace-sss` do."""

from __future__ import annotations

import figures
from benchmarks.ablation_command import ablation_command
from benchmarks.bench_command import bench
from benchmarks.disturbed import disturbed_command
from benchmarks.furnace import furnace_command
from benchmarks.gathered_command import gathered_command
from benchmarks.inversion_command import inversion_command
from benchmarks.media_errors import media_errors_command
from benchmarks.rivals_command import rivals_command
from benchmarks.shapes_command import shapes_command
from benchmarks.total_error_command import time_to_error_command, total_error_command
from benchmarks.trade_check_command import check_command
from benchmarks.training_commands import train_shapes_command, train_universal_command
from benchmarks.truths_commands import errors_truths, validate
from figures.parts.command import COMMANDS as FIGURES
from halfspace_sss.cli.shared import Commands, add, group

figures.ADDED |= {"trade": "benchmarks.trade_figure"}
STUDIES = ("gallery", "gathered", "scenes", "spheres", "textures", "thin")
figures.ADDED |= {name: f"benchmarks.{name}_figure" for name in STUDIES}
figures.ADDED |= {
    name: f"benchmarks.published.{name}" for name in ("fig01", "fig03", "fig07", "fig08", "fig11", "table1")
}
COMMANDS = {
    "ablation": ablation_command,
    "bench": bench,
    "disturbed": disturbed_command,
    "furnace": furnace_command,
    "gathered": gathered_command,
    "inversion": inversion_command,
    "media-errors": media_errors_command,
    "rivals": rivals_command,
    "shapes": shapes_command,
    "time-to-error": time_to_error_command,
    "total-error": total_error_command,
    "trade-check": check_command,
    "train-shapes": train_shapes_command,
    "train-universal": train_universal_command,
    "truths": errors_truths,
    "validate": validate,
}

app = group("Compare choices and rivals of the models, and train the networks of the package.", cls=Commands)
for name, function in COMMANDS.items():
    add(app, name, function)
inner = group("Compute and draw figures, those of the benchmarks too.")
for name, function in FIGURES.items():
    add(inner, name, function)
app.add_typer(inner, name="figures")

if __name__ == "__main__":
    app(prog_name="python -m benchmarks")
