"""The command `halfspace-sss errors`: every model against path tracing, on materials, held-out media or an object."""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from full_geometry.cli.variants import Variant, use_mitsuba
from halfspace_sss.backend import array_types
from halfspace_sss.checks import check_choice
from halfspace_sss.cli.shared import (
    Albedo,
    Backend,
    Bar,
    Channels,
    Define,
    Eta,
    Materials,
    MeanCosine,
    ObjectId,
    OutFolder,
    Scheduler,
    SigmaT,
    Workers,
    by_channel,
    check_channel,
    check_left_out,
    console,
    defined,
    executor_of,
    stated_medium,
    whole,
)
from halfspace_sss.noise_free import NoiseFree
from halfspace_sss.provenance import check_folder

if TYPE_CHECKING:
    import pandas

    from full_geometry.scenes.learners import ObjectError
    from halfspace_sss.physics.medium import Medium

EVENTS, BLOCK, BACKEND, VARIANT = 2e7, 4, "llvm", "llvm_ad_rgb"  # events for each medium
EXITS = 256  # of an object
SQUARE = ("error_square", "error_square_standard_error")  # what a printed error is made of
DEFINITION = (
    "error: sum |E_model - E_traced| / sum E_traced over unseen pairs of directions, E = ∫ S mu_i mu_o dA over "
    "blocks of {0} x {0} cells of 40 x 16 from r = 0.02 mfp on; noise of the reference taken out; orders of each model"
)

OBJECT_DEFINITION = (
    "error: relative RMSE of the radiance of random exits under constant light, of four lobes cos^16, or as images "
    "of an even sky show it, against walks; noise of both taken out; orders of each model"
)


def errors_command(
    material: Materials = None,
    channel: Channels = None,
    registry: Annotated[bool, typer.Option("--registry", help="All registered materials, every channel.")] = False,
    held_out: Annotated[
        int | None, typer.Option(help="This many random media over the range of `neural`.", parser=whole)
    ] = None,
    as_trained: Annotated[
        bool, typer.Option("--as-trained", help="Held-out media as for the training: a third of them with g near 1.")
    ] = False,
    truths: Annotated[
        bool,
        typer.Option(
            "--truths", help="Reflectance against published and exact values instead: minutes; goes on where it was."
        ),
    ] = False,
    scene: Annotated[
        Path | None, typer.Option(help="Mitsuba XML file: radiance of an object of it against walks instead.")
    ] = None,
    object: ObjectId = None,
    exits: Annotated[int, typer.Option(help="Random exits of an object.", parser=whole)] = EXITS,
    sigma_t: SigmaT = None,
    albedo: Albedo = None,
    g: MeanCosine = None,
    eta: Eta = None,
    model: Annotated[list[str] | None, typer.Option(help="A model; repeat for more.", show_default="all")] = None,
    events: Annotated[float, typer.Option(help="Scattering events of the reference for each medium.")] = EVENTS,
    block: Annotated[int, typer.Option(help="Cells put together for the comparison, in distance and azimuth.")] = BLOCK,
    seed: Annotated[int, typer.Option(help="Seed of media, directions and walks.", parser=whole)] = 0,
    backend: Backend = BACKEND,
    define: Define = None,
    variant: Variant = VARIANT,
    workers: Workers = None,
    scheduler: Scheduler = None,
    out: OutFolder = Path("errors"),
) -> None:
    """Compare models with path tracing over all directions: error, bias, decades of r; written as CSV and JSON."""
    from halfspace_sss.comparison import model_errors as tables

    places = {"workers": workers, "scheduler": scheduler}
    given = {"sigma_t": sigma_t, "albedo": albedo, "g": g, "eta": eta}
    if scene is not None:
        changed = {"events": (events, EVENTS), "block": (block, BLOCK), "backend": (backend, BACKEND)}
        others = {"material": material, "channel": channel, "registry": registry, "held_out": held_out,
                  "as_trained": as_trained, "truths": truths, **places, **given}  # fmt: skip
        check_left_out({**others, **{k: None if a == b else a for k, (a, b) in changed.items()}}, "with --scene")
        _object(scene, model or [], {"object": object, "seed": seed, "exits": exits}, variant, define, out)
        return
    changed = {"variant": None if variant == VARIANT else variant, "exits": None if exits == EXITS else exits}
    check_left_out({"object": object, "define": define, **changed}, "without --scene")
    if truths:
        check_left_out(places, "with --truths")
        _truths(material or registry or held_out is not None, model, out)
        return
    media = _media((material or [], channel), registry, (held_out, as_trained), seed, given)
    _check(model, events, block, seed)
    _check_accepted(model or (), list(media.values()))
    array_types(backend)
    check_folder(out)
    with executor_of(**places) as executor, Bar("errors") as bar:

        def show(what: str, done: int, total: int) -> None:
            bar.show(round(1000 * ((what == "models") + done / total)), 2000, what)

        result = tables.references(list(media.values()), events * len(media), seed, block, show, backend, executor)
        table = tables.error_table(media, result, model or None, show, executor)
    how = {"events": events, "block": block, "seed": seed}
    files = _write(out, table, tables.percentiles(table), DEFINITION.format(block), how)
    _report(table, tables, len(media), block)
    for file in files:
        console().print(f"  {file}", highlight=False, markup=False, soft_wrap=True)


