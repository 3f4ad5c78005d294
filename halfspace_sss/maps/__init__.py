"""Maps of S over the plane: traced, stored and resumed, and many noisy ones to train with."""

from __future__ import annotations

from typing import TYPE_CHECKING

from halfspace_sss.lazy import lazy_names

if TYPE_CHECKING:
    from halfspace_sss.maps.grid import MapGrid
    from halfspace_sss.maps.map_store import load_maps, make_maps

__all__ = ["MapGrid", "load_maps", "make_maps"]

__getattr__, __dir__ = lazy_names(__name__, {"grid": ["MapGrid"], "map_store": ["load_maps", "make_maps"]})
