"""The figure `textures`: a bunny of painted vertices and a ball of painted texels, walked and by half-space models."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from benchmarks.things import Staging, against_walks, lit_scene, shown, thing_parts, walked
from figures.computing.contenders import NOTE
from figures.computing.scans import BUNNY, MM_PER_UNIT
from figures.drawing.image_grid import image_files, rows_of
from figures.parts.part import Part, Result, SceneDict, Task
from halfspace_sss.neural.universal import shipped_weights
from halfspace_sss.provenance import check_folder

TITLE = "media by textures of the surface: painted reflectance, walked and by half-space models"
MODELS = ("lambert", "better_dipole", "neural")
THINGS = ("bunny", "ball")
SIZES = {"draft": 128, "paper": 384}
MODEL_SPP = {"draft": 16, "paper": 64}
TRUTH_SPP = {"draft": 128, "paper": 1024}
ETA = 1.4
BUNNY_MFP = "1.2,0.8,0.5"  # mm
CELLS = 60  # of the mosaic on the bunny
PAINTS = ((0.72, 0.24, 0.13), (0.80, 0.55, 0.18), (0.12, 0.42, 0.40), (0.78, 0.72, 0.60), (0.25, 0.10, 0.28))
GROUT = (0.86, 0.83, 0.76)
GROUT_WIDTH = 0.02  # of the largest extent
TEXELS = (128, 256)
BANDS = ((0.80, 0.72, 0.60), (0.62, 0.36, 0.20), (0.84, 0.80, 0.70), (0.70, 0.50, 0.34), (0.45, 0.25, 0.16))
SPOT = (0.68, 0.20, 0.10)
STAGE = Staging((0.25, 0.15, 1), (-0.9, 0.8, 0.7), fov=23.0, lamp_radius=0.4, sky=0.25)
NOTES = (
    "All images contain all scattering orders. The walk takes the medium of its exit for the whole way, models take "
    "both ends. The bunny's reflectance is an attribute of its vertices, the ball's reflectance and mean free "
    "path are bitmaps. Models render by gathered light. FLIP and relative squared error of the pixels of the object. "
    f"{NOTE}"
)


def parts(quality: str) -> list[Part]:
    """For each thing the path-traced image, then the image of each model."""
    models = [(model, (shipped_weights(),) if model == "neural" else ()) for model in MODELS]
    spp, results = (TRUTH_SPP[quality], MODEL_SPP[quality]), []
    for thing in THINGS:
        common = {"thing": thing, "size": SIZES[quality], "seed": 0}
        files = (BUNNY,) if thing == "bunny" else ()
        results += thing_parts(thing, common, spp, (path_traced, rendered), models, files)
    return results


def path_traced(task: Task) -> dict[str, object]:
    """The image by random walks."""
    return walked(task, _scene)


def rendered(task: Task) -> dict[str, object]:
    """The image of a model."""
    return shown(task, _scene)


def _scene(task: Task) -> SceneDict:
    thing = _bunny(check_folder(task.folder)) if task.params["thing"] == "bunny" else _ball()
    return lit_scene({"thing": thing}, STAGE, task.params["size"], MM_PER_UNIT)


def _bunny(folder: Path) -> SceneDict:
    """The bunny with a mosaic as an attribute of its vertices."""
    import mitsuba as mi

    from full_geometry.geometry.mesh import vertex_positions

    mesh = mi.load_dict({"type": "ply", "filename": str(BUNNY)})
    p = vertex_positions(mesh).astype(float)
    mesh.add_attribute("vertex_paint", 3, mosaic(p).astype(np.float32).ravel().tolist())
    path = folder / "painted.ply"
    mesh.write_ply(str(path))
    paint = {"type": "mesh_attribute", "name": "vertex_paint"}
    surface = {"type": "translucent", "reflectance": paint, "mfp": BUNNY_MFP, "eta": ETA, "model": "better_dipole"}
    return {"type": "ply", "filename": str(path), "bsdf": surface}


def mosaic(p: np.ndarray) -> np.ndarray:
    """Reflectance of a mosaic at points, shape (n, 3): cells about random points of them, with grout between."""
    rng = np.random.default_rng(5)
    seeds = p[rng.choice(len(p), CELLS, replace=False)]
    away = np.linalg.norm(p[:, None] - seeds[None], axis=-1)
    first, second = np.sort(away, axis=1)[:, :2].T
    paint = np.array(PAINTS)[rng.integers(len(PAINTS), size=CELLS)][away.argmin(axis=1)]
    edge = np.clip((second - first) / (GROUT_WIDTH * np.ptp(p, axis=0).max()), 0, 1)[:, None]
    return edge * paint + (1 - edge) * np.array(GROUT)


def _ball() -> SceneDict:
    """A banded ball, whose bands differ in reflectance and mean free path."""
    import mitsuba as mi

    reflectance, mfp = (
        {"type": "bitmap", "bitmap": mi.Bitmap(np.ascontiguousarray(values, dtype=np.float32)), "raw": True}
        for values in bands()
    )
    surface = {"type": "translucent", "reflectance": reflectance, "mfp": mfp, "eta": ETA, "model": "better_dipole"}
    axis = mi.ScalarTransform4f().rotate([0, 0, 1], 20).rotate([1, 0, 0], -90)
    return {"type": "sphere", "to_world": axis.scale(4.0), "bsdf": surface}


def bands() -> tuple[np.ndarray, np.ndarray]:
    """Reflectance and mean free path (mm) of wavy bands with a spot, arrays of shape (rows, columns, 3)."""
    v, u = np.meshgrid(*((np.arange(n) + 0.5) / n for n in TEXELS), indexing="ij")
    wave = v + 0.012 * np.sin(2 * np.pi * (5 * u + 3 * v)) + 0.008 * np.sin(2 * np.pi * (11 * u - 7 * v))
    at = np.clip(wave, 0, 0.999) * 11
    k, f = at.astype(int), np.clip((at % 1 - 0.42) / 0.16, 0, 1)[..., None]
    paints = np.array(BANDS)[np.arange(12) % len(BANDS)]
    reflectance = (1 - f) * paints[k] + f * paints[np.minimum(k + 1, 11)]
    spot = np.clip(4 - 4 * np.hypot((u - 0.80) / 0.085, (v - 0.6) / 0.085), 0, 1)[..., None]
    reflectance = (1 - spot) * reflectance + spot * np.array(SPOT)
    lengths = np.where(np.arange(12) % 2 == 0, 0.3, 1.2)
    mfp = ((1 - f[..., 0]) * lengths[k] + f[..., 0] * lengths[np.minimum(k + 1, 11)])[..., None] * [1.0, 0.7, 0.5]
    return reflectance, mfp


def draw(results: Mapping[str, Result]) -> dict[str, bytes | str]:
    """The figure, the page and the table."""
    scenes = {thing: against_walks(results, thing, MODELS) for thing in THINGS}
    return image_files("textures", "Media by textures", scenes, rows_of(scenes, "thing"), NOTES)
