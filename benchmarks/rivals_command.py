"""The command `rivals`: tables of samplers and of models of one object, at equal CPU time."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from benchmarks.tables import markdown
from full_geometry.cli.variants import Variant, use_mitsuba
from halfspace_sss.checks import check_choice, check_count, check_interval
from halfspace_sss.cli.shared import Bar, Define, ObjectId, OutFolder, console, defined, whole
from halfspace_sss.provenance import check_folder, write_together

if TYPE_CHECKING:
    import mitsuba as mi
    import pandas


TABLES = ("errors", "samplers")


def rivals_command(
    scene: Annotated[Path, typer.Option(help="Mitsuba XML file with the object.")],
    object: ObjectId = None,
    table: Annotated[
        list[str] | None, typer.Option(help="errors or samplers; repeat for both.", show_default="all")
    ] = None,
    seconds: Annotated[float, typer.Option(help="CPU time of each training with its data.")] = 60.0,
    samples: Annotated[int, typer.Option(help="Samples of each exit, for errors and variances.", parser=whole)] = 2048,
    seed: Annotated[int, typer.Option(help="Seed of random numbers.", parser=whole)] = 0,
    define: Define = None,
    variant: Variant = "llvm_ad_rgb",
    out: OutFolder = Path("rivals"),
) -> None:
    """Compare ways of drawing entries by variance x time, and models by errors, at equal CPU time."""
    chosen = table or list(TABLES)
    for name in chosen:
        check_choice("table", name, TABLES)
    check_interval("seconds", seconds, 0.1, 1e6)
    for key, value, least in (("samples", samples, 2), ("seed", seed, 0)):
        check_count(key, value, least)
    parameters = defined(define)
    check_folder(out)
    use_mitsuba(variant)
    from full_geometry.scenes.scene_files import load_objects

    loaded, files = load_objects(scene, parameters), {}
    for name in chosen:
        with Bar(name) as bar:
            frame = _made(name, loaded, object, seconds, samples, seed, bar)
        files[out / f"{name}.csv"] = frame.to_csv(index=False, lineterminator="\n")
        files[out / f"{name}.md"] = markdown(_errors_wide(frame) if name == "errors" else frame)
    write_together(files)
    for path, text in files.items():
        if path.suffix == ".md":
            console().print(text, highlight=False, markup=False, soft_wrap=True)
        console().print(f"  {path}", highlight=False, markup=False, soft_wrap=True)


def _made(
    table: str, scene: mi.Scene, name: str | None, seconds: float, samples: int, seed: int, bar: Bar
) -> pandas.DataFrame:
    from tempfile import TemporaryDirectory

    from benchmarks import rivals
    from benchmarks.flow_training import FlowRecipe
    from benchmarks.rivals import sampler_table
    from full_geometry.learning.training import train_unattended
    from full_geometry.objects.objects import object_of

    def show(what: str, done: int, total: int) -> None:
        bar.show(done, total, what)

    if table == "errors":
        return rivals.error_table(
            scene, name, seconds=seconds, walks=samples, samples=samples, seed=seed, progress=show
        )
    with TemporaryDirectory() as folder:
        learnt = train_unattended(object_of(scene, None, None, name), folder, cpu_seconds=seconds, seed=seed)
    return sampler_table(learnt, FlowRecipe(seconds=0.5 * seconds), samples=samples, seed=seed, progress=show)


def _errors_wide(table: pandas.DataFrame) -> pandas.DataFrame:
    """A row for each model; a column for each channel and light: error ± its own, %."""
    texts = table.assign(
        what=[f"{light}, channel {channel}" for light, channel in zip(table["light"], table["channel"])],
        text=[f"{100 * a:.2g} ± {100 * b:.1g}" for a, b in zip(table["error"], table["standard_error"])],
    )
    wide = texts.pivot(index="model", columns="what", values="text")
    return wide.loc[table["model"].unique(), list(dict.fromkeys(texts["what"]))].reset_index()
