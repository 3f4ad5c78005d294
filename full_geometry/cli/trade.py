"""The command `halfspace-sss trade`: what each way of rendering costs, how wrong it is, and which one to take."""

from __future__ import annotations

import json
from collections.abc import Iterable
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from full_geometry.cli.variants import Variant, use_mitsuba
from halfspace_sss.checks import check_count, check_interval
from halfspace_sss.cli.shared import (
    Bar,
    Define,
    OutFolder,
    SampleSeed,
    SensorNumber,
    check_left_out,
    console,
    defined,
    numbers,
    whole,
)
from halfspace_sss.noise_free import NoiseFree
from halfspace_sss.provenance import check_folder

if TYPE_CHECKING:
    from full_geometry.trade.advice import Advice, Job
    from full_geometry.trade.results import ObjectTrade, WayTrade

SHIPPED = "trade.csv"  # in the package: three materials, two shapes, two lights
TOLERANCE, IMAGES, ASSESS = 0.05, 1, 4.0


def trade_command(
    what: Annotated[
        str | None,
        typer.Argument(help="A Mitsuba XML file, or a material for curves.", show_default="the shipped table"),
    ] = None,
    tolerance: Annotated[float, typer.Option(help="Relative error, bias and noise together.")] = TOLERANCE,
    images: Annotated[int, typer.Option(help="How many are to be rendered.", parser=whole)] = IMAGES,
    seconds: Annotated[float | None, typer.Option(help="That the whole job may take.", show_default="no limit")] = None,
    model: Annotated[
        list[str] | None, typer.Option(help="A model or path_traced; repeat for more.", show_default="all")
    ] = None,
    every: Annotated[bool, typer.Option("--all", help="Every way, also those that cannot win.")] = False,
    assess: Annotated[float, typer.Option(help="Seconds of measuring for each object.")] = ASSESS,
    train_seconds: Annotated[
        float, typer.Option(help="Learn objects without weights first, for so many seconds each; the time counts.")
    ] = 0.0,
    r: Annotated[str | None, typer.Option(help="Of a material: smallest and largest distance, mm, as 0.1,20.")] = None,
    sensor: SensorNumber = 0,
    seed: SampleSeed = 0,
    define: Define = None,
    variant: Variant = "llvm_ad_rgb",
    out: OutFolder = Path("trade"),
) -> None:
    """Measure speed against accuracy: a table, a recommendation, CSV, JSON, and the figure and page of a scene."""
    check_interval("tolerance", tolerance, 1e-4, 10.0)
    check_count("images", images, 1)
    check_count("seed", seed, 0)
    models = model or None
    if what is None:
        given = {"seconds": seconds, "model": models, "r": r, "define": define}
        check_left_out(given, "without a scene or a material")
        _shipped()
    elif Path(what).suffix == ".xml" or Path(what).is_file():
        check_left_out({"r": r}, "with a scene")
        parameters = defined(define)
        check_folder(out)
        use_mitsuba(variant)
        from full_geometry.trade.advice import Job
        from full_geometry.trade.ways import ways

        models = [way.name for way in ways()] if every and models is None else models
        how = {"seconds": assess, "models": models, "sensor": sensor, "seed": seed, "parameters": parameters}
        how |= {"train_seconds": train_seconds}
        _scene(Path(what), Job(tolerance, images, seconds), how, out)
    else:
        check_left_out({"seconds": seconds, "define": define}, "with a material")
        check_folder(out)
        _material(what, {"r": r, "tolerance": tolerance, "models": models, "seed": seed}, out)


def _shipped() -> None:
    """The table of the package."""
    import pandas

    file = resources.files("full_geometry.trade").joinpath("data", SHIPPED)
    with resources.as_file(file) as path:
        table = pandas.read_csv(path)
    screen = console()
    screen.print(_rich(["material", "shape", "light", *_HEADINGS], [_shipped_row(row) for row in table.itertuples()]))
    screen.print("measured by `python -m benchmarks figures all trade`; docs/trade.md says how", highlight=False)


def _shipped_row(row: Any) -> list[str]:
    bias = "exact" if row.way == "path_traced" else NoiseFree(row.bias2, row.bias2_standard_error).told()
    cost = (f"{row.variance:.3g}", f"{row.seconds_per_million:.3g}", f"{row.cost:.3g}")
    return [row.material, row.shape, row.light, row.way, bias, *cost, f"{row.flip:.3f}"]


