"""The commands `train object` and `errors object`: networks of an object, and errors of models of it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from full_geometry.cli.variants import SceneOptions, use_mitsuba
from halfspace_sss.cli import shared
from halfspace_sss.cli.errors import write_errors
from halfspace_sss.cli.train import ResultOptions, need_torch
from halfspace_sss.provenance import check_folder

if TYPE_CHECKING:
    from rich.table import Table

    from full_geometry.learning.learners import LearntObject, ObjectError


def train_object(
    scene: Annotated[Path, typer.Option(help="Mitsuba XML or glTF file with the object.")],
    on: SceneOptions,
    results: ResultOptions,
    places: shared.Places,
    object: Annotated[  # noqa: A002
        list[str] | None,
        typer.Option(help="Id of the object in the scene; repeat for more.", show_default="the only translucent one"),
    ] = None,
    seconds: Annotated[float, typer.Option(help="Seconds for data and fit, without compilation.")] = 60.0,
    model: Annotated[
        str | None, typer.Option(help="Name of a model that learns objects.", show_default="full_geometry")
    ] = None,
) -> None:
    """Train networks of objects of a scene for `render`, and print their errors."""
    need_torch()
    parameters = on.parameters()
    use_mitsuba(on.variant)
    from full_geometry.learning.learners import learner
    from full_geometry.objects.objects import object_of
    from full_geometry.scenes.scene_files import load_objects
    from halfspace_sss.executors import completed

    learner(model)
    if object and len(object) > 1:  # all are looked for before one is trained
        loaded = load_objects(scene, parameters)
        for name in object:
            object_of(loaded, None, None, name)
    learnt: dict[str, LearntObject] = {}
    with places.executor() as executor, shared.Bar("training") as bar:
        results = results.elsewhere() if executor else results
        of, parts = (scene.absolute() if executor else scene, parameters, on.variant, model), {}
        how = {"seconds": seconds, "target_error": results.target_error, "seed": results.seed, "folder": results.out}
        for name in dict.fromkeys(object or (None,)):
            work = results.work / name if results.work and len(object or ()) > 1 else results.work
            parts[name or "object"] = (of, {**how, "object": name, "work": work}, None if executor else bar)
        for name, result in completed(executor, _train, parts):
            learnt[name] = result
            if executor:
                bar.show(len(learnt), len(parts), name)
    for name in parts:
        _report(learnt[name])


def _train(
    of: tuple[Path, dict[str, str], str, str | None], how: dict[str, Any], bar: shared.Bar | None
) -> LearntObject:
    """The network of an object of a scene file, by its parameters, variant and learner; on a worker without a bar."""
    scene, parameters, variant, model = of
    use_mitsuba(variant)
    from full_geometry.learning.learners import learner
    from full_geometry.scenes.scene_files import load_objects

    return learner(model).train(load_objects(scene, parameters), **how, progress=bar.told if bar else None)


def _report(learnt: LearntObject) -> None:
    if learnt.path is None:
        shared.say(f"{learnt.object}: no weights are written")
        return
    shared.say(object_table(learnt.errors), DEFINITION, f"{learnt.steps} steps in {learnt.seconds:.0f} s; written:")
    shared.say_files([learnt.path])


# --------------------------------------------------------------------------------------------------
# The command `halfspace-sss errors object`: models of an object of a scene against walks.


DEFINITION = (
    "error: relative RMSE of the radiance of random exits under constant light, of four lobes cos^16, or as images "
    "of an even sky show it, against walks; noise of both taken out; orders of each model"
)


def errors_object(
    on: SceneOptions,
    scene: Annotated[Path, typer.Option(help="Mitsuba XML or glTF file with the object.")],
    object: shared.ObjectId = None,  # noqa: A002
    model: shared.Models = None,
    exits: Annotated[int, typer.Option(help="Random exits.", parser=shared.whole)] = 256,
    seed: shared.Seed = 0,
    out: shared.OutFolder = Path("errors"),
) -> None:
    """Compare models of an object of a scene with walks: radiance of random exits; written as CSV and JSON."""
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
    headings = ("object", "channel", "model", "light", "error", "standard error", "mean / traced mean")
    cells = [(*r[:4], f"{100 * r.error:.3g}", f"{100 * r.standard_error:.2g}", f"{r.ratio:.3f}") for r in rows]
    return shared.table(headings, cells, title="errors, %", left=4)
