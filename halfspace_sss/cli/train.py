"""The commands `maps` and `train material`: traced maps of media, and networks trained on them."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from halfspace_sss.cli import shared
from halfspace_sss.provenance import check_folder, path_of

if TYPE_CHECKING:
    from rich.table import Table

    from halfspace_sss.maps.grid import MapGrid
    from halfspace_sss.neural.training.train_material import TrainedChannel
    from halfspace_sss.physics.medium import Medium

TARGET_ERROR = 0.05


@dataclass(frozen=True)
class TracingOptions:
    """What is traced for a map, and how much."""

    target_error: Annotated[
        float | None, typer.Option(help="Mean cell error to stop at.", show_default="0.05, none with --paths")
    ] = None
    paths: Annotated[
        int | None,
        typer.Option(help="Walks for 16 maps; with --target-error their largest number.", parser=shared.whole),
    ] = None
    grid: Annotated[
        str, typer.Option(help="Numbers of angles of incidence, of observations, of cells in r, in azimuth.")
    ] = "16,64,48,24"
    seed: shared.Seed = 0
    backend: shared.Backend = "llvm"


def maps(
    stated: shared.MediumOptions,
    tracing: TracingOptions,
    places: shared.Places,
    material: shared.Materials = None,
    channel: Annotated[
        str | None, typer.Option(help="Channels, as R,B, each in its own store.", show_default="all in one store")
    ] = None,
    name: Annotated[
        str | None, typer.Option(help="Name of the store of a medium given by coefficients.", show_default="medium")
    ] = None,
    out: Annotated[
        Path,
        typer.Option(
            help="Folder of the stores, or a URL as s3://BUCKET/maps; a run with the same options is continued.",
            parser=path_of,
            metavar="FOLDER",
        ),
    ] = Path("maps"),
) -> None:
    """Trace training maps into Zarr stores; an interrupted run goes on when it is started again."""
    from halfspace_sss.maps.map_store import make_maps

    media = stated.media(material or [], channel)
    if name is not None and "medium" not in media:
        raise ValueError(f"name must be left out unless coefficients are given, got {name!r}")
    if name == "":
        raise ValueError("name must have a letter at least, got ''")
    media = {re.sub(r"[^\w.-]+", "_", title) if name is None else name: medium for title, medium in media.items()}
    target = TARGET_ERROR if tracing.target_error is None and tracing.paths is None else tracing.target_error
    check_folder(out)
    with places.executor() as executor, shared.Bar("tracing") as bar:
        stores = make_maps(
            media, out, grid=_grid(tracing.grid), target_error=target, n_paths=tracing.paths, seed=tracing.seed,
            backend=tracing.backend, progress=bar.show, executor=executor,
        )  # fmt: skip
    shared.say(_table(stores))
    shared.say_files(stores.values())


def _grid(text: str) -> MapGrid:
    from halfspace_sss.maps.grid import MapGrid

    values = shared.numbers("grid", text)
    if len(values) != 4 or not all(value.is_integer() for value in values):
        raise ValueError(f"grid must be four whole numbers separated by commas, got {text!r}")
    try:
        return MapGrid(*(int(value) for value in values))
    except ValueError as error:
        raise ValueError(f"grid {text}: {error}") from None


def _table(stores: dict[str, Path]) -> Table:
    """What each store holds; loading it checks that it is whole."""
    from halfspace_sss.maps.map_store import load_maps

    rows = []
    for name, path in stores.items():
        maps = load_maps(path)
        channels, n = maps.sizes["channel"], maps.sizes["channel"] * maps.sizes["theta"] * maps.sizes["phi"]
        error, walks, seconds = (maps[key].values for key in ("mean_cell_error", "n_paths", "seconds"))
        rows.append([name, f"{channels}", f"{n}", f"{error.max():.3f}", f"{walks.sum():.2e}", f"{seconds.sum():.0f}"])
    return shared.table(["store", "channels", "maps", "mean cell error", "walks", "seconds"], rows)


@dataclass(frozen=True)
class ResultOptions:
    """Where a training leaves weights and what it goes on with, and when they are good enough."""

    target_error: Annotated[
        float | None, typer.Option(help="Stop early once the validation error is below this in 95 % of cases.")
    ] = None
    seed: shared.Seed = 0
    out: Annotated[Path | None, typer.Option(help="Folder for the weights.", show_default="where models find them")] = (
        None
    )
    work: Annotated[
        Path | None, typer.Option(help="Folder for unfinished work, which an interrupted run continues.")
    ] = None

    def elsewhere(self) -> ResultOptions:
        """With folders that processes elsewhere find."""
        out, work = (folder and folder.absolute() for folder in (self.out, self.work))
        return replace(self, out=out, work=work)


def need_torch() -> None:
    """ValueError unless it is installed."""
    if find_spec("torch") is None:
        raise ValueError("training needs torch: `pip install halfspace-sss[train]`")


@dataclass(frozen=True)
class RecipeOptions:
    """The model of a medium, and how long it is trained."""

    model: Annotated[Literal["neural_material", "neural_paper"], typer.Option(help="The model that is trained.")] = (
        "neural_material"
    )
    fast: Annotated[bool, typer.Option("--fast", help="A quarter of the time, about twice the error.")] = False
    steps: Annotated[
        int | None, typer.Option(help="Steps of the optimiser.", parser=shared.whole, show_default="from the recipe")
    ] = None
    backend: shared.Backend = "llvm"


def train_material(
    stated: shared.MediumOptions,
    wanted: RecipeOptions,
    results: ResultOptions,
    places: shared.Places,
    material: shared.Materials = None,
    channel: shared.Channels = None,
) -> None:
    """Train networks of media: one for each channel of the materials, or for the given coefficients."""
    need_torch()
    from halfspace_sss.checks import check_count
    from halfspace_sss.executors import completed
    from halfspace_sss.neural.training.train_material import FAST, STANDARD

    media = stated.media(material or [], channel)
    recipe = FAST if wanted.fast else STANDARD
    if wanted.steps is not None:
        check_count("steps", wanted.steps, 1)
        recipe = replace(recipe, how=replace(recipe.how, steps=wanted.steps))
    rows: dict[str, list[TrainedChannel]] = {}
    with places.executor() as executor, shared.Bar("training") as bar:
        results = results.elsewhere() if executor else results
        how = {"model": wanted.model, "recipe": recipe, "backend": wanted.backend, "seed": results.seed}
        how |= {"target_error": results.target_error, "folder": results.out}
        parts = {name: (name, medium, how, results.work, None if executor else bar) for name, medium in media.items()}
        for name, result in completed(executor, _train, parts):
            rows[name] = result
            if executor:
                bar.show(len(rows), len(parts), name)
    _report([(name, each) for name in parts for each in rows[name]])


def _train(
    name: str, medium: Medium, how: dict[str, object], work: Path | None, bar: shared.Bar | None
) -> list[TrainedChannel]:
    """Networks of the channels of a medium; on a worker without a bar."""
    from halfspace_sss import neural

    def show(what: str, done: int, total: int) -> None:
        bar.show(done, total, f"{name}: {what}")

    return neural.train(medium, **how, work=work / name if work else None, progress=show if bar else None)


def _report(rows: list[tuple[str, TrainedChannel]]) -> None:
    cells = []
    for name, r in rows:
        ratios = (f"{float(getattr(r.medium, key)):.4g}" for key in ("albedo", "g", "eta"))
        errors = (r.error.known.told(), f"{100 * r.error.noise:.2f}", f"{100 * r.error.bias:+.2f}")
        cells.append((name, *ratios, *errors, f"{r.data_seconds:.0f}", f"{r.fit_seconds:.0f}"))
    headings = ("material", "albedo", "g", "eta", "error %", "noise %", "bias %", "maps s", "fit s")
    caption = "error: energy-weighted relative L1 of unseen maps in blocks of 2 x 2 cells, noise removed; order >= 2"
    shared.say(shared.table(headings, cells, caption=caption))
    shared.say_files(r.path for _, r in rows)
