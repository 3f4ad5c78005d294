"""References that models are compared with.

They are path traced images of two halves, denoised, with what FLIP tells of their noise.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from figures.computing.images import FLIP, Shot, compared, noise_of, stops_of
from figures.computing.scans import long_render, prepare, scan_scene
from figures.parts.part import Result, Task
from full_geometry.trade.denoising import check_denoiser, cover, denoised, guides
from full_geometry.transport.models import model_names
from halfspace_sss.backend import clock

if TYPE_CHECKING:
    import mitsuba as mi

MODELS = ("standard_dipole", "better_dipole", "directional_dipole", "photon_beam_diffusion", "neural")
OF_OBJECTS = tuple(name for name in ("neural_shape", "full_geometry") if name in model_names())
WALK = "translucent_walk"
LONG_PASS = 32  # samples per pixel of a pass of the long render
COMPILING = 2  # samples per pixel of a render that is not timed: a power of two has the kernels of all others


def gathered_anew(scene: mi.Scene) -> float:
    """Gather the light of a scene by `bssrdf` as if it never had been; the CPU seconds that takes."""
    started = clock()
    scene.integrator().gathering = type(scene.integrator().gathering)()
    scene.integrator().prepare(scene)
    return clock() - started


def long_walk(task: Task) -> dict[str, object]:
    """A long image by our walk: what the other images are compared with.
    Its passes, of which each has an eighth of the samples at most, survive an interruption. The parameters of the task
    are material, size, lights, spp and seed."""
    each = min(max(task.params["spp"] // 8, 1), LONG_PASS)
    return long_render(task, _walked(task), each, max(task.params["spp"] // each, 2))


def _walked(task: Task) -> mi.Scene:
    """The scene of a scanned object by our walk, made ready."""
    from full_geometry.scenes.scene_files import PATH_TRACED, load_scene

    prepare()
    p = task.params
    return load_scene(scan_scene(p["material"], p["size"], p["lights"]), PATH_TRACED)


# ---- References ----

SPP_PER_PASS = 32
NOTE = (
    "The reference is path traced and denoised by Open Image Denoise, led by albedo and normals of the object. FLIP "
    "below it is between its two halves, each denoised from half of the samples: more than the noise that is left."
)


def reference_image(task: Task, scene: mi.Scene, alone: mi.Scene | None = None) -> dict[str, object]:
    """The path traced image of a scene without its noise, and how far two halves of its samples are apart.
    `task`: whose parameters "spp" and "seed" are those of the image; what is done of it is kept in its folder. `scene`:
    Mitsuba scene with an integrator that traces paths. `alone`: the scene with nothing but the object, whose pixels
    count; by default all that is there counts."""
    check_denoiser()  # before time is spent
    spp = task.params["spp"] // 2
    each = min(SPP_PER_PASS, max(spp // 2, 1))
    halves = [long_render(task, scene, each, max(spp // each, 2), half) for half in (0, 1)]
    covered, about = cover(alone or scene), guides(scene)
    seen = covered if alone is None else cover(scene)
    raw = np.mean([half["image"] for half in halves], axis=0)

    def clean(image: np.ndarray) -> np.ndarray:
        return denoised(np.maximum(image, 0), *about)[0] * (seen > 0)[..., None]

    image, first, second = clean(raw), *(clean(half["image"]) for half in halves)
    mask = covered > 0.5
    variance = 0.25 * (halves[0]["variance"] + halves[1]["variance"])
    numbers = {"standard error": noise_of(raw, variance, mask), "halves": _apart(image, first, second, mask)}
    for key in ("seconds", "spp"):
        numbers[key] = sum(half[key] for half in halves)
    return {"image": image.astype(np.float32), "cover": covered, **numbers}


def long_reference(task: Task) -> dict[str, object]:
    """`reference_image` of a scanned object; the parameters are material, size, lights, spp, seed and any scan."""
    return reference_image(task, _walked(task))


def _apart(image: np.ndarray, first: np.ndarray, second: np.ndarray, mask: np.ndarray) -> float:
    """FLIP between the halves of an image, at its exposure."""
    gain = np.float32(2.0 ** stops_of(image, mask))
    return compared("second", gain * second, gain * first, mask=mask).numbers[FLIP]


def reference_shot(result: Result, label: str = "Path traced") -> tuple[Shot, np.ndarray, float]:
    """The reference exposed as it is shown, the mask of the pixels that count, and the stops.
    `result`: of a part that gave `reference_image`."""
    image, mask = result.images["image"], result.images["cover"] > 0.5
    stops = stops_of(image, mask)
    apart = f"{result.numbers['halves']:.3f}"  # text: it is no model that could be the best
    numbers = {FLIP: apart, **{key: result.numbers[key] for key in ("standard error", "spp")}}
    return Shot(label, np.float32(2.0**stops) * image, numbers), mask, stops


def against(reference: tuple[Shot, np.ndarray, float], label: str, image: np.ndarray, **numbers: float | str) -> Shot:
    """An image beside a reference, exposed alike.
    `reference`: as `reference_shot` gives it. `label`: of the model or method. `image`: linear radiance, not exposed.
    `numbers`: further columns."""
    shot, mask, stops = reference
    return compared(label, np.float32(2.0**stops) * image, shot.image, mask=mask, numbers=numbers)