_HEADINGS = ("way", "bias, %", "variance", "s a million", "cost", "FLIP")


def _material(name: str, how: dict[str, Any], out: Path) -> None:
    from full_geometry.trade.flat import recommend_flat
    from halfspace_sss import materials
    from halfspace_sss.provenance import provenance, write_together

    limits = None if how["r"] is None else tuple(numbers("r", how["r"]))
    result = recommend_flat(materials.load(name).medium, **{**how, "r": limits})
    about = {"provenance": provenance(material=name, **how), **result.record()}
    table = result.table().to_csv(index=False, lineterminator="\n")
    files = {out / f"{name}_trade.csv": table, out / f"{name}_trade.json": json.dumps(about, indent=1) + "\n"}
    write_together(files)
    console().print(str(result), highlight=False, markup=False, soft_wrap=True)
    _tell_files(files)


def _tell_files(files: Iterable[Path]) -> None:
    for path in files:
        console().print(f"  {path}", highlight=False, markup=False, soft_wrap=True)


def _scene(file: Path, job: Job, how: dict[str, Any], out: Path) -> None:
    from full_geometry.trade.advice import advise
    from full_geometry.trade.assessing import assess
    from halfspace_sss.provenance import provenance, write_together

    with Bar("trade") as bar:
        result = assess(
            file,
            **how,
            tolerance=job.tolerance,
            images=job.images,
            progress=lambda what, done, total: bar.show(done, total, what),
        )
    advice = advise(result, job)
    about = {"provenance": provenance(scene=str(file), tolerance=job.tolerance, images=job.images, **how)}
    about |= {"integrator": advice.integrator, "sentences": str(advice).splitlines(), "assessment": result.record()}
    files: dict[str, bytes | str] = {
        "csv": result.table().to_csv(index=False, lineterminator="\n"),
        "json": json.dumps(about, indent=1) + "\n",
        **_drawn(file, advice, how),
    }
    paths = {out / f"{file.stem}_trade.{ending}": data for ending, data in files.items()}
    write_together(paths)
    screen = console()
    for o in result.objects:
        screen.print(object_table(o))
    screen.print(str(advice), highlight=False, markup=False, soft_wrap=True)
    for o in result.objects:
        for note in o.notes:
            typer.echo(f"warning: {note}", err=True)
    screen.print(f"measured in {result.seconds:.1f} s, compilation {result.compilation:.1f} s beside", highlight=False)
    _tell_files(paths)


def _drawn(file: Path, advice: Advice, how: dict[str, Any]) -> dict[str, bytes]:
    """The figure and the page, if what draws them is installed."""
    from full_geometry.trade.images import picture_of
    from halfspace_sss.extensions import renderer

    draw = renderer("trade")
    if not draw:
        return {}
    return draw(picture_of(file, advice.assessment, advice.tolerance, str(advice).splitlines(), how))


def object_table(assessed: ObjectTrade) -> Any:
    """All ways of rendering an object."""
    from full_geometry.trade.results import UNNAMED

    rows = [_row(row) for row in assessed.ways if not row.refusal]
    low, high = assessed.mfp
    title = f"{assessed.object or UNNAMED}: {low:.3g} to {high:.3g} mean free paths, {100 * assessed.share:.3g} % seen"
    headings = (*_HEADINGS[:-1], "mean / traced", "preparation, s", "memory, MB", "FLIP")
    return _rich(headings, rows, title)


def _row(row: WayTrade) -> list[str]:
    cost = (f"{row.variance:.3g}", f"{1e6 * row.seconds:.3g}", f"{1e6 * row.seconds * row.variance:.3g}")
    means = " ".join(f"{value:.3f}" for value in row.ratio)
    flip = "–" if row.flip is None else f"{row.flip:.3f}"
    return [row.way, row.told_bias, *cost, means, f"{row.preparation:.2g}", f"{row.memory / 1e6:.3g}", flip]


def _rich(headings: Any, rows: list[list[str]], title: str | None = None) -> Any:
    from rich.box import SIMPLE_HEAD
    from rich.table import Table

    table = Table(title=title, title_justify="left", box=SIMPLE_HEAD, pad_edge=False)
    for heading in headings:
        words = heading in ("way", "material", "shape", "light")
        table.add_column(heading, justify="left" if words else "right", overflow="fold")
    for row in rows:
        table.add_row(*row)
    return table
