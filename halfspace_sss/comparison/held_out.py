"""Errors of models on media that no network was trained on, and on materials, as tables."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

import numpy as np

from halfspace_sss.comparison.model_errors import TracedMaps, model_error, reference_maps
from halfspace_sss.interface.model import bssrdf, models
from halfspace_sss.maps.grid import draw_media
from halfspace_sss.maps.noisy_maps import CellGrid
from halfspace_sss.physics.medium import Medium
from halfspace_sss.progress import NamedProgress

if TYPE_CHECKING:
    import pandas

__all__ = ["GRID", "bands", "error_table", "held_out_media", "losses", "percentiles", "references"]

HELD_OUT_SEED = 15485863
GRID, BLOCK = CellGrid(40, 16), 4
BANDS = {
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


def references(
    media: list[Medium], events: float, seed: int = 0, block: int = BLOCK,
    progress: NamedProgress | None = None, backend: str = "llvm",
) -> list[TracedMaps]:  # fmt: skip
    """Traced maps of the media: 128 unseen pairs of directions each, `events` over all."""
    return reference_maps(media, 1, GRID, block, events, (HELD_OUT_SEED, seed), progress, backend)


def error_table(
    labels: Iterable[str],
    found: list[TracedMaps],
    names: Iterable[str] | None = None,
    progress: NamedProgress | None = None,
) -> pandas.DataFrame:
    """One row per medium and model that accepts it: error, noise, bias (fractions), error by decade of r in mfp."""
    import pandas

    rows: list[dict[str, Any]] = []
    for k, (label, reference) in enumerate(zip(labels, found)):
        m = reference.medium
        for name in names or models():
            try:
                model = bssrdf(name, m)
            except ValueError:
                continue  # the model refuses this medium
            e = model_error(model, reference)
            row = {"medium": label, "albedo": float(m.albedo), "g": float(m.g), "eta": m.eta, "model": name}
            row |= {"orders": model.orders, "error": e.error, "error_square": e.square}
            row |= {"error_square_standard_error": e.square_error, "raw": e.raw, "noise": e.noise, "bias": e.bias}
            rows.append(row | {"bias_noise": e.bias_noise} | {f"r {d}": v for d, v in e.by_decade.items()})
        if progress:
            progress("models", k + 1, len(found))
    return pandas.DataFrame(rows)


def percentiles(table: pandas.DataFrame) -> pandas.DataFrame:
    """Per model: media, median, 90th percentile and largest error with its medium, median of |bias|."""
    import pandas

    rows = []
    for name, t in table.groupby("model", sort=False):
        worst = t.loc[t["error"].idxmax()]
        row = {"model": name, "orders": worst["orders"], "media": len(t), "median": t["error"].median()}
        row |= {"p90": t["error"].quantile(0.9), "worst": worst["error"], "worst_medium": worst["medium"]}
        rows.append(row | {"median_abs_bias": t["bias"].abs().median(), "median_noise": t["noise"].median()})
    return pandas.DataFrame(rows)


def bands(table: pandas.DataFrame, name: str) -> pandas.DataFrame:
    """Median and 90th percentile of the error of one model over ranges of albedo and g."""
    import pandas

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
