"""Ways to render a scanned object: Mitsuba's volume path tracer, our own walk, and the models, each ready to render.

References are path traced images of two halves, denoised, with what FLIP tells of their noise.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from figures.computing.images import FLIP, Shot, compared, noise_of, stops_of
from figures.computing.scans import long_render, prepare, scan_scene
from figures.parts.part import Result, SceneDict, Task
from full_geometry.trade.denoising import check_denoiser, cover, denoised, guides
from full_geometry.transport.models import model_names
from halfspace_sss import bssrdf
from halfspace_sss.physics.medium import Medium

if TYPE_CHECKING:
    import mitsuba as mi

MODELS = ("standard_dipole", "better_dipole", "directional_dipole", "photon_beam_diffusion", "neural")
OF_OBJECTS = tuple(name for name in ("neural_shape", "full_geometry") if name in model_names())
WALK = "translucent_walk"
RR_DEPTHS = (5, 64, 200, 1024)
LONG_PASS = 32  # samples per pixel of a pass of the long render
_VOLUME = "volpathmis"


def volume(rr_depth: int) -> str:
    """Name of Mitsuba's volume path tracer with Russian roulette from the given number of vertices on."""
    return f"{_VOLUME} {rr_depth}"


VOLUMES = tuple(volume(rr_depth) for rr_depth in RR_DEPTHS)


def contender(
    method: str, material: str, size: int, lights: str, bare: bool = False, sampler: str = "independent",
    scan: str = "bunny",
) -> mi.Scene | tuple[mi.Scene, ...]:  # fmt: skip
    """The scene of a scanned object for a method, see `ready`.
    `method`, `bare`: as in `ready`. `material`, `size`, `lights`, `sampler`, `scan`: as in
    `figures.computing.scans.scan_scene`. ValueError if there is no such method, material or lights."""
    from halfspace_sss import materials

    description = scan_scene(material, size, lights, scan, sampler)
    return ready(method, description, scan, materials.load(material).medium, bare)


def ready(
    method: str, description: SceneDict, name: str, medium: Medium, bare: bool = False
) -> mi.Scene | tuple[mi.Scene, ...]:
    """The Mitsuba scene for a method, or three, one for each channel; `timed.rendered` takes both.

    Mitsuba's media have one phase function for all channels: it is given the channels of others one by one.

    Args:
        method: a name in `VOLUMES`, `WALK`, or a model; `full_geometry` must have been trained.
        description: of the scene, with millimetres of its unit in the integrator; it is changed.
        medium: of the object, 1/mm; of one that varies any with its mean cosine.
        bare: whether a model is left without surface reflection and without the single scattering that it lacks.

    Raises:
        ValueError: no such method.
    """
    from full_geometry.scenes.scene_files import PATH_TRACED, load_scene

    if method in VOLUMES:
        return _volume_scene(description, name, medium, int(method.split()[1]))
    if method == WALK:
        return load_scene(description, PATH_TRACED)
    if not bare:
        return load_scene(description, method)
    description[name]["bsdf"]["reflection"] = False
    return load_scene(description, method, bssrdf(method, medium).orders)


def _volume_scene(description: SceneDict, name: str, medium: Medium, rr_depth: int) -> mi.Scene | tuple[mi.Scene, ...]:
    from full_geometry.scenes.mitsuba_scene import with_media

    integrator = {"type": _VOLUME, "max_depth": -1, "rr_depth": rr_depth, "hide_emitters": True}
    mm_per_unit = description["integrator"].get("mm_per_unit", 1.0)
    if np.ptp(medium.g) == 0:
        return with_media(description, mm_per_unit, integrator)
    results = []
    for channel in medium.channels():
        values = {key: float(getattr(channel, key)) for key in ("sigma_s", "sigma_a", "g", "eta")}
        one = {**description[name], "bsdf": {"type": "translucent", **values}}
        results.append(with_media({**description, name: one}, mm_per_unit, integrator))
    return tuple(results)


def long_walk(task: Task) -> dict[str, object]:
    """A long image by our walk, in passes that survive an interruption: what the other images are compared with.
    The parameters of the task are material, size, lights, spp, seed and, unless it is the bunny, scan."""
    return long_passes(task, _walked(task))


def _walked(task: Task) -> mi.Scene:
    """The scene of a scanned object by our walk, made ready."""
    prepare()
    p = task.params
    return contender(WALK, p["material"], p["size"], p["lights"], scan=p.get("scan", "bunny"))


def long_passes(task: Task, scene: mi.Scene) -> dict[str, object]:
    """`long_render` of the samples per pixel "spp" of a task, in passes that are its eighth at most."""
    each = min(max(task.params["spp"] // 8, 1), LONG_PASS)
    return long_render(task, scene, each, max(task.params["spp"] // each, 2))


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
