"""Fig. 6: one full-geometry model under four environments and from four views, beside path tracing, with FLIP."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from figures.computing.contenders import NOTE, against, reference_image, reference_shot
from figures.computing.images import Shot
from figures.computing.learnt import CHUNKS, FULL_GEOMETRY, train_scan, training_of, with_weights
from figures.computing.scans import BUNNY, ENVIRONMENTS, environment, environment_file, prepare, scan_scene
from figures.drawing.image_grid import image_grid
from figures.drawing.page import page
from figures.parts.part import Part, Result, Task
from halfspace_sss.comparison.style import paper, saved

TITLE = "one full-geometry model under four environments and from four views"
MATERIAL = "potato"
WINDOWS = "windows"  # the surroundings of Fig. 9 with its lamp
EVEN = "even sky"
LIGHTS = ("sunset", "forest", WINDOWS, EVEN)  # not the studio, whose lamps walks hardly find
SCALES = {"sunset": 1.5, "forest": 0.8}
VIEWS = (0, 90, 180, 270)  # degrees about the bunny
VIEWS_LIGHT = LIGHTS[0]
SIZES = {"draft": 72, "paper": 384}
SPP = {"draft": {"path_traced": 128, FULL_GEOMETRY: 16}, "paper": {"path_traced": 1024, FULL_GEOMETRY: 64}}
AXIS = (-0.17, 0.15)  # x and z of the axis that the camera goes about
NOTES = (
    "Trained once, without any of these lights: the same weights in all images, by gathered light. All scattering "
    f"orders. FLIP and relative squared error of the pixels of the object. {NOTE}"
)


def parts(quality: str) -> list[Part]:
    """The training, then each light and each view by walks and by the model."""
    size, results = SIZES[quality], [train_scan(MATERIAL, MATERIAL, CHUNKS[quality])]
    for light, view in _cases():
        files = (environment_file(light),) if light in ENVIRONMENTS else ()
        for model, spp in SPP[quality].items():
            params = {
                "light": light,
                "scale": SCALES.get(light, 1.0),
                "view": view,
                "size": size,
                "spp": spp,
                "seed": 0,
            }
            params["model"] = model
            needs = (training_of(MATERIAL),) if model == FULL_GEOMETRY else ()
            name = _name(light, view, model)
            results.append(Part(name, seen, params, spp * size**2, needs, (BUNNY, *files), model))
    return results


def _cases() -> list[tuple[str, int]]:
    """Lights with views, each once."""
    return list(dict.fromkeys([*((light, VIEWS[0]) for light in LIGHTS), *((VIEWS_LIGHT, view) for view in VIEWS)]))


def _name(light: str, view: int, model: str) -> str:
    return f"{light}, {view} degrees, {model}"


def seen(task: Task) -> dict[str, object]:
    """The bunny under a light, from a view."""
    import mitsuba as mi

    from full_geometry.scenes.scene_files import PATH_TRACED, load_scene

    prepare()
    p = task.params
    description = scan_scene(MATERIAL, p["size"], EVEN if p["light"] == EVEN else "both")
    if p["light"] in ENVIRONMENTS:
        del description["lamp"]
        description["sky"] = environment(p["light"], p["scale"])
    about = mi.ScalarTransform4f().translate([AXIS[0], 0, AXIS[1]])
    turn = about @ mi.ScalarTransform4f().rotate([0, 1, 0], p["view"]) @ about.inverse()
    description["integrator"]["light"] = "gathered"
    description["sensor"]["to_world"] = turn @ description["sensor"]["to_world"]
    with with_weights(task.folder, task.needed):
        scene = load_scene(description, p["model"])
        if p["model"] == PATH_TRACED:
            return reference_image(task, scene)
        image = np.array(mi.render(scene, spp=p["spp"], seed=p["seed"]))
    return {"image": image[..., :3].astype(np.float32), "spp": p["spp"]}


def draw(results: Mapping[str, Result]) -> dict[str, bytes | str]:
    """Environments and views as PDF and PNG each, the page to flip between the images, and the numbers as a table."""
    import pandas

    pairs = {case: _pair(results, *case) for case in _cases()}
    rows = [{"light": light, "view": view, **pair[1].numbers} for (light, view), pair in pairs.items()]
    files: dict[str, bytes | str] = {"fig06.csv": pandas.DataFrame(rows).to_csv(index=False, lineterminator="\n")}
    of_lights = {light.capitalize(): pairs[light, VIEWS[0]] for light in LIGHTS}
    of_views = {f"{view}°": pairs[VIEWS_LIGHT, view] for view in VIEWS}
    for name, shown in (("environments", of_lights), ("views", of_views)):
        with paper():
            drawn = saved(image_grid(_by_method(shown)))
        files |= {f"fig06_{name}.{end}": data for end, data in drawn.items()}
    scenes = {f"{light}, {view}°": list(pair) for (light, view), pair in pairs.items()}
    files["fig06.html"] = page("Fig. 6: one model, all lights and views", scenes, notes=NOTES)
    return files


def _pair(results: Mapping[str, Result], light: str, view: int) -> tuple[Shot, Shot]:
    """The images by walks and by the model, exposed alike."""
    reference = reference_shot(results[_name(light, view, "path_traced")])
    model = against(reference, "Full geometry", results[_name(light, view, FULL_GEOMETRY)].images["image"])
    return reference[0], model


def _by_method(pairs: Mapping[str, tuple[Shot, Shot]]) -> dict[str, list[Shot]]:
    """A row for each method, a column for each light or view."""
    rows: dict[str, list[Shot]] = {}
    for title, pair in pairs.items():
        for shot in pair:
            renamed = Shot(title, shot.image, shot.numbers, shot.flip, shot.difference)
            rows.setdefault(shot.label, []).append(renamed)
    return rows
