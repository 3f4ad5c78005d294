"""The trade of speed for accuracy: three materials, two shapes and two lights by walks, models and gathered light."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from pathlib import Path
from tempfile import TemporaryDirectory

import mitsuba as mi
import numpy as np

from benchmarks.closed_shapes import write_shape
from benchmarks.trade_tables import markdown, multiples, trade_table
from figures.computing.contenders import OF_OBJECTS
from figures.computing.learnt import CHUNKS, FULL_GEOMETRY, train_scan, training_of, weight_files, with_weights
from figures.computing.scans import BUNNY, MM_PER_UNIT, prepare, scan_scene
from figures.drawing.page import page
from figures.drawing.trade_plot import image_shots
from figures.parts.part import Params, Part, Result, SceneDict, Task
from full_geometry.trade.results import Assessment
from full_geometry.trade.techniques import CORRECTED, GATHERED, LAMBERT, READY_FIRST, WALKED, Technique
from halfspace_sss import materials
from halfspace_sss.comparison.style import paper, saved

TITLE = "bias against time to a given noise, for every way of rendering"
MATERIALS = ("marble", "potato", "ketchup")
SHAPES = ("bunny", "spikes")
LIGHTS = {"sky": "even sky", "small light": "small light"}
ALL = tuple((material, shape, light) for material in MATERIALS for shape in SHAPES for light in LIGHTS)
SCENES = {  # a draft has both lights, a dense material and a shape that nothing learnt; it tells little of small lights
    "draft": (("marble", "bunny", "sky"), ("potato", "bunny", "small light"), ("potato", "spikes", "sky")),
    "paper": ALL,
}
SECONDS = {"draft": 4.0, "paper": 60.0}  # second halves of gathered light, of 5 to 20 s each, count in it
SIZE = {"draft": 64, "paper": 128}
SPP = {"draft": 16, "paper": 32}
TOLERANCE = 0.05
NETWORKS = ("neural", "neural_shape")
LEARNT = (*NETWORKS, FULL_GEOMETRY)
WAYS = (
    *(each.name for each in WALKED), LAMBERT, "standard_dipole_normalized", "better_dipole", "photon_beam_diffusion",
    *LEARNT, *(f"{model}, {GATHERED}" for model in ("better_dipole", *LEARNT)), f"{READY_FIRST}, {CORRECTED}",
)  # fmt: skip
FEW = (*(each.name for each in WALKED), LAMBERT, *LEARNT, f"{READY_FIRST}, {CORRECTED}")
CHOSEN = {"draft": FEW, "paper": WAYS}


def parts(quality: str) -> list[Part]:
    """The bunny's training for each material, then a scene each; the spikes are not learnt, as a new object."""
    results = []
    for material in MATERIALS:
        scenes = [scene for scene in SCENES[quality] if scene[0] == material]
        if not scenes:
            continue
        medium = materials.load(material).medium
        inputs = (BUNNY, *(f for model in NETWORKS for f in weight_files(model, medium)))
        learns = FULL_GEOMETRY in OF_OBJECTS
        if learns:
            results.append(train_scan(material, material, CHUNKS[quality]))
        for _, shape, light in scenes:
            needs = (training_of(material),) if learns and shape == "bunny" else ()
            params = {"material": material, "shape": shape, "light": light, "seconds": SECONDS[quality]}
            params |= {"size": SIZE[quality], "spp": SPP[quality], "seed": 0, "ways": list(CHOSEN[quality])}
            results.append(Part(_name(material, shape, light), measured, params, SECONDS[quality], needs, inputs))
    return results


def _name(material: str, shape: str, light: str) -> str:
    return f"{material}, {shape}, {light}"


def measured(task: Task) -> dict[str, object]:
    """The assessment of a scene, and an image by each way, raw."""
    from full_geometry.trade.assessing import assess_stage
    from full_geometry.trade.images import small_images
    from full_geometry.trade.techniques import Effort, stage

    prepare()
    p, learnt = task.params, with_weights(task.folder, task.needed)
    with TemporaryDirectory() as folder, learnt, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # they are in the notes of the assessment
        on = stage(_scene(p, Path(folder)))
        chosen = [Technique.of(name) for name in p["ways"]]

        def tell(what: str, done: int, total: int) -> None:
            task.progress(done, total + 1)

        result = assess_stage(on, chosen, Effort(p["seconds"], seed=p["seed"]), tell)
        named = {row.way for row in result.objects[0].ways if not row.refusal}
        shown = [way for way in chosen if way.name in named and not way.denoised]
        images = small_images(on, shown, 0, p["seed"], p["size"], p["spp"])
    numbered = {f"image_{k}": image for k, image in enumerate(images.values())}
    return {"assessment": result.record(), "seconds": p["seconds"], "shown": list(images), **numbered}


def _scene(p: Params, folder: Path) -> SceneDict:
    """The bunny, or what stands in its place at the same size."""
    scene = scan_scene(p["material"], 512, LIGHTS[p["light"]])
    if p["shape"] != "bunny":
        # 37 mm across as the bunny is tall, in the middle of the picture
        to_world = mi.ScalarTransform4f().translate([-0.55, 4.7, 0]).scale(0.42 / MM_PER_UNIT)
        bsdf = scene.pop("bunny")["bsdf"]
        mesh = folder / "spikes.ply"
        write_shape(mesh, "spikes", (0, 0, 62))
        scene["spikes"] = {"type": "ply", "filename": str(mesh), "to_world": to_world, "bsdf": bsdf}
    return scene


def draw(results: Mapping[str, Result]) -> dict[str, bytes | str]:
    """The figure, the table as CSV and Markdown, and the page to flip between images."""
    result, shots = {}, {}
    for scene in ALL:
        name = _name(*scene)
        if name not in results:
            continue
        assessment = Assessment.from_record(results[name].numbers["assessment"])
        result[scene] = assessment.objects[0]
        shown = enumerate(results[name].numbers["shown"])
        images = {way: np.asarray(results[name].images[f"image_{k}"]) for k, way in shown}
        shots[name] = image_shots(images, assessment)
    table = trade_table(result)
    with paper():
        figure = multiples(result, TOLERANCE)
        files: dict[str, bytes | str] = {f"trade.{ending}": data for ending, data in saved(figure).items()}
    files["trade.csv"] = table.to_csv(index=False, lineterminator="\n", float_format="%.5g")
    seconds = max(results[name].numbers["seconds"] for name in shots)
    files["trade.md"] = markdown(result, seconds)
    files["trade.html"] = page("Speed against accuracy", shots)
    return files
