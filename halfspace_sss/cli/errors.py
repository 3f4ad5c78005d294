"""The commands `errors materials`, `errors truths` and `validate`: models and tracing against what is known."""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from halfspace_sss.backend import array_types
from halfspace_sss.cli import shared
from halfspace_sss.cli.shared import Bar, Seed, csv_of, say, table
from halfspace_sss.noise_free import NoiseFree
from halfspace_sss.provenance import (
    JsonDict,
    KeptRows,
    check_folder,
    provenance,
    without_nan,
    write_atomically,
    write_together,
)

if TYPE_CHECKING:
    import pandas
    from rich.table import Table

    from halfspace_sss.comparison.truths import Comparison, Truth, Validation
    from halfspace_sss.physics.medium import Medium

SQUARE = ("error_square", "error_square_standard_error")  # what a printed error is made of
DEFINITION = (
    "error: sum |E_model - E_traced| / sum E_traced over unseen pairs of directions, E = ∫ S mu_i mu_o dA over "
    "blocks of {0} x {0} cells of 40 x 16 from r = 0.02 mfp on; noise of the reference taken out; orders of each model"
)


@dataclass(frozen=True)
class MediaOptions:
    """Media without names."""

    registry: Annotated[bool, typer.Option("--registry", help="Every channel of all registered materials.")] = False
    held_out: Annotated[
        int | None, typer.Option(help="Number of random media over the range of `neural`.", parser=shared.whole)
    ] = None
    as_trained: Annotated[
        bool, typer.Option("--as-trained", help="Draw held-out media as in training: a third with g near 1.")
    ] = False


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
    many: MediaOptions,
    traced: ReferenceOptions,
    places: shared.Places,
    material: shared.Materials = None,
    channel: shared.Channels = None,
    model: shared.Models = None,
    out: shared.OutFolder = Path("errors"),
) -> None:
    """Compare models with path tracing over all directions: error, bias, decades of r; written as CSV and JSON."""
    from halfspace_sss.checks import check_interval
    from halfspace_sss.comparison import model_errors

    media = _media(stated, material or [], channel, many, traced.seed)
    block, n = int(traced.block), len(media)
    check_models(model)
    check_interval("events", traced.events, 1e4, 1e12)
    _check_accepted(model or (), list(media.values()))
    array_types(traced.backend)
    check_folder(out)
    with places.executor() as executor, shared.Bar("errors") as bar:

        def show(what: str, done: int, total: int) -> None:
            bar.show(round(1000 * ((what == "models") + done / total)), 2000, what)

        references = model_errors.references(
            list(media.values()), traced.events * n, traced.seed, block, show, traced.backend, executor
        )
        found = model_errors.error_table(media, references, model or None, show, executor)
    how = {"events": traced.events, "block": block, "seed": traced.seed}
    files = write_errors(out, found, model_errors.percentiles(found), DEFINITION.format(block), how)
    shared.say(*_tables(found, n), DEFINITION.format(block))
    shared.say_files(files)


def errors_truths(model: shared.Models = None, out: shared.OutFolder = Path("errors")) -> None:
    """Compare reflectances of models with published and exact values; an interrupted run goes on."""
    from halfspace_sss.comparison.model_truths import reflectance_truths, truth_summary

    check_models(model)
    check_folder(out)
    kept = KeptRows(out / "truths.part", {"what": "truths"})
    if kept:
        shared.tell(f"goes on after {len(kept)} reflectances that were kept")
    with shared.Bar("truths") as bar:
        found = reflectance_truths(model or None, bar.told, kept)
    write_atomically(out / "truths.csv", shared.csv_of(found))
    kept.finish()
    shared.say(_table(truth_summary(found), "relative error of the reflectance (single order included), %"))
    shared.say_files([out / "truths.csv"])


def _media(
    stated: shared.MediumOptions, names: list[str], channel: str | None, many: MediaOptions, seed: int
) -> dict[str, Medium]:
    """Scalar media by label."""
    from halfspace_sss import materials
    from halfspace_sss.checks import check_count
    from halfspace_sss.comparison.model_errors import held_out_media

    if many.as_trained and many.held_out is None:
        raise ValueError("as_trained must come with held_out, got it alone")
    given = bool(names) or stated != shared.MediumOptions()
    if given + many.registry + (many.held_out is not None) > 1:
        raise ValueError("material, registry and held_out must be given one at a time, got several")
    if many.held_out is not None:
        check_count("held_out", many.held_out, 1)
        media = held_out_media(many.held_out, seed, many.as_trained)
        return {f"a {float(m.albedo):.5g} g {float(m.g):.3g} eta {m.eta:.3g}": m for m in media}
    results = {}
    for title, medium in stated.media(materials.names() if many.registry else names, channel).items():
        labels = () if channel or title == "medium" else materials.load(title).channels
        for label, one in zip(labels or ("",), medium.channels()):
            if float(one.albedo) > 0 or not labels:
                results[f"{title} {label}".strip()] = one
    return results


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


def _tables(found: pandas.DataFrame, n_media: int) -> list[Table | str]:
    from halfspace_sss.comparison.model_errors import bands, losses, percentiles

    if n_media <= 3:
        columns = ["medium", "model", "error", *SQUARE, "noise", "bias", *(c for c in found if c.startswith("r "))]
        return [_table(found[columns], "errors, %")]
    results: list[Table | str] = [_table(percentiles(found), "errors over the media, %")]
    if (found["model"] == "neural").any():
        results.append(_table(bands(found, "neural"), "neural over ranges of media, %"))
        lost = losses(found, "neural")[["medium", "error", *SQUARE, "noise", "model_best", "error_best"]]
        title = f"media on which an analytic model has a smaller error than neural: {len(lost)}"
        results.append(_table(lost, title) if len(lost) else title)
    return results


