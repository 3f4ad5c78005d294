"""The command `halfspace-sss maps`: training maps of materials or of a stated medium, one store each."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from halfspace_sss.cli import shared

if TYPE_CHECKING:
    from rich.table import Table

    from halfspace_sss.maps.grid import MapGrid

TARGET_ERROR = 0.05


def _path(text: str | Path) -> Path:
    from halfspace_sss.provenance import path_of

    return path_of(text)


@dataclass(frozen=True)
class TracingOptions:
    """What is traced for a map, and how much."""

    target_error: Annotated[
        float | None, typer.Option(help="Mean cell error to stop at.", show_default="0.05, none with --paths")
    ] = None
    paths: Annotated[
        int | None,
        typer.Option(help="Walks for 16 maps: this number, or the most with --target-error.", parser=shared.whole),
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
        str | None, typer.Option(help="Only these, as R,B, a store each.", show_default="all in one store")
    ] = None,
    name: Annotated[
        str | None, typer.Option(help="Name of the store of a medium given by coefficients.", show_default="medium")
    ] = None,
    out: Annotated[
        Path,
        typer.Option(
            help="Folder of the stores, or a URL as s3://BUCKET/maps; a run with the same options is continued.",
            parser=_path,
            metavar="FOLDER",
        ),
    ] = Path("maps"),
) -> None:
    """Trace training maps into Zarr stores; an interrupted run goes on when it is started again."""
    from halfspace_sss.maps.map_store import make_maps
    from halfspace_sss.provenance import check_folder

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
