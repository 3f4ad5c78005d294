"""What lies inside translucent objects, as walks meet it: which medium is on either side of a surface there.

Indices are relative, as Mitsuba's path tracers take them: int_ior / ext_ior of a `dielectric` inside, and eta of an
object inside another, are those of its inside over what is around it. A bubble in wax of eta 1.4 is a `dielectric` with
int_ior 1 and ext_ior 1.4. What refracts displaces the medium around it; what passes light straight (`null`, `mask`,
`thindielectric`) stands in it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from halfspace_sss.rendering.light.small import is_delta
from halfspace_sss.rendering.surface.object import Object, survey
from halfspace_sss.rendering.surface.placement import Content, contents
from halfspace_sss.rendering.surface.sharing import scene_of

__all__ = ["Inner"]

REFRACTS = int(mi.BSDFFlags.DeltaTransmission) | int(mi.BSDFFlags.GlossyTransmission)


@dataclass(frozen=True, eq=False)
class Inner:
    """What lies inside the objects of a scene.

    Args:
        scene: a Mitsuba scene that holds the objects, and the shapes inside or partly inside them.
        tables: by what Dr.Jit's registry calls a shape, the number of the object `around` it or -1, and whether it
            `displaces` that; by the number of an object, whether it stands `alone`, neither in another nor around
            anything.
        lamps: the delta lights in the medium of an object, and its number.
    """

    scene: Any
    tables: dict[str, Any]
    lamps: list[tuple[Any, int]]

    @classmethod
    def of(cls, scene: Any, objects: list[Object]) -> Inner | None:
        """What lies inside; None if nothing does.

        Raises:
            ValueError: something that refracts lies partly inside, is not closed, or objects count some orders only.
        """
        found = contents(scene, objects)
        if not found:
            return None
        _check(found, objects)
        glass = [survey(thing, scene) for thing in _shapes(found) if _displaces(thing)]
        for piece in glass:
            if not piece.closed:
                raise ValueError(f"what refracts inside an object must be closed, got the shape {piece.name}")
        if glass:
            found = contents(scene, [*objects, *glass])
        holders = [*objects, *glass]
        inside = [content for content in found if content.object < len(objects)]
        things = {id(content.thing): content.thing for content in inside}
        around = {key: _innermost(key, found, holders, len(objects)) for key in things}
        own = [obj.shape for obj in objects]
        shapes = [*own, *(thing for thing in _shapes(inside) if not any(thing is shape for shape in own))]
        numbers = [int(dr.reinterpret_array(mi.UInt32, mi.ShapePtr(shape))[0]) for shape in shapes]
        at = np.full(max(numbers) + 1, -1, dtype=np.int32)
        displaces = np.zeros(len(at), dtype=bool)
        for number, shape in zip(numbers, shapes):
            at[number], displaces[number] = around.get(id(shape), -1), _displaces(shape)
        holding = {content.object for content in inside}
        alone = [k not in holding and id(shape) not in things for k, shape in enumerate(own)]
        tables = {"around": mi.Int32(at.tolist()), "displaces": mi.Bool(displaces.tolist()), "alone": mi.Bool(alone)}
        dr.make_opaque(tables)
        lamps = [(thing, around[key]) for key, thing in things.items() if isinstance(thing, mi.Emitter)]
        lamps = [(lamp, k) for lamp, k in lamps if is_delta(lamp) and k >= 0]
        return cls(scene_of(shapes, scene), tables, lamps)

    def around(self, shape: Any) -> Any:
        """The number of the object around a shape, or -1."""
        return self._of_shape("around", shape, -1)

    def displaces(self, shape: Any) -> Any:
        """Whether a shape, which is no translucent object, displaces the medium around it."""
        return self._of_shape("displaces", shape, False)

    def _of_shape(self, key: str, shape: Any, otherwise: Any) -> Any:
        pointer, table = dr.reinterpret_array(mi.UInt32, shape), self.tables[key]
        known = pointer < dr.width(table)
        return dr.select(known, dr.gather(type(table), table, pointer, known), otherwise)


def _shapes(found: list[Content]) -> list[Any]:
    return list({id(c.thing): c.thing for c in found if isinstance(c.thing, mi.Shape)}.values())


def _displaces(shape: Any) -> bool:
    return not hasattr(shape.bsdf(), "inside") and bool(shape.bsdf().flags() & REFRACTS)


def _innermost(key: int, found: list[Content], holders: list[Object], n: int) -> int:
    """The smallest holder of a thing if that is an object, by its number; -1 if it is of glass."""
    numbers = [content.object for content in found if id(content.thing) == key]
    smallest = min(numbers, key=lambda k: holders[k].size)
    return smallest if smallest < n else -1


def _check(found: list[Content], objects: list[Object]) -> None:
    for content in found:
        holder = objects[content.object]
        surfaces = [holder.shape.bsdf()]
        if isinstance(content.thing, mi.Shape):
            translucent = hasattr(content.thing.bsdf(), "inside")
            if not content.whole and (translucent or _displaces(content.thing)):
                raise ValueError(
                    f"what refracts must lie inside an object or outside, got {content.name} partly inside "
                    f"object {holder.name}"
                )
            surfaces += [content.thing.bsdf()] if translucent else []
        for surface in surfaces:
            if surface.inside.orders != "total":
                raise ValueError(
                    f"orders must be 'total' of objects with something inside, got {surface.inside.orders!r} where "
                    f"{content.name} lies inside object {holder.name}"
                )
