"""The table of docs/limits.md of what each model takes, from the capabilities of the models.

    python -m tests.limits_table

writes it into the page.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

from full_geometry.settings import Capabilities
from full_geometry.transport.models import CORRECTED, MODELS, WALKS, lookup

PAGE = Path(__file__).resolve().parent.parent / "docs" / "limits.md"
HEADING = "| input | "  # of the table in the page
VARYING = {"exact": "taken", "mean": "its mean, with a warning", "": "refused"}


def _taken(name: str) -> Callable[[Capabilities], str]:
    return lambda of: "taken" if getattr(of, name) else "refused"


ROWS: dict[str, Callable[[Capabilities], str]] = {
    "orders of scattering in S": lambda of: {"multiple": "two and more", "total": "all"}.get(of.orders, "by model"),
    "light that passes unscattered": lambda of: "traced" if of.straight else "refused above 25 %",
    "textures of the medium": _taken("textures"),
    "spectral variants": _taken("spectra"),
    "something inside the object": _taken("inclusions"),
    "a medium that varies in space": lambda of: VARYING[of.varying],
    "stretched instances": _taken("stretched"),
    "normal and bump maps": _taken("normal_maps"),
    "light that is gathered once": lambda of: "taken" if of.gathered else "–",
    "derivatives by the medium": _taken("derivatives"),
    "training of the object": lambda of: "needed" if of.trained else "–",
}


def table() -> str:
    """The table as Markdown: a row for what a scene may ask for, a column for each model, and for walks."""
    columns = {"a half-space model": lookup("neural").capabilities}
    columns |= {f"`{name}`": entry.capabilities for name, entry in MODELS.items()} | {"corrected light": CORRECTED}
    columns |= {"`translucent_walk`": WALKS}
    lines = [HEADING + " | ".join(columns) + " |", "|---" * (1 + len(columns)) + "|"]
    lines += [f"| {what} | {' | '.join(map(told, columns.values()))} |" for what, told in ROWS.items()]
    return "\n".join(lines) + "\n"


def replaced(page: str) -> str:
    """A page with the table in the place of the one that it has."""
    result, n = re.subn(rf"^{re.escape(HEADING)}a half-space model.*\n(?:\|.*\n)+", lambda _: table(), page, flags=re.M)
    if n != 1:
        raise ValueError(f"page must have one table that begins with {HEADING!r}, got {n}")
    return result


if __name__ == "__main__":
    PAGE.write_text(replaced(PAGE.read_text(encoding="utf-8")), encoding="utf-8")
