"""What the flow of a patch is told: where the exit and its first event lie as seen from the patch."""

from __future__ import annotations

from typing import Any

from full_geometry.features import Frame, Side
from full_geometry.flow.chart import PatchFrame

__all__ = ["N_CONTEXT", "context", "direction_square", "from_square"]

N_CONTEXT = 18


def context(frame: Frame, exit: Side, patch: PatchFrame) -> list[Any]:
    """The numbers of `N_CONTEXT`.

    x_o and y_o in the frame of the patch as v / (|v| + radius), the logarithms of both distances over the radius, n_o
    and w_o in that frame, and the radius, in mean free paths, and the way to y_o, as logarithms.
    """
    import drjit as dr

    def local(v: Any) -> list[Any]:
        return [dr.dot(v, axis) for axis in patch.axes]

    found: list[Any] = []
    for p in (exit.at.p, exit.event.y):
        d = p - patch.centre
        r = dr.norm(d)
        found += [*local(d / (r + patch.radius)), 0.5 * dr.log(r / patch.radius + 0.05)]
    found += [*local(exit.at.n_out), *local(exit.at.w), dr.dot(exit.at.n_out, exit.at.w)]
    found += [0.5 * dr.log(patch.radius * frame.sigma_t + 1e-3), 0.5 * dr.log(exit.event.length * frame.sigma_t + 1e-2)]
    return [*found, 1 / (1 + patch.radius * frame.sigma_t)]


def _tangents(n: Any, towards: Any) -> tuple[Any, Any]:
    """Tangents of a normal, the first towards a point as seen from there; any where that is along the normal."""
    import drjit as dr
    import mitsuba as mi

    flat = towards - n * dr.dot(towards, n)
    length = dr.norm(flat)
    s = dr.select(length > 1e-4 * dr.norm(towards), flat / dr.maximum(length, 1e-30), mi.coordinate_system(n)[0])
    return mi.Vector3f(s), mi.Vector3f(dr.cross(n, s))


def direction_square(n: Any, towards: Any, w: Any) -> tuple[Any, Any]:
    """Coordinates in [0, 1)² of a direction above a surface, uniform where it follows the cosine."""
    import drjit as dr
    import mitsuba as mi

    s, t = _tangents(n, towards)
    u = mi.warp.cosine_hemisphere_to_square(mi.Vector3f(dr.dot(w, s), dr.dot(w, t), dr.maximum(dr.dot(w, n), 0)))
    return tuple(dr.clip(v, 0, 1 - 2.0**-20) for v in u)


def from_square(n: Any, towards: Any, u: tuple[Any, Any]) -> Any:
    """The direction of coordinates u."""
    import mitsuba as mi

    s, t = _tangents(n, towards)
    v = mi.warp.square_to_cosine_hemisphere(mi.Point2f(*u))
    return s * v.x + t * v.y + n * v.z
