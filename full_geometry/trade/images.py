"""Small images of a scene by each way, and how different they look: FLIP."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from full_geometry.geometry.sensors import independent, seeded
from full_geometry.scenes.scene_files import PATH_TRACED
from full_geometry.trade.image_differences import mean_flip
from full_geometry.trade.results import Assessment
from full_geometry.trade.sampling import radiance
from full_geometry.trade.techniques import Stage, Technique, stage

SIDE, SPP = 40, 32


def small_images(
    on: Stage, chosen: Sequence[Technique], sensor: int, seed: int, side: int = SIDE, spp: int = SPP
) -> dict[str, np.ndarray]:
    """Linear images (H, W, 3) of the ways that do not refuse the scene, by name; one seed for all.

    Args:
        on: the scene.
        chosen: ways.
        sensor: number of the sensor.
        seed: of the samples.
        side: longest side, pixels.
        spp: samples for each pixel.
    """
    camera = on.scene.sensors()[sensor]
    film = camera.film()
    small = _film(np.array(film.crop_size(), dtype=int), side)
    results = {}
    for k, technique in enumerate(chosen):
        try:
            image = _rendered(on.scene, camera, on.integrator(technique), small, spp, seeded(seed, 51, k))
        except (ValueError, RuntimeError):
            continue
        results[technique.name] = image
    return results


def _film(size: np.ndarray, side: int) -> tuple[int, int]:
    scale = min(side / size.max(), 1.0)
    return tuple(int(v) for v in np.maximum(np.rint(size * scale), 4))


def _rendered(
    scene: mi.Scene, camera: mi.Sensor, integrator: mi.Integrator, size: tuple[int, int], spp: int, seed: int
) -> np.ndarray:
    """Rays of the camera over its whole film, averaged in fewer pixels."""
    n = size[0] * size[1] * spp
    sampler = independent(seed, n)
    index = dr.arange(mi.UInt32, n) // dr.opaque(mi.UInt32, spp)
    x, y = index % dr.opaque(mi.UInt32, size[0]), index // dr.opaque(mi.UInt32, size[0])
    inverse = mi.Vector2f(dr.opaque(mi.Float, 1 / size[0]), dr.opaque(mi.Float, 1 / size[1]))
    position = (mi.Vector2f(x, y) + sampler.next_2d()) * inverse
    ray, weight = camera.sample_ray_differential(camera.shutter_open(), 0.5, mi.Point2f(position), sampler.next_2d())
    ray = mi.Ray3f(ray.o + dr.zeros(mi.Point3f, n), ray.d + dr.zeros(mi.Vector3f, n))
    L = radiance(scene, integrator, sampler, ray)
    columns = [dr.block_sum(w * c, spp).numpy() / spp for w, c in zip(weight, L)]
    image = np.stack(columns * (3 if len(columns) == 1 else 1), axis=1)
    return np.maximum(image, 0).reshape(size[1], size[0], 3).astype(np.float32)


def with_flip(
    on: Stage,
    chosen: Sequence[Technique],
    assessment: Assessment,
    sensor: int,
    seed: int,
    images: Mapping[str, np.ndarray] | None = None,
    spp: int = SPP,
) -> Assessment:
    """The assessment with FLIP of the whole small image, where the evaluator is installed and something shines.

    Args:
        on: the scene.
        chosen: ways, path traced first.
        assessment: the assessment.
        sensor: number of the sensor.
        seed: of the samples.
        images: of `small_images`, if they have been rendered, with `spp` samples a pixel.
        spp: samples for each pixel.
    """
    if find_spec("flip_evaluator") is None or all(o.is_dark for o in assessment.objects):
        return assessment
    measured = {PATH_TRACED, *(w.way for o in assessment.objects for w in o.ways if not w.refusal)}
    shown = [
        technique for technique in chosen if technique.name in measured
    ]  # others would gather light for a number that is not told
    images = small_images(on, shown, sensor, seed, spp=spp) if images is None else images
    truth = images[PATH_TRACED]
    again = small_images(on, [chosen[0]], sensor, seeded(seed, 52), max(truth.shape), spp)[PATH_TRACED]
    noise = mean_flip(truth, again)
    values = {name: noise if name == PATH_TRACED else mean_flip(truth, image) for name, image in images.items()}
    objects = []
    for o in assessment.objects:
        rows = tuple(replace(w, flip=values.get(w.way), flip_noise=noise) if not w.refusal else w for w in o.ways)
        objects.append(replace(o, ways=rows))
    return replace(assessment, objects=tuple(objects))


# --------------------------------------------------------------------------------------------------
# What the figure of a trade is drawn from.


PAGE_SIDE = 128  # of the images of the page


@dataclass(frozen=True, eq=False)
class TradePicture:
    """A trade to be drawn.

    Args:
        title: of the scene.
        found: what was measured.
        tolerance: that was asked.
        sentences: of the recommendation.
        images: linear radiance (H, W, 3) by name of the way, path traced first.
    """

    title: str
    found: Assessment
    tolerance: float
    sentences: tuple[str, ...] = ()
    images: Mapping[str, np.ndarray] = field(default_factory=dict)


def picture_of(
    file: Path, assessment: Assessment, tolerance: float, sentences: Sequence[str], how: Mapping[str, Any]
) -> TradePicture:
    """The picture of a recommendation for a scene file, whose images are rendered for it.

    Args:
        file: the scene.
        assessment: what was measured.
        tolerance: that was asked.
        sentences: of the recommendation.
        how: sensor, seed and parameters, as for `assess`.
    """
    names = dict.fromkeys(w.way for o in assessment.objects for w in o.ways if not w.refusal)
    images: Mapping[str, np.ndarray] = {}
    if names:
        on = stage(file, how["parameters"])
        images = small_images(on, [Technique.of(name) for name in names], how["sensor"], how["seed"], PAGE_SIDE, SPP)
    return TradePicture(file.stem, assessment, tolerance, tuple(sentences), images)
