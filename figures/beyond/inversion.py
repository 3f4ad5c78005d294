"""Materials from images, measured: `fit` beside Mitsuba's `prbvolpath` on homogeneous media, and textures of a bunny.

Media after the synthetic benchmark of Son et al. 2024: sigma_t 20, 50, 50 and albedo 0.9, from sigma_t 50 and albedo
0.5, of a cube of 0.2 mm; images of `volpathmis` at depth 256, as `volpath` has outliers. `prbvolpath` at depth 6 and 64
moves log sigma_t and logit albedo by Adam at rate 0.05, one view a step, with two independent renders in its loss. All
CPU seconds, compiling too.

Textures: the albedo of the bunny's vertices from views around it, lit by one lamp, so that some see its lit side and
some its other side; images by `translucent_walk`. FLIP of views held out, and under a light from elsewhere.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from figures.beyond.textures import mosaic
from figures.computing.images import mean_flip
from figures.computing.scenes import BUNNY, MM_PER_UNIT
from halfspace_sss import inverse
from halfspace_sss.inverse.views import GivenView
from halfspace_sss.progress import NamedProgress
from halfspace_sss.rendering.scenes.mitsuba_scene import with_media
from halfspace_sss.rendering.scenes.scene_files import PATH_TRACED, load_scene

# ---- Homogeneous media -----------------------------------------------------------------------------------------------

CASES: Mapping[str, Mapping[str, float]] = {
    "eta 1": {"eta": 1.0, "g": 0.0},
    "eta 1.4": {"eta": 1.4, "g": 0.0},
    "g 0.8": {"eta": 1.0, "g": 0.8},
}
TRUE = {"albedo": np.full(3, 0.9), "sigma_t": np.array([20.0, 50.0, 50.0])}
START = {"albedo": np.full(3, 0.5), "sigma_t": np.full(3, 50.0)}
EDGE = 0.2  # mm
TARGET_DEPTH = 256
DEPTHS = (6, 64)
RATE = 0.05
SIDES = ([0, 0, 1], [1, 0.2, 0], [0, 1, 0.2], [-1, 0, 0.3], [0.2, -1, 0], [0.3, 0.2, -1])


def medium_rows(
    size: int, spp: int, steps: int, prb_steps: int, seed: int, progress: NamedProgress | None = None
) -> Iterator[dict[str, Any]]:
    """Of each case and way: errors of what was found, and CPU seconds.

    Args:
        size: pixels of the square images.
        spp: samples a pixel of each render of a step.
        steps: of `fit`.
        prb_steps: of `prbvolpath`.
        seed: of all samples.
        progress: called with (what, done, total).
    """
    for case, kind in CASES.items():
        volpath = {"type": "volpathmis", "max_depth": TARGET_DEPTH, "hide_emitters": True}
        truth = with_media(_cube(TRUE, kind, size), 1.0, volpath)
        images = [np.array(mi.render(truth, sensor=k, spp=16 * spp, seed=seed + k)) for k in range(len(SIDES))]
        views = [GivenView.of(f"view {k}", k, image) for k, image in enumerate(images)]
        settings = inverse.FitSettings(steps=steps, spp=spp, seed=seed)
        for done, depth in enumerate((None, *DEPTHS)):
            way = "fit" if depth is None else f"prbvolpath, depth {depth}"
            if progress:
                progress(f"{case}, {way}", done, 1 + len(DEPTHS))
            at = time.process_time()
            if depth is None:
                found = inverse.fit(_cube(START, kind, size), views, ("albedo", "sigma_t"), settings=settings).values
            else:
                found = _prb(_cube(START, kind, size), images, spp, prb_steps, depth, seed)
            seconds = time.process_time() - at
            yield {"case": case, "way": way, **_errors(found, kind["g"]), "CPU s": seconds}


def _errors(found: Mapping[str, np.ndarray], g: float) -> dict[str, float]:
    """Root mean squares over channels; of sigma_s' and sigma_t relative."""
    reduced = [values["albedo"] * values["sigma_t"] * (1 - g) for values in (found, TRUE)]
    return {
        "albedo": _rms(found["albedo"] - TRUE["albedo"]),
        "sigma_t, %": 100 * _rms(found["sigma_t"] / TRUE["sigma_t"] - 1),
        "sigma_s', %": 100 * _rms(reduced[0] / reduced[1] - 1),
    }


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def _cube(medium: Mapping[str, np.ndarray], kind: Mapping[str, float], size: int) -> dict[str, Any]:
    """A cube of 0.2 mm under a dim sky and a large lamp, seen from six sides."""
    at, film = mi.ScalarTransform4f(), _film(size)
    numbers = {key: ", ".join(map(repr, map(float, value))) for key, value in medium.items()}
    scene = {
        "type": "scene",
        "integrator": {"type": "translucent_walk", "hide_emitters": True},
        "sky": {"type": "constant", "radiance": 0.5},
        "lamp": {"type": "sphere", "center": [-0.72, 0.96, 0.96], "radius": 0.8,
                 "emitter": {"type": "area", "radiance": 2.5}},
        "object": {"type": "cube", "to_world": at.rotate([0, 1, 0], 25).scale(EDGE / 2),
                   "bsdf": {"type": "translucent", **numbers, **kind}},
    }  # fmt: skip
    for k, side in enumerate(SIDES):
        eye = (8 * EDGE * np.array(side) / np.linalg.norm(side)).tolist()
        view = at.look_at(eye, [0, 0, 0], [0, 1, 0] if abs(side[1]) < 1 else [0, 0, 1])
        scene[f"view{k}"] = {"type": "perspective", "fov": 12.0, "to_world": view, "film": film}
    return scene


