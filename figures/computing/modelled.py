"""The modelled objects on a floor: where they are seen from, and the light that they stand in."""

from __future__ import annotations

from typing import NamedTuple

from figures.computing.scenes import environment
from figures.parts.part import SceneDict

FLOOR, GAP = (0.33, 0.3, 0.27), 0.02  # reflectance of the floor, and how far it lies below the lowest point, mm


class View(NamedTuple):
    """Where the camera stands and looks, mm, its field of view, the environment, its scale and turn, degrees."""

    origin: tuple[float, float, float]
    target: tuple[float, float, float]
    fov: float
    light: str
    scale: float
    turn: float


VIEWS = {
    "candle": View((25, 125, 140), (0, 31.5, 0), 29, "sunset", 0.25, 0),
    "mandarin": View((18, 100, 150), (1, 14, 14), 33, "studio", 0.3, 0),
    "meat": View((10, 120, 110), (-1, 7, 2), 34, "studio", 0.3, 0),
    "croissant": View((30, 110, 170), (-4, 11, 21), 35, "studio", 0.3, -75),
}


def scene(shown: SceneDict, view: View, size: int, low: float = 0.0) -> SceneDict:
    """A scene of parts on a grey floor below the height `low`, mm, for `mitsuba.load_dict`; without an integrator."""
    import mitsuba as mi

    T = mi.ScalarTransform4f
    to_world = T().look_at(list(view.origin), list(view.target), [0, 1, 0])
    film = {"type": "hdrfilm", "width": size, "height": size, "rfilter": {"type": "box"}}
    floor = T().translate([0, low - GAP, 0]).rotate([1, 0, 0], -90).scale(2000)
    return {
        "type": "scene",
        "sensor": {"type": "perspective", "fov": view.fov, "to_world": to_world, "film": film},
        "sky": environment(view.light, view.scale, view.turn),
        "floor": {
            "type": "rectangle",
            "to_world": floor,
            "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": list(FLOOR)}},
        },
        **shown,
    }


def foot(part: SceneDict) -> float:
    """Height of the lowest point of a mesh in a file, mm; 0 if it is above."""
    import mitsuba as mi

    return min(0.0, float(mi.load_dict({"type": "ply", "filename": part["filename"]}).bbox().min[1]))
