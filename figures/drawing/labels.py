"""Names of methods as figures print them, and tables in Markdown."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from figures.computing.contenders import VOLUMES, WALK
from halfspace_sss.comparison.style import look

if TYPE_CHECKING:
    import pandas


def label(method: str) -> str:
    """The name of a method as people read it."""
    if method in VOLUMES:
        kind, rr_depth = method.split()
        return f"Mitsuba {kind}, roulette from {rr_depth}"
    if method == WALK:
        return "Our walk"
    return "Neural half-space" if method == "neural" else look(method).label


def in_markdown(table: pandas.DataFrame) -> str:
    """A table in Markdown, numbers with three digits."""
    lines = [list(table.columns), ["---"] * len(table.columns)]
    lines += [[_said(value) for value in row] for row in table.itertuples(index=False)]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def _said(value: str | float) -> str:
    if isinstance(value, str):
        return value
    if not np.isfinite(value):
        return "—"
    return f"{value:.0f}" if abs(value) >= 100 else f"{value:.3g}"
