"""Tables for pages."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import pandas


def markdown(table: pandas.DataFrame) -> str:
    """The table as Markdown."""
    rows = [[f"{v:.3g}" if isinstance(v, float) else str(v) for v in row] for row in table.itertuples(index=False)]
    kinds = ["---:" if table[key].dtype.kind == "f" else "---" for key in table]
    lines = [list(map(str, table.columns)), kinds, *rows]
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)
