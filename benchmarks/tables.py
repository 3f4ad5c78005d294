"""Tables for pages."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    import pandas


def markdown(table: pandas.DataFrame) -> str:
    """The table as Markdown."""
    rows = [[f"{v:.3g}" if isinstance(v, float) else str(v) for v in row] for row in table.itertuples(index=False)]
    kinds = ["---:" if table[key].dtype.kind == "f" else "---" for key in table]
    lines = [list(map(str, table.columns)), kinds, *rows]
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)


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
