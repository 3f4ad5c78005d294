"""The white furnace: a closed sphere that hardly absorbs, in light of radiance 1 from everywhere, must not exceed 1."""

from __future__ import annotations

from typing import Any

import numpy as np

from figures.computing.contenders import WALK
from figures.computing.model_inputs import accepting
from figures.computing.scenes import prepare
from figures.parts.part import Task
from halfspace_sss.physics.medium import Medium

__all__ = ["furnace", "furnace_models", "furnace_scene"]

ALBEDO, ETA = 1 - 1e-6, 1.5
RADIUS = 1000.0  # mean free paths: what a half-space lets out farther away than the sphere is wide is below 1 %
WALK_SPP = 4  # nearly every walk comes back with weight 1


def furnace_models() -> list[str]:
    """Names of the models that there are for the medium of the furnace."""
    return accepting(Medium.from_albedo(ALBEDO, 1.0, 0.0, ETA))


def furnace_scene(model: str, size: int, radius: float = RADIUS) -> Any:
    """The Mitsuba scene of the furnace: the middle of the sphere fills the image.

    Args:
        model: of the BSSRDF, or "translucent_walk".
        size: pixels of the square image.
        radius: of the sphere, mean free paths.
    """
    import mitsuba as mi

    from halfspace_sss.rendering.scenes.scene_files import PATH_TRACED, load_scene

    at = mi.ScalarTransform4f()
    view = at.look_at([0, 0, 2 * radius], [0, 0, 0], [0, 1, 0]) @ at.scale([0.9 * radius, 0.9 * radius, 1])
    film = {"type": "hdrfilm", "width": size, "height": size, "rfilter": {"type": "box"}}
    surface = {"type": "translucent", "sigma_s": ALBEDO, "sigma_a": 1 - ALBEDO, "g": 0.0, "eta": ETA}
    scene = {
        "type": "scene",
        "integrator": {"type": "bssrdf"},
        "sensor": {"type": "orthographic", "to_world": view, "film": film},
        "sky": {"type": "constant", "radiance": 1.0},
        "sphere": {"type": "sphere", "radius": radius, "bsdf": surface},
    }
    return load_scene(scene, PATH_TRACED if model == WALK else model)


def furnace(task: Task) -> dict[str, Any]:
    """Mean radiance of the sphere and its standard error."""
    import mitsuba as mi

    prepare()
    p = task.params
    spp = min(p["spp"], WALK_SPP) if p["model"] == WALK else p["spp"]
    image = np.array(mi.render(furnace_scene(p["model"], p["size"]), spp=spp, seed=3), dtype=np.float64)[..., :3]
    pixels = image.mean(axis=2).ravel()
    return {"mean": float(pixels.mean()), "standard error": float(pixels.std(ddof=1) / np.sqrt(pixels.size))}
