"""Textures from images, measured: by walks, and by the dipole of Deng et al. 2022 with all else alike.

The albedo of a bunny's vertices, or of 128 x 128 texels of a ball, from views around it, lit by one lamp, so that some
see its lit side and some its other side; sigma_t is known, images by `translucent_walk`. FLIP of views held out, and
under a lamp from elsewhere, of renders by the way that was fitted; of the truth with other samples it is that of noise.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from pathlib import Path

import mitsuba as mi
import numpy as np

from benchmarks.published import deng
from benchmarks.textures_figure import bands, mosaic
from figures.computing.scans import BUNNY, MM_PER_UNIT
from figures.parts.part import Row, SceneDict
from full_geometry import inverse
from full_geometry.geometry.mesh import vertex_positions
from full_geometry.inverse.views import GivenView
from full_geometry.scenes.scene_files import PATH_TRACED, load_scene
from full_geometry.trade.image_differences import flip_ldr, luminance, srgb
from halfspace_sss.progress import NamedProgress

THINGS = ("bunny", "ball")
WAYS: Mapping[str, str] = {"walk": PATH_TRACED, "deng_dipole": deng.MODEL}
VIEWS, HELD = 8, 2
GIVEN, SHOWN = 64, 128  # samples of images that are given and that are compared, over those of a render of a step
PAINT = "vertex_paint"
SIGMA_T = "0.8, 1.2, 2"  # 1/mm
GUESS = 0.8  # of the albedo
CENTRE, LAMP, OTHER_LAMP = [-0.55, 4.7, 0.0], [-10, 8, 14], [8, 8, -14]
BALL = 4.0  # radius, units of 3.8 mm
TEXELS = 128


def texture_rows(
    thing: str, size: int, spp: int, steps: int, seed: int, folder: Path, progress: NamedProgress | None = None
) -> list[Row]:
    """Of each way, from the same images: errors of the albedo, and FLIP of images.

    Args:
        thing: of `THINGS`.
        size: pixels of the square images.
        spp: samples a pixel of each render of a step.
        steps: of the fit.
        seed: of all samples.
        folder: where meshes are written.
        progress: called with (what, done, total).
    """
    true = _albedo(thing)

    def scene(name: str, albedo: np.ndarray, model: str, lamp: list[float] = LAMP) -> mi.Scene:
        return load_scene(_scene(_object(thing, albedo, folder / f"{name}.ply"), size, model, lamp), model)

    def shown(
        of: mi.Scene, seed: int, views: range = range(VIEWS, VIEWS + HELD), more: int = SHOWN
    ) -> list[np.ndarray]:
        return [np.array(mi.render(of, sensor=k, spp=more * spp, seed=seed + k))[..., :3] for k in views]

    def flip(wanted: list[np.ndarray], got: list[np.ndarray]) -> float:
        return float(np.mean([mean_flip(*pair) for pair in zip(wanted, got)]))

    truth, relit = scene("true", true, PATH_TRACED), scene("true relit", true, PATH_TRACED, OTHER_LAMP)
    images = shown(truth, seed, range(VIEWS), GIVEN)
    given = [GivenView.of(f"view {k}", k, image) for k, image in enumerate(images)]
    held, other, noise = shown(truth, seed + 30), shown(relit, seed + 70), shown(truth, seed + 50)
    settings, rows = inverse.FitSettings(steps=steps, spp=spp, seed=seed), []
    for way, model in WAYS.items():
        first = scene("first", np.full_like(true, GUESS), model)
        before, at = shown(first, seed + 50), time.process_time()

        def show(done: int, total: int, line: str, way: str = way) -> None:
            if progress:
                progress(f"{thing}, {way}: {line}", done, total)

        found = inverse.fit(first, given, ("albedo",), model=None, settings=settings, progress=show)
        seconds, albedo = time.process_time() - at, found.textures["albedo"]
        got = shown(scene("relit", albedo, model, OTHER_LAMP), seed + 90)
        rows.append({
            "object": thing, "way": way, "size": size, "steps": steps, "seed": seed, "numbers": true.size // 3,
            "RMSE, first guess": rms(true - GUESS), "RMSE": rms(albedo - true),
            "held out: FLIP, first guess": flip(held, before), "held out: FLIP": flip(held, shown(first, seed + 50)),
            "held out: FLIP of noise": flip(held, noise), "other lamp: FLIP": flip(other, got), "CPU s": seconds,
        })  # fmt: skip
    return rows


def rms(values: np.ndarray) -> float:
    """The root of the mean square."""
    return float(np.sqrt(np.mean(np.square(values))))


def _albedo(thing: str) -> np.ndarray:
    """Albedos of about the reflectances of the mosaic (vertices, 3), or of the bands (rows, columns, 3)."""
    if thing == "ball":
        reflectance = bands()[0].reshape(TEXELS, TEXELS, -1, 3).mean(axis=2)
    else:
        mesh = mi.load_dict({"type": "ply", "filename": str(BUNNY)})
        reflectance = mosaic(vertex_positions(mesh).astype(float))
    return 1 - (1 - reflectance) ** 2


def _object(thing: str, albedo: np.ndarray, path: Path) -> SceneDict:
    values = np.ascontiguousarray(albedo, dtype=np.float32)
    surface = {"type": "translucent", "sigma_t": SIGMA_T, "eta": 1.4}
    if thing == "ball":
        surface["albedo"] = {"type": "bitmap", "bitmap": mi.Bitmap(values), "raw": True}
        turned = mi.ScalarTransform4f().translate(CENTRE).rotate([0, 0, 1], 20).rotate([1, 0, 0], -90)
        return {"type": "sphere", "to_world": turned.scale(BALL), "bsdf": surface}
    mesh = mi.load_dict({"type": "ply", "filename": str(BUNNY)})
    mesh.add_attribute(PAINT, 3, values.ravel().tolist())
    mesh.write_ply(str(path))
    surface["albedo"] = {"type": "mesh_attribute", "name": PAINT}
    return {"type": "ply", "filename": str(path), "bsdf": surface}


def _scene(thing: SceneDict, size: int, model: str, lamp: list[float]) -> SceneDict:
    """An object with cameras around it and a lamp on one side; the dipole has no single scattering, as its authors."""
    at = mi.ScalarTransform4f()
    if model != PATH_TRACED:
        thing["bsdf"] |= {"orders": deng.ORDERS}
    kind = "translucent_walk" if model == PATH_TRACED else "bssrdf"
    scene = {
        "type": "scene",
        "integrator": {"type": kind, "mm_per_unit": MM_PER_UNIT, "hide_emitters": True},
        "sky": {"type": "constant", "radiance": 0.15},
        "lamp": {"type": "sphere", "center": np.add(CENTRE, lamp).tolist(), "radius": 2.5,
                 "emitter": {"type": "area", "radiance": 25.0}},
        "object": thing,
    }  # fmt: skip
    turns = [*np.arange(VIEWS) * 2 * np.pi / VIEWS, *(np.arange(HELD) * np.pi + 0.4)]
    film = {"type": "hdrfilm", "width": size, "height": size, "rfilter": {"type": "box"}, "pixel_format": "rgb",
            "component_format": "float32"}  # fmt: skip
    for k, turn in enumerate(turns):
        eye = np.add(CENTRE, [24 * np.sin(turn), 6 * np.cos(3 * turn), 24 * np.cos(turn)]).tolist()
        view = at.look_at(eye, CENTRE, [0, 1, 0])
        scene[f"view{k}"] = {"type": "perspective", "fov": 25.0, "to_world": view, "film": film}
    return scene


WHITE = 0.9  # encoded luminance of the bright end
BRIGHT = 99.0  # percentile that comes out there


def mean_flip(reference: np.ndarray, test: np.ndarray) -> float:
    """Mean LDR-FLIP of two images, both exposed so that the bright end of the reference is nearly white."""
    level = float(np.percentile(luminance(reference), BRIGHT))
    exposure = float(np.log2(WHITE / level)) if level > 0 else 0.0
    return flip_ldr(srgb(reference, exposure), srgb(test, exposure)).mean
