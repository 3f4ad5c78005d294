"""Pictures of the worst held-out objects: path traced, by the network of all shapes, by the best half-space model."""

from __future__ import annotations

import tempfile
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np

from figures.studies.shape_errors import Case, Row, held_out
from halfspace_sss.progress import NamedProgress

WORST = 10
SIZE, SPP, WALKED_SPP, GAP = 96, 64, 256, 4
DISTANCE, FOV = 4.0, 28.0  # of the camera, radii of the object
BRIGHT = 97  # percentile of the path-traced object that is shown white


def worst_pictures(rows: Sequence[Row], progress: NamedProgress | None = None) -> np.ndarray:
    """The objects with the largest errors under constant light: a row of three images for each, worst first.

    All scattering orders, half a sky from the left; each row exposed by its path-traced image.

    Args:
        rows: the errors of `cases.held_out(len(rows))`, in order.
        progress: called with (what, done, total).

    Returns:
        Radiance (height, width), 1 where it is white.
    """
    worst = sorted(range(len(rows)), key=lambda k: -rows[k].of("neural_shape"))[:WORST]
    objects = {k: case for k, case in enumerate(held_out(max(worst) + 1)) if k in worst}
    lines = []
    for done, k in enumerate(worst):
        if progress:
            progress("pictures", done, len(worst))
        models = ("path_traced", "neural_shape", rows[k].best()[0])
        images = [picture(objects[k], model) for model in models]
        lit = images[0][images[0] > 0]
        white = float(np.percentile(lit, BRIGHT)) if lit.size else 1.0
        lines.append(
            np.concatenate([np.pad(np.minimum(v / white, 1), GAP // 2, constant_values=1) for v in images], axis=1)
        )
    return np.concatenate(lines)


def picture(case: Case, model: str, size: int = SIZE) -> np.ndarray:
    """Radiance (size, size) of an object by a model, or "path_traced", under half a sky from the left."""
    from halfspace_sss.rendering.scenes.scene_files import load_scene

    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of sizes: they are what is shown
        scene = load_scene(_scene(case, Path(folder) / "object.ply", size), model)
        image = mi.render(scene, spp=WALKED_SPP if model == "path_traced" else SPP, seed=1)
    return np.maximum(np.array(image, dtype=float).reshape(size, size, -1).mean(axis=2), 0)


def _scene(case: Case, path: Path, size: int) -> dict[str, Any]:
    shape, m = case.subject.object.shape, case.subject.media[0]
    shape.write_ply(str(path))
    box = shape.bbox()
    centre, radius = np.array(box.center()).ravel(), 0.5 * float(np.linalg.norm(np.array(box.extents()).ravel()))
    eye = centre + DISTANCE * radius * np.array([0.25, 0.3, 0.92])
    film = {"type": "hdrfilm", "width": size, "height": size, "pixel_format": "luminance", "rfilter": {"type": "box"}}
    pixels = np.zeros((16, 32, 3), np.float32)
    pixels[:, :16] = 1
    return {
        "type": "scene",
        "integrator": {"type": "bssrdf", "hide_emitters": True},
        "sensor": {
            "type": "perspective", "fov": FOV,
            "to_world": mi.ScalarTransform4f().look_at(list(eye), list(centre), [0, 1, 0]),
            "film": film,
        },
        "light": {"type": "envmap", "bitmap": mi.Bitmap(pixels)},
        "object": {
            "type": "ply", "filename": str(path),
            "bsdf": {
                "type": "translucent", "model": "neural", "sigma_s": float(m.sigma_s), "sigma_a": float(m.sigma_a),
                "g": float(m.g), "eta": m.eta,
            },
        },
    }  # fmt: skip