def _film(size: int) -> dict[str, Any]:
    return {"type": "hdrfilm", "width": size, "height": size, "rfilter": {"type": "box"}, "pixel_format": "rgb",
            "component_format": "float32"}  # fmt: skip


def _prb(
    start: dict[str, Any], images: list[np.ndarray], spp: int, steps: int, depth: int, seed: int
) -> dict[str, np.ndarray]:
    """Adam on log sigma_t and logit albedo by Mitsuba's gradients of volume paths."""
    scene = with_media(start, 1.0, {"type": "prbvolpath", "max_depth": depth, "hide_emitters": True})
    parameters = mi.traverse(scene)
    keys = {name: next(k for k in parameters.keys() if k.endswith(f"{name}.value.value")) for name in TRUE}
    scale = float(START["sigma_t"].max())  # `with_media` has the colour over this
    targets = [mi.TensorXf(image.astype(np.float32)) for image in images]
    weights = [1 / dr.square(target + 0.1 * dr.mean(target, axis=None)) for target in targets]
    adam = mi.ad.Adam(lr=RATE)
    x = {"albedo": np.log(START["albedo"] / (1 - START["albedo"])), "sigma_t": np.log(START["sigma_t"] / scale)}
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
    return {"albedo": 1 / (1 + np.exp(-x["albedo"])), "sigma_t": scale * np.exp(x["sigma_t"])}


# ---- Textures --------------------------------------------------------------------------------------------------------

VIEWS, HELD = 8, 2
PAINT, GUESS = "vertex_paint", 0.8
SIGMA_T = "0.8, 1.2, 2"


