"""Small images of a scene by each way."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from full_geometry.geometry.points import floats
from full_geometry.geometry.sensors import independent, seeded
from full_geometry.trade.results import Assessment
from full_geometry.trade.sampling import radiance
from full_geometry.trade.techniques import Stage, Technique, stage

SIDE, SPP = 40, 32


def small_images(
    on: Stage, chosen: Sequence[Technique], sensor: int, seed: int, side: int = SIDE, spp: int = SPP
) -> dict[str, np.ndarray]:
    """Linear images (H, W, 3) of the ways that do not refuse the scene, by name; one seed for all.
    `chosen`: ways. `side`: longest side, pixels."""
    camera = on.scene.sensors()[sensor]
    film = camera.film()
    small = film_of(np.array(film.crop_size(), dtype=int), side)
    results = {}
    for k, technique in enumerate(chosen):
        try:
            image = _rendered(on.scene, camera, on.integrator(technique), small, spp, seeded(seed, 51, k))
        except (ValueError, RuntimeError):
            continue
        results[technique.name] = image
    return results


def film_of(size: np.ndarray, side: int = SIDE) -> tuple[int, int]:
    """Pixels of a film as `size`, at most `side` along each axis."""
    scale = min(side / size.max(), 1.0)
    return tuple(int(v) for v in np.maximum(np.rint(size * scale), 4))


def _rendered(
    scene: mi.Scene, camera: mi.Sensor, integrator: mi.Integrator, size: tuple[int, int], spp: int, seed: int
) -> np.ndarray:
    """Rays of the camera over its whole film, averaged in fewer pixels."""

    def traced(sampler: mi.Sampler, ray: mi.Ray3f, weight: mi.Spectrum) -> list[mi.Float]:
        return [w * c for w, c in zip(weight, radiance(scene, integrator, sampler, ray))]

    image = pixel_means(camera, size, pixels_of(size), spp, seed, traced).reshape(size[1], size[0], -1)
    return np.maximum(image.repeat(3, axis=2) if image.shape[2] == 1 else image, 0).astype(np.float32)


Traced = Callable[..., list]  # of a sampler, rays of the camera and their weights: columns of what they bring


def pixel_means(
    camera: mi.Sensor, film: tuple[int, int], pixels: np.ndarray, spp: int, seed: int, traced: Traced, passes: int = 1
) -> np.ndarray:
    """Means of what rays bring over the samples of each pass of pixels, (pixels, passes, columns).
    `film`: pixels along x and y. `pixels`: x and y of each (n, 2). `spp`: samples of a pass."""
    n = len(pixels) * passes * spp
    sampler = independent(seed, n)
    index = dr.arange(mi.UInt32, n) // dr.opaque(mi.UInt32, passes * spp)
    corner = mi.Point2f(*(dr.gather(mi.Float, floats(pixels[:, k]), index) for k in (0, 1)))
    inverse = mi.Vector2f(dr.opaque(mi.Float, 1 / film[0]), dr.opaque(mi.Float, 1 / film[1]))
    position = mi.Point2f((corner + sampler.next_2d()) * inverse)
    ray, weight = camera.sample_ray_differential(camera.shutter_open(), 0.5, position, sampler.next_2d())
    ray = mi.Ray3f(ray.o + dr.zeros(mi.Point3f, n), ray.d + dr.zeros(mi.Vector3f, n))
    columns = [dr.block_sum(c + dr.zeros(mi.Float, n), spp).numpy() / spp for c in traced(sampler, ray, weight)]
    return np.stack(columns, axis=1).reshape(len(pixels), passes, -1)


def pixels_of(size: Sequence[int], corner: Sequence[int] = (0, 0)) -> np.ndarray:
    """x and y of the pixels of a window (n, 2), row by row."""
    y, x = np.mgrid[: size[1], : size[0]]
    return np.stack([x.ravel() + corner[0], y.ravel() + corner[1]], axis=1)


# --------------------------------------------------------------------------------------------------
# What the figure of a trade is drawn from.


PAGE_SIDE = 128  # of the images of the page


@dataclass(frozen=True, eq=False)
class TradePicture:
    """A trade to be drawn.
    `found`: what was measured. `tolerance`: that was asked. `sentences`: of the recommendation. `images`: linear
    radiance (H, W, 3) by name of the way, path traced first."""

    title: str
    found: Assessment
    tolerance: float
    sentences: tuple[str, ...] = ()
    images: Mapping[str, np.ndarray] = field(default_factory=dict)


def picture_of(
    file: Path, assessment: Assessment, tolerance: float, sentences: Sequence[str], how: Mapping[str, Any]
) -> TradePicture:
    """The picture of a recommendation for a scene file, whose images are rendered for it.
    `assessment`: what was measured. `tolerance`: that was asked. `sentences`: of the recommendation. `how`: sensor,
    seed and parameters, as for `assess`."""
    names = dict.fromkeys(w.way for o in assessment.objects for w in o.ways if not w.refusal)
    images: Mapping[str, np.ndarray] = {}
    if names:
        on = stage(file, how["parameters"])
        images = small_images(on, [Technique.of(name) for name in names], how["sensor"], how["seed"], PAGE_SIDE, SPP)
    return TradePicture(file.stem, assessment, tolerance, tuple(sentences), images)
