"""The command `halfspace-sss validate`: trace the table of half-space truths, print a summary, write every row."""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from halfspace_sss.cli.shared import Bar, Seed, csv_of, say, table

if TYPE_CHECKING:
    from halfspace_sss.comparison.truths import Comparison, Truth, Validation
    from halfspace_sss.provenance import JsonDict

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
    from halfspace_sss.provenance import provenance, write_together

    records = [_record(c) for c in result.comparisons]
    content = {
        "provenance": provenance(seed=result.seed, quick=result.quick, z_limit=Z_LIMIT),
        "seconds": result.seconds,
        "summary": summary(result.comparisons),
        "failures": [c.truth.id for c in result.failures],
        "not_covered": [vars(n) for n in result.not_covered],
        "rows": records,
    }
    about = json.dumps(_strict(content), indent=1, allow_nan=False) + "\n"
    write_together({folder / "validate.csv": csv_of(pandas.DataFrame(records)), folder / "validate.json": about})


def _strict(value: object) -> object:
    """The value with None in place of infinities and NaN, which JSON does not know."""
    if isinstance(value, dict):
        return {key: _strict(v) for key, v in value.items()}
    if isinstance(value, list):
        return [_strict(v) for v in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def validate(
    out: Annotated[Path | None, typer.Option(help="Folder for validate.csv and validate.json.")] = None,
    seed: Seed = 0,
    quick: Annotated[bool, typer.Option("--quick", help="Ten times looser standard errors.")] = False,
    rows: Annotated[str | None, typer.Option(help="Only these ids, measures (R_d, BRDF, ...) or kinds.")] = None,
) -> None:
    """Trace every published, third-party or exact half-space number of the packaged table and compare."""
    from halfspace_sss.comparison import truths
    from halfspace_sss.provenance import check_folder

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
