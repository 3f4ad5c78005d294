"""Lines between two points, and where light would go if the surface between them were a plane."""

from __future__ import annotations

from typing import Any, NamedTuple

__all__ = ["Line", "on_a_plane"]

LEAST_R = 1e-9


class Line(NamedTuple):
    """From one point to another: direction, length."""

    d: Any
    length: Any

    @classmethod
    def between(cls, a: Any, b: Any) -> Line:
        """From a to b."""
        import drjit as dr

        way = b - a
        length = dr.norm(way)
        return cls(way / dr.maximum(length, LEAST_R), length)

    @property
    def back(self) -> Line:
        """From the other end."""
        return Line(-self.d, self.length)


def on_a_plane(n_o: Any, inner_o: Any, n_i: Any, inner_i: Any, line: Line) -> tuple[Any, Any]:
    """The refracted directions as on a plane, x along the line between the points, z along the normals.

    There both y lie a mean free path along them.
    """
    import drjit as dr
    import mitsuba as mi

    def inside(n: Any, along: Any) -> Any:
        flat = mi.Vector3f(line.d - n * dr.dot(n, line.d))
        spare = mi.coordinate_system(n)[0]
        t = dr.normalize(dr.select(dr.squared_norm(flat) > 1e-12, flat, spare))
        return mi.Vector3f(dr.dot(along, t), dr.dot(along, dr.cross(n, t)), dr.dot(along, n))

    return inside(n_o, inner_o), inside(n_i, inner_i)