def _table(frame: pandas.DataFrame, title: str) -> Table:
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


KINDS = ("published", "thirdparty", "exact")


def row_filter(text: str | None) -> Callable[[Truth], bool] | None:
    """Choose rows by a comma-separated list of ids, measures (R_d, BRDF, ring, ...) or kinds; None chooses all.

    Raises:
        ValueError: an entry is none of these.
    """
    from halfspace_sss.comparison.truths import MEASURES

    if not text:
        return None
    wanted = {part.strip() for part in text.split(",") if part.strip()}
    known = {*MEASURES.values(), *KINDS}
    for part in sorted(wanted - known):
        if not (part[:1] == "T" and part[1:].isdigit()):
            raise ValueError(f"rows must be ids such as T0134, or of {', '.join(sorted(known))}; got {part!r}")
    return lambda truth: bool(wanted & {truth.id, truth.measure, truth.kind})


def summary(comparisons: list[Comparison]) -> list[JsonDict]:
    """One record per quantity: rows, largest and rms z, largest standard error relative to the traced value.

    Reflectances of albedo below 0.5, whose bounds are wider, are apart.
    """
    groups: dict[str, list[Comparison]] = {}
    for c in comparisons:
        dim = c.truth.measure in ("R_d", "R_total") and c.truth.medium.albedo < 0.5
        groups.setdefault(c.truth.quantity + (", albedo < 0.5" if dim else ""), []).append(c)
    results = []
    for name, group in sorted(groups.items()):
        z = [abs(c.z) for c in group]
        error = max(c.standard_error / abs(c.reflected) if c.reflected else math.inf for c in group)
        about = {"quantity": name, "rows": len(group), "max_abs_z": max(z)}
        results.append(about | {"rms_z": math.hypot(*z) / math.sqrt(len(z)), "max_relative_error": error})
    return results


def _record(c: Comparison) -> JsonDict:
    """A row of the CSV and JSON files."""
    t, m = c.truth, c.truth.medium
    mu_o, phi = t.direction or (None, None)
    inner, outer = t.ring or (None, None)
    return {
        "id": t.id, "kind": t.kind, "quantity": t.quantity, "sigma_s_per_mm": m.sigma_s, "sigma_a_per_mm": m.sigma_a,
        "g": m.g, "eta": m.eta, "mu_i": t.mu_i, "mu_o": mu_o, "delta_phi_rad": phi, "r_inner_mm": inner,
        "r_outer_mm": outer, "truth": t.value, "uncertainty": t.uncertainty, "traced": c.traced,
        "standard_error": c.standard_error, "z": c.z, "n_paths": c.n_paths, "n_events": c.n_events, "seed": c.seed,
        "source": t.source,
    }  # fmt: skip


def write_results(result: Validation, folder: Path) -> None:
    """Write validate.csv (a line per row) and validate.json (rows, summary, rows not covered, provenance)."""
    import pandas

    from halfspace_sss.comparison.truths import Z_LIMIT

    records = [_record(c) for c in result.comparisons]
    content = {
        "provenance": provenance(seed=result.seed, quick=result.quick, z_limit=Z_LIMIT),
        "seconds": result.seconds,
        "summary": summary(result.comparisons),
        "failures": [c.truth.id for c in result.failures],
        "not_covered": [vars(n) for n in result.not_covered],
        "rows": records,
    }
    about = json.dumps(without_nan(content), indent=1, allow_nan=False) + "\n"
    write_together({folder / "validate.csv": csv_of(pandas.DataFrame(records)), folder / "validate.json": about})


def validate(
    out: Annotated[Path | None, typer.Option(help="Folder for validate.csv and validate.json.")] = None,
    seed: Seed = 0,
    quick: Annotated[bool, typer.Option("--quick", help="Ten times looser standard errors.")] = False,
    rows: Annotated[str | None, typer.Option(help="Rows to trace: ids, measures (R_d, BRDF, ...) or kinds.")] = None,
) -> None:
    """Trace every published, third-party or exact half-space number of the packaged table and compare."""
    from halfspace_sss.comparison import truths

    if out is not None:
        check_folder(out)
    with Bar("tracing") as bar:
        result = truths.validate(row_filter(rows), seed, quick, progress=bar.show)
    if out is not None:
        write_results(result, out)
    cells = [
        (s["quantity"], f"{s['rows']}", f"{s['max_abs_z']:.2f}", f"{s['rms_z']:.2f}", f"{s['max_relative_error']:.1e}")
        for s in summary(result.comparisons)
    ]
    headings = ("quantity", "rows", "max |z|", "rms z", "largest relative error")
    say(table(headings, cells, title="traced against truths.csv"))
    for reason, count in Counter(n.reason for n in result.not_covered).most_common():
        say(f"not covered: {count} rows: {reason}")
    for c in result.failures:
        truth = f"truth {c.truth.value:.8g} ± {c.truth.uncertainty:.1e}, z = {c.z:.2f}"
        say(f"{c.truth.id} {c.truth.quantity}: traced {c.traced:.8g} ± {c.standard_error:.1e}, {truth}")
    verdict = f"{len(result.failures)} of {len(result.comparisons)} rows have |z| >= {truths.Z_LIMIT:g}"
    say(f"{verdict}; {result.seconds:.0f} s")
    if result.failures:
        raise typer.Exit(1)
