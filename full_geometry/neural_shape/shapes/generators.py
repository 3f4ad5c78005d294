"""Shapes without end, by a seed: signed distances put together at random and meshed.

Families of training and families that are held out share no generator. Lengths are of the order of one.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from full_geometry.neural_shape.shapes import families, held_out
from full_geometry.neural_shape.shapes.mesh import Box, Distance, Mesh, surface
from halfspace_sss.checks import check_choice, check_count

__all__ = ["HELD_OUT", "TRAINING", "make_shape"]

Family = Callable[[np.random.Generator], tuple[Distance, Box]]
TRAINING: dict[str, Family] = families.FAMILIES
HELD_OUT: dict[str, Family] = held_out.FAMILIES
TRIES = 8


def make_shape(family: str, seed: int, resolution: int = 48) -> Mesh:
    """A random shape of a family.

    Args:
        family: name in TRAINING or HELD_OUT.
        seed: whole number >= 0.
        resolution: grid cubes along its longest side, >= 8.

    Raises:
        ValueError: an argument is out of range, or no shape of that family came out in eight tries.
    """
    check_choice("family", family, (*TRAINING, *HELD_OUT))
    check_count("seed", seed, 0)
    check_count("resolution", resolution, 8)
    make = {**TRAINING, **HELD_OUT}[family]
    error: ValueError | None = None
    for k in range(TRIES):
        distance, box = make(np.random.default_rng([seed, k]))
        try:
            return surface(distance, box, resolution)
        except ValueError as found:
            error = found
    raise ValueError(f"seed must give a shape of the family {family!r}, got {seed!r}: {error}")
