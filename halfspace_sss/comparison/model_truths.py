"""Reflectance of models against the published and exact values that the tracer is held against."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import TYPE_CHECKING

from halfspace_sss.comparison.exits import exits
from halfspace_sss.comparison.truths import Truth, read_truths
from halfspace_sss.interface.model import BSSRDF, bssrdf, models
from halfspace_sss.physics import single_scattering
from halfspace_sss.physics.fresnel import F_r
from halfspace_sss.progress import NamedProgress

if TYPE_CHECKING:
    import pandas

__all__ = ["reflectance_truths", "sampled_reflectance", "truth_summary"]

MEASURES = ("R_d", "R_total")
POINTS, REPEATS = 2**13, 4  # of each proposal; scrambles


def reflectance_truths(names: Iterable[str] | None = None, progress: NamedProgress | None = None) -> pandas.DataFrame:
    """One row per true reflectance and model that accepts its medium: truth, model's value at total order, error.

    Args:
        names: of models; None for all.
        progress: called with (what, done, total).

    Media without scattering are left out; R_total includes the surface reflection.
    """
    import pandas

    truths = [t for t in read_truths()[0] if t.measure in MEASURES and float(t.medium.albedo) > 0]
    rows = []
    known: dict[tuple, tuple[float, float] | None] = {}
    for k, t in enumerate(truths):
        for name in models() if names is None else names:
            key = (name, t.medium.albedo, t.medium.g, t.medium.eta, t.mu_i)
            if key not in known:
                known[key] = _reflectance(name, t)
            if known[key] is None:
                continue
            R, error = (t.factor * v for v in known[key])
            if t.measure == "R_total":
                R += float(F_r(t.mu_i, t.medium.eta))
            m = t.medium
            row = {"id": t.id, "kind": t.kind, "model": name, "albedo": float(m.albedo), "g": float(m.g), "eta": m.eta}
            rows.append(
                row | {"mu_i": t.mu_i, "truth": t.value, "value": R, "error": error, "relative_error": R / t.value - 1}
            )
        if progress:
            progress("truths", k + 1, len(truths))
    return pandas.DataFrame(rows)


def _reflectance(name: str, t: Truth) -> tuple[float, float] | None:
    """Total reflectance without the surface reflection and its error; None if the model refuses the medium."""
    try:
        model = bssrdf(name, t.medium)
    except ValueError:
        return None
    R, error = sampled_reflectance(model, t.mu_i)
    return (R, error) if model.orders == "total" else (R + single_scattering.reflectance(t.medium, t.mu_i), error)


def sampled_reflectance(model: BSSRDF, mu_i: float | str, seed: int = 0, points: int = POINTS) -> tuple[float, float]:
    """R(mu_i) = ∫∫ S mu_o dw_o dA of a scalar medium by quasi Monte Carlo (`exits`), and its error.

    mu_i is a cosine or "diffuse". The error is that of the mean of independent scrambles.
    """
    values = exits(model, [mu_i] * REPEATS, points, (seed,)).flux.sum(axis=1)
    return float(values.mean()), float(values.std(ddof=1) / math.sqrt(REPEATS))


def truth_summary(table: pandas.DataFrame) -> pandas.DataFrame:
    """Per model and albedo below 0.5 or not: rows, median, 90th percentile and largest relative error, its medium."""
    import pandas

    rows = []
    for (name, bright), t in table.assign(bright=table["albedo"] >= 0.5).groupby(["model", "bright"], sort=False):
        error = t["relative_error"].abs()
        worst = t.loc[error.idxmax()]
        row = {"model": name, "albedo": ">= 0.5" if bright else "< 0.5", "rows": len(t), "median": error.median()}
        row |= {"p90": error.quantile(0.9), "worst": error.max()}
        row["worst_row"] = f"{worst['id']} a {worst['albedo']:.4g} g {worst['g']:.3g} eta {worst['eta']:.3g}"
        rows.append(row)
    return pandas.DataFrame(rows)
