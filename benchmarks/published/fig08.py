"""Fig. 8: error against the number N of incident samples, the paper's network and ours."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from figures.computing.learnt import bunny_of_potato
from figures.computing.scans import BUNNY, prepare
from figures.parts.part import Params, Part, Result, Task
from halfspace_sss.comparison.style import COLUMN, paper, saved

if TYPE_CHECKING:
    from full_geometry.learning.model_errors import ExitRadiance, ExitTruth
    from full_geometry.objects.objects import TranslucentObject

TITLE = "error against the number of incident samples, the paper's network and ours"
SECONDS = {"draft": 6, "paper": 600}  # CPU time of each training
NUMBERS = {"draft": (1, 8, 64), "paper": (1, 2, 4, 8, 16, 32, 64, 128)}
TRUTH = {"draft": (96, 512), "paper": (256, 8192)}  # exits, and walks of each
OURS = "full_geometry"
BACKBONE = "better_dipole"  # its proposals
LIGHTS = ("constant", "lobes")
LOOKS = {
    OURS: ("#C00000", "-", "o"), "paper, points of walks": ("#0072B2", "-", "s"),
    "paper, uniform points": ("#0072B2", (0, (2, 1.4)), "^"),
}  # fmt: skip


def parts(quality: str) -> list[Part]:
    """Ours for all N, and a training of the paper's network for each N."""
    seconds, (exits, walks) = SECONDS[quality], TRUTH[quality]
    common = {"seconds": seconds, "exits": exits, "walks": walks, "seed": 0}
    results = [Part(OURS, ours, {"numbers": list(NUMBERS[quality]), **common}, seconds, inputs=(BUNNY,))]
    for n in NUMBERS[quality]:
        results.append(Part(f"paper, N = {n}", papers, {"n": n, **common}, seconds, inputs=(BUNNY,)))
    return results


def truth_of(obj: TranslucentObject, p: Params) -> ExitTruth:
    """Exits and their radiance."""
    from full_geometry.learning.model_errors import reference

    return reference(obj, p["exits"], p["walks"], p["seed"])


def _rmse(result: ExitRadiance, truth: ExitTruth, per_estimate: float) -> dict[str, float]:
    """Relative RMSE of one estimate, its noise included and that of the truth taken out, mean over channels.

    Args:
        result: estimates of the exits.
        truth: from walks.
        per_estimate: variance of one estimate over that of their mean.
    """
    values = {}
    for light, columns in (("constant", slice(0, 1)), ("lobes", slice(1, None))):
        a, b = result.mean[..., columns], truth.truth.mean[..., columns]
        spread = result.variance[..., columns]
        square = (a - b) ** 2 - spread - truth.truth.variance[..., columns] + per_estimate * spread
        ratio = square.mean(axis=1) / np.maximum(b.mean(axis=1), 1e-30) ** 2
        values[light] = float(np.sqrt(np.maximum(ratio.mean(axis=1), 0)).mean())
    return values


def ours(task: Task) -> dict[str, object]:
    """Errors of `full_geometry` with N entries by patches."""
    from full_geometry.learning.model_errors import modelled
    from full_geometry.learning.training import train_unattended
    from full_geometry.objects.objects import object_of
    from full_geometry.transport.exit_pairs import EntryProposals
    from full_geometry.transport.one_object import HalfSpace

    prepare()
    p = task.params
    obj = object_of(*bunny_of_potato())
    learnt = train_unattended(obj, task.folder, cpu_seconds=p["seconds"], seed=p["seed"])
    truth = truth_of(obj, p)
    proposals = EntryProposals(obj, HalfSpace(obj, BACKBONE)).with_patches(learnt.sampler)
    result = modelled(learnt.model, proposals, truth.exits, p["walks"], p["seed"])
    rows = [{"method": OURS, "N": n, **_rmse(result, truth, p["walks"] / n)} for n in p["numbers"]]
    return {"rows": rows}


def papers(task: Task) -> dict[str, object]:
    """Errors of the paper's network for one N, its points from walks and uniform."""
    from benchmarks.published.paper_network import PaperRecipe, estimate, fit_paper
    from full_geometry.objects.objects import object_of

    prepare()
    p, repeats = task.params, 8
    obj = object_of(*bunny_of_potato())
    truth = truth_of(obj, p)
    net, steps = fit_paper(obj, PaperRecipe(n=p["n"], seconds=p["seconds"]), p["seed"])
    rows = []
    for points, name in (("walks", "paper, points of walks"), ("uniform", "paper, uniform points")):
        result = estimate(obj, net, truth.exits, points, repeats, p["seed"])
        rows.append({"method": name, "N": p["n"], **_rmse(result, truth, repeats)})
    return {"rows": rows, "steps": steps}


def draw(results: Mapping[str, Result]) -> dict[str, bytes | str]:
    """The figure as PDF and PNG, and the numbers as a table."""
    import pandas
    from matplotlib.figure import Figure
    from matplotlib.ticker import FuncFormatter

    table = pandas.DataFrame([row for result in results.values() for row in result.numbers["rows"]])
    with paper():
        figure = Figure(figsize=(2 * COLUMN, 0.75 * COLUMN))
        for ax, light in zip(figure.subplots(1, 2, sharey=True), LIGHTS):
            for name, (color, dash, marker) in LOOKS.items():
                rows = table[table["method"] == name].sort_values("N")
                ax.plot(rows["N"], rows[light], color=color, ls=dash, marker=marker, ms=3, lw=1, label=name)
            ax.set(xscale="log", yscale="log", xlabel="incident samples N", title=light)
            numbers = sorted(set(table["N"]))
            ax.set_xticks(numbers, [str(n) for n in numbers])
            ax.set_xticks([], minor=True)
            for set_formatter in (ax.yaxis.set_major_formatter, ax.yaxis.set_minor_formatter):
                set_formatter(FuncFormatter(lambda y, _: f"{y:g}" if f"{y:.0e}"[0] in "1235" else ""))
            ax.grid(True, which="both", lw=0.3, color="#dddddd")
        figure.axes[0].set_ylabel("relative RMSE of one estimate")
        figure.axes[1].legend(frameon=False)
        figure.tight_layout(pad=0.4)
        files: dict[str, bytes | str] = {f"fig08.{end}": data for end, data in saved(figure).items()}
    files["fig08.csv"] = table.to_csv(index=False, lineterminator="\n")
    return files
