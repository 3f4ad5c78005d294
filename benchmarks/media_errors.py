"""The command `media-errors`: models of the half-space over random media, or over all registered ones."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import numpy as np
import pandas
import typer
from rich.table import Table

from benchmarks.universal_training import draw_media
from halfspace_sss import materials
from halfspace_sss.checks import check_count
from halfspace_sss.cli import shared
from halfspace_sss.cli.errors import SQUARE, ReferenceOptions, channels_of, compared, percent_table
from halfspace_sss.comparison.model_errors import HELD_OUT_SEED, percentiles
from halfspace_sss.physics.medium import Medium

BANDS: dict[str, Callable[[pandas.DataFrame], pandas.Series]] = {
    "albedo < 0.5": lambda t: t["albedo"] < 0.5,
    "albedo 0.5-0.9": lambda t: (t["albedo"] >= 0.5) & (t["albedo"] < 0.9),
    "albedo 0.9-0.99": lambda t: (t["albedo"] >= 0.9) & (t["albedo"] < 0.99),
    "albedo >= 0.99": lambda t: t["albedo"] >= 0.99,
    "g < 0.5": lambda t: t["g"] < 0.5,
    "g 0.5-0.9": lambda t: (t["g"] >= 0.5) & (t["g"] < 0.9),
    "g >= 0.9": lambda t: t["g"] >= 0.9,
}


def held_out_media(n: int, seed: int = 0, as_trained: bool = False) -> list[Medium]:
    """Media over the whole range, from other seeds than those of the training.

    g is uniform, or, `as_trained`, log-uniform in 1 - g for a third of them: a harder set. albedo and eta as there.
    """
    rng = np.random.default_rng([HELD_OUT_SEED, seed])
    ratios = draw_media(n, rng) if as_trained else draw_media(n, rng, steep_share=0.0)
    return [Medium.from_albedo(float(a), 1.0, float(g), float(eta)) for a, g, eta in zip(*ratios)]


def bands(table: pandas.DataFrame, name: str) -> pandas.DataFrame:
    """Median and 90th percentile of the error of one model over ranges of albedo and g."""
    mine = table[table["model"] == name]
    rows = []
    for band, choose in BANDS.items():
        t = mine[choose(mine)]
        if len(t):
            row = {"media": band, "count": len(t), "median": t["error"].median(), "p90": t["error"].quantile(0.9)}
            rows.append(row | {"median_noise": t["noise"].median(), "median_abs_bias": t["bias"].abs().median()})
    return pandas.DataFrame(rows)


def losses(table: pandas.DataFrame, name: str = "neural") -> pandas.DataFrame:
    """Media on which a model that is not learnt has a smaller error than `name`."""
    analytic = table[~table["model"].str.startswith("neural")]
    best = analytic.loc[analytic.groupby("medium")["error"].idxmin()].set_index("medium")
    mine = table[table["model"] == name].set_index("medium")
    both = mine.join(best[["model", "error"]].add_suffix("_best"))
    return both[both["error_best"] < both["error"]].reset_index()


def media_errors_command(
    traced: ReferenceOptions,
    places: shared.Places,
    held_out: Annotated[
        int | None,
        typer.Option(
            help="Number of random media over the range of `neural`.", parser=shared.whole, show_default="the registry"
        ),
    ] = None,
    as_trained: Annotated[
        bool, typer.Option("--as-trained", help="Draw held-out media as in training: a third with g near 1.")
    ] = False,
    model: shared.Models = None,
    out: shared.OutFolder = Path("errors"),
) -> None:
    """Compare models with path tracing over random media, or every channel of all registered materials."""
    if held_out is None:
        media = channels_of({name: materials.load(name).medium for name in materials.names()})
    else:
        check_count("held_out", held_out, 1)
        drawn = held_out_media(held_out, traced.seed, as_trained)
        media = {f"a {float(m.albedo):.5g} g {float(m.g):.3g} eta {m.eta:.3g}": m for m in drawn}
    compared(media, traced, places, model, out, _tables)


def _tables(found: pandas.DataFrame) -> list[Table | str]:
    results: list[Table | str] = [percent_table(percentiles(found), "errors over the media, %")]
    if (found["model"] == "neural").any():
        results.append(percent_table(bands(found, "neural"), "neural over ranges of media, %"))
        lost = losses(found, "neural")[["medium", "error", *SQUARE, "noise", "model_best", "error_best"]]
        title = f"media on which an analytic model has a smaller error than neural: {len(lost)}"
        results.append(percent_table(lost, title) if len(lost) else title)
    return results
