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
from full_geometry.scenes.scene_files import PATH_TRACED
from full_geometry.trade.results import Assessment
from full_geometry.trade.techniques import GATHERED, LAMBERT, Technique
from halfspace_sss import materials
from halfspace_sss.comparison.style import paper, saved
from halfspace_sss.physics.medium import Medium

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
KNOB_SECONDS = {"draft": 1.0, "paper": 24.0}
SIZE = {"draft": 64, "paper": 128}
SPP = {"draft": 16, "paper": 32}
TOLERANCE = 0.05
NETWORKS = ("neural", "neural_shape")
LEARNT = (*NETWORKS, FULL_GEOMETRY)
WAYS = (
    PATH_TRACED, LAMBERT, "standard_dipole_normalized", "better_dipole", "directional_dipole", "photon_beam_diffusion",
    *LEARNT, *(f"{model}, {GATHERED}" for model in ("better_dipole", *LEARNT)),
)  # fmt: skip
FEW = (
    PATH_TRACED,
    LAMBERT,
    "better_dipole",
    *LEARNT,
    f"{FULL_GEOMETRY}, {GATHERED}",
)
CHOSEN = {"draft": FEW, "paper": WAYS}
KNOB_MATERIALS = {"draft": ("marble",), "paper": ("marble", "ketchup")}
KNOB_WAYS = ("better_dipole", "neural")


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
    for material in KNOB_MATERIALS[quality]:
        params = {"material": material, "shape": "bunny", "light": "small light", "seconds": KNOB_SECONDS[quality]}
        params |= {"seed": 0, "names": list(KNOB_WAYS)}
        results.append(Part(f"{material}, knobs", turned, params, 6 * KNOB_SECONDS[quality], inputs=(BUNNY,)))
    return results


def _name(material: str, shape: str, light: str) -> str:
    return f"{material}, {shape}, {light}"


def measured(task: Task) -> dict[str, object]:
    """The assessment of a scene, and an image by each way."""
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
        shown = [way for way in chosen if way.name in named]
        images = small_images(on, shown, 0, p["seed"], p["size"], p["spp"])
    numbered = {f"image_{k}": image for k, image in enumerate(images.values())}
    return {"assessment": result.record(), "seconds": p["seconds"], "shown": list(images), **numbered}


def turned(task: Task) -> dict[str, object]:
    """What the knobs bring on a scene."""
    from benchmarks.knobs import channel_settings, entry_settings, node_settings, precision_settings
    from full_geometry.trade.techniques import stage

    prepare()
    p = task.params
    on = stage(_scene(p, task.folder))
    settings = entry_settings(on, p["names"], p["seconds"], p["seed"])
    task.progress(1, 3)
    media = materials.load(p["material"]).medium.channels()
    alone = [stage(_scene(p, task.folder, medium)) for medium in media]
    settings += channel_settings(on, alone, p["seconds"], p["seed"])
    task.progress(2, 3)
    settings += node_settings(media[0], seed=p["seed"]) + precision_settings(media[0], seed=p["seed"])
    return {"settings": [{**vars(s), "material": p["material"]} for s in settings]}


def _scene(p: Params, folder: Path, medium: Medium | None = None) -> SceneDict:
    """The bunny, or what stands in its place at the same size; with a scalar medium instead of the material."""
    scene = scan_scene(p["material"], 512, LIGHTS[p["light"]])
    if medium is not None:
        coefficients = {key: float(getattr(medium, key)) for key in ("sigma_s", "sigma_a", "g", "eta")}
        kept = {key: value for key, value in scene["bunny"]["bsdf"].items() if key != "material"}
        scene["bunny"]["bsdf"] = kept | coefficients
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
    knobs = [result.numbers["settings"] for name, result in results.items() if name.endswith(", knobs")]
    seconds = max(results[name].numbers["seconds"] for name in shots)
    files["trade.md"] = markdown(result, seconds, [s for settings in knobs for s in settings])
    files["trade.html"] = page("Speed against accuracy", shots)
    return files
