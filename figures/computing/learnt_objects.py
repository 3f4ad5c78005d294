"""Objects that are learnt for figures, as shapes with their media, and where their weights are kept."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from figures.computing.scenes import BUNNY, MM_PER_UNIT
from figures.modelling.candle import make_candle
from figures.modelling.grid import tissue
from halfspace_sss import materials
from halfspace_sss.neural.trained import ENVIRONMENT_VARIABLE
from halfspace_sss.physics.medium import Medium

__all__ = ["SHAPES", "shape_of", "weights_in"]

SHAPES = ("bunny", "candle")


def shape_of(name: str, folder: Path, resolution: int = 96, seed: int = 0) -> tuple[Any, Medium, float]:
    """A Mitsuba shape, its medium and millimetres of a unit: the bunny of potato, or the candle of wax.

    Args:
        name: "bunny" or "candle".
        folder: where the mesh of the candle is written.
        resolution, seed: of the candle.
    """
    import mitsuba as mi

    if name == "bunny":
        return mi.load_dict({"type": "ply", "filename": str(BUNNY)}), materials.load("potato").medium, MM_PER_UNIT
    path = make_candle(resolution, seed).wax.write_ply(folder / "wax.ply")
    return mi.load_dict({"type": "ply", "filename": str(path)}), tissue("candle wax").medium, 1.0


@contextmanager
def weights_in(folder: Path) -> Iterator[None]:
    """Weights are kept and looked for in a folder, and nowhere else."""
    before = os.environ.get(ENVIRONMENT_VARIABLE)
    os.environ[ENVIRONMENT_VARIABLE] = str(folder)
    try:
        yield
    finally:
        os.environ.pop(ENVIRONMENT_VARIABLE)
        if before is not None:
            os.environ[ENVIRONMENT_VARIABLE] = before
