"""Light that is gathered, corrected or precomputed by few samples, for tests that do not ask how exact it is."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any


def gather_by_few(put: Callable[[Any, str, Any], None]) -> None:
    """Take fewer points, directions, rays and walks; `put` is `setattr`, or that of a `pytest.MonkeyPatch`."""
    from full_geometry.integrators import correction, gathering, inner_light, translucent_walk
    from full_geometry.precomputed import transport_matrix, unscattered_light

    values = {
        gathering: {"DIRECTIONS": 2**14},
        transport_matrix: {"MOST": 1024, "SAMPLES": 2**14, "FEWEST_ENTRIES": 16},
        inner_light: {"COUNT": 2**13},
        translucent_walk: {"FEWEST_RAYS": 2**13},
        unscattered_light: {"FEWEST_PATHS": 2**11},
        correction: {"PER_LAUNCH": 2**12, "FEWEST": 2**13, "FEWEST_OF_LIGHT": 2**14},
    }
    for module, numbers in values.items():
        for name, value in numbers.items():
            put(module, name, value)
