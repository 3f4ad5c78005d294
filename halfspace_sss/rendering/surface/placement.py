"""Which shapes of a scene are translucent, and where they, cameras and media of Mitsuba may not stand."""

from __future__ import annotations

from typing import Any

import numpy as np

from halfspace_sss.rendering.surface.object import Object, is_inside

__all__ = ["check_sensors", "choices", "translucent_shapes"]

STARTS = 64  # rays of each sensor that are looked at


def translucent_shapes(scene: Any) -> list[Any]:
    """The shapes whose surface is `translucent`.

    Raises:
        ValueError: such a surface is inside of another BSDF, which would show its reflection only, or its shape belongs
            to a shape group, whose instances are several objects; or the scene has media of Mitsuba.
    """
    import mitsuba as mi

    shapes = scene.shapes()
    for node in mi.traverse(scene).hierarchy:
        if isinstance(node, mi.Shape) and node not in shapes and _inside(node.bsdf()):
            raise ValueError(
                f"a translucent object must stand in the scene itself, got {node.id()!r} in a shapegroup: "
                "give each instance a shape of its own"
            )
    for shape in shapes:
        bsdf = shape.bsdf()
        if _inside(bsdf) and not hasattr(bsdf, "inside"):
            raise ValueError(
                f"a translucent surface must stand alone, got one inside the {bsdf.class_name()} of {shape.id()!r}"
            )
    _check_media(scene)
    return [shape for shape in shapes if hasattr(shape.bsdf(), "inside")]


def _check_media(scene: Any) -> None:
    """ValueError if light would be scattered outside of the objects, or by a second medium in one."""
    found = [
        (side, shape)
        for shape in scene.shapes()
        for side, medium in (("interior", shape.interior_medium()), ("exterior", shape.exterior_medium()))
        if medium is not None
    ]
    for side, shape in found:
        if hasattr(shape.bsdf(), "inside"):
            raise ValueError(
                f"a translucent object must be without {side}, as its surface says what is inside, got the {side} "
                f"of {shape.id()!r}"
            )
    if found:
        side, shape = found[0]
        raise ValueError(f"the scene must be without media of Mitsuba, such as fog, got the {side} of {shape.id()!r}")
    for place in (*scene.sensors(), *scene.emitters()):
        if place.get_medium() is not None:
            raise ValueError(f"the scene must be without media of Mitsuba, such as fog, got one around {place.id()!r}")


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
    import mitsuba as mi

    u = np.random.default_rng(13).random((5, STARTS)).astype(np.float32)
    numbers = [mi.Float(row.tolist()) for row in u]
    # not sample_ray, which some sensors lack
    ray, _ = sensor.sample_ray_differential(0.0, numbers[0], mi.Point2f(*numbers[1:3]), mi.Point2f(*numbers[3:]))
    return np.array(mi.Point3f(ray.o + ray.d * (1e-4 * size))).reshape(3, -1)


def choices(scene: Any) -> dict[str, str]:
    """Why the model "auto" of objects became the one that they have, by id; empty before it was chosen."""
    return {shape.id(): why for shape in scene.shapes() if (why := getattr(shape.bsdf(), "choice", ""))}


def _inside(bsdf: Any) -> bool:
    """Whether a BSDF is `translucent` or has such a one in it."""
    import mitsuba as mi

    return bsdf is not None and any(hasattr(node, "inside") for node in mi.traverse(bsdf).hierarchy)
