"""Things on their own under a small lamp and a dim even sky: the scene, images by walks and models, shots."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np

from figures.computing.contenders import against, reference_image, reference_shot
from figures.computing.images import Shot
from figures.computing.scans import prepare
from figures.drawing.image_grid import label
from figures.parts.part import Params, Part, Result, SceneDict, Task


class Staging(NamedTuple):
    """Where a thing is seen and lit from: directions, in its radii; the vertical angle of view is in degrees."""

    eye: tuple[float, float, float]
    lamp: tuple[float, float, float]
    fov: float
    lamp_radius: float
    sky: float  # radiance
    glow: float = 60.0  # radiance of the lamp
    far: float = 4.0  # of the eye; the lamp is at 3


def lit_scene(things: SceneDict, stage: Staging, size: int, mm_per_unit: float) -> SceneDict:
    """The scene of a thing, as a dict for `scenes.scene_files.load_scene`.

    Args:
        things: shapes by name for `mitsuba.load_dict`, the first of which is looked at.
        stage: how.
        size: pixels of the square image.
        mm_per_unit: of the shapes.
    """
    import mitsuba as mi

    first = next(iter(things.values()))
    box = mi.load_dict({key: value for key, value in first.items() if key != "bsdf"}).bbox()
    centre, radius = np.array(box.center()).ravel(), 0.5 * float(np.linalg.norm(np.array(box.extents()).ravel()))
    eye, lamp = (np.array(d) / np.linalg.norm(d) for d in (stage.eye, stage.lamp))
    view = mi.ScalarTransform4f().look_at(list(centre + stage.far * radius * eye), list(centre), [0, 1, 0])
    film = {"type": "hdrfilm", "width": size, "height": size, "rfilter": {"type": "box"}}
    where = {"center": list(centre + 3 * radius * lamp), "radius": stage.lamp_radius * radius}
    return {
        "type": "scene",
        "integrator": {"type": "bssrdf", "mm_per_unit": mm_per_unit, "hide_emitters": True},
        "sensor": {"type": "perspective", "fov": stage.fov, "to_world": view, "film": film},
        **things,
        "sky": {"type": "constant", "radiance": stage.sky},
        "lamp": {"type": "sphere", **where, "emitter": {"type": "area", "radiance": stage.glow}},
    }


def thing_parts(
    name: str,
    common: Params,
    spp: tuple[int, int],
    functions: tuple[Callable, Callable],
    models: Iterable[tuple[str, tuple[Path, ...]]],
    inputs: tuple[Path, ...] = (),
    needs: tuple[str, ...] = (),
) -> list[Part]:
    """The path-traced image of a thing, then the image of each model.

    Args:
        name: of the thing.
        common: parameters of all the images, "size" among them.
        spp: samples per pixel of the walk and of a model.
        functions: that make the one and the others.
        models: with the files of their weights.
        inputs: files of the thing.
        needs: parts that the images of models need.
    """
    traced, rendered = functions
    pixels = common["size"] ** 2
    results = [Part(f"{name}, path traced", traced, {**common, "spp": spp[0]}, spp[0] * pixels, inputs=inputs)]
    for model, weights in models:
        params = {**common, "spp": spp[1], "model": model}
        files = (*inputs, *weights)
        results.append(Part(f"{name}, {model}", rendered, params, spp[1] * pixels, needs, files, model))
    return results


def walked(task: Task, scene_of: Callable[[Task], SceneDict]) -> dict[str, object]:
    """`reference_image` of a thing."""
    from full_geometry.scenes.scene_files import PATH_TRACED, load_scene

    prepare()
    return reference_image(task, load_scene(scene_of(task), PATH_TRACED))


def shown(task: Task, scene_of: Callable[[Task], SceneDict]) -> dict[str, object]:
    """The image of a model by its gathered light."""
    import mitsuba as mi

    from full_geometry.scenes.scene_files import load_scene

    prepare()
    p = task.params
    description = scene_of(task)
    description["integrator"]["light"] = "gathered"
    image = mi.render(load_scene(description, p["model"]), spp=p["spp"], seed=p["seed"] + 1)
    return {"image": np.array(image)[..., :3].astype(np.float32), "spp": p["spp"]}


def against_walks(results: Mapping[str, Result], name: str, models: Iterable[str]) -> list[Shot]:
    """The images of a thing, exposed alike; with the mean of each over that of the walks."""
    reference = reference_shot(results[f"{name}, path traced"])
    shot, mask, stops = reference
    shots = [shot]
    for model in models:
        image = results[f"{name}, {model}"].images["image"]
        mean = float(np.float32(2.0**stops) * image[mask].mean() / shot.image[mask].mean())
        shots.append(against(reference, label(model), image, **{"mean over path traced": mean}))
    return shots
