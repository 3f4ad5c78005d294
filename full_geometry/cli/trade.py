"""The command `halfspace-sss trade`: what each way of rendering costs, how wrong it is, and which one to take."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from full_geometry.cli.variants import Drawers, SceneOptions, use_mitsuba
from halfspace_sss.cli import shared
from halfspace_sss.noise_free import NoiseFree
from halfspace_sss.provenance import check_folder, provenance, write_together

if TYPE_CHECKING:
    from rich.table import Table

    from full_geometry.trade.results import ObjectTrade, TechniqueTrade

SHIPPED = "trade.csv"  # in the package: three materials, two shapes, two lights
HEADINGS = ("technique", "bias, %", "variance", "s a million", "cost")


@dataclass(frozen=True)
class TradeOptions:
    """How good, how often, how soon."""

    tolerance: Annotated[float, typer.Option(help="Relative error, bias and noise together: 0.05 is 5 %.")] = 0.05
    images: Annotated[int, typer.Option(help="Number of images to render.", parser=shared.whole)] = 1
    seconds: Annotated[float | None, typer.Option(help="Longest time of the whole job.", show_default="no limit")] = (
        None
    )


@dataclass(frozen=True)
class MeasuringOptions:
    """What is measured of a scene."""

    every: Annotated[bool, typer.Option("--all", help="Measure every technique, also those that cannot win.")] = False
    assess: Annotated[float, typer.Option(help="Seconds of measuring for each object.")] = 4.0
    train_seconds: Annotated[
        float, typer.Option(help="Seconds to train each object without weights first; the job's time includes them.")
    ] = 0.0
    sensor: shared.SensorNumber = 0
    seed: shared.Seed = 0


def trade(
    context: typer.Context,
    wanted: TradeOptions,
    measuring: MeasuringOptions,
    on: SceneOptions,
    what: Annotated[
        str | None,
        typer.Argument(
            help="A Mitsuba XML or glTF file, or a material for curves.",
            metavar="SCENE_OR_MATERIAL",
            show_default="the shipped table",
        ),
    ] = None,
    model: shared.Models = None,
    r: Annotated[
        str | None, typer.Option(help="Smallest and largest distance for curves of a material, mm, as 0.1,20.")
    ] = None,
    out: shared.OutFolder = Path("trade"),
) -> None:
    """Measure speed against accuracy: a table, a recommendation, CSV, JSON, and the figure and page of a scene."""
    from halfspace_sss.checks import check_count, check_interval

    check_interval("tolerance", wanted.tolerance, 1e-4, 1.0)  # 5 is meant as 5 %
    check_count("images", wanted.images, 1)
    if what is None:
        _check_left_out("without a scene or a material", seconds=wanted.seconds, model=model, r=r, define=on.define)
        _shipped()
    elif Path(what).suffix == ".xml" or Path(what).is_file():
        _check_left_out("with a scene", r=r)
        parameters = on.parameters()
        check_folder(out)
        use_mitsuba(on.variant)
        how = {"seconds": measuring.assess, "models": model or None, "sensor": measuring.sensor, "seed": measuring.seed}
        how |= {"parameters": parameters, "train_seconds": measuring.train_seconds}
        _scene(Path(what), wanted, measuring.every, how, out, context.find_object(Drawers))
    else:
        _check_left_out("with a material", seconds=wanted.seconds, define=on.define)
        check_folder(out)
        limits = None if r is None else tuple(shared.numbers("r", r))
        how = {"r": limits, "tolerance": wanted.tolerance, "models": model or None, "seed": measuring.seed}
        _material(what, how, out)


def _check_left_out(beside: str, **options: object) -> None:
    """ValueError if one of the options was given where `beside` says that it has no place."""
    for name, value in options.items():
        if value not in (None, []):
            raise ValueError(f"{name} must be left out {beside}, got {value!r}")


def _shipped() -> None:
    """The table of the package."""
    from importlib import resources

    import pandas

    with resources.as_file(resources.files("full_geometry.trade").joinpath("data", SHIPPED)) as path:
        rows = list(pandas.read_csv(path).itertuples())
    cells = []
    for row in rows:
        known = row.bias2 == row.bias2_standard_error == 0  # sampled walks, denoised or not
        bias = "exact" if known else NoiseFree(row.bias2, row.bias2_standard_error).told()
        cost = (f"{row.variance:.3g}", f"{row.seconds_per_million:.3g}", f"{row.cost:.3g}")
        cells.append((row.material, row.shape, row.light, row.way, bias, *cost))
    shared.say(shared.table(["material", "shape", "light", *HEADINGS], cells, left=4))
    shared.say("measured by `python -m benchmarks figures all trade`; docs/trade.md says how")


def _material(name: str, how: dict[str, Any], out: Path) -> None:
    from full_geometry.trade.advice import recommend_flat
    from halfspace_sss import materials

    result = recommend_flat(materials.load(name).medium, **how)
    about = {"provenance": provenance(material=name, **how), **result.record()}
    texts = {"csv": shared.csv_of(result.table()), "json": json.dumps(about, indent=1) + "\n"}
    files = {out / f"{name}_trade.{ending}": text for ending, text in texts.items()}
    write_together(files)
    shared.say(str(result))
    shared.say_files(files)


def _scene(
    file: Path, wanted: TradeOptions, every: bool, how: dict[str, Any], out: Path, drawers: Drawers | None
) -> None:
    from full_geometry.trade.advice import advise
    from full_geometry.trade.assessing import assess
    from full_geometry.trade.images import picture_of
    from full_geometry.trade.techniques import Job, techniques

    job, limits = Job(**asdict(wanted)), {"tolerance": wanted.tolerance, "images": wanted.images}
    if every and how["models"] is None:
        how["models"] = [way.name for way in techniques()]
    with shared.Bar("trade") as bar:
        result = assess(file, **how, job=job, progress=bar.told)
    advice = advise(result, job)
    sentences = str(advice).splitlines()
    about = {"provenance": provenance(scene=str(file), **limits, **how), "integrator": advice.integrator}
    about |= {"sentences": sentences, "assessment": result.record()}
    texts: dict[str, bytes | str] = {"csv": shared.csv_of(result.table()), "json": json.dumps(about, indent=1) + "\n"}
    if drawers:
        texts |= drawers.trade(picture_of(file, advice.assessment, advice.tolerance, sentences, how))
    files = {out / f"{file.stem}_trade.{ending}": data for ending, data in texts.items()}
    write_together(files)
    shared.say(*(object_table(o) for o in result.objects), str(advice))
    for o in result.objects:
        for note in o.notes:
            typer.echo(f"warning: {note}", err=True)
    shared.say(f"measured in {result.seconds:.1f} s, compilation {result.compilation:.1f} s beside")
    shared.say_files(files)


def object_table(assessed: ObjectTrade) -> Table:
    from full_geometry.trade.results import UNNAMED

    low, high = assessed.mfp
    title = f"{assessed.object or UNNAMED}: {low:.3g} to {high:.3g} mean free paths, {100 * assessed.share:.3g} % seen"
    rows = [_row(row) for row in assessed.ways if not row.refusal]
    return shared.table([*HEADINGS, "mean / traced", "preparation, s", "memory, MB"], rows, title=title)


def _row(row: TechniqueTrade) -> list[str]:
    cost = (f"{row.variance:.3g}", f"{1e6 * row.seconds:.3g}", f"{1e6 * row.cost:.3g}")
    means = " ".join(f"{value:.3f}" for value in row.ratio)
    return [row.way, row.told_bias, *cost, means, f"{row.preparation:.2g}", f"{row.memory / 1e6:.3g}"]
