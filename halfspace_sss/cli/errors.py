"""The command `errors materials`: models against path tracing."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from halfspace_sss.backend import array_types
from halfspace_sss.cli import shared
from halfspace_sss.noise_free import NoiseFree
from halfspace_sss.provenance import (
    check_folder,
    provenance,
    write_together,
)

if TYPE_CHECKING:
    import pandas
    from rich.table import Table

    from halfspace_sss.physics.medium import Medium

SQUARE = ("error_square", "error_square_standard_error")  # what a printed error is made of
DEFINITION = (
    "error: sum |E_model - E_traced| / sum E_traced over unseen pairs of directions, E = ∫ S mu_i mu_o dA over "
    "blocks of {0} x {0} cells of 40 x 16 from r = 0.02 mfp on; noise of the reference taken out; orders of each model"
)


@dataclass(frozen=True)
class ReferenceOptions:
    """What models are compared with."""

    events: Annotated[float, typer.Option(help="Scattering events of the reference for each medium.")] = 2e7
    block: Annotated[
        Literal["1", "2", "4", "8"],
        typer.Option(help="Cells put together for the comparison, in distance and azimuth."),
    ] = "4"
    seed: shared.Seed = 0
    backend: shared.Backend = "llvm"


def errors_materials(
    stated: shared.MediumOptions,
    traced: ReferenceOptions,
    places: shared.Places,
    material: shared.Materials = None,
    channel: shared.Channels = None,
    model: shared.Models = None,
    out: shared.OutFolder = Path("errors"),
) -> None:
    """Compare models with path tracing over all directions: error, bias, decades of r; written as CSV and JSON."""
    media = channels_of(stated.media(material or [], channel), bool(channel))
    compared(media, traced, places, model, out, _tables)


def _tables(found: pandas.DataFrame) -> list[Table | str]:
    if found["medium"].nunique() > 3:
        from halfspace_sss.comparison.model_errors import percentiles

        return [percent_table(percentiles(found), "errors over the media, %")]
    columns = ["medium", "model", "error", *SQUARE, "noise", "bias", *(c for c in found if c.startswith("r "))]
    return [percent_table(found[columns], "errors, %")]


def channels_of(media: Mapping[str, Medium], chosen: bool = False) -> dict[str, Medium]:
    """Scalar media by label: channels of materials that scatter; those of a medium that is stated, or `chosen`, all."""
    from halfspace_sss import materials

    results = {}
    for title, medium in media.items():
        labels = () if chosen or title == "medium" else materials.load(title).channels
        for label, one in zip(labels or ("",), medium.channels()):
            if float(one.albedo) > 0 or not labels:
                results[f"{title} {label}".strip()] = one
    return results


def compared(
    media: Mapping[str, Medium], traced: ReferenceOptions, places: shared.Places, model: list[str] | None, out: Path,
    tables: Callable[[pandas.DataFrame], list[Table | str]],
) -> None:  # fmt: skip
    """Write the errors of models of media, a row each, and show tables of them."""
    from halfspace_sss.checks import check_interval
    from halfspace_sss.comparison import model_errors

    block = int(traced.block)
    check_models(model)
    check_interval("events", traced.events, 1e4, 1e12)
    _check_accepted(model or (), list(media.values()))
    array_types(traced.backend)
    check_folder(out)
    with places.executor() as executor, shared.Bar("errors") as bar:

        def show(what: str, done: int, total: int) -> None:
            bar.show(round(1000 * ((what == "models") + done / total)), 2000, what)

        references = model_errors.references(
            list(media.values()), traced.events * len(media), traced.seed, block, show, traced.backend, executor
        )
        found = model_errors.error_table(media, references, model or None, show, executor)
    how = {"events": traced.events, "block": block, "seed": traced.seed}
    files = write_errors(out, found, model_errors.percentiles(found), DEFINITION.format(block), how)
    shared.say(*tables(found), DEFINITION.format(block))
    shared.say_files(files)


def check_models(names: Sequence[str] | None) -> None:
    """ValueError with the nearest name if one is no model of the half-space."""
    from halfspace_sss import models
    from halfspace_sss.checks import check_choice

    for name in names or ():
        check_choice("model", name, models())


def _check_accepted(names: Sequence[str], media: list[Medium]) -> None:
    """Refuse a model, with its own words, that refuses all media."""
    from halfspace_sss import bssrdf

    for name in names:
        for k, medium in enumerate(media):
            try:
                bssrdf(name, medium)
                break
            except ValueError:
                if k == len(media) - 1:
                    raise


def write_errors(
    out: Path, found: pandas.DataFrame, summary: pandas.DataFrame, definition: str, how: Mapping[str, object]
) -> list[Path]:
    """Write errors.csv and errors.json, with what an error is and how it was measured; the paths."""
    content = {"provenance": provenance(**how), "definition": definition}
    content["summary"] = json.loads(summary.to_json(orient="records"))
    files = {out / "errors.csv": shared.csv_of(found), out / "errors.json": json.dumps(content, indent=1)}
    write_together(files)
    return list(files)


def percent_table(frame: pandas.DataFrame, title: str) -> Table:
    columns = [name for name in frame if name not in SQUARE]
    rows = [
        [told_error(row) if name == "error" and SQUARE[0] in row else _cell(row[name]) for name in columns]
        for row in frame.to_dict("records")
    ]
    left = next((k for k, name in enumerate(columns) if frame[name].dtype.kind != "O"), len(columns))
    return shared.table([str(name) for name in columns], rows, title=title, left=left)


def told_error(row: Mapping[str, float]) -> str:
    """An error with its standard error, or what it is below."""
    return NoiseFree(*(row[name] for name in SQUARE)).told()


def _cell(value: float | str) -> str:
    if isinstance(value, str):
        return value
    if isinstance(value, int):
        return str(value)
    return "–" if value != value else f"{100 * value:.3g}"
