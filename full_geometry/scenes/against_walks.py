"""How far an image by a model is off: its mean on each object over that of a few random walks.

At random places of the film where an object is seen, one walk each estimates the radiance L without bias of a model.
With I the image there, the ratio of means is R = sum I / sum L, of standard error sqrt(sum (I - R L)²) / sum L.
"""

from __future__ import annotations

from typing import NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np

from full_geometry.objects.objects import translucent_shapes

WALKS = 4096
SHOWN = 64  # places on an object, fewer of which tell nothing
LEAST = 0.03  # off, below which there is nothing to tell


class MeanRatio(NamedTuple):
    """The mean of an object in an image over that of walks, with its standard error."""

    object: str
    value: float
    error: float


def mean_ratios(scene: mi.Scene, image: np.ndarray, sensor: int = 0, seed: int = 0) -> list[MeanRatio]:
    """Of each translucent object that enough places of the film show.

    Args:
        scene: whose integrator tells mm_per_unit and max_depth.
        image: (height, width, channels) radiance by a model, of the whole crop.
        sensor: its number.
        seed: of places and walks.

    Raises:
        ValueError: the scene cannot be walked.
    """
    # ---- rays through random places of the film, and the objects they meet
    camera, numbers = scene.sensors()[sensor], np.random.default_rng(seed)
    place = numbers.random((2, WALKS), dtype=np.float32)
    ray, weight = camera.sample_ray(camera.shutter_open(), 0.5, mi.Point2f(*map(mi.Float, place)), mi.Point2f(0.5))
    si = scene.ray_intersect(ray)
    dr.eval(ray, weight, si)

    # ---- a walk each
    settings = scene.integrator().settings.shared()
    walks = mi.load_dict({"type": "translucent_walk", **settings})
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(seed, WALKS)
    L = weight * walks.sample(scene, sampler, mi.Ray3f(ray))[0]
    walked = np.array(L).reshape(-1, WALKS)

    # ---- the image at these places
    height, width = image.shape[:2]
    x, y = (np.minimum((u * n).astype(int), n - 1) for u, n in zip(place, (width, height)))
    shown = image[y, x, : len(walked)].T
    results = []
    for shape in translucent_shapes(scene):
        on = np.array(si.shape == mi.ShapePtr(shape))
        image_there, W = shown[:, on].mean(axis=0), walked[:, on].mean(axis=0)
        if on.sum() < SHOWN or not W.sum() > 0:
            continue
        ratio = image_there.sum() / W.sum()
        results.append(
            MeanRatio(shape.id(), float(ratio), float(np.sqrt(np.square(image_there - ratio * W).sum()) / W.sum()))
        )
    return results


def told(ratios: list[MeanRatio], model: str) -> list[str]:
    """A sentence for each object that is off by more than LEAST and three standard errors."""
    return [
        f"{model} is off: object {r.object!r} has {r.value:.2f} ± {r.error:.2f} of the light of {WALKS} random walks; "
        "--model path_traced has no such error"
        for r in ratios
        if abs(r.value - 1) > max(LEAST, 3 * r.error)
    ]
