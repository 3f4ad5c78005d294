"""The objects as parts of scenes: dicts for Mitsuba that stand on the floor y = 0, with the files that they read."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from figures.modelling import croissant, mandarin, meat
from figures.modelling.candle import make_candle
from figures.modelling.grid import Grid, mixed, tissue
from full_geometry.learning.meshes import Mesh, surface

__all__ = [
    "FLAME_RADIANCE", "OBJECTS", "VARYING", "Varying", "candle_parts", "learnable_parts", "make_varying",
    "varying_parts",
]  # fmt: skip

VARYING = ("mandarin", "meat", "croissant")
OBJECTS = ("candle", *VARYING)
FLAME_RADIANCE = (60.0, 30.0, 8.5)
ROUGHNESS = {"mandarin": 0.22, "meat": 0.2, "croissant": 0.5}  # alpha of the boundary, chosen
ETA = {"mandarin": 1.36, "meat": 1.4, "croissant": 1.3}
_MODELS = {
    "mandarin": (mandarin.Mandarin, mandarin.BOX),
    "meat": (meat.Meat, meat.BOX),
    "croissant": (croissant.Croissant, croissant.BOX),
}


@dataclass(frozen=True, eq=False)
class Varying:
    """An object whose medium varies: its surface, the medium, the relative index and roughness of its boundary."""

    name: str
    mesh: Mesh
    grid: Grid
    eta: float
    alpha: float


def make_varying(name: str, resolution: int = 192, grid_resolution: int = 160, seed: int = 0) -> Varying:
    """An object whose medium varies.

    Args:
        name: "mandarin", "meat" or "croissant".
        resolution: grid cubes of the surface along the longest side of its box, >= 8.
        grid_resolution: cells of the medium along that side, >= 8.
        seed: of everything uneven about it.

    Raises:
        ValueError: no such object, or a resolution is too small.
    """
    if name not in VARYING:
        raise ValueError(f"object must be one of {', '.join(VARYING)}, got {name!r}")
    make, box = _MODELS[name]
    found = make(seed)
    mesh, grid = surface(found.distance, box, resolution), mixed(found.tissues, box, grid_resolution)
    return Varying(name, mesh, grid, ETA[name], ROUGHNESS[name])


def candle_parts(folder: Path, resolution: int = 192, seed: int = 0, model: str = "neural") -> dict[str, Any]:
    """The candle: "candle" with the surface `translucent`, "wick", and "flame", an area light in the bowl; mm.

    Args:
        folder: where its PLY files are written.
        resolution, seed: as for `make_candle`.
        model: of the BSSRDF.
    """
    made, wax = make_candle(resolution, seed), tissue("candle wax").medium
    files = {name: getattr(made, name).write_ply(Path(folder) / f"{name}.ply") for name in ("wax", "wick", "flame")}
    surface = {"type": "translucent", "model": model, "g": 0.0, "eta": wax.eta}  # smooth, so that walks join the flame
    for key in ("sigma_s", "sigma_a"):
        surface[key] = ", ".join(f"{v:.9g}" for v in getattr(wax, key))
    black = {"type": "diffuse", "reflectance": 0.0}
    soot = {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.02, 0.015, 0.012]}}
    glow = {"type": "area", "radiance": {"type": "rgb", "value": list(FLAME_RADIANCE)}}
    return {
        "candle": {"type": "ply", "filename": str(files["wax"]), "bsdf": surface},
        "wick": {"type": "ply", "filename": str(files["wick"]), "bsdf": soot},
        "flame": {"type": "ply", "filename": str(files["flame"]), "bsdf": black, "emitter": glow},
    }


def varying_parts(found: Varying, folder: Path) -> dict[str, Any]:
    """An object whose medium varies, as a rough dielectric about Mitsuba's `heterogeneous` medium; mm.

    Args:
        found: the object.
        folder: where its PLY file and its grid volumes are written.
    """
    path = found.mesh.write_ply(Path(folder) / f"{found.name}.ply")
    boundary = {"type": "roughdielectric", "alpha": found.alpha, "int_ior": found.eta, "ext_ior": 1.0}
    medium = found.grid.write(Path(folder), found.name)
    return {found.name: {"type": "ply", "filename": str(path), "bsdf": boundary, "interior": medium}}


def learnable_parts(found: Varying, folder: Path, model: str = "full_geometry") -> dict[str, Any]:
    """An object whose medium varies with the surface `translucent` and a smooth boundary, so that it can be learnt; mm.

    Args:
        found: the object.
        folder: where its PLY file and its grid volumes are written.
        model: of light in it.
    """
    parts = varying_parts(found, folder)[found.name]
    grids = {key: parts["interior"][key] for key in ("sigma_t", "albedo")}
    surface = {"type": "translucent", "model": model, "g": 0.0, "eta": found.eta, **grids}
    return {found.name: {"type": "ply", "filename": parts["filename"], "bsdf": surface}}
