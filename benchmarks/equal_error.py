"""The time in which each method reaches the same error as Mitsuba's volume path tracer, and where that time goes."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from benchmarks import equal_error_tables
from benchmarks.bench import kernel_seconds
from benchmarks.methods import VOLUMES, contender, ready, volume
from benchmarks.modelling.learnt import object_parts, train_modelled
from benchmarks.modelling.objects import MODELS as VARYING
from benchmarks.modelling.objects import TISSUES, tissue
from benchmarks.published.fig01 import VIEWS
from benchmarks.timed import TimedRender, alternating, rendered
from figures.computing.contenders import MODELS, OF_OBJECTS, WALK, long_passes, long_walk
from figures.computing.learnt import (
    CHUNKS,
    FULL_GEOMETRY,
    TRAINING,
    accepting,
    train_scan,
    training_of,
    weight_files,
    with_weights,
)
from figures.computing.scans import BUNNY, MATERIALS, SCANS, prepare
from figures.parts.part import Params, Part, Result, SceneDict, Task
from full_geometry.trade.denoising import cover
from halfspace_sss import materials
from halfspace_sss.checks import check_choice
from halfspace_sss.physics.medium import Medium
from halfspace_sss.provenance import check_folder

if TYPE_CHECKING:
    import mitsuba as mi

MODELLED = ("candle", "mandarin")
LIGHTS = ("small light", "even sky")
LAMP, LAMP_RADIUS = (-67.0, 46.0, -45.0), 8.0  # from what is looked at, mm: behind it, as with the bunny
GLOW = (90.0, 84.0, 75.0)


def modelled_scene(
    name: str, resolution: int, size: int, lights: str, folder: Path, sampler: str = "independent", seed: int = 0
) -> SceneDict:
    """A modelled object on its own, as a dict for `scene_files.load_scene`, under its name.

    Args:
        name: a name in `modelling.objects.MODELS`, or "candle".
        resolution, seed: of its surface.
        size: pixels of the square image.
        lights: "even sky", radiance 1 from everywhere, or "small light": of the candle its flame, else a lamp.
        folder: for its files.
        sampler: Mitsuba's plugin of random numbers.

    Raises:
        ValueError: no such object or lights.
    """
    import mitsuba as mi

    check_choice("lights", lights, LIGHTS)
    shown, view = object_parts(name, resolution, check_folder(folder), seed), VIEWS[name]
    to_world = mi.ScalarTransform4f().look_at(list(view.origin), list(view.target), [0, 1, 0])
    film = {"type": "hdrfilm", "width": size, "height": size, "rfilter": {"type": "box"}}
    if lights == "even sky":
        shown = {name: shown[name], "sky": {"type": "constant", "radiance": 1.0}}
    elif "flame" not in shown:
        centre = [a + b for a, b in zip(view.target, LAMP)]
        glow = {"type": "area", "radiance": {"type": "rgb", "value": list(GLOW)}}
        shown["lamp"] = {"type": "sphere", "center": centre, "radius": LAMP_RADIUS, "emitter": glow}
    return {
        "type": "scene",
        "integrator": {"type": "bssrdf", "hide_emitters": True},
        "sensor": {"type": "perspective", "fov": view.fov, "to_world": to_world, "film": film,
                   "sampler": {"type": sampler}},
        **shown,
    }  # fmt: skip


def modelled_contender(
    method: str, p: Params, folder: Path, sampler: str = "independent"
) -> mi.Scene | tuple[mi.Scene, ...]:
    """The scene of a modelled object for a method, see `methods.ready`.

    Args:
        method: of rendering.
        p: "object", "resolution", "size" and "lights" of `modelled_scene`.
        folder: for its files.
        sampler: Mitsuba's plugin of random numbers.
    """
    result = modelled_scene(p["object"], p["resolution"], p["size"], p["lights"], folder, sampler)
    return ready(method, result, p["object"], tissue("candle wax").medium)  # all tissues scatter isotropically


def long_modelled(task: Task) -> dict[str, object]:
    """A long image by our walk, for the parameters of `modelled_contender` and "spp" and "seed"."""
    prepare()
    return long_passes(task, modelled_contender(WALK, task.params, task.folder))


TITLE = "time to equal error against Mitsuba's volume path tracer, time per sample, white furnace"
OBJECTS = MODELLED
SUBJECTS = {name: ("bunny", name) for name in MATERIALS} | {"dragon of potato": ("dragon", "potato")}
TRUTH = "truth"  # last word of the names of parts
BARE = "bare"  # without reflection and without the single scattering that a model lacks
BARE_MATERIALS = ("marble", "potato", "ketchup")
SPLIT_MATERIAL = "marble"
SIZES = {"draft": 48, "paper": 128}
TRUTH_SPP = {"draft": 64, "paper": 8192}
SAMPLER = "multijitter"  # of all methods; it takes square numbers of samples as they are
PASSES = {"draft": 3, "paper": 8}
SPP = {  # of a pass; one that is much shorter would show what a render costs before its first sample
    "draft": {"volume": 4, WALK: 16, "model": 64},
    "paper": {"volume": 64, WALK: 64, "model": 1024},
}
# most of the time of a draft goes into compiling, which each method takes for each kind of light
COMPARED = {  # and in which light
    "draft": {"marble": LIGHTS, "candle": LIGHTS[:1]},
    "paper": dict.fromkeys((*SUBJECTS, *OBJECTS), LIGHTS),
}
ROULETTES = {"draft": (volume(5), volume(200)), "paper": VOLUMES}
HALF_SPACES = {"draft": ("better_dipole", "neural"), "paper": MODELS}
BARE_MODELS = {"draft": (), "paper": MODELS}
LEARNT = {"draft": (FULL_GEOMETRY,), "paper": OF_OBJECTS}
RESOLUTION = {"draft": 64, "paper": 192}  # of modelled objects
LANES = {"draft": 2**18, "paper": 2**22}
FURNACE = {"draft": {"size": 16, "spp": 256}, "paper": {"size": 32, "spp": 16384}}


def parts(quality: str) -> list[Part]:
    """For each object its training, for each light the truth and the errors with times; then samples and furnace."""
    results = []
    chosen = COMPARED[quality]
    for name, (scan, material) in ((key, each) for key, each in SUBJECTS.items() if key in chosen):
        if FULL_GEOMETRY in OF_OBJECTS:
            results.append(train_scan(name, material, CHUNKS[quality], scan=scan))
        for lights in chosen[name]:
            results += _parts_of(name, lights, quality)
    for name in (key for key in OBJECTS if key in chosen):
        results.append(train_modelled(name, RESOLUTION[quality], CHUNKS[quality]))
        for lights in chosen[name]:
            results += _parts_of(name, lights, quality)
    weights = weight_files("neural", materials.load(SPLIT_MATERIAL).medium)
    common = {"material": SPLIT_MATERIAL, "models": list(HALF_SPACES[quality]), "lanes": LANES[quality], "repeats": 5}
    results.append(Part("time per sample", split, common, LANES[quality], inputs=(BUNNY, *weights)))
    for model in (WALK, *furnace_models()):
        params = {"model": model, **FURNACE[quality]}
        inputs = weight_files(model, materials.load(SPLIT_MATERIAL).medium) if model == "neural" else ()
        work = params["spp"] * params["size"] ** 2
        results.append(Part(_furnace_name(model), furnace, params, work, inputs=inputs))
    return results


def _errors_name(name: str, lights: str) -> str:
    return f"{name}, {lights}, errors"


def _furnace_name(method: str) -> str:
    return f"furnace, {method}"


def _parts_of(name: str, lights: str, quality: str) -> list[Part]:
    of_subject, file, medium = _subject(name, quality)
    common, spp = {**of_subject, "size": SIZES[quality], "lights": lights}, SPP[quality]
    known = (model for model in LEARNT[quality] if name not in VARYING or model == FULL_GEOMETRY)  # of media that vary
    methods = [*ROULETTES[quality], WALK, *HALF_SPACES[quality], *known]
    if name in BARE_MATERIALS:
        methods += [f"{model}, {BARE}" for model in BARE_MODELS[quality]]
    kinds = {method: "volume" if method in VOLUMES else WALK if method == WALK else "model" for method in methods}
    params = {
        **common, "passes": PASSES[quality], "spp": {method: spp[kinds[method]] for method in methods}, "seed": 1,
        "sampler": SAMPLER,
    }  # fmt: skip
    work = sum(params["spp"].values()) * params["passes"] * SIZES[quality] ** 2
    truth = f"{name}, {lights}, {TRUTH}"
    needs = (truth, *((training_of(name),) if FULL_GEOMETRY in OF_OBJECTS else ()))
    models = (method for method in methods if kinds[method] == "model" and BARE not in method)
    inputs = (file, *(f for model in models for f in weight_files(model, medium)))
    long, trace = {**common, "spp": TRUTH_SPP[quality], "seed": 0}, long_modelled if name in OBJECTS else long_walk
    return [
        Part(truth, trace, long, long["spp"] * SIZES[quality] ** 2, inputs=(file,)),
        Part(_errors_name(name, lights), measured, params, work, needs=needs, inputs=inputs),
    ]


def _subject(name: str, quality: str) -> tuple[dict[str, int | str], Path, Medium]:
    """What of the parameters of its parts tells an object, the file that it depends on, and its medium."""
    if name in OBJECTS:
        return {"object": name, "resolution": RESOLUTION[quality]}, TISSUES, tissue("candle wax").medium
    scan, material = SUBJECTS[name]
    return {"scan": scan, "material": material}, SCANS[scan].file, materials.load(material).medium


def measured(task: Task) -> dict[str, object]:
    """Errors and CPU seconds of all methods, whose passes take turns, and those of training."""
    prepare()
    p = task.params
    (truth,) = (result for name, result in task.needed.items() if name.endswith(TRUTH))
    seconds = [result.numbers["cpu seconds"] for name, result in task.needed.items() if name.endswith(TRAINING)]

    def progress(done: int, total: int) -> None:
        task.progress(total + done, 2 * total)

    with with_weights(task.folder, task.needed):
        scenes = _compiled(task)
        covered = cover(scenes[WALK], 8) > 0
        result = alternating(scenes, p["spp"], p["seed"], passes=p["passes"], progress=progress)
    traced = (WALK, *VOLUMES)
    rows = [{"method": name, **errors(timed, truth, covered, name in traced)} for name, timed in result.items()]
    level = float(np.mean(truth.images["image"][covered].astype(np.float64) ** 2))
    noise = float(np.mean(truth.images["variance"][covered], dtype=np.float64))
    about = {"mean square": level, "variance": noise, "seconds": truth.numbers["seconds"], "spp": truth.numbers["spp"]}
    return {"rows": rows, "truth": about, "training": dict(zip([FULL_GEOMETRY], seconds))}


def _compiled(task: Task) -> dict[str, mi.Scene]:
    """The scenes of all methods, with their kernels: the walk and the sampler have one for each number of samples."""
    p, scenes = task.params, {}
    for k, (name, spp) in enumerate(p["spp"].items()):
        method, _, bare = name.partition(", ")
        if "object" in p:
            scenes[name] = modelled_contender(method, p, task.folder, p["sampler"])
        else:
            more = (bare == BARE, p["sampler"], p["scan"])
            scenes[name] = contender(method, p["material"], p["size"], p["lights"], *more)
        rendered(scenes[name], spp, p["seed"])
        task.progress(k, 2 * len(p["spp"]))
    return scenes


def errors(timed: TimedRender, truth: Result, mask: np.ndarray, is_exact: bool) -> dict[str, float]:
    """Mean squared errors of one pass, about a long independent image of the same method and about the truth.

    The independent image of a model is the average of all other passes; that of a path tracer is the truth itself.
    What the independent image and the truth vary by themselves is taken off, so that an error that is lost in the noise
    of the truth can come out below 0.

    Args:
        timed: at least two passes.
        truth: with images "image" and "variance".
        mask: (H, W), true for the pixels that count.
        is_exact: whether the method is a path tracer.
    """
    images = timed.images[:, mask].astype(np.float64)
    count = len(images)
    against, noise = (truth.images[name][mask].astype(np.float64) for name in ("image", "variance"))
    # the mean square about all other passes times (count - 1)/count
    spread = images.var(axis=0, ddof=1).mean(axis=1)
    error = (np.mean((images - against) ** 2, axis=0) - noise).mean(axis=1)
    bias2 = np.zeros_like(error) if is_exact else error - spread
    return {
        "spp": timed.spp // count,
        "seconds": float(np.median(timed.pass_cpu_seconds)),
        "variance": float(np.mean(error if is_exact else spread)),
        "bias2": float(np.mean(bias2)),
        "bias2 standard error": _standard_error(bias2),
        "error": float(np.mean(error)),
        "error standard error": _standard_error(error),
        "spread": float(np.mean(spread)),
    }


def _standard_error(pixels: np.ndarray) -> float:
    """Of the mean; the noise of pixels is independent."""
    return float(pixels.std(ddof=1) / np.sqrt(len(pixels)))


def draw(results: Mapping[str, Result]) -> dict[str, bytes | str]:
    """The tables: all numbers as CSV, and what they say as Markdown."""
    scenes = {(name, lights): _errors_name(name, lights) for name in (*SUBJECTS, *OBJECTS) for lights in LIGHTS}
    furnaces = {method: _furnace_name(method) for method in (WALK, *furnace_models())}

    def numbers(names: Mapping[tuple[str, str] | str, str]) -> dict[tuple[str, str] | str, Params]:
        return {key: results[name].numbers for key, name in names.items() if name in results}

    tables = {
        "errors": equal_error_tables.equal_error(numbers(scenes)),
        "sampling": equal_error_tables.sampling(results["time per sample"].numbers["rows"]),
        "furnace": equal_error_tables.furnace(numbers(furnaces)),
    }
    files: dict[str, bytes | str] = {
        f"equal_error_{name}.csv": table.to_csv(index=False, lineterminator="\n") for name, table in tables.items()
    }
    files["equal_error.md"] = equal_error_tables.markdown(tables["errors"], tables["sampling"], tables["furnace"])
    return files


ALBEDO, ETA = 1.0, 1.5  # exactly: by 1 - 1e-6 a half-space absorbs 0.5 %
RADIUS = 1000.0  # mean free paths: what a half-space lets out farther away than the sphere is wide is below 1 %
SEEN = 0.7  # of the radius: the corners of the image see the sphere too
WALK_SPP = 4  # every walk comes back with weight 1


def furnace_models() -> list[str]:
    """Names of the models that there are for the medium of the furnace."""
    return accepting(Medium.from_albedo(ALBEDO, 1.0, 0.0, ETA))


def furnace_scene(model: str, size: int, radius: float = RADIUS) -> mi.Scene:
    """The Mitsuba scene of the furnace: the middle of the sphere fills the image.

    Args:
        model: of the BSSRDF, or "translucent_walk".
        size: pixels of the square image.
        radius: of the sphere, mean free paths.
    """
    import mitsuba as mi

    from full_geometry.scenes.scene_files import PATH_TRACED, load_scene

    at = mi.ScalarTransform4f()
    view = at.look_at([0, 0, 2 * radius], [0, 0, 0], [0, 1, 0]) @ at.scale([SEEN * radius, SEEN * radius, 1])
    film = {"type": "hdrfilm", "width": size, "height": size, "rfilter": {"type": "box"}}
    surface = {"type": "translucent", "sigma_s": ALBEDO, "sigma_a": 1 - ALBEDO, "g": 0.0, "eta": ETA}
    scene = {
        "type": "scene",
        "integrator": {"type": "bssrdf"},
        "sensor": {"type": "orthographic", "to_world": view, "film": film},
        "sky": {"type": "constant", "radiance": 1.0},
        "sphere": {"type": "sphere", "radius": radius, "bsdf": surface},
    }
    return load_scene(scene, PATH_TRACED if model == WALK else model)


def furnace(task: Task) -> dict[str, object]:
    """Mean radiance of the sphere and its standard error."""
    import mitsuba as mi

    prepare()
    p = task.params
    spp = min(p["spp"], WALK_SPP) if p["model"] == WALK else p["spp"]
    image = np.array(mi.render(furnace_scene(p["model"], p["size"]), spp=spp, seed=3), dtype=np.float64)[..., :3]
    pixels = image.mean(axis=2).ravel()
    return {"mean": float(pixels.mean()), "standard error": float(pixels.std(ddof=1) / np.sqrt(pixels.size))}


STEPS = ("entries", "visibility", "evaluation")


def split(task: Task) -> dict[str, object]:
    """Seconds per million samples of each step and model, each step as a kernel of its own over the same lanes.

    The models take turns; of the repeats the fastest counts, which is the one that nothing else delayed.
    """
    prepare()
    p = task.params
    steps = {model: _steps(contender(model, p["material"], 64, "small light"), p["lanes"]) for model in p["models"]}
    best = {(model, step): np.inf for model in p["models"] for step in STEPS}
    for k in range(p["repeats"] + 1):  # the first compiles
        for model, step in best:
            seconds = kernel_seconds(steps[model][step])
            best[model, step] = min(best[model, step], seconds) if k else np.inf
        task.progress(k + 1, p["repeats"] + 1)
    scale = 1e6 / p["lanes"]
    return {
        "rows": [{"model": model, **{step: scale * best[model, step] for step in STEPS}} for model in p["models"]],
        "lanes": p["lanes"],
    }


def _steps(scene: mi.Scene, n: int) -> dict[str, Callable[[], object]]:
    """For each step what it computes, from inputs that are in memory."""
    import drjit as dr
    import mitsuba as mi

    from full_geometry.geometry.points import cosine_above, place
    from full_geometry.geometry.rounding import ray_from
    from full_geometry.integrators.surface_paths import exit_at

    (obj,) = scene.integrator().prepare(scene)
    si, sampler = _seen(scene, n), mi.load_dict({"type": "independent"})
    sampler.seed(11, n)
    out, face = exit_at(obj, si), mi.UInt32(si.prim_index)
    prepared = obj.transport.prepare(out, mi.Bool(True))
    where = obj.proposals.prepare(out, prepared, mi.Bool(True))
    entry = obj.proposals.sample(out, face, where, sampler, mi.Bool(True))
    direction, _ = cosine_above(entry.n_out, entry.n, sampler.next_2d())  # the same for all models
    dr.eval(tuple(out), face, tuple(entry), direction, sampler)  # named tuples are passed over
    ray = ray_from(place(entry.p, entry.n), direction, obj.geometry.clearance)
    dr.eval(ray)
    result = entry.weight > 0
    dr.eval(result)

    def evaluated() -> mi.Spectrum:
        at = entry.facing(direction)
        return obj.transport.S(prepared, at, result) * at.mu

    return {
        "entries": lambda: tuple(obj.proposals.sample(out, face, where, sampler.clone(), mi.Bool(True))),
        "visibility": lambda: scene.ray_intersect_preliminary(ray, coherent=False, active=result),
        "evaluation": evaluated,
    }


def _seen(scene: mi.Scene, n: int) -> mi.SurfaceInteraction3f:
    """Points of the object where n rays of the camera meet it."""
    import drjit as dr
    import mitsuba as mi

    rng, sensor, result = np.random.default_rng(5), scene.sensors()[0], np.zeros((2, 0), dtype=np.float32)
    while result.shape[1] < n:
        place = rng.random((2, 2 * n)).astype(np.float32)
        ray, _ = sensor.sample_ray(0.0, 0.5, mi.Point2f(place), mi.Point2f(0.5))
        result = np.hstack([result, place[:, np.array(scene.ray_intersect_preliminary(ray).is_valid())]])
    ray, _ = sensor.sample_ray(0.0, 0.5, mi.Point2f(result[:, :n]), mi.Point2f(0.5))
    si = scene.ray_intersect(ray)
    dr.eval(si)
    return si