def _object(
    scene: Path, models: list[str], how: dict[str, Any], variant: str, define: list[str] | None, out: Path
) -> None:
    """Errors of models of an object of a scene: files and a table."""
    import pandas

    parameters = defined(define)
    check_folder(out)
    use_mitsuba(variant)
    from full_geometry.scenes.learners import object_errors
    from full_geometry.scenes.scene_files import load_objects

    loaded = load_objects(scene, parameters)
    with Bar("errors") as bar:
        rows = object_errors(loaded, models, **how, progress=lambda what, done, total: bar.show(done, total, what))
    table = pandas.DataFrame(rows)
    files = _write(out, table, table, OBJECT_DEFINITION, {"scene": str(scene), **how})
    screen = console()
    screen.print(object_table(rows), OBJECT_DEFINITION, highlight=False, sep="\n")
    for file in files:
        screen.print(f"  {file}", highlight=False, markup=False, soft_wrap=True)


def object_table(rows: Sequence[ObjectError]) -> Any:
    """Errors of models of an object."""
    from rich.box import SIMPLE_HEAD
    from rich.table import Table

    table = Table(title="errors, %", box=SIMPLE_HEAD, pad_edge=False)
    for heading in ("object", "channel", "model", "light", "error", "standard error", "mean / traced mean"):
        table.add_column(heading, justify="right" if heading[0] in "ems" and heading != "model" else "left")
    for row in rows:
        numbers = (f"{100 * row.error:.3g}", f"{100 * row.standard_error:.2g}", f"{row.ratio:.3f}")
        table.add_row(row.object, row.channel, row.model, row.light, *numbers)
    return table


def _truths(others: bool, names: list[str] | None, out: Path) -> None:
    """Reflectance against the packaged truths: files and a summary."""
    from halfspace_sss.comparison.model_truths import reflectance_truths, truth_summary, truths_cost
    from halfspace_sss.kept_rows import KeptRows
    from halfspace_sss.provenance import write_atomically

    if others:
        raise ValueError("truths must stand alone, got it with materials or held-out media")
    _check_models(names)
    check_folder(out)
    kept = KeptRows(out / "truths.part", {"what": "truths"})
    before, (number, seconds) = len(kept), truths_cost(names or None, kept)
    note = f", after {before} that were kept" if before else ""
    typer.echo(f"{number} reflectances, about {max(seconds, 1):.0f} s{note}", err=True)
    with Bar("truths") as bar:
        table = reflectance_truths(names or None, lambda what, done, total: bar.show(done, total), kept)
    write_atomically(out / "truths.csv", table.to_csv(index=False, lineterminator="\n"))
    kept.finish()
    console().print(_rich(truth_summary(table), "relative error of the reflectance (single order included), %"))
    console().print(f"  {out / 'truths.csv'}", highlight=False, markup=False, soft_wrap=True)