def texture_row(
    size: int, spp: int, steps: int, seed: int, folder: Path, progress: NamedProgress | None = None
) -> dict[str, Any]:
    """Errors of the bunny's albedo by vertex, and FLIP of its images.

    Args:
        size: pixels of the square images.
        spp: samples a pixel of each render of a step.
        steps: of the fit.
        seed: of all samples.
        folder: where the meshes are written.
        progress: called with (what, done, total).
    """
    mesh = mi.load_dict({"type": "ply", "filename": str(BUNNY)})
    p = np.array(mi.traverse(mesh)["vertex_positions"], dtype=float).reshape(-1, 3)
    true = 1 - (1 - mosaic(p)) ** 2  # albedos of about these reflectances
    scenes = {name: load_scene(_bunny(v, size, folder, name), PATH_TRACED) for name, v in
              (("true", true), ("first", np.full_like(true, GUESS)))}  # fmt: skip
    images = [_truth(scenes["true"], k, spp, seed) for k in range(VIEWS + HELD)]
    views = [GivenView.of(f"view {k}", k, image, held_out=k >= VIEWS) for k, image in enumerate(images)]
    before = [mean_flip(images[k], _truth(scenes["first"], k, spp, seed + 50)) for k in range(VIEWS, VIEWS + HELD)]

    def show(done: int, total: int, what: str) -> None:
        if progress:
            progress(what, done, total)

    settings = inverse.FitSettings(steps=steps, spp=spp, seed=seed)
    at = time.process_time()
    found = inverse.fit(scenes["first"], views, ("albedo",), model=None, settings=settings, progress=show)
    seconds = time.process_time() - at
    albedo = found.textures["albedo"]
    flips = [mean_flip(images[k], _truth(scenes["first"], k, spp, seed + 50)) for k in range(VIEWS, VIEWS + HELD)]
    other = [load_scene(_bunny(v, size, folder, name, [8, 8, -14]), PATH_TRACED) for name, v in
             (("true", true), ("found", albedo))]  # fmt: skip
    relit = [mean_flip(*(_truth(scene, k, spp, seed + 20 * j) for j, scene in enumerate(other))) for k in range(2)]
    return {
        "size": size, "steps": steps, "vertices": len(true), "RMSE of the first guess": _rms(true - GUESS),
        "RMSE": _rms(albedo - true), "held out: FLIP of the first guess": float(np.mean(before)),
        "held out: FLIP": float(np.mean(flips)), "other light: FLIP": float(np.mean(relit)), "CPU s": seconds,
    }  # fmt: skip


def _truth(scene: mi.Scene, view: int, spp: int, seed: int) -> np.ndarray:
    return np.array(mi.render(scene, sensor=view, spp=8 * spp, seed=seed + view))[..., :3]


def _bunny(albedo: np.ndarray, size: int, folder: Path, name: str, lamp: list[float] | None = None) -> dict[str, Any]:
    """The bunny with an albedo at its vertices, cameras around it, and a lamp on one side."""
    at, centre = mi.ScalarTransform4f(), [-0.55, 4.7, 0.0]
    mesh = mi.load_dict({"type": "ply", "filename": str(BUNNY)})
    mesh.add_attribute(PAINT, 3, albedo.astype(np.float32).ravel().tolist())
    mesh.write_ply(path := str(folder / f"{name}.ply"))
    where = np.add(centre, lamp or [-10, 8, 14]).tolist()
    surface = {"type": "translucent", "albedo": {"type": "mesh_attribute", "name": PAINT}, "sigma_t": SIGMA_T}
    scene = {
        "type": "scene",
        "integrator": {"type": "translucent_walk", "mm_per_unit": MM_PER_UNIT, "hide_emitters": True},
        "sky": {"type": "constant", "radiance": 0.15},
        "lamp": {"type": "sphere", "center": where, "radius": 2.5, "emitter": {"type": "area", "radiance": 25.0}},
        "bunny": {"type": "ply", "filename": path, "bsdf": {**surface, "eta": 1.4}},
    }
    turns = [*np.arange(VIEWS) * 2 * np.pi / VIEWS, *(np.arange(HELD) * np.pi + 0.4)]
    for k, turn in enumerate(turns):
        eye = np.add(centre, [24 * np.sin(turn), 6 * np.cos(3 * turn), 24 * np.cos(turn)]).tolist()
        view = at.look_at(eye, centre, [0, 1, 0])
        scene[f"view{k}"] = {"type": "perspective", "fov": 25.0, "to_world": view, "film": _film(size)}
    return scene
