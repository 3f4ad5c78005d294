"""The figure of total error over seconds: renders, and a panel for each object and light with a curve by technique."""

from __future__ import annotations

import numpy as np
import pandas
from matplotlib.figure import Figure, SubFigure

from benchmarks.total_error import CORRECTED, PRECOMPUTED, REFERENCE, Measured
from figures.computing.images import stops_of
from full_geometry.trade.image_differences import srgb
from halfspace_sss.comparison.style import paper

# technique -> label, colour; a denoised image is dashed
CURVES = {
    "volpathmis": ("volpathmis", "#888888"),
    "walk, light sampled": ("walk, sampled light", "#3465a4"),
    "walk, light precomputed": ("walk, precomputed light", "#c0392b"),
    "better_dipole, light corrected": ("better_dipole, corrected light", "#2e7d32"),
}

RENDERS = (
    ("volpathmis", "volpathmis"), (PRECOMPUTED, "walk, precomputed light"), (CORRECTED, "corrected light"),
    (REFERENCE, "reference"),
)  # fmt: skip


def draw(measured: Measured) -> Figure:
    """Renders of the first case after the middle time, and errors of pixels and of blocks over CPU seconds, log-log.

    Args:
        measured: by `total_error.total_errors`; of `volpathmis` the roulette depth with the smaller error is shown.
    """
    table = measured.table
    curves = {key: value for key, value in CURVES.items() if table["way"].str.startswith(key).any()}
    cases = list(table.groupby(["object", "light"], sort=False))
    with paper():
        figure = Figure(figsize=(max(2.3 * len(cases), 4.6), 5.6), layout="constrained")
        above, below = figure.subfigures(2, 1, height_ratios=(1.25, 4.2))
        _draw_renders(above, measured)
        axes = below.subplots(2, len(cases), sharex=True, sharey="row", squeeze=False)
        for column, ((name, light), rows) in enumerate(cases):
            for row, what in enumerate(("pixels, %", "blocks, %")):
                ax = axes[row][column]
                for technique, (label, colour) in curves.items():
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
        below.legend(loc="outside lower center", ncols=3, fontsize=7)
    return figure


def _draw_renders(figure: SubFigure, measured: Measured) -> None:
    """Techniques side by side with the error of their pixels, and the reference, exposed alike."""
    rows = measured.table.groupby(["object", "light"], sort=False).get_group(tuple(measured.table.iloc[0][:2]))
    times = sorted(set(rows["seconds"]))
    middle = times[len(times) // 2]
    rows = rows[rows["seconds"] == middle].set_index("way")["pixels, %"]
    reference = measured.images[REFERENCE]
    inside = reference.sum(axis=2) > 0
    stops = stops_of(reference, inside)
    box = tuple(slice(int(at.min()), int(at.max()) + 1) for at in np.nonzero(inside))
    shown = [each for each in RENDERS if any(way.startswith(each[0]) for way in measured.images)]
    for ax, (technique, label) in zip(figure.subplots(1, len(shown), squeeze=False)[0], shown):
        way = rows[rows.index.str.startswith(technique)].idxmin() if technique != REFERENCE else technique
        ax.imshow(srgb(np.maximum(measured.images[way][box], 0), stops), interpolation="nearest")
        error = f"\n{way.rpartition(', ')[2]}, {middle:g} s: {rows[way]:.1f} %" if way in rows.index else "\n"
        ax.set_title(label + error, fontsize=7)
        ax.set_axis_off()


def _curve(rows: pandas.DataFrame, technique: str, kind: str, what: str) -> pandas.Series:
    chosen = rows[rows["way"].str.startswith(technique) & rows["way"].str.endswith(f", {kind}")]
    return chosen.groupby("seconds")[what].min()
