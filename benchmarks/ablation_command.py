"""The command `ablation`: what each choice of a network brings, against the paper's set-up."""

from __future__ import annotations

import json
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from benchmarks.kept_rows import KeptRows
from halfspace_sss.backend import array_types
from halfspace_sss.cli.shared import Backend, Bar, MediumOptions, OutFolder, Places, console, whole
from halfspace_sss.provenance import JsonDict, check_folder, provenance, write_together

if TYPE_CHECKING:
    from collections.abc import Sequence

    import pandas
    from rich.table import Table

    from benchmarks.budgets import Budget
    from halfspace_sss.physics.medium import Medium


def ablation_command(
    stated: MediumOptions,
    places: Places,
    material: Annotated[
        str | None, typer.Argument(help="Name of a material; see `halfspace-sss materials list`.", show_default="fig10")
    ] = None,
    channel: Annotated[
        str | None, typer.Option(help="Its channel, by name or number.", show_default="the first")
    ] = None,
    seconds: Annotated[
        float | None,
        typer.Option(help="Seconds of each training at equal time.", show_default="20, none with --samples"),
    ] = None,
    samples: Annotated[
        int | None,
        typer.Option(
            help="Samples of each training at equal data.", parser=whole, show_default="1000000, none with --seconds"
        ),
    ] = None,
    seeds: Annotated[int, typer.Option(help="Trainings of each variant.", parser=whole)] = 3,
    seed: Annotated[int, typer.Option(help="Seed of the maps, and the first of the trainings.", parser=whole)] = 0,
    backend: Backend = "llvm",
    out: OutFolder = Path("ablation"),
) -> None:
    """Train the paper's network, `neural_material` and the steps between them, at equal time and at equal data.

    48 trainings by default, about 20 min; an interrupted run goes on after its finished trainings.
    """
    if find_spec("torch") is None:
        raise ValueError("training needs torch: `pip install halfspace-sss[train]`")
    from benchmarks import ablation as variants
    from halfspace_sss.neural.training.train_material import STANDARD

    title, medium = _medium(material, channel, stated)
    budgets = _budgets(seconds, samples) or variants.BUDGETS
    check_folder(out)
    runs = variants.trainings(medium, budgets, seeds, seed)
    array_types(backend)
    how = {"medium": repr(medium.in_mfp()), "recipe": repr(STANDARD), "seed": seed, "backend": backend}
    kept = KeptRows(out / "ablation.part", how)
    typer.echo(variants.cost(run for name, run in runs.items() if name not in kept), err=True)
    with places.executor() as executor, Bar("ablation") as bar:
        table = variants.ablation(
            medium, STANDARD, budgets, seeds, seed, backend=backend, kept=kept, executor=executor,
            progress=bar.told,
        )  # fmt: skip
    summary, caption = variants.summary(table), variants.caption(budgets, int(table["threads"].max()))
    how = {"medium": title, "budgets": [str(b) for b in budgets], "seeds": seeds, "seed": seed, "backend": backend}
    files = _write(out, table, summary, caption, how)
    kept.finish()
    screen = console()
    for budget, rows in summary.groupby("budget", sort=False):
        noise = _number(rows["noise"].mean())
        screen.print(_rich(f"{title}: {budget} each, {seeds} seed(s); noise of the reference {noise} %", rows))
    screen.print(caption, highlight=False, markup=False)
    for file in files:
        screen.print(f"  {file}", highlight=False, markup=False, soft_wrap=True)


def _medium(name: str | None, channel: str | None, options: MediumOptions) -> tuple[str, Medium]:
    """A title and a scalar medium."""
    from halfspace_sss.materials.catalogue import one_channel

    stated = options.stated([name] if name else [])
    if stated is None:
        return one_channel(name or "fig10", channel)
    return "medium", one_channel(stated, channel)[1]


def _budgets(seconds: float | None, samples: int | None) -> Sequence[Budget]:
    from benchmarks.budgets import Samples, Seconds

    given = [Seconds(seconds)] if seconds is not None else []
    return [*given, Samples(samples)] if samples is not None else given


def _write(out: Path, table: pandas.DataFrame, summary: pandas.DataFrame, caption: str, how: dict) -> list[Path]:
    from benchmarks.bench import machine

    content: JsonDict = {"provenance": provenance(**how), "machine": machine(), "caption": caption}
    content["summary"] = json.loads(summary.to_json(orient="records"))
    files = {
        "ablation.csv": table.to_csv(index=False, lineterminator="\n"),
        "ablation.json": json.dumps(content, indent=1, allow_nan=False) + "\n",
    }
    write_together({out / name: text for name, text in files.items()})
    return [out / name for name in files]


def _rich(title: str, summary: pandas.DataFrame) -> Table:
    from rich.box import SIMPLE_HEAD
    from rich.table import Table

    table = Table(title=title, box=SIMPLE_HEAD, pad_edge=False)
    decades = [key for key in summary if key.startswith("r ")]
    for heading in ("variant", "kB", "samples", "seconds", "error %", "bias %", *decades):
        table.add_column(heading, justify="left" if heading == "variant" else "right")
    for row in summary.to_dict("records"):
        spent = (f"{row['kB']:.3g}", f"{row['samples']:.3g}", f"{row['seconds']:.3g}")
        errors = (_percent(row, key) for key in ("error", "bias"))
        table.add_row(row["variant"], *spent, *errors, *(_number(row[key]) for key in decades))
    return table


def _percent(row: JsonDict, key: str) -> str:
    spread = row[f"{key}_sd"]
    return _number(row[key]) if spread != spread else f"{_number(row[key])} ± {_number(spread)}"


def _number(value: float) -> str:
    percent = 100 * value
    return f"{percent:.2g}" if abs(percent) < 1 else f"{percent:.3g}" if abs(percent) < 100 else f"{percent:.0f}"
