"""Fig. 7: mandarin, meat, candle and croissant, path traced, by Deng et al. 2022, TG et al. 2023 and ours; FLIP."""

from __future__ import annotations

import time
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from benchmarks.modelling.learnt import object_parts, train_modelled
from benchmarks.modelling.objects import TISSUES
from benchmarks.published import meat  # noqa: F401  # an object more
from benchmarks.published.fig01 import LIGHT, RESOLUTION, SIZES, TRUTH, VIEWS, View, foot, scene, shown
from benchmarks.published.fig01 import SPP as OURS_SPP
from figures.computing.contenders import NOTE, against, reference_shot
from figures.computing.images import Shot
from figures.computing.learnt import CHUNKS, FULL_GEOMETRY, training_of
from figures.computing.scans import environment_file, prepare
from figures.drawing.image_grid import image_files
from figures.parts.part import Part, Result, SceneDict, Task
from halfspace_sss.provenance import check_folder

TITLE = "mandarin, meat, candle and croissant, path traced, by two rivals and ours, with FLIP"
OBJECTS = ("mandarin", "meat", "candle", "croissant")
SHOWN = {"draft": ("mandarin", "candle"), "paper": OBJECTS}
DENG, TG = "Deng et al. 2022", "TG et al. 2023"
LABELS = {DENG: DENG, TG: TG, FULL_GEOMETRY: "Ours, full geometry"}
RIVALS_SPP = {"draft": {DENG: 64, TG: 2}, "paper": {DENG: 128, TG: 16}}
PHOTOGRAPHS = {"draft": {"n": 16, "size": 32, "spp": 64}, "paper": {"n": 24, "size": 64, "spp": 96}}
STEPS, STEP_SPP = {"draft": 50, "paper": 120}, {"draft": 16, "paper": 32}
TEXELS = {"draft": 1500, "paper": 6000}
LAMPS = ("flame",)
SECONDS = {"draft": 8.0, "paper": 48.0}  # CPU time of the network of TG et al., as ours takes
BACKGROUND_SPP = 64  # of what the network of distant light does not show
NOTES = (
    "Each method was given the object before, none these lights. Deng et al.: a dipole with a texture of the albedo, "
    "fitted to photographs under distant lights. TG et al.: a network for one distant light, environments as sums over "
    "directions, the flame as its direction from the centre of the candle. FLIP and relative squared error of the "
    f"pixels of the object. {NOTE}"
)


def parts(quality: str) -> list[Part]:
    """For each object its training, then its image by walks, by both rivals and by ours."""
    size, resolution, seconds, results = SIZES[quality], RESOLUTION[quality], SECONDS[quality], []
    for name in SHOWN[quality]:
        results.append(train_modelled(name, resolution, CHUNKS[quality]))
        common = {"object": name, "size": size, "resolution": resolution, "seed": 0}
        common["view"] = list(VIEWS[name]._replace(light=LIGHT))
        inputs = (environment_file(LIGHT), TISSUES)
        ours = {TRUTH: OURS_SPP[quality][TRUTH], FULL_GEOMETRY: OURS_SPP[quality]["model"]}
        for method, spp in {**ours, **RIVALS_SPP[quality]}.items():
            params, work, needs = {**common, "spp": spp, "model": method, "light": "gathered"}, spp * size**2, ()
            function = {DENG: deng, TG: distant}.get(method, shown)
            if method == DENG:
                params |= {"photographs": PHOTOGRAPHS[quality], "steps": STEPS[quality], "step spp": STEP_SPP[quality]}
                params |= {"texels": TEXELS[quality]}
                work = STEPS[quality] * STEP_SPP[quality] * PHOTOGRAPHS[quality]["size"] ** 2
            if method == TG:
                params |= {"seconds": seconds}
                work = seconds
            if method == FULL_GEOMETRY:
                needs = (training_of(name),)
            results.append(Part(f"{name}, {method}", function, params, work, needs, inputs, f"{name} {method}"))
    return results


def _unlit(name: str, resolution: int, folder: Path, seed: int) -> SceneDict:
    """The shapes of an object that give no light themselves; its boundary mirrors nothing."""
    parts = {key: part for key, part in object_parts(name, resolution, folder, seed).items() if key not in LAMPS}
    parts[name]["bsdf"] = {**parts[name]["bsdf"], "reflection": False}
    return parts


