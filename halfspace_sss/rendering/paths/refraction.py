"""Where rays inside an object meet its boundary, and the one ray that is refracted towards a given point.

The connection follows Walter, Zhao, Holzschuch and Bala 2009 in spirit: the direction at the event is moved by Newton's
method until the refracted ray meets the target; the derivative of the refracted ray (Igehy 1999) contains the curvature
of the shading normals. One solution is looked for, from where the straight ray meets the boundary: light that reaches
the event along several refracted rays is counted once, and where Newton's method fails the light is lost.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import drjit as dr
import mitsuba as mi

from halfspace_sss.rendering.surface.object import turned
from halfspace_sss.rendering.transport.body import Body

__all__ = ["Connection", "meet", "refracted_connection"]

ITERATIONS = 6
LONGEST_STEP = 0.5  # of the direction, radians
TOLERANCE = 1e-3  # distance by which the target may be missed, over its distance


class Connection(NamedTuple):
    """A refracted connection; `d` is its direction inside, `density` the solid angle inside per area across the ray."""

    p: Any
    n: Any
    d: Any
    w: Any
    T: Any
    length: Any
    density: Any
    valid: Any


def meet(body: Body, p: Any, d: Any, flags: Any, active: Any) -> tuple[Any, Any, Any]:
    """Interaction with the boundary, shading normal and geometric normal, both outwards (along d for a sheet)."""
    si = body.found.scene.ray_intersect(mi.Ray3f(p, d), flags, False, active)
    sign = body.found.side(si.prim_index, active & si.is_valid())
    if not body.found.closed:
        sign = dr.select(dr.dot(si.n, d) > 0, 1.0, -1.0)
    return si, turned(si.sh_frame.n, si.n) * sign, si.n * sign


def _refract(body: Body, d: Any, n: Any) -> tuple[Any, Any, Any]:
    """Direction outside, Fresnel reflectance, and whether light passes, for a ray inside along d."""
    eta = body.eta
    c = dr.dot(d, n)
    c_t2 = 1 - eta * eta * (1 - c * c)
    F = mi.fresnel(dr.maximum(c, 0), 1 / eta)[0]
    w = eta * d + n * (dr.safe_sqrt(c_t2) - eta * c)
    return dr.normalize(w), F, (c > 0) & (c_t2 > 0)


def refracted_connection(body: Body, p: Any, target: Any, active: Any) -> Connection:
    """The ray from p inside the body that is refracted towards `target` outside."""

    def step(k: Any, d: Any, found: tuple, active: Any) -> tuple:
        e, J, met, valid = _aim(body, p, d, target, active)
        (a, b), (c, f) = J
        det = a * f - b * c
        inverse = dr.rcp(dr.select(dr.abs(det) > 1e-12, det, 1e-12))
        step_1, step_2 = (f * e[0] - b * e[1]) * inverse, (a * e[1] - c * e[0]) * inverse
        size = dr.sqrt(step_1 * step_1 + step_2 * step_2)
        shrink = dr.minimum(1, LONGEST_STEP / dr.maximum(size, 1e-9))
        miss = dr.sqrt(e[0] * e[0] + e[1] * e[1])
        close = valid & (miss < TOLERANCE * dr.norm(target - mi.Point3f(met[0])))
        found = tuple(
            dr.select(active & close, x, y) for x, y in zip((*met, 1 / dr.maximum(dr.abs(det), 1e-12), d, close), found)
        )
        e_1, e_2 = mi.coordinate_system(d)
        onward = dr.normalize(d + (e_1 * step_1 + e_2 * step_2) * shrink)
        active = active & valid & (~close | (miss > 1e-5 * dr.norm(target - p))) & (k + 1 < ITERATIONS)
        return k + 1, dr.select(active, onward, d), found, active

    start = _first_guess(body, p, dr.normalize(target - p), active)
    nothing = (
        mi.Point3f(0), mi.Normal3f(0, 0, 1), mi.Vector3f(0, 0, 1), mi.Float(0), mi.Float(0),
        mi.Float(0), mi.Vector3f(0, 0, 1), mi.Bool(False),
    )  # fmt: skip
    state = (mi.UInt32(0), mi.Vector3f(start), nothing, mi.Bool(active))
    at, n, w, T, length, density, d, valid = dr.while_loop(state, lambda *s: s[-1], step, label="refraction")[2]
    return Connection(at, n, d, w, T, length, density, valid & active)


def _first_guess(body: Body, p: Any, w: Any, active: Any) -> Any:
    """The direction inside of light that arrives along -w where the straight ray along w meets the boundary."""
    _, n_out, _ = meet(body, p, w, mi.RayFlags.Minimal | mi.RayFlags.ShadingFrame, active)
    across = (w - n_out * dr.dot(w, n_out)) / body.eta
    return dr.normalize(across + n_out * dr.sqrt(dr.maximum(1 - dr.squared_norm(across), 1e-4)))


def _aim(body: Body, p: Any, d: Any, target: Any, active: Any) -> tuple[tuple, tuple, tuple, Any]:
    """Miss of the target in two axes across the refracted ray, its derivative by d, the passage, and its validity.

    With dw across d: dx = s (dw - d (dw.n)/(d.n)); dn = n_u du + n_v dv; refracted w = eta d + (c_t - eta c) n.
    """
    flags = mi.RayFlags.All | mi.RayFlags.dNSdUV
    si, n_out, n = meet(body, p, d, flags, active)
    w, F, valid = _refract(body, d, n_out)
    eta, c = body.eta, dr.dot(d, n_out)
    c_t = dr.sqrt(dr.maximum(1 - eta * eta * (1 - c * c), 1e-6))
    flip = dr.select(dr.dot(si.sh_frame.n, n_out) > 0, 1.0, -1.0) * body.found.curvature_sign
    D = dr.dot(target - si.p, w)
    f = mi.coordinate_system(w)
    columns = []
    for e in mi.coordinate_system(d):
        dx = si.t * (e - d * (dr.dot(e, n) / dr.dot(d, n)))
        du, dv = _surface_steps(si, dx)
        dn = (si.dn_du * du + si.dn_dv * dv) * flip
        dc = dr.dot(e, n_out) + dr.dot(d, dn)
        dw = eta * e + dn * (c_t - eta * c) + n_out * (eta * eta * c * dc / c_t - eta * dc)
        moved = dx + dw * D
        columns.append((dr.dot(f[0], moved), dr.dot(f[1], moved)))
    miss = target - (si.p + w * D)
    e = (dr.dot(f[0], miss), dr.dot(f[1], miss))
    J = ((columns[0][0], columns[1][0]), (columns[0][1], columns[1][1]))
    valid = valid & si.is_valid() & (D > 0) & (dr.dot(w, n) > 0)
    return e, J, (mi.Point3f(si.p), mi.Normal3f(n), mi.Vector3f(w), 1 - F, si.t), valid


def _surface_steps(si: Any, dx: Any) -> tuple[Any, Any]:
    """(du, dv) with dp_du du + dp_dv dv = dx; 0 where the shape has no parametrisation."""
    a, b, c = dr.dot(si.dp_du, si.dp_du), dr.dot(si.dp_du, si.dp_dv), dr.dot(si.dp_dv, si.dp_dv)
    p, q = dr.dot(si.dp_du, dx), dr.dot(si.dp_dv, dx)
    det = a * c - b * b
    inverse = dr.select(det > 1e-14 * a * c, dr.rcp(det), 0)
    return (c * p - b * q) * inverse, (a * q - b * p) * inverse
