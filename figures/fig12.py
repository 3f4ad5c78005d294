"""Fig. 12: one sample a pixel with and without sampling that has learnt, against the converged image."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from figures.computing.contenders import reference_image
from figures.computing.images import FLIP, Shot, compared, stops_of
from figures.computing.learnt import bunny_of_potato
from figures.computing.scans import BUNNY, prepare, scan_scene
from figures.drawing.image_grid import image_files
from figures.parts.part import Params, Part, Result, Task
from halfspace_sss.neural.store import weights_in

if TYPE_CHECKING:
    import mitsuba as mi

TITLE = "one sample a pixel, with and without sampling that has learnt"
SIZES = {"draft": 128, "paper": 384}
SECONDS = {"draft": 6, "paper": 60}  # CPU time of the training
REFERENCE_SPP = {"draft": 128, "paper": 512}
LIGHTS = {"both": "lamp and windows", "small light": "small light"}  # under an even sky little is left to be drawn
SHOWN = {"draft": ("small light",), "paper": tuple(LIGHTS)}
SAMPLERS = ("probes", "patches")
ENTRIES = (1, 8)  # points of entry of an exit
NOTES = (
    "The same network in all images, one path a pixel; the images differ in how points of entry are drawn: probes that "
    "follow the half-space, or learnt weights of patches. One of N entries of an exit is followed. Gathered "
    "light takes the sum over entries. FLIP and relative squared error against many samples by patches, denoised by "
    "Open Image Denoise; FLIP below these is between two halves of them."
)


def parts(quality: str) -> list[Part]:
    """All images of each light; the training is done once for each."""
    size, seconds = SIZES[quality], SECONDS[quality]
    params = {"size": size, "seconds": seconds, "spp": REFERENCE_SPP[quality], "seed": 0}
    params["lights"] = list(SHOWN[quality])
    return [Part("bunny", rendered, params, seconds + REFERENCE_SPP[quality] * size**2 * 1e-6, inputs=(BUNNY,))]


def rendered(task: Task) -> dict[str, object]:
    """The images of all samplers and numbers of entries under all lights, by gathered light, and the converged ones."""
    prepare()
    p, results, done = task.params, {}, 0
    folders = _weights(task)
    total = len(p["lights"]) * (1 + len(SAMPLERS) * len(ENTRIES))
    for light in p["lights"]:
        with weights_in(folders["patches"]):
            long = reference_image(replace(task, folder=task.folder / _key(light)), _scene(p, light))
        results[_key(light, "converged")] = long["image"]
        results[_key(light, "halves")] = long["halves"]
        results[_key(light, "gathered")] = _image(folders["patches"], p, light, 1, gathered=True)
        for sampler in SAMPLERS:
            for n in ENTRIES:
                results[_key(light, sampler, n)] = _image(folders[sampler], p, light, n)
                done += 1
                task.progress(done, total)
    return results


def _key(*words: object) -> str:
    """Of an image in the result."""
    return "-".join(str(word).replace(" ", "_") for word in words)


def _weights(task: Task) -> dict[str, Path]:
    """A folder of weights for each sampler, of one training, without patches and with them."""
    from full_geometry.learning.training import train_unattended
    from full_geometry.objects.objects import object_of
    from full_geometry.transport.storing import CENTRES, KIND
    from halfspace_sss.neural.store import load_weights, save_weights

    p, folders = task.params, {name: task.folder / name for name in SAMPLERS}
    obj = object_of(*bunny_of_potato())
    path = train_unattended(obj, folders["patches"], cpu_seconds=p["seconds"], seed=p["seed"]).path
    arrays, record = load_weights(path, KIND)
    of_patches = {CENTRES} | {name for name in arrays if name.startswith(("V_", "c_"))}
    bare = {name: value for name, value in arrays.items() if name not in of_patches}
    save_weights(folders["probes"] / path.name, KIND, bare, record)
    return folders


def _image(folder: Path, p: Params, light: str, entries: int, gathered: bool = False) -> np.ndarray:
    """The image of one path a pixel with the weights of a folder, light sampled or gathered."""
    import mitsuba as mi

    with weights_in(folder):
        scene = _scene(p, light, entries, "gathered" if gathered else "sampled")
        return np.array(mi.render(scene, spp=1, seed=7), dtype=np.float32)


def _scene(p: Params, light: str, entries: int = 1, gathering: str = "sampled") -> mi.Scene:
    """The bunny, orders from two on."""
    from full_geometry.scenes.scene_files import load_scene

    description = scan_scene("potato", p["size"], light)
    description["integrator"] |= {"entries": entries, "light": gathering}
    description["bunny"]["bsdf"]["orders"] = "multiple"
    return load_scene(description, "full_geometry")


def draw(results: Mapping[str, Result]) -> dict[str, bytes | str]:
    """The figure as PDF and PNG, the page to flip between the images, and the numbers as a table."""
    images, numbers, scenes, rows = results["bunny"].images, results["bunny"].numbers, {}, []
    for light in (name for name in LIGHTS if _key(name, "converged") in images):
        reference = np.maximum(images[_key(light, "converged")], 0)
        mask = reference.max(axis=2) > 0
        gain = np.float32(2.0 ** stops_of(reference, mask))
        shots = [Shot("Converged", gain * reference, {FLIP: f"{numbers[_key(light, 'halves')]:.3f}"})]
        labels = {(sampler, n): f"{sampler.capitalize()}, N = {n}" for n in ENTRIES for sampler in SAMPLERS}
        for (sampler, *n), label in {**labels, ("gathered",): "Gathered light"}.items():
            image = images[_key(light, sampler, *n)]
            shots.append(compared(label, gain * image, gain * reference, mask=mask, numbers={}))
            rows.append({"light": light, "sampler": sampler, "N": n[0] if n else None, **shots[-1].numbers})
        scenes[LIGHTS[light]] = shots
    return image_files("fig12", "Fig. 12: one sample a pixel", scenes, rows, NOTES)
