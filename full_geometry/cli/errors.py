"""The command `halfspace-sss errors object`: models of an object of a scene against walks."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from full_geometry.cli.variants import SceneOptions, use_mitsuba
from halfspace_sss.cli import shared
from halfspace_sss.cli.errors import write_errors

if TYPE_CHECKING:
    from rich.table import Table

    from full_geometry.learning.records import ObjectError

DEFINITION = (
    "error: relative RMSE of the radiance of random exits under constant light, of four lobes cos^16, or as images "
    "of an even sky show it, against walks; noise of both taken out; orders of each model"
)


def errors_object(
    on: SceneOptions,
    scene: Annotated[Path, typer.Option(help="Mitsuba XML file with the object.")],
    object: shared.ObjectId = None,  # noqa: A002
    model: shared.Models = None,
    exits: Annotated[int, typer.Option(help="Random exits.", parser=shared.whole)] = 256,
    seed: shared.Seed = 0,
    out: shared.OutFolder = Path("errors"),
) -> None:
    """Compare models of an object of a scene with walks: radiance of random exits; written as CSV and JSON."""
    from halfspace_sss.provenance import check_folder

    parameters = on.parameters()
    check_folder(out)
    use_mitsuba(on.variant)
    import pandas

    from full_geometry.learning.learners import object_errors
    from full_geometry.scenes.scene_files import load_objects

    how = {"object": object, "seed": seed, "exits": exits}
    with shared.Bar("errors") as bar:
        rows = object_errors(load_objects(scene, parameters), model or [], **how, progress=bar.told)
    found = pandas.DataFrame(rows)
    files = write_errors(out, found, found, DEFINITION, {"scene": str(scene), **how})
    shared.say(object_table(rows), DEFINITION)
    shared.say_files(files)


def object_table(rows: Sequence[ObjectError]) -> Table:
    """Errors of models of an object."""
    headings = ("object", "channel", "model", "light", "error", "standard error", "mean / traced mean")
    cells = [
        (
            r.object,
            r.channel,
            r.model,
            r.light,
            f"{100 * r.error:.3g}",
            f"{100 * r.standard_error:.2g}",
            f"{r.ratio:.3f}",
        )
        for r in rows
    ]
    return shared.table(headings, cells, title="errors, %", left=4)
