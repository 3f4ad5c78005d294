"""How long parts will take, from what others were measured to take."""

from __future__ import annotations

from collections.abc import Sequence
from statistics import median
from typing import NamedTuple

from figures.parts.part import Part
from figures.parts.store import PartStore

__all__ = ["Projected", "duration", "projected"]


class Projected(NamedTuple):
    """Seconds that a part will take and where that is known from; None and "" if nothing like it was measured."""

    seconds: float | None
    source: str


def projected(parts: Sequence[Part], stores: Sequence[tuple[str, PartStore]]) -> dict[str, Projected]:
    """Seconds of each part, scaled by its work, by name.

    Args:
        parts: whose time is asked for.
        stores: (what it is called, where parts were measured), the most telling one first. A part of the same name is
            taken before others of the same function, of which the median counts.
    """
    same: dict[tuple[str, str], tuple[float, str]] = {}
    kinds: dict[str, list[float]] = {}
    for label, store in stores:
        for slug, kind, work, seconds in store.seconds():
            same.setdefault((slug, kind), (seconds / work, f"the same part in {label}"))
            kinds.setdefault(kind, []).append(seconds / work)
    found = {}
    for part in parts:
        if (part.slug, part.kind) in same:
            rate, source = same[part.slug, part.kind]
            found[part.name] = Projected(rate * part.work, source)
        elif part.kind in kinds:
            found[part.name] = Projected(median(kinds[part.kind]) * part.work, "like parts")
        else:
            found[part.name] = Projected(None, "")
    return found


def duration(seconds: float) -> str:
    """Seconds as people say them: "40 s", "12 min", "3.5 h"."""
    if seconds < 99.5:
        return f"{seconds:.2g} s" if seconds < 9.95 else f"{seconds:.0f} s"
    if seconds < 99.5 * 60:
        return f"{seconds / 60:.0f} min"
    return f"{seconds / 3600:.1f} h"
