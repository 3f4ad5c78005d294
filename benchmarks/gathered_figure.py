"""The figure `gathered`: a bunny walked, by a model sampled and gathered, and walked to precomputed light."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING

import numpy as np

from benchmarks.timed import power_of_two, rendered
from figures.computing.contenders import NOTE, against, gathered_anew, long_reference, reference_shot
from figures.computing.images import FLIP, Shot
from figures.computing.learnt import CHUNKS, FULL_GEOMETRY, train_scan, training_of, with_weights
from figures.computing.scans import BUNNY, prepare, scan_scene
from figures.drawing.image_grid import image_files
from figures.parts.part import Part, Result, Row, Task
from full_geometry.scenes.scene_files import PATH_TRACED, load_scene
from halfspace_sss.backend import clock

if TYPE_CHECKING:
    import mitsuba as mi

TITLE = "walked, sampled, gathered, and walked with light precomputed, in equal time"
MATERIALS = ("marble",)
LIGHTS = "both"
WAYS = {
    "walked": (PATH_TRACED, "sampled"),
    "sampled": (FULL_GEOMETRY, "sampled"),
    "gathered": (FULL_GEOMETRY, "gathered"),
    "precomputed": (PATH_TRACED, "precomputed"),
}
SIZES = {"draft": 128, "paper": 384}
SECONDS = {"draft": 3.0, "paper": 20.0}  # of the processor, all cores together
TRUTH_SPP = {"draft": 128, "paper": 1024}
PASSES, PILOT = 8, 2  # of an image, at least; samples of a pixel by which the time of others is foreseen
NOTES = (
    "All had the same seconds of the processor, compilation and the training of `full_geometry` left out, the "
    "gathering and the precomputation of light counted. Walked with light sampled, then with unscattered light inside "
    f"precomputed (last). FLIP of the pixels of the object. {NOTE}"
)


def parts(quality: str) -> list[Part]:
    """For each material the object learnt, a long walk, then what every way makes of the time."""
    size, spp, results = SIZES[quality], TRUTH_SPP[quality], []
    for material in MATERIALS:
        common = {"material": material, "size": size, "lights": LIGHTS}
        params = {**common, "spp": spp, "seed": 0}
        results.append(Part(f"{material}, truth", long_reference, params, spp * size**2, inputs=(BUNNY,)))
        results.append(train_scan(material, material, CHUNKS[quality]))
        params = {**common, "seconds": SECONDS[quality], "seed": 1}
        needs = (training_of(material),)
        results.append(Part(f"{material}, equal time", in_time, params, len(WAYS) * SECONDS[quality], needs, (BUNNY,)))
    return results


def in_time(task: Task) -> dict[str, object]:
    """What each way makes of the same time."""
    prepare()
    p, found, numbers = task.params, {}, {}
    with with_weights(task.folder, task.needed):
        for way, (model, light) in WAYS.items():

            def load(model: str = model, light: str = light) -> mi.Scene:
                description = scan_scene(p["material"], p["size"], p["lights"])
                return load_scene(description, model, settings={"light": light})

            found[way], numbers[way] = _passes(load, p["seconds"], p["seed"], light)
    return {**found, "ways": numbers}


def _passes(load: Callable[[], mi.Scene], seconds: float, seed: int, light: str) -> tuple[np.ndarray, Row]:
    """The mean of passes that take so long, light gathered or precomputed anew among it, and their numbers."""
    scene = load()
    rendered(scene, PILOT, seed, 0)  # compiles
    gathering, started = gathered_anew(scene) if light == "gathered" else 0.0, clock()
    rendered(scene, PILOT, seed, 1)
    spp = power_of_two(PILOT * (seconds - gathering) / PASSES / (clock() - started))
    rendered(scene, spp, seed, 2)  # compiles for that number
    if light == "precomputed":
        scene = load()  # whose first pass makes the cells
    images, started = [], clock()
    while not images or (clock() - started) * (1 + 0.5 / len(images)) < seconds - gathering:
        images.append(rendered(scene, spp, seed, 3 + len(images))[0])
    took = gathering + clock() - started
    image = np.mean(images, axis=0, dtype=np.float64).astype(np.float32)
    return image, {"spp": spp * len(images), "seconds": took, "seconds of gathering": gathering}


def draw(results: Mapping[str, Result]) -> dict[str, bytes | str]:
    """The figure as PDF and PNG, the page to flip between the images, and the numbers as a table."""
    scenes = {material: _shots(results, material) for material in MATERIALS}
    rows = [{"material": name, "way": s.label, **s.numbers} for name, shots in scenes.items() for s in shots[1:]]
    return image_files("gathered", TITLE.capitalize(), scenes, rows, NOTES, printed=(FLIP, "spp"))


def _shots(results: Mapping[str, Result], material: str) -> list[Shot]:
    """The images of a material, exposed alike."""
    equal = results[f"{material}, equal time"]
    reference = reference_shot(results[f"{material}, truth"])
    shots = [reference[0]]
    for way, about in equal.numbers["ways"].items():
        title = f"{way.capitalize()}, {about['seconds']:.2g} s"
        shots.append(against(reference, title, equal.images[way], **{**about, "spp": str(about["spp"])}))
    return shots
