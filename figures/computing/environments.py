"""Environment maps that light the figures."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from figures.parts.exr import read_exr

__all__ = ["ENVIRONMENTS", "environment", "environment_file"]

ENVIRONMENTS = ("studio", "sunset", "forest")


def environment_file(name: str) -> Path:
    """The file of an environment map, for `Part.inputs`; ValueError if there is none of that name."""
    if name not in ENVIRONMENTS:
        raise ValueError(f"environment must be one of {', '.join(ENVIRONMENTS)}, got {name!r}")
    return Path(__file__).parents[1] / "assets" / f"{name}.exr"


def environment(name: str, scale: float = 1.0, turn: float = 0.0) -> dict[str, Any]:
    """An environment map as an emitter for `mitsuba.load_dict`.

    Args:
        name: "studio" (two lamps in a dark hall), "sunset" (a square by the sea, the sun just below the horizon) or
            "forest" (a clearing by day).
        scale: of its radiance.
        turn: about y, degrees.

    Raises:
        ValueError: there is none of that name.
    """
    import mitsuba as mi

    image = np.maximum(read_exr(environment_file(name))[..., :3], 0)  # the file has negative pixels
    to_world = mi.ScalarTransform4f().rotate([0, 1, 0], turn)
    return {"type": "envmap", "bitmap": mi.Bitmap(image), "scale": scale, "to_world": to_world}