def _media(
    chosen: tuple[list[str], str | None],
    registry: bool,
    drawn: tuple[int | None, bool],
    seed: int,
    given: dict[str, float | None],
) -> dict[str, Medium]:
    """Scalar media by label."""
    from halfspace_sss import materials
    from halfspace_sss.checks import check_count
    from halfspace_sss.comparison.model_errors import held_out_media
    from halfspace_sss.neural.symmetric import channels

    names, channel = chosen
    stated = stated_medium(names, given)
    check_channel(channel, names)
    held_out, as_trained = drawn
    if as_trained and held_out is None:
        raise ValueError("as_trained must come with held_out, got it alone")
    if sum((bool(names) or stated is not None, registry, held_out is not None)) > 1:
        raise ValueError("material, registry and held_out must be given one at a time, got several")
    if held_out is not None:
        check_count("held_out", held_out, 1)
        media = held_out_media(held_out, seed, as_trained)
        return {f"a {float(m.albedo):.5g} g {float(m.g):.3g} eta {m.eta:.3g}": m for m in media}
    if stated is not None:
        return {"medium": stated}
    if channel is not None:
        return dict(by_channel(names, channel))
    results = [materials.load(name) for name in (materials.names() if registry else names or ["fig10"])]
    return {
        f"{m.name} {c}".strip(): one
        for m in results
        for c, one in zip(m.channels or ("",), channels(m.medium))
        if float(one.albedo) > 0
    }


def _check_models(names: list[str] | None) -> None:
    from halfspace_sss import models

    for name in names or ():
        check_choice("model", name, models())


def _check(names: list[str] | None, events: float, block: int, seed: int) -> None:
    from halfspace_sss.checks import check_count, check_interval

    _check_models(names)
    check_interval("events", events, 1e4, 1e12)
    check_count("seed", seed, 0)
    if block not in (1, 2, 4, 8):
        raise ValueError(f"block must be 1, 2, 4 or 8, got {block}")


def _check_accepted(names: Iterable[str], media: list[Medium]) -> None:
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


def _write(
    out: Path, table: pandas.DataFrame, summary: pandas.DataFrame, definition: str, how: dict[str, Any]
) -> list[Path]:
    from halfspace_sss.provenance import provenance, write_together

    content = {"provenance": provenance(**how), "definition": definition}
    content["summary"] = json.loads(summary.to_json(orient="records"))
    files = {"errors.csv": table.to_csv(index=False, lineterminator="\n"), "errors.json": json.dumps(content, indent=1)}
    write_together({out / name: text for name, text in files.items()})
    return [out / name for name in files]


def _report(table: pandas.DataFrame, tables: Any, n_media: int, block: int) -> None:
    screen = console()
    if n_media <= 3:
        columns = ["medium", "model", "error", *SQUARE, "noise", "bias", *(c for c in table if c.startswith("r "))]
        screen.print(_rich(table[columns], "errors, %"))
    else:
        screen.print(_rich(tables.percentiles(table), "errors over the media, %"))
        for name in ("neural",):
            if (table["model"] == name).any():
                screen.print(_rich(tables.bands(table, name), f"{name} over ranges of media, %"))
                lost = tables.losses(table, name)[["medium", "error", *SQUARE, "noise", "model_best", "error_best"]]
                title = f"media on which an analytic model has a smaller error than {name}: {len(lost)}"
                screen.print(_rich(lost, title) if len(lost) else title)
    screen.print(DEFINITION.format(block), highlight=False, markup=False)


def _rich(table: pandas.DataFrame, title: str) -> Any:
    from rich.box import SIMPLE_HEAD
    from rich.table import Table

    out = Table(title=title, box=SIMPLE_HEAD, pad_edge=False)
    columns = [name for name in table if name not in SQUARE]
    for name in columns:
        out.add_column(str(name), justify="left" if table[name].dtype.kind == "O" else "right", overflow="fold")
    for row in table.to_dict("records"):
        out.add_row(*(_error(row) if name == "error" and SQUARE[0] in row else _cell(row[name]) for name in columns))
    return out


def _error(row: dict[str, Any]) -> str:
    """With its standard error, or what it is below."""
    return NoiseFree(*(row[name] for name in SQUARE)).told()


def _cell(value: Any) -> str:
    if isinstance(value, str):
        return value
    if isinstance(value, int):
        return str(value)
    return "–" if value != value else f"{100 * value:.3g}"
