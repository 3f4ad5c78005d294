"""Maps of S over the plane: traced, stored and resumed, and many noisy ones to train with."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from halfspace_sss.maps.grid import MapGrid
    from halfspace_sss.maps.store import load_maps, make_maps

__all__ = ["MapGrid", "load_maps", "make_maps"]

_HOME = {"MapGrid": "grid", "load_maps": "store", "make_maps": "store"}


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{_HOME[name]}"), name)
