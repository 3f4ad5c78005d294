"""The figure of total error over seconds: a panel for each object and light, a curve for each technique."""

from __future__ import annotations

import pandas
from matplotlib.figure import Figure

from halfspace_sss.comparison.style import paper

# technique -> label, colour; a denoised image is dashed
CURVES = {
    "volpathmis": ("volpathmis", "#888888"),
    "walk, light sampled": ("walk, sampled light", "#3465a4"),
    "walk, light precomputed": ("walk, precomputed light", "#c0392b"),
    "better_dipole, light corrected": ("better_dipole, corrected light", "#2e7d32"),
}


def draw(table: pandas.DataFrame) -> Figure:
    """Error of pixels and of blocks over CPU seconds, log-log.

    Args:
        table: of `total_error.total_errors`; of `volpathmis` the roulette depth with the smaller error is shown.
    """
    cases = list(table.groupby(["object", "light"], sort=False))
    with paper():
        figure = Figure(figsize=(2.3 * len(cases), 4.2), layout="constrained")
        axes = figure.subplots(2, len(cases), sharex=True, sharey="row", squeeze=False)
        for column, ((name, light), rows) in enumerate(cases):
            for row, what in enumerate(("pixels, %", "blocks, %")):
                ax = axes[row][column]
                for technique, (label, colour) in CURVES.items():
                    for kind, style in (("raw", "-"), ("denoised", "--")):
                        curve = _curve(rows, technique, kind, what)
                        shown = f"{label}, {kind}" if column == row == 0 else None
                        ax.loglog(curve.index, curve.values, style, color=colour, marker="o", ms=3, label=shown)
                ax.grid(True, which="both", lw=0.3, alpha=0.5)
            times = sorted(set(rows["seconds"]))
            axes[1][column].set_xticks(times, [f"{value:g}" for value in times])
            axes[1][column].minorticks_off()
            axes[0][column].set_title(f"{name}, {light}", fontsize=8)
            axes[1][column].set_xlabel("CPU seconds")
        axes[0][0].set_ylabel("error of pixels, %")
        axes[1][0].set_ylabel("error of 8 x 8 blocks, %")
        figure.legend(loc="outside lower center", ncols=3, fontsize=7)
    return figure


def _curve(rows: pandas.DataFrame, technique: str, kind: str, what: str) -> pandas.Series:
    chosen = rows[rows["way"].str.startswith(technique) & rows["way"].str.endswith(f", {kind}")]
    return chosen.groupby("seconds")[what].min()