def deng(task: Task) -> dict[str, object]:
    """An object as the fit of Deng et al. has found it from photographs."""
    import mitsuba as mi

    from benchmarks.published import deng as study
    from benchmarks.published.photographs import Studio
    from full_geometry.scenes.scene_files import load_scene

    prepare()
    p, name, folder = task.params, task.params["object"], check_folder(task.folder)
    taken, began = p["photographs"], time.process_time()
    parts = _unlit(name, p["resolution"], folder, p["seed"])
    studio = Studio(parts, name, taken["size"], taken["n"], p["seed"])
    images = studio.photographs(taken["spp"], p["seed"])
    eta = float(parts[name]["bsdf"]["eta"])
    start = study.painted(parts[name], folder / "start.ply", eta, reflection=False)
    studio = Studio({**parts, name: start}, name, taken["size"], taken["n"], p["seed"], study.MODEL)
    textures = study.fit(
        studio, images, texels=p["texels"], steps=p["steps"], spp=p["step spp"], seed=p["seed"], progress=task.progress
    )
    seconds = time.process_time() - began
    made = object_parts(name, p["resolution"], folder, p["seed"])
    made[name] = study.painted(made[name], folder / "found.ply", eta, textures)
    description = scene(made, View(*p["view"]), p["size"], foot(made[name]))
    loaded = load_scene({**description, "integrator": {"type": "bssrdf"}}, study.MODEL)
    image = np.array(mi.render(loaded, spp=p["spp"], seed=p["seed"] + 1))[..., :3]
    again, began = max(p["spp"] // 4, 1), time.process_time()  # compiled now
    np.array(mi.render(loaded, spp=again, seed=p["seed"] + 2))
    about = {"cpu seconds": seconds, "kB": 2 * textures.albedo.size / 1000, "sigma_t": textures.sigma_t.tolist()}
    about["cpu seconds of a sample"] = (time.process_time() - began) / again
    return {"image": image.astype(np.float32), "spp": p["spp"], **about}


def distant(task: Task) -> dict[str, object]:
    """An object as the network of TG et al. shows it, before what it mirrors and the rest of the scene."""
    import mitsuba as mi

    from benchmarks.published import distant_light as study
    from full_geometry.objects.objects import object_of
    from full_geometry.scenes.scene_files import open_scene

    prepare()
    p, name, folder = task.params, task.params["object"], check_folder(task.folder)
    parts, began = object_parts(name, p["resolution"], folder, p["seed"]), time.process_time()
    alone = {"type": "scene", "integrator": {"type": "bssrdf"}, name: parts[name]}
    obj = object_of(open_scene(alone, FULL_GEOMETRY), None, None, name)
    net = study.fit_distant(obj, p["seconds"], p["seed"], progress=lambda _, done, total: task.progress(done, total))
    seconds = time.process_time() - began
    description = scene(parts, View(*p["view"]), p["size"], foot(parts[name]))
    description["integrator"] = {"type": "path", "max_depth": 8}
    lamps = {key: description.pop(key) for key in LAMPS if key in description}
    surroundings = {key: value for key, value in description.items() if key not in parts}
    light = [study.incident(mi.load_dict(surroundings), net.centre, p["seed"])]
    if lamps:
        alone = {"type": "scene", "integrator": description["integrator"], **lamps}
        light.append(study.lamp(mi.load_dict(alone), net.centre, p["seed"]))
    directions, E = (np.concatenate(columns) for columns in zip(*light))
    loaded = mi.load_dict({**description, **lamps})
    began = time.process_time()
    image = study.image(loaded, name, net, directions, E, p["spp"], p["seed"])
    each = (time.process_time() - began) / p["spp"]
    image = image + np.array(mi.render(loaded, spp=BACKGROUND_SPP, seed=p["seed"]))[..., :3]
    about = {"cpu seconds": seconds, "kB": net.kilobytes, "cpu seconds of a sample": each}
    return {"image": image.astype(np.float32), "spp": p["spp"], **about}


def draw(results: Mapping[str, Result]) -> dict[str, bytes | str]:
    """The figure as PDF and PNG, the page to flip between the images, and the numbers as a table."""
    scenes = {name: _shots(results, name) for name in dict.fromkeys(key.split(", ")[0] for key in results)}
    rows = [{"object": name, "method": s.label, **s.numbers} for name, shots in scenes.items() for s in shots[1:]]
    return image_files("fig07", "Fig. 7: four objects by two rivals and ours", scenes, rows, NOTES)


def _shots(results: Mapping[str, Result], name: str) -> list[Shot]:
    """The images of an object, exposed alike, with the CPU seconds of each training."""
    reference = reference_shot(results[f"{name}, {TRUTH}"])
    shots = [reference[0]]
    for method, label in LABELS.items():
        result = results[f"{name}, {method}"]
        learnt = results[training_of(name)] if method == FULL_GEOMETRY else result
        numbers = {"training, CPU s": learnt.numbers["cpu seconds"]}
        shots.append(against(reference, label, result.images["image"], **numbers))
    return shots
