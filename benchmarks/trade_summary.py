"""What came of many random scenes: shares that kept their tolerance, costs, misses, and whether errors are honest."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from benchmarks.trade_check import WAYS, outcome, z_values
from full_geometry.scenes.scene_files import PATH_TRACED
from halfspace_sss.provenance import JsonDict

if TYPE_CHECKING:
    import pandas

ASKED = 5.0  # seconds of an assessment
DEAR = 1.5  # times the cheapest way, up to which a recommendation is called cheap
ALWAYS = WAYS


def outcomes(records: Sequence[JsonDict]) -> pandas.DataFrame:
    """One row for each scene in which something is seen."""
    import pandas

    rows = [row for row in map(outcome, records) if row["way"] is not None]
    return pandas.DataFrame(rows)


def summary(records: Sequence[JsonDict]) -> JsonDict:
    """Counts of scenes: kept, cheap, misses by number; mean and spread of z; times of fixed choices.

    A fixed choice that never keeps the tolerance of a scene is counted as one that failed; times are sums over the
    scenes in which all of them keep it, so that they are of equal work.
    """
    table = outcomes(records)
    z = np.array([value for record in records for _, value in z_values(record)])
    cheap = table["ratio"] <= DEAR
    results: JsonDict = {"scenes": len(table), "kept": int(table["keeps"].sum()), "cheap": int(cheap.sum())}
    results |= {"kept_and_cheap": int((table["keeps"] & cheap).sum())}
    results |= {"surely_cheap": int((table["sure_ratio"] <= DEAR).sum())}
    results |= {"cheap_techniques": int((table["technique_ratio"] <= DEAR).sum())}
    results["not_kept"] = [int(n) for n in table.loc[~table["keeps"], "number"]]
    results["dear"] = [int(n) for n in table.loc[~cheap, "number"]]
    results["assess_s"] = float(table["seconds"].max())
    results["z"] = {"count": len(z), "mean": float(z.mean()), "sd": float(z.std(ddof=1)) if len(z) > 1 else math.nan}
    results["z"] |= {"beyond_2": float(np.mean(np.abs(z) > 2)), "beyond_3": float(np.mean(np.abs(z) > 3))}
    results["assess_median_s"], results["quick"] = (
        float(table["seconds"].median()),
        int((table["seconds"] <= ASKED).sum()),
    )
    results["models_cheapest"] = int((table["cheapest"] != PATH_TRACED).sum())
    results["models_recommended"] = int((table["way"] != PATH_TRACED).sum())
    results["cheapest"] = {str(k): int(v) for k, v in table["cheapest"].value_counts().items()}
    results["recommended"] = {str(k): int(v) for k, v in table["way"].value_counts().items()}
    results["always"] = {name: _always(table, name) for name in ALWAYS}
    results["recommended_s"], results["cheapest_s"] = float(table["cost_s"].sum()), float(table["cheapest_s"].sum())
    return results


def _always(table: pandas.DataFrame, name: str) -> JsonDict:
    """A fixed choice: in how many scenes it can keep the tolerance, and its time there over the recommended one."""
    time = table[f"{name}_s"].astype(float)
    can = np.isfinite(time)
    told: JsonDict = {"keeps": int(can.sum())}
    if can.any():
        ratio = time[can] / table.loc[can, "cost_s"]
        told |= {"seconds": float(time[can].sum()), "recommended_s": float(table.loc[can, "cost_s"].sum())}
        told |= {"median_ratio": float(ratio.median())}
    return told


INTRODUCTION = """\
# The advice of `trade` on random scenes

Written by `python -m benchmarks trade-check` ({arguments}): random scenes of shape x medium x light x size x tolerance.
Each scene has {assess:g} s for a recommendation among {ways} ways, and a long run with exits and samples of its
own: {truth:g} s for each denoised way, or until its squared error is known to 5 %, a quarter of that for all others.
Times are those of the processor, all cores together, preparation included. *Always* is the cost of one fixed choice
where it can keep the tolerance, with as many samples as the long runs say.
"""


def markdown(values: JsonDict, table: pandas.DataFrame, how: JsonDict) -> str:
    """The page: the summary and the misses.

    Args:
        values: of `summary`.
        table: of `outcomes`.
        how: scenes, first, seed, assess, truth: what was asked.
    """
    n, z = values["scenes"], values["z"]
    arguments = " ".join(
        f"--{key} {how[key]}" for key in ("scenes", "first", "seed", "tolerance") if how[key] is not None
    )
    lines = [
        INTRODUCTION.format(arguments=f"`{arguments}`", ways=len(WAYS), **{k: how[k] for k in ("assess", "truth")}),
        f"{values['kept']} of {n} recommendations keep their tolerance (within two standard errors of the long run), "
        f"{values['cheap']} cost at most {DEAR:g} times the cheapest way that does by the long run, "
        f"{values['surely_cheap']} of the cheapest with the doubt that a recommendation counts. Stopped as soon as it "
        f"keeps the tolerance by the long run, the technique costs that in {values['cheap_techniques']}. An assessment "
        f"took at most {values['assess_s']:.2g} s of the processor, compilation left out.",
        "",
        f"(bias² of the assessment - bias² of the long run) over their standard errors, {z['count']} pairs: mean "
        f"{z['mean']:+.2f}, standard deviation {z['sd']:.2f}, {100 * z['beyond_2']:.1f} % beyond 2, "
        f"{100 * z['beyond_3']:.1f} % beyond 3.",
        "",
        f"Another way than walks by chance is cheapest by the long run in {values['models_cheapest']} of {n} scenes, "
        f"and recommended in {values['models_recommended']}. Assessments of at most {ASKED:g} s: {values['quick']}; "
        f"median {values['assess_median_s']:.2g} s.",
        "",
        f"Cheapest by the long run: {', '.join(f'{name} {count}' for name, count in values['cheapest'].items())}.",
        "",
        f"Recommended: {', '.join(f'{name} {count}' for name, count in values['recommended'].items())}.",
        "",
        "| always | keeps the tolerance in | its time there, s | recommended there, s | median of ratios |",
        "|---|---:|---:|---:|---:|",
    ]
    for name, row in values["always"].items():
        numbers = [f"{row[key]:.3g}" if key in row else "–" for key in ("seconds", "recommended_s", "median_ratio")]
        lines.append(f"| {name} | {row['keeps']} of {n} | {' | '.join(numbers)} |")
    misses = table[~table["keeps"] | (table["ratio"] > DEAR)]
    if len(misses):
        lines += ["", "| miss | shape, light | mfp | asked | way | error | cost over cheapest | cheapest |"]
        lines.append("|---:|---|---:|---:|---|---:|---:|---|")
    for row in misses.itertuples():
        error = f"{100 * row.error:.3g} ± {100 * row.error_standard_error:.1g} %"
        lines.append(
            f"| {row.number} | {row.shape}, {row.light} | {row.mfp:.3g} | {100 * row.tolerance:.3g} % | {row.way} | "
            f"{error} | {row.ratio:.3g} | {row.cheapest} |"
        )
    return "\n".join(lines) + "\n"
