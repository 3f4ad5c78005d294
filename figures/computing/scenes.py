"""The scenes of the figures: one object, a small light and surroundings, for any material and model."""

from __future__ import annotations

import gc
from pathlib import Path
from typing import Any

import numpy as np

from halfspace_sss.checks import check_choice

__all__ = ["BUNNY", "MATERIALS", "MM_PER_UNIT", "bunny_scene", "prepare", "surroundings"]

BUNNY = Path(__file__).parent.parent / "assets" / "bunny.ply"
MM_PER_UNIT = 3.8  # the bunny is 37 mm tall
MATERIALS = ("marble", "apple", "potato", "ketchup", "regular chocolate milk")
LIGHTS = ("both", "small light", "even sky")


def prepare() -> None:
    """Set the variant of Mitsuba that the figures use, and register the plugins.

    Scenes of earlier parts are freed, so that the objects of the next get their numbers, and it their kernels.
    """
    import mitsuba as mi

    from halfspace_sss import rendering

    if mi.variant() != "llvm_ad_rgb":
        mi.set_variant("llvm_ad_rgb")
    rendering.register()
    gc.collect()


def bunny_scene(
    material: str, size: int, lights: str = "both", model: str = "neural", sampler: str = "independent"
) -> dict[str, Any]:
    """A translucent bunny on its own, as a dict for `rendering.scene_files.load_scene`.

    Args:
        material: name in the registry.
        size: pixels of the square image.
        lights: "both" for the small light and dim surroundings with two windows, "small light", or "even sky",
            radiance 1 from everywhere.
        model: of the BSSRDF.
        sampler: Mitsuba's plugin of random numbers; "multijitter" has less noise and takes square numbers of samples.

    Raises:
        ValueError: lights is something else.
    """
    import mitsuba as mi

    check_choice("lights", lights, LIGHTS)
    view = mi.ScalarTransform4f().look_at([6, 9, 24], [-0.55, 4.7, 0], [0, 1, 0])
    film = {"type": "hdrfilm", "width": size, "height": size, "rfilter": {"type": "box"}}
    scene: dict[str, Any] = {
        "type": "scene",
        "integrator": {"type": "bssrdf", "mm_per_unit": MM_PER_UNIT, "hide_emitters": True},
        "sensor": {"type": "perspective", "fov": 26.0, "to_world": view, "film": film, "sampler": {"type": sampler}},
        "bunny": {
            "type": "ply",
            "filename": str(BUNNY),
            "bsdf": {"type": "translucent", "material": material, "model": model},
        },
    }
    if lights != "even sky":
        glow = {"type": "area", "radiance": {"type": "rgb", "value": [90.0, 84.0, 75.0]}}
        scene["lamp"] = {"type": "sphere", "center": [-14, 14, -9], "radius": 1.6, "emitter": glow}
    if lights == "even sky":
        scene["sky"] = {"type": "constant", "radiance": 1.0}
    elif lights == "both":
        scene["sky"] = {"type": "envmap", "bitmap": mi.Bitmap(surroundings()), "scale": 1.0}
    return scene


def surroundings(height: int = 64) -> np.ndarray:
    """Radiance from all directions, (height, 2 height, 3): grey, lighter above, with two soft windows."""
    theta = (np.arange(height)[:, None] + 0.5) / height * np.pi
    phi = (np.arange(2 * height)[None, :] + 0.5) / height * np.pi
    image = np.zeros((height, 2 * height, 3)) + 0.12
    image += 0.18 * np.clip(np.cos(theta), 0, 1)[..., None]
    for centre_theta, centre_phi, half_theta, half_phi, radiance in (
        (1.0, 5.2, 0.35, 0.45, (3.2, 3.3, 3.5)),
        (1.2, 2.2, 0.5, 0.25, (1.5, 1.4, 1.2)),
    ):
        inside = _soft(theta, centre_theta, half_theta) * _soft(phi, centre_phi, half_phi)
        image += inside[..., None] * np.array(radiance)
    return image.astype(np.float32)


def _soft(x: np.ndarray, centre: float, half: float) -> np.ndarray:
    """1 inside, 0 outside, with an edge of 0.1."""
    return np.clip((half - np.abs(x - centre)) / 0.1 + 0.5, 0, 1)
