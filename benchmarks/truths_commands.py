"""The commands `truths` and `validate`: models and tracing against published, third-party and exact numbers."""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Annotated

import pandas
import typer

from benchmarks import truths
from benchmarks.kept_rows import KeptRows
from benchmarks.truths import MEASURES, Z_LIMIT, Comparison, Truth, Validation, read_truths
from halfspace_sss.cli import shared
from halfspace_sss.cli.errors import check_models, percent_table
from halfspace_sss.cli.shared import Bar, Seed, csv_of, say, table
from halfspace_sss.interface.model import BSSRDF
from halfspace_sss.measure.reflected_flux import reflectance_estimate
from halfspace_sss.physics.fresnel import F_r
from halfspace_sss.progress import NamedProgress
from halfspace_sss.provenance import JsonDict, check_folder, provenance, without_nan, write_atomically, write_together
from halfspace_sss.registry import models_of

REFLECTANCES = ("R_d", "R_total")


def reflectance_truths(
    names: Iterable[str] | None = None,
    progress: NamedProgress | None = None,
    kept: dict[str, list[float]] | None = None,
) -> pandas.DataFrame:
    """One row per true reflectance and model that accepts its medium: truth, model's value at total order, error.
    `names`: of models; None for all. `progress`: called with (what, done, total). `kept`: reflectances found before;
    new ones are added. Media without scattering are left out; R_total includes the surface reflection."""
    names, result = None if names is None else list(names), {} if kept is None else kept
    truths, rows = [t for t in read_truths()[0] if t.measure in REFLECTANCES and float(t.medium.albedo) > 0], []
    for k, t in enumerate(truths):
        m = t.medium
        for model in models_of(m, names):
            key = f"{model.name} {' '.join(model.checksums)} {float(m.albedo)!r} {float(m.g)!r} {m.eta!r} {t.mu_i}"
            if key not in result:
                result[key] = _reflectance(model, t.mu_i)
            R, error = (t.factor * v for v in result[key])
            if t.measure == "R_total":
                R += float(F_r(t.mu_i, m.eta))
            row = {"id": t.id, "kind": t.kind, "model": model.name, "albedo": float(m.albedo), "g": float(m.g)}
            row |= {"eta": m.eta, "mu_i": t.mu_i, "truth": t.value, "value": R, "error": error}
            rows.append(row | {"relative_error": R / t.value - 1})
        if progress:
            progress("truths", k + 1, len(truths))
    return pandas.DataFrame(rows)


def _reflectance(model: BSSRDF, mu_i: float | str) -> list[float]:
    """Total reflectance without the surface reflection and its error."""
    return [float(v) for v in reflectance_estimate(model, mu_i, "total")]


def truth_summary(table: pandas.DataFrame) -> pandas.DataFrame:
    """Per model and albedo below 0.5 or not: rows, median, 90th percentile and largest relative error, its medium."""
    rows = []
    for (name, bright), t in table.assign(bright=table["albedo"] >= 0.5).groupby(["model", "bright"], sort=False):
        error = t["relative_error"].abs()
        worst = t.loc[error.idxmax()]
        row = {"model": name, "albedo": ">= 0.5" if bright else "< 0.5", "rows": len(t), "median": error.median()}
        row |= {"p90": error.quantile(0.9), "worst": error.max()}
        row["worst_row"] = f"{worst['id']} a {worst['albedo']:.4g} g {worst['g']:.3g} eta {worst['eta']:.3g}"
        rows.append(row)
    return pandas.DataFrame(rows)


def errors_truths(model: shared.Models = None, out: shared.OutFolder = Path("errors")) -> None:
    """Compare reflectances of models with published and exact values; an interrupted run goes on."""
    check_models(model)
    check_folder(out)
    kept = KeptRows(out / "truths.part", {"what": "truths"})
    if kept:
        shared.tell(f"goes on after {len(kept)} reflectances that were kept")
    with shared.Bar("truths") as bar:
        found = reflectance_truths(model or None, bar.told, kept)
    write_atomically(out / "truths.csv", shared.csv_of(found))
    kept.finish()
    shared.say(percent_table(truth_summary(found), "relative error of the reflectance (single order included), %"))
    shared.say_files([out / "truths.csv"])


KINDS = ("published", "thirdparty", "exact")


def row_filter(text: str | None) -> Callable[[Truth], bool] | None:
    """Choose rows by a comma-separated list of ids, measures (R_d, BRDF, ring, ...) or kinds; None chooses all.

    Raises:
        ValueError: an entry is none of these.
    """
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
