"""The figure `objects`: candle, mandarin, meat and croissant side by side, path traced and denoised."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from figures.computing.images import Shot, check_denoiser, denoised, guides
from figures.computing.scenes import environment, environment_file, long_render, prepare
from figures.drawing.image_grid import image_grid
from figures.drawing.page import page
from figures.drawing.style import paper, saved
from figures.modelling.objects import (
    OBJECTS,
    TISSUES,
    VARYING,
    Grid,
    Varying,
    candle_parts,
    make_varying,
    varying_parts,
)
from figures.parts.part import Part, Result, Task
from halfspace_sss.provenance import check_folder

TITLE = "the objects modelled for the figures, path traced"
SIZES = {"draft": 112, "paper": 448}
SPP = {"draft": 16, "paper": 1024}
RESOLUTION = {"draft": 96, "paper": 240}  # of surfaces and of grids
SPP_PER_PASS = 8
GUIDE_PASSES = 8
FLOOR, GAP = (0.33, 0.3, 0.27), 0.02  # reflectance of the floor, and how far it lies below the lowest point, mm
NOTES = (
    "The candle by exact walks in homogeneous wax, the others by Mitsuba's volpathmis in grid volumes of extinction "
    "and albedo under a rough dielectric; all orders. Denoised by Open Image Denoise, led by normals and, for grids, "
    "by the albedo at the surface. Lengths are mm; the coefficients are chosen, see figures/modelling/tissues.toml."
)


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


def parts(quality: str) -> list[Part]:
    """One image of each object."""
    size, spp, results = SIZES[quality], SPP[quality], []
    for name in OBJECTS:
        params = {"object": name, "size": size, "spp": spp, "resolution": RESOLUTION[quality], "seed": 0}
        inputs = (environment_file(VIEWS[name].light), TISSUES)
        params |= {"view": list(VIEWS[name])}
        function = varying if name in VARYING else candle
        results.append(Part(name, function, params, spp * size**2, inputs=inputs))
    return results


def scene(shown: Mapping[str, Any], view: View, size: int, low: float = 0.0) -> dict[str, Any]:
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


def foot(part: Mapping[str, Any]) -> float:
    """Height of the lowest point of a mesh in a file, mm; 0 if it is above."""
    import mitsuba as mi

    return min(0.0, float(mi.load_dict({"type": "ply", "filename": part["filename"]}).bbox().min[1]))


def candle(task: Task) -> dict[str, Any]:
    """The candle by exact walks."""
    from full_geometry.scenes.scene_files import load_scene

    check_denoiser()
    prepare()
    p, folder = task.params, check_folder(task.folder)
    shown = candle_parts(folder, p["resolution"], p["seed"])
    integrator = {"type": "translucent_walk"}
    loaded = load_scene({**scene(shown, View(*p["view"]), p["size"]), "integrator": integrator}, "path_traced")
    return _image(task, loaded, *guides(loaded))


def varying(task: Task) -> dict[str, Any]:
    """An object whose medium varies by Mitsuba's volpathmis."""
    import mitsuba as mi

    check_denoiser()
    prepare()
    p, folder = task.params, check_folder(task.folder)
    made = make_varying(p["object"], p["resolution"], p["resolution"], p["seed"])
    shown = varying_parts(made, folder)
    integrator = {"type": "volpathmis", "max_depth": -1, "rr_depth": 8}
    low = float(made.mesh.vertices[:, 1].min())
    loaded = mi.load_dict({**scene(shown, View(*p["view"]), p["size"], low), "integrator": integrator}, parallel=False)
    return _image(task, loaded, _surface_albedo(loaded, made), guides(loaded)[1])


def _image(task: Task, loaded: Any, albedo: np.ndarray, normal: np.ndarray) -> dict[str, Any]:
    """The image in passes that survive an interruption, as rendered and denoised; then the files of the scene go."""
    spp = task.params["spp"]
    result = long_render(task, loaded, min(SPP_PER_PASS, spp), max(spp // SPP_PER_PASS, 1))
    image = np.maximum(result["image"], 0)
    smooth, _ = denoised(image, albedo, normal)
    return {"image": image, "denoised": smooth, "seconds": result["seconds"], "spp": result["spp"]}


def _surface_albedo(loaded: Any, made: Varying) -> np.ndarray:
    """What a diffuse surface of each pixel's tissue would reflect, (H, W, 3), to lead the denoiser.

    (1 - s)(1 - 0.139 s) / (1 + 1.17 s), s² = 1 - albedo (van de Hulst 1980); off the object that of the floor.
    """
    import mitsuba as mi

    position = mi.load_dict({"type": "aov", "aovs": "p:position"})
    total = 0.0
    for seed in range(GUIDE_PASSES):
        points = np.array(mi.render(loaded, integrator=position, spp=1, seed=seed))[..., :3]
        s = np.sqrt(1 - _at(made.grid, points))
        off = points[..., 1:2] < made.mesh.vertices[:, 1].min() - 0.5 * GAP
        total = total + np.where(off, FLOOR, (1 - s) * (1 - 0.139 * s) / (1 + 1.17 * s))
    return (total / GUIDE_PASSES).astype(np.float32)


def _at(grid: Grid, points: np.ndarray) -> np.ndarray:
    """The albedo of the grid at points, interpolated."""
    from scipy.ndimage import map_coordinates

    low, high = np.array(grid.box.low), np.array(grid.box.high)
    at = (points - low) / (high - low) * np.array(grid.sigma_t.shape[::-1]) - 0.5
    at = np.moveaxis(at, -1, 0)[::-1]
    channels = (map_coordinates(grid.albedo[..., k], at, order=1, mode="nearest") for k in range(3))
    return np.stack(list(channels), axis=-1)


def draw(results: Mapping[str, Result]) -> dict[str, bytes | str]:
    """The figure as PDF and PNG, and the page to flip between the images as rendered and denoised."""

    def shots(key: str) -> list[Shot]:
        return [
            Shot(name.capitalize(), results[name].images[key], {"seconds": results[name].numbers["seconds"]})
            for name in OBJECTS
        ]

    with paper():
        grid = image_grid({"": shots("denoised")}, printed=())
        files: dict[str, bytes | str] = {f"objects.{ending}": data for ending, data in saved(grid).items()}
    scenes = {"denoised": shots("denoised"), "as rendered": shots("image")}
    files["objects.html"] = page("The objects of the figures", scenes, notes=NOTES)
    return files
