"""Light that goes straight through boundaries of index 1 to emitters."""

from __future__ import annotations

from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rendered import independent

mi = pytest.importorskip("mitsuba")
from benchmarks.mitsuba_media import with_media  # noqa: E402

pytestmark = pytest.mark.usefixtures("rgb")

WIDEST_Z = 5.0
UNIT, N, RUNS = 1.2, 4, 12
MEDIUM = {"sigma_t": "0.5,0.3,0.4", "albedo": "0.9,0.8,0.5", "g": 0.3, "eta": 1.0}
LIGHTS = {
    "lamp": {"type": "sphere", "center": [30, 3, 4], "radius": 1.0, "emitter": {"type": "area", "radiance": 300.0}},
    "point": {"type": "point", "position": [12, 2, 3], "intensity": 200.0},
    "sky": {"type": "constant", "radiance": 0.5},
}


def _blocks(path: Path) -> dict[str, Any]:
    """One object of two blocks side by side, so that light passes through one on its way to the other."""
    lines, faces = [], ("1 3 4", "1 4 2", "5 6 8", "5 8 7", "1 2 6", "1 6 5", "3 7 8", "3 8 4", "1 5 7", "1 7 3",
                        "2 4 8", "2 8 6")  # fmt: skip
    for block, x in enumerate((-3.0, 3.0)):
        corners = product((-2, 2), (-3, 3), (x - 2, x + 2))
        lines += [f"v {a} {b} {c}" for c, b, a in corners]
        lines += ["f " + " ".join(str(int(i) + 8 * block) for i in face.split()) for face in faces]
    path.write_text("\n".join(lines))
    return {"type": "obj", "filename": str(path), "face_normals": True}


def _scene(shape: dict[str, Any], lights: tuple[str, ...], surface: dict[str, Any], **how: Any) -> dict[str, Any]:
    film = {"type": "hdrfilm", "width": N, "height": N, "rfilter": {"type": "box"}, "component_format": "float32",
            "pixel_format": "rgb"}  # fmt: skip
    view = mi.ScalarTransform4f().look_at([-5, 8, 50], [0, 0, 0], [0, 1, 0])
    return {
        "type": "scene", "integrator": {"type": "translucent_walk", "mm_per_unit": UNIT, "light": "sampled", **how},
        "sensor": {"type": "perspective", "fov": 12.0, "to_world": view, "film": film},
        **{name: LIGHTS[name] for name in lights}, "object": {**shape, "bsdf": {"type": "translucent", **surface}},
    }  # fmt: skip


def _means(scene: Any, spp: int, seed: int) -> np.ndarray:
    """Of the left and the right half of the image, shape (runs, 2, 3)."""
    return independent(scene, RUNS, spp, seed).reshape(RUNS, N, 2, N // 2, 3).mean(axis=(1, 3))


def _agree(found: np.ndarray, wanted: np.ndarray, known_to: float) -> None:
    error = np.sqrt((found.var(axis=0, ddof=1) + wanted.var(axis=0, ddof=1)) / RUNS)
    mean = wanted.mean(axis=0)
    assert (np.abs(found.mean(axis=0) - mean) < WIDEST_Z * error).all()
    assert (error < known_to * mean).all()


@pytest.mark.parametrize(
    ("lights", "known_to"), [(("lamp", "sky"), 0.01), pytest.param(("point",), 0.04, marks=pytest.mark.slow)]
)
def test_images_of_an_object_that_shades_itself_agree_with_the_volume_path_tracer_of_mitsuba(
    lights: tuple[str, ...], known_to: float, tmp_path: Path
) -> None:
    scene = _scene(_blocks(tmp_path / "blocks.obj"), lights, MEDIUM)
    theirs = with_media(scene, UNIT, {"type": "volpathmis", "max_depth": -1, "rr_depth": 1000})
    _agree(_means(mi.load_dict(scene), 512, 1), _means(theirs, 512, 1001), known_to)


@pytest.mark.slow
def test_a_limit_of_depth_that_no_path_meets_changes_no_mean(tmp_path: Path) -> None:
    """Of the lit side: with a limit, light that passes the object again is found by chance."""
    scenes = [_scene(_blocks(tmp_path / "blocks.obj"), ("lamp",), MEDIUM, **how) for how in ({}, {"max_depth": 1000})]
    free, limited = (_means(mi.load_dict(scene), 256, seed) for seed, scene in enumerate(scenes))
    _agree(limited[:, 1:], free[:, 1:], 0.03)


def test_a_white_medium_whose_channels_scatter_unlike_is_as_bright_as_its_sky() -> None:
    """Of an environment map, which is sampled: a `constant` one is left to chance."""
    surface = {"sigma_t": "0.6,0.3,0.2", "albedo": 1.0, "g": "0,0.5,-0.4", "eta": 1.0}
    scene = _scene({"type": "sphere", "radius": 6.0}, (), surface)
    scene["sky"] = {"type": "envmap", "bitmap": mi.Bitmap(np.full((4, 8, 3), 0.5, np.float32))}
    images = _means(mi.load_dict(scene), 256, 3)
    error = images.std(axis=0, ddof=1) / np.sqrt(RUNS)
    assert (np.abs(images.mean(axis=0) - 0.5) < WIDEST_Z * error + 1e-6).all()
    assert (error < 0.005).all()


@pytest.mark.slow
def test_a_texture_of_one_colour_is_as_bright_as_the_colour() -> None:
    """Light that passes the object again took another medium there, so that it is left to chance."""
    colour = np.full((2, 2, 3), [0.9, 0.8, 0.5], np.float32)
    texture = {"type": "bitmap", "bitmap": mi.Bitmap(colour), "raw": True}
    ball = {"type": "sphere", "radius": 4.0}
    found, wanted = (
        _means(mi.load_dict(_scene(ball, ("lamp",), {**MEDIUM, "albedo": albedo})), 256, seed)
        for seed, albedo in enumerate((texture, MEDIUM["albedo"]))
    )
    _agree(found, wanted, 0.03)
