"""Media from images, measured: `fit` beside Mitsuba's `prbvolpath` on a cube of a homogeneous medium.

After the synthetic benchmark of Son et al. 2024: from sigma_t 50 and albedo 0.5, of a cube of 0.2 mm, to sigma_t 20,
50, 50 and albedo 0.9, and to media drawn from sigma_t 30 to 100 and albedo 0.8 to 0.98; images of `volpathmis` at depth
256, as `volpath` has outliers. `prbvolpath` at depth 6 and 64 moves log sigma_t and logit albedo by Adam at rate 0.05,
one view a step, with two independent renders in its loss. All CPU seconds, compiling too.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence

import drjit as dr
import mitsuba as mi
import numpy as np

from benchmarks.inversion_textures import rms
from benchmarks.mitsuba_media import with_media
from figures.parts.part import Row, SceneDict
from full_geometry import inverse
from full_geometry.inverse.views import GivenView
from halfspace_sss.progress import NamedProgress, ProgressText

CASES: Mapping[str, Mapping[str, float]] = {
    "eta 1": {"eta": 1.0, "g": 0.0},
    "eta 1.4": {"eta": 1.4, "g": 0.0},
    "eta 1.4, rough": {"eta": 1.4, "g": 0.0, "alpha": 0.2},
    "g 0.8": {"eta": 1.0, "g": 0.8},
}
FIRST = {"albedo": np.full(3, 0.9), "sigma_t": np.array([20.0, 50.0, 50.0])}
DRAWN = {"albedo": (0.8, 0.98), "sigma_t": (30.0, 100.0)}
START = {"albedo": np.full(3, 0.5), "sigma_t": np.full(3, 50.0)}
EDGE = 0.2  # mm
TARGET_DEPTH = 256
DEPTHS = (6, 64)
RATE = 0.05
WITHIN = (30, 10, 3)  # % of sigma_t, and when it was reached
SIDES = ([0, 0, 1], [1, 0.2, 0], [0, 1, 0.2], [-1, 0, 0.3], [0.2, -1, 0], [0.3, 0.2, -1])


def target(number: int) -> dict[str, np.ndarray]:
    """A medium to be found: the first is that of the benchmark, the others are drawn, each channel on its own."""
    rng = np.random.default_rng([30, number])
    return {name: rng.uniform(*ends, 3) for name, ends in DRAWN.items()} if number else FIRST


def medium_rows(
    case: str, number: int, size: int, spp: int, target_spp: int, steps: int, prb_steps: int, seed: int,
    progress: NamedProgress | None = None,
) -> list[Row]:  # fmt: skip
    """Of each way: errors of what was found, CPU seconds, and those after which errors of sigma_t stayed small.

    Args:
        case: of `CASES`.
        number: of the target.
        size: pixels of the square images.
        spp: samples a pixel of each render of a step.
        target_spp: of the images that are given.
        steps: of `fit`.
        prb_steps: of `prbvolpath`; 0 leaves it out.
        seed: of all samples.
        progress: called with (what, done, total).
    """
    kind, true, rows = CASES[case], target(number), []
    images = targets(case, number, size, target_spp, seed)
    views = [GivenView.of(f"view {k}", k, image) for k, image in enumerate(images)]
    settings = inverse.FitSettings(steps=steps, spp=spp, seed=seed)
    for depth in (None, *(DEPTHS if prb_steps else ())):
        way = "fit" if depth is None else f"prbvolpath, depth {depth}"
        at, times = time.process_time(), []

        def show(done: int, total: int, _: str, way: str = way, times: list[float] = times, at: float = at) -> None:
            times.append(time.process_time() - at)
            if progress:
                progress(f"{case}, target {number}, {way}", done, total)

        start = _cube(START, kind, size)
        if depth is None:
            fitted = inverse.fit(start, views, ("albedo", "sigma_t"), settings=settings, progress=show)
            way_there = [{name: np.array(v) for name, v in step.values.items()} for step in fitted.steps[1:]]
            way_there.append(fitted.values)
        else:
            way_there = _prb(start, images, spp, prb_steps, depth, seed, show)
        about = {"case": case, "target": number, "way": way, "samples of targets": target_spp, "seed": seed}
        seconds, off = time.process_time() - at, [_errors(found, true, kind["g"]) for found in way_there]
        until = {f"CPU s to {most} %": _until([e["sigma_t, %"] for e in off], times, most) for most in WITHIN}
        rows.append({**about, **off[-1], "CPU s": seconds, **until})
    return rows


def _until(off: Sequence[float], times: Sequence[float], most: float) -> float:
    """When an error fell below `most` for good; NaN if it did not."""
    above = [k for k, error in enumerate(off) if error >= most]
    first = above[-1] + 1 if above else 0
    return times[first] if first < len(times) else np.nan


def targets(case: str, number: int, size: int, spp: int, seed: int) -> list[np.ndarray]:
    """The images of a medium from all sides by `volpathmis`."""
    volpath = {"type": "volpathmis", "max_depth": TARGET_DEPTH}
    truth = with_media(_cube(target(number), CASES[case], size), 1.0, volpath)
    return [np.array(mi.render(truth, sensor=k, spp=spp, seed=seed + k)) for k in range(len(SIDES))]


def _errors(found: Mapping[str, np.ndarray], true: Mapping[str, np.ndarray], g: float) -> dict[str, float]:
    """Root mean squares over channels; of sigma_s' and sigma_t relative."""
    reduced = [values["albedo"] * values["sigma_t"] * (1 - g) for values in (found, true)]
    return {
        "albedo": rms(found["albedo"] - true["albedo"]),
        "sigma_t, %": 100 * rms(found["sigma_t"] / true["sigma_t"] - 1),
        "sigma_s', %": 100 * rms(reduced[0] / reduced[1] - 1),
    }


