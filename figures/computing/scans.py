"""The scenes of the figures: one object, a small light and surroundings; environment maps; long renders of them."""

from __future__ import annotations

import gc
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from figures.parts.part import SceneDict, Task
from figures.parts.runner import read_exr
from halfspace_sss.checks import check_choice
from halfspace_sss.provenance import check_folder

if TYPE_CHECKING:
    import mitsuba as mi

BUNNY = Path(__file__).parent.parent / "assets" / "bunny.ply"
DRAGON = BUNNY.with_name("dragon.ply")
MM_PER_UNIT = 3.8  # the bunny is 37 mm tall
MATERIALS = ("marble", "apple", "potato", "ketchup", "regular chocolate milk")
VARIANTS = ("llvm_ad_rgb", "cuda_ad_rgb")
LIGHTS = ("both", "small light", "even sky")


class Scan(NamedTuple):
    """A scanned object: its mesh, millimetres of its unit, where it is looked at, and its scale against the bunny."""

    file: Path
    mm_per_unit: float
    centre: tuple[float, float, float]
    scale: float


SCANS = {"bunny": Scan(BUNNY, MM_PER_UNIT, (-0.55, 4.7, 0), 1.0), "dragon": Scan(DRAGON, 21.0, (0, 0, 0), 0.1)}
_EYE, _LAMP = (6.55, 4.3, 24), (-13.45, 9.3, -9)  # from what is looked at, units of the bunny


def prepare() -> None:
    """Set the variant of Mitsuba that the figures use unless it is one of `VARIANTS`, and register the plugins.
    Scenes of earlier parts are freed, so that the objects of the next get their numbers, and it their kernels."""
    import mitsuba as mi

    import full_geometry

    if mi.variant() not in VARIANTS:
        mi.set_variant(VARIANTS[0])
    full_geometry.register()
    gc.collect()


def scan_scene(material: str, size: int, lights: str = "both", scan: str = "bunny") -> SceneDict:
    """A translucent object on its own, as a dict for `scenes.scene_files.load_scene`, under its name.

    Args:
        size: pixels of the square image.
        lights: "both" for the small light and dim surroundings with two windows, "small light", or "even sky",
            radiance 1 from everywhere.
        scan: name in `SCANS`.

    Raises:
        ValueError: scan or lights is something else.
    """
    import mitsuba as mi

    check_choice("scan", scan, SCANS)
    check_choice("lights", lights, LIGHTS)
    result = SCANS[scan]
    view = mi.ScalarTransform4f().look_at(_beside(result, _EYE), list(result.centre), [0, 1, 0])
    film = {"type": "hdrfilm", "width": size, "height": size, "rfilter": {"type": "box"}}
    scene: SceneDict = {
        "type": "scene",
        "integrator": {"type": "bssrdf", "mm_per_unit": result.mm_per_unit, "hide_emitters": True},
        "sensor": {"type": "perspective", "fov": 26.0, "to_world": view, "film": film},
        scan: {
            "type": "ply",
            "filename": str(result.file),
            "bsdf": {"type": "translucent", "material": material, "model": "neural"},
        },
    }
    if lights != "even sky":
        glow = {"type": "area", "radiance": {"type": "rgb", "value": [90.0, 84.0, 75.0]}}
        lamp = {"center": _beside(result, _LAMP), "radius": 1.6 * result.scale}
        scene["lamp"] = {"type": "sphere", **lamp, "emitter": glow}
    if lights == "even sky":
        scene["sky"] = {"type": "constant", "radiance": 1.0}
    elif lights == "both":
        scene["sky"] = {"type": "envmap", "bitmap": mi.Bitmap(surroundings()), "scale": 1.0}
    return scene


def _beside(scan: Scan, offset: tuple[float, float, float]) -> list[float]:
    """A point of the bunny's scene in that of a scan."""
    return [c + scan.scale * d for c, d in zip(scan.centre, offset)]


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


ENVIRONMENTS = ("studio", "sunset", "forest")


def environment_file(name: str) -> Path:
    """The file of an environment map, for `Part.inputs`; ValueError if there is none of that name."""
    check_choice("environment", name, ENVIRONMENTS)
    return Path(__file__).parents[1] / "assets" / f"{name}.exr"


def environment(name: str, scale: float = 1.0, turn: float = 0.0) -> SceneDict:
    """An environment map as an emitter for `mitsuba.load_dict`. `name`: "studio" (two lamps in a dark hall), "sunset"
    (a square by the sea, the sun just below the horizon) or "forest" (a clearing by day). `scale`: of its radiance.
    `turn`: about y, degrees. ValueError if there is none of that name."""
    import mitsuba as mi

    image = np.maximum(read_exr(environment_file(name))[..., :3], 0)  # the file has negative pixels
    to_world = mi.ScalarTransform4f().rotate([0, 1, 0], turn)
    return {"type": "envmap", "bitmap": mi.Bitmap(image), "scale": scale, "to_world": to_world}


SEEDS_APART = 10_000  # of the halves of an image; passes count up from the first seed


def long_render(task: Task, scene: mi.Scene, spp_per_pass: int, passes: int, half: int = 0) -> dict[str, object]:
    """The image of a scene with its variance, seconds and samples; what is done of it is kept in the task's folder.
    `task`: whose parameter "seed" is that of the first pass. `spp_per_pass`, `passes`: samples per pixel of each pass,
    and their number. `half`: 1 for another image of other random numbers."""
    from full_geometry.scenes import reference

    result = reference.render(
        scene,
        check_folder(task.folder) / f"passes{half}.exr",
        spp_per_pass=spp_per_pass,
        seed=task.params["seed"] + half * SEEDS_APART,
        passes=passes,
        progress=lambda so_far: task.progress(so_far.passes, passes),
    )
    image, variance = (v[..., :3].astype(np.float32) for v in (result.mean, result.variance))
    return {"image": image, "variance": variance, "seconds": result.seconds, "spp": result.spp}
