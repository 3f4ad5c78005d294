"""The command `halfspace-sss maps`: training maps of materials or of a stated medium, one store each."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from halfspace_sss.cli.shared import (
    Albedo,
    Backend,
    Bar,
    Eta,
    Materials,
    MeanCosine,
    Scheduler,
    SigmaT,
    Workers,
    by_channel,
    check_channel,
    console,
    executor_of,
    fig10_medium,
    numbers,
    stated_medium,
    whole,
)
from halfspace_sss.provenance import check_folder, path_of

if TYPE_CHECKING:
    from rich.table import Table

    from halfspace_sss.maps.grid import MapGrid
    from halfspace_sss.physics.medium import Medium

TARGET_ERROR = 0.05


def maps_command(
    material: Materials = None,
    channel: Annotated[
        str | None, typer.Option(help="Only these, as R,B, a store each.", show_default="all in one store")
    ] = None,
    sigma_t: SigmaT = None,
    albedo: Albedo = None,
    g: MeanCosine = None,
    eta: Eta = None,
    name: Annotated[str | None, typer.Option(help="Store of a stated medium.", show_default="medium")] = None,
    target_error: Annotated[
        float | None, typer.Option(help="Mean cell error to stop at.", show_default="0.05, none with --paths")
    ] = None,
    paths: Annotated[
        int | None, typer.Option(help="Walks for 16 maps: this number, or the most with --target-error.", parser=whole)
    ] = None,
    grid: Annotated[
        str, typer.Option(help="Numbers of angles of incidence, of observations, of cells in r, in azimuth.")
    ] = ("16,64,48,24"),
    seed: Annotated[int, typer.Option(help="Seed of directions and walks.", parser=whole)] = 0,
    backend: Backend = "llvm",
    share: Annotated[str, typer.Option(help="k/n: of n processes that fill one folder, this is number k < n.")] = "0/1",
    workers: Workers = None,
    scheduler: Scheduler = None,
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
    from halfspace_sss.maps.store import make_maps

    media = _media(material or [], channel, {"sigma_t": sigma_t, "albedo": albedo, "g": g, "eta": eta}, name)
    if target_error is None and paths is None:
        target_error = TARGET_ERROR
    part = _share(share)
    check_folder(out)
    with executor_of(workers, scheduler) as executor, Bar("tracing") as bar:
        stores = make_maps(
            media, out, grid=_grid(grid), target_error=target_error, n_paths=paths, seed=seed, backend=backend,
            share=part, progress=bar.show, executor=executor,
        )  # fmt: skip
    _report(stores, part)


def _media(
    names: list[str], channels: str | None, given: dict[str, float | None], name: str | None
) -> dict[str, Medium]:
    """Media by the name of their store."""
    from halfspace_sss import materials

    stated = stated_medium(names, given)
    if name is not None and stated is None:
        raise ValueError(f"name must be left out unless coefficients are given, got {name!r}")
    if name == "":
        raise ValueError("name must have a letter at least, got ''")
    check_channel(channels, names)
    if not names:
        return {"fig10": fig10_medium()} if stated is None else {name or "medium": stated}
    if channels is None:
        chosen = [(material.name, material.medium) for material in map(materials.load, names)]
    else:
        chosen = by_channel(names, channels)
    media = {re.sub(r"[^\w.-]+", "_", title): medium for title, medium in chosen}
    if len(media) < len(chosen):
        raise ValueError(f"materials and channels must be different, got {', '.join(title for title, _ in chosen)}")
    return media


def _share(text: str) -> tuple[int, int]:
    try:
        k, n = (int(part) for part in text.split("/"))
    except ValueError:
        raise ValueError(f"share must be k/n with 0 <= k < n, got {text!r}") from None
    return k, n


def _grid(text: str) -> MapGrid:
    from halfspace_sss.maps.grid import MapGrid

    values = numbers("grid", text)
    if len(values) != 4 or not all(value.is_integer() for value in values):
        raise ValueError(f"grid must be four whole numbers separated by commas, got {text!r}")
    try:
        return MapGrid(*(int(value) for value in values))
    except ValueError as error:
        raise ValueError(f"grid {text}: {error}") from None


def _report(stores: dict[str, Path], share: tuple[int, int]) -> None:
    screen = console()
    if share[1] > 1:
        line = f"share {share[0]}/{share[1]} is done; the stores are whole when all {share[1]} shares are:"
        screen.print(line, highlight=False)
    else:
        screen.print(_table(stores))
    for path in stores.values():
        screen.print(f"  {path}", highlight=False, markup=False, soft_wrap=True)


def _table(stores: dict[str, Path]) -> Table:
    """What each store holds; loading it checks that it is whole."""
    from rich.box import SIMPLE_HEAD
    from rich.table import Table

    from halfspace_sss.maps.store import load_maps

    table = Table(box=SIMPLE_HEAD, pad_edge=False)
    for heading in ("store", "channels", "maps", "mean cell error", "walks", "seconds"):
        table.add_column(heading, justify="left" if heading == "store" else "right")
    for name, path in stores.items():
        maps = load_maps(path)
        channels, n = maps.sizes["channel"], maps.sizes["channel"] * maps.sizes["theta"] * maps.sizes["phi"]
        error, walks, seconds = (maps[key].values for key in ("mean_cell_error", "n_paths", "seconds"))
        row = (channels, n, f"{error.max():.3f}", f"{walks.sum():.2e}", f"{seconds.sum():.0f}")
        table.add_row(name, *map(str, row))
    return table
