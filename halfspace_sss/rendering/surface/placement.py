"""Which shapes of a scene are translucent, and what a `translucent` surface may not be part of."""

from __future__ import annotations

from typing import Any

__all__ = ["choices", "translucent_shapes"]


def translucent_shapes(scene: Any) -> list[Any]:
    """The shapes whose surface is `translucent`.

    Raises:
        ValueError: such a surface is inside of another BSDF, which would show its reflection only, or its shape belongs
            to a shape group, whose instances are several objects.
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
    return [shape for shape in shapes if hasattr(shape.bsdf(), "inside")]


def choices(scene: Any) -> dict[str, str]:
    """Why the model "auto" of objects became the one that they have, by id; empty before it was chosen."""
    return {shape.id(): why for shape in scene.shapes() if (why := getattr(shape.bsdf(), "choice", ""))}


def _inside(bsdf: Any) -> bool:
    """Whether a BSDF is `translucent` or has such a one in it."""
    import mitsuba as mi

    return bsdf is not None and any(hasattr(node, "inside") for node in mi.traverse(bsdf).hierarchy)
