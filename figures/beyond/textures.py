"""The figure `textures`: a bunny of painted vertices and a ball of painted texels, walked and by half-space models."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from figures.computing.images import Shot, compared, noise_of, stops_of
from figures.computing.scenes import BUNNY, MM_PER_UNIT, long_render, prepare
from figures.drawing.error_tables import label
from figures.drawing.image_grid import image_grid
from figures.drawing.page import page
from figures.drawing.style import paper, saved
from figures.parts.part import Part, Result, Task, unmodelled
from halfspace_sss.neural.universal import shipped_weights
from halfspace_sss.provenance import check_folder

TITLE = "media by textures of the surface: painted reflectance, walked and by half-space models"
MODELS = ("lambert", "better_dipole", "neural")
THINGS = ("bunny", "ball")
SIZES = {"draft": 128, "paper": 384}
MODEL_SPP = {"draft": 256, "paper": 2304}  # square numbers, for the sampler
TRUTH_SPP = {"draft": 512, "paper": 8192}
SPP_PER_PASS = 32
ETA = 1.4
BUNNY_MFP = "1.2,0.8,0.5"  # mm
CELLS = 60  # of the mosaic on the bunny
PAINTS = ((0.72, 0.24, 0.13), (0.80, 0.55, 0.18), (0.12, 0.42, 0.40), (0.78, 0.72, 0.60), (0.25, 0.10, 0.28))
GROUT = (0.86, 0.83, 0.76)
GROUT_WIDTH = 0.02  # of the largest extent
TEXELS = (128, 256)
BANDS = ((0.80, 0.72, 0.60), (0.62, 0.36, 0.20), (0.84, 0.80, 0.70), (0.70, 0.50, 0.34), (0.45, 0.25, 0.16))
SPOT = (0.68, 0.20, 0.10)
NOTES = (
    "All images contain all scattering orders. The walk takes the medium of its exit for the whole way, models that of "
    "both ends. The bunny's reflectance is an attribute of its vertices, the ball's reflectance and mean free path are "
    "bitmaps. FLIP and relative squared error of the pixels of the object; the noise of both images is in them."
)


def parts(quality: str) -> list[Part]:
    """For each thing the path-traced image, then the image of each model."""
    size, results = SIZES[quality], []
    for thing in THINGS:
        common = {"thing": thing, "size": size, "seed": 0}
        files, spp = ((BUNNY,) if thing == "bunny" else ()), TRUTH_SPP[quality]
        params = {**common, "spp": spp}
        results.append(Part(f"{thing}, path traced", path_traced, params, spp * size**2, inputs=files))
        for model in MODELS:
            params = {**common, "spp": MODEL_SPP[quality], "model": model}
            work = params["spp"] * size**2
            inputs = (*files, *((shipped_weights(),) if model == "neural" else ()))
            results.append(Part(f"{thing}, {model}", rendered, params, work, inputs=inputs, like=model))
    return results


@unmodelled
def path_traced(task: Task) -> dict[str, Any]:
    """The image by random walks, in passes that survive an interruption."""
    prepare()
    return long_render(task, _scene(task, "path_traced"), SPP_PER_PASS, task.params["spp"] // SPP_PER_PASS)


def rendered(task: Task) -> dict[str, Any]:
    """The image of a model."""
    import mitsuba as mi

    prepare()
    p = task.params
    image = mi.render(_scene(task, p["model"]), spp=p["spp"], seed=p["seed"] + 1)
    return {"image": np.array(image)[..., :3].astype(np.float32), "spp": p["spp"]}


def _scene(task: Task, model: str) -> Any:
    """A painted thing under a small lamp and a dim even sky."""
    import mitsuba as mi

    from halfspace_sss.rendering.scenes.scene_files import load_scene

    p = task.params
    thing = _bunny(check_folder(task.folder)) if p["thing"] == "bunny" else _ball()
    box = mi.load_dict({key: value for key, value in thing.items() if key != "bsdf"}).bbox()
    centre, radius = np.array(box.center()).ravel(), 0.5 * float(np.linalg.norm(np.array(box.extents()).ravel()))
    view = mi.ScalarTransform4f().look_at(list(centre + 4 * radius * _unit(0.25, 0.15, 1)), list(centre), [0, 1, 0])
    film = {"type": "hdrfilm", "width": p["size"], "height": p["size"], "rfilter": {"type": "box"}}
    sampler = {"type": "independent" if model == "path_traced" else "multijitter"}
    glow, where = {"type": "area", "radiance": 60.0}, list(centre + 3 * radius * _unit(-0.9, 0.8, 0.7))
    description = {
        "type": "scene",
        "integrator": {"type": "bssrdf", "mm_per_unit": MM_PER_UNIT, "hide_emitters": True},
        "sensor": {"type": "perspective", "fov": 23.0, "to_world": view, "film": film, "sampler": sampler},
        "thing": thing,
        "sky": {"type": "constant", "radiance": 0.25},
        "lamp": {"type": "sphere", "center": where, "radius": 0.4 * radius, "emitter": glow},
    }
    return load_scene(description, model)


def _unit(*d: float) -> np.ndarray:
    return np.array(d) / np.linalg.norm(d)


def _bunny(folder: Path) -> dict[str, Any]:
    """The bunny with a mosaic as an attribute of its vertices."""
    import mitsuba as mi

    mesh = mi.load_dict({"type": "ply", "filename": str(BUNNY)})
    p = np.array(mi.traverse(mesh)["vertex_positions"], dtype=float).reshape(-1, 3)
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


def _ball() -> dict[str, Any]:
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
    """The figure as PDF and PNG, the page to flip between the images, and the numbers as a table."""
    import pandas

    scenes = {thing: _shots(results, thing) for thing in THINGS}
    rows = [{"thing": n, "model": s.label, **s.numbers} for n, shots in scenes.items() for s in shots[1:]]
    with paper():
        files: dict[str, bytes | str] = {f"textures.{end}": data for end, data in saved(image_grid(scenes)).items()}
    files["textures.csv"] = pandas.DataFrame(rows).to_csv(index=False, lineterminator="\n")
    files["textures.html"] = page("Media by textures", scenes, notes=NOTES)
    return files


def _shots(results: Mapping[str, Result], thing: str) -> list[Shot]:
    """The images of a thing, exposed alike; with the mean of each over that of the walks."""
    truth = results[f"{thing}, path traced"]
    reference = truth.images["image"]
    mask = reference.max(axis=2) > 0
    gain = np.float32(2.0 ** stops_of(reference, mask))
    error = noise_of(reference, truth.images["variance"], mask)
    shots = [Shot("Path traced", gain * reference, {"standard error": error})]
    for model in MODELS:
        image = results[f"{thing}, {model}"].images["image"]
        numbers = {"mean over path traced": float(image[mask].mean() / reference[mask].mean())}
        shots.append(compared(label(model), gain * image, gain * reference, mask=mask, numbers=numbers))
    return shots
