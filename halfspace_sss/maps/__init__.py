"""Maps of S over the plane: traced, stored and resumed, and many noisy ones to train with."""

from halfspace_sss.maps.grid import MapGrid
from halfspace_sss.maps.map_store import load_maps, make_maps

__all__ = ["MapGrid", "load_maps", "make_maps"]
