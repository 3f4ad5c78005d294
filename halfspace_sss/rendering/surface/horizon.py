"""Directions above a surface but below the horizon of its interpolated normal, so that light there is not lost.

With the geometric normal n and the interpolated one m, a direction w with (m.w)(n.w) < 0 sees the normal

    m' = m - 2 (m.w) w,    |m'| = 1,    m'.w = -m.w,

which is bent just so far that w is as high above its horizon as it was below. What is drawn about m and refracted to
below the surface leaves along -w instead: as w runs over those directions, -w runs over the ones that m does not reach,
with the same |m.w|. So every direction above the surface counts once, and

    ∫_{n.w > 0} f(|m.w|) dw = ∫_{m.w > 0} f(m.w) dw    for every f.

What is reflected to below the surface is reflected once more, at the surface.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

__all__ = ["cosine_above", "cosine_density", "lift", "lifted", "mirrored", "opposed", "sided"]


def lifted(m: Any, n: Any, w: Any) -> Any:
    """The interpolated normal m that w sees, on the side of w that the geometric normal n is on."""
    c = dr.dot(m, w)
    return mi.Normal3f(dr.select(c * dr.dot(n, w) < 0, m - 2 * c * w, m))


def lift(si: Any, w: Any, active: Any = True) -> Any:
    """The interaction with the frame that w sees, a direction in the world that becomes its `wi`."""
    c = dr.dot(si.sh_frame.n, w)
    below = active & (c * dr.dot(si.n, w) < 0)
    frame = mi.Frame3f(dr.select(below, si.sh_frame.n - 2 * c * w, si.sh_frame.n))
    si.sh_frame = dr.select(below, frame, si.sh_frame)
    si.wi = dr.select(below, frame.to_local(w), si.wi)
    return si


def opposed(w: Any, n: Any) -> Any:
    """w, or -w where that is the one above the surface of the normal n."""
    return dr.select(dr.dot(w, n) < 0, -w, w)


def mirrored(w: Any, n: Any) -> Any:
    """w, mirrored at the surface of the normal n where it is below."""
    return w - n * (2 * dr.minimum(dr.dot(w, n), 0))


def sided(si: Any, wo: Any) -> tuple[Any, Any]:
    """A direction of a boundary in the world, on the side of the surface that it has in the frame; if it was turned."""
    d = si.to_world(wo)
    side = dr.select(wo.z > 0, 1.0, -1.0)
    n = si.n * side
    wrong = dr.dot(d, n) < 0
    reflects = wo.z * mi.Frame3f.cos_theta(si.wi) > 0
    return mi.Vector3f(dr.select(wrong, dr.select(reflects, mirrored(d, n), -d), d)), wrong & reflects


def cosine_above(m: Any, n: Any, u: Any) -> tuple[Any, Any]:
    """A direction above the surface by the cosine to m, for a pair of uniforms, and its density |m.w| / pi."""
    w = opposed(mi.Frame3f(m).to_world(mi.warp.square_to_cosine_hemisphere(u)), n)
    return mi.Vector3f(w), cosine_density(m, n, w)


def cosine_density(m: Any, n: Any, w: Any) -> Any:
    """The density of `cosine_above`, 1/sr; 0 below the surface."""
    return dr.select(dr.dot(w, n) > 0, dr.abs(dr.dot(w, m)) * dr.inv_pi, 0)
