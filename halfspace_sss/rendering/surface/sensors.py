"""Where the rays of sensors begin: outside of every translucent object, or the scene is refused."""

from __future__ import annotations

from typing import Any

import mitsuba as mi
import numpy as np

from halfspace_sss.rendering.surface.object import Object, is_inside

__all__ = ["check_sensors"]

STARTS = 64  # rays of each sensor that are looked at


def check_sensors(scene: Any, objects: list[Object]) -> None:
    """Refuse sensors inside of objects, of any kind: they may have several places, or a surface.

    Raises:
        ValueError: rays of a sensor begin inside an object, whose id is named.
    """
    for sensor in scene.sensors():
        for found in objects:
            if is_inside(found, _starts(sensor, found.size)).any():
                raise ValueError(f"the camera must be outside of every object, got it inside {found.name}")


def _starts(sensor: Any, size: float) -> np.ndarray:
    """Shape (3, n); off a surface that the rays leave by a little of the size of an object."""
    u = np.random.default_rng(13).random((5, STARTS)).astype(np.float32)
    numbers = [mi.Float(row.tolist()) for row in u]
    # not sample_ray, which some sensors lack
    ray, _ = sensor.sample_ray_differential(0.0, numbers[0], mi.Point2f(*numbers[1:3]), mi.Point2f(*numbers[3:]))
    return np.array(mi.Point3f(ray.o + ray.d * (1e-4 * size))).reshape(3, -1)
