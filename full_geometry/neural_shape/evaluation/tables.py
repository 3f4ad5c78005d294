"""Tables of errors as text of Markdown."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from full_geometry.learning.model_errors import LIGHTS
from full_geometry.neural_shape.evaluation.cases import Row

__all__ = ["by_property", "case_table", "speed_table", "summary"]

MODEL = "neural_shape"
BINS: dict[str, tuple[Callable[[Row], float], tuple[float, ...]]] = {
    "sigma_t sqrt(A)": (lambda r: r.size, (1, 10, 100, 3000)),
    "mean chord, mfp": (lambda r: r.thickness, (0, 1, 5, 30, 1e9)),
    "reduced albedo": (lambda r: r.albedo * (1 - r.g) / (1 - r.albedo * r.g), (0, 0.5, 0.9, 0.99, 1.001)),
    "g": (lambda r: r.g, (-1, -0.01, 0.01, 0.5, 1)),
}


def _table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = [f"| {' | '.join(cells)} |" for cells in (head, ["---"] * len(head), *rows)]
    return "\n".join(lines) + "\n"


def _percent(pair: tuple[float, float]) -> str:
    return f"{100 * pair[0]:.1f} ± {100 * pair[1]:.1f}"


def case_table(rows: Sequence[Row]) -> str:
    """Every case: what it is, the best half-space model under constant light, and both errors of the network, %."""
    head = ["object", "size, mfp", "albedo", "g", "eta", "half-space", "its error", "its lobes", "constant", "lobes"]
    found = []
    for r in rows:
        name, _ = r.best()
        found.append([
            r.name, f"{r.size:.3g}", f"{r.albedo:.4g}", f"{r.g:.2g}", f"{r.eta:.3g}", name,
            *(_percent(r.errors[model][light]) for model in (name, MODEL) for light in LIGHTS),
        ])  # fmt: skip
    return _table(head, found)


def summary(rows: Sequence[Row]) -> str:
    """Median and 90th percentile of the errors, and how they compare with the best half-space model of each case, %."""
    found = []
    for light in LIGHTS:
        own = np.array([r.of(MODEL, light) for r in rows])
        best = np.array([r.best(light)[1] for r in rows])
        ratio = best / np.maximum(own, 1e-9)
        found.append([
            light, f"{100 * np.median(own):.1f}", f"{100 * np.quantile(own, 0.9):.1f}",
            f"{100 * np.median(best):.1f}", f"{100 * np.quantile(best, 0.9):.1f}", f"{np.median(ratio):.1f}",
            f"{(ratio >= 4).sum()} of {len(rows)}", f"{(ratio < 1).sum()} of {len(rows)}",
        ])  # fmt: skip
    head = ["light", "median", "90th percentile", "best half-space: median", "90th percentile", "median ratio",
            "4 times better", "worse"]  # fmt: skip
    return _table(head, found)


def by_property(rows: Sequence[Row]) -> str:
    """Median errors under constant light by size, thickness, albedo and g, %."""
    found = []
    for name, (value, edges) in BINS.items():
        for low, high in zip(edges, edges[1:]):
            inside = [r for r in rows if low <= value(r) < high]
            if inside:
                own, best = ([f(r) for r in inside] for f in (lambda r: r.of(MODEL), lambda r: r.best()[1]))
                to = "" if high > 1e8 else f" to {high:g}"
                cells = (f"{100 * np.median(own):.1f}", f"{100 * max(own):.1f}", f"{100 * np.median(best):.1f}")
                found.append([name, f"{low:g}{to}", str(len(inside)), *cells])
    return _table(["by", "range", "objects", "median", "largest", "best half-space: median"], found)


def speed_table(seconds: dict[str, float]) -> str:
    """Seconds per million evaluations."""
    return _table(["model", "seconds per million"], [[name, f"{v:.2f}"] for name, v in seconds.items()])