def _cube(medium: Mapping[str, np.ndarray], kind: Mapping[str, float], size: int) -> SceneDict:
    """A cube of 0.2 mm under a dim sky and a large lamp, seen from six sides."""
    at, film = mi.ScalarTransform4f(), _film(size)
    numbers = {key: ", ".join(map(repr, map(float, value))) for key, value in medium.items()}
    surface = {"type": "translucent", **numbers, "eta": kind["eta"], "g": kind["g"]}
    if "alpha" in kind:
        rough = {"type": "roughdielectric", "alpha": kind["alpha"], "int_ior": kind["eta"], "ext_ior": 1.0}
        surface["boundary"] = rough
    scene = {
        "type": "scene",
        "integrator": {"type": "translucent_walk"},
        "sky": {"type": "constant", "radiance": 0.5},
        "lamp": {"type": "sphere", "center": [-0.72, 0.96, 0.96], "radius": 0.8,
                 "emitter": {"type": "area", "radiance": 2.5}},
        "object": {"type": "cube", "to_world": at.rotate([0, 1, 0], 25).scale(EDGE / 2),
                   "bsdf": surface},
    }  # fmt: skip
    for k, side in enumerate(SIDES):
        eye = (8 * EDGE * np.array(side) / np.linalg.norm(side)).tolist()
        view = at.look_at(eye, [0, 0, 0], [0, 1, 0] if abs(side[1]) < 1 else [0, 0, 1])
        scene[f"view{k}"] = {"type": "perspective", "fov": 12.0, "to_world": view, "film": film}
    return scene


def _film(size: int) -> SceneDict:
    return {"type": "hdrfilm", "width": size, "height": size, "rfilter": {"type": "box"}, "pixel_format": "rgb",
            "component_format": "float32"}  # fmt: skip


def _prb(
    start: SceneDict, images: list[np.ndarray], spp: int, steps: int, depth: int, seed: int, show: ProgressText
) -> list[dict[str, np.ndarray]]:
    """The medium after each step of Adam on log sigma_t and logit albedo, by Mitsuba's gradients of volume paths."""
    scene = with_media(start, 1.0, {"type": "prbvolpath", "max_depth": depth})
    parameters = mi.traverse(scene)
    keys = {name: next(k for k in parameters.keys() if k.endswith(f"{name}.value.value")) for name in START}
    scale = float(START["sigma_t"].max())  # `with_media` has the colour over this
    targets = [mi.TensorXf(image.astype(np.float32)) for image in images]
    weights = [1 / dr.square(target + 0.1 * dr.mean(target, axis=None)) for target in targets]
    adam = mi.ad.Adam(lr=RATE)
    x = {"albedo": np.log(START["albedo"] / (1 - START["albedo"])), "sigma_t": np.log(START["sigma_t"] / scale)}
    found = []
    for name, key in keys.items():
        adam[name] = type(parameters[key])(x[name].tolist())
    for k in range(steps):
        parameters[keys["albedo"]] = 1 / (1 + dr.exp(-adam["albedo"]))
        parameters[keys["sigma_t"]] = dr.exp(adam["sigma_t"])
        parameters.update()
        which, seeds = k % len(images), np.random.SeedSequence([seed, k]).generate_state(2)
        image = mi.render(scene, parameters, sensor=which, spp=spp, seed=int(seeds[0]), seed_grad=int(seeds[1]))
        dr.backward(dr.mean(weights[which] * dr.square(image - targets[which]), axis=None))
        adam.step()
        x = {name: np.ravel(np.array(dr.detach(adam[name]), dtype=float)) for name in keys}
        found.append({"albedo": 1 / (1 + np.exp(-x["albedo"])), "sigma_t": scale * np.exp(x["sigma_t"])})
        show(k + 1, steps, "")
    return found
