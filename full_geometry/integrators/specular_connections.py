"""Specular connections: rays from a point inside an object that refract towards a point outside, by Newton's method.

In the spirit of Walter, Zhao, Holzschuch and Bala 2009 the direction d at the inner point is moved until the refracted
ray meets the target. The derivatives of reflected and refracted rays (Igehy 1999) contain the curvature of the shading
normals; that of normal and bump maps is left out, so that they focus no light.

Many rays may be refracted towards a target, with or without a reflection before. `trial` starts Newton's method from
the first guess, where the straight ray meets the boundary, or from a random direction (specular manifold sampling,
Zeltner, Georgiev and Jakob 2020). From the first guess one ray is found: light that arrives along others is left to
random starts, and where Newton's method fails light is lost.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi

from full_geometry.geometry.points import turned
from full_geometry.geometry.rounding import clear
from full_geometry.objects.objects import TranslucentObject

# steps of Newton's method and the longest, radians, from the first guess and from random directions
FIRST, OTHERS = (6, 0.5), (10, 0.15)
TOLERANCE = 2e-4  # distance by which the target may be missed, over its distance
EXACT = 1e-5  # of that, below which Newton's method ends
LEAST_SPREAD = 1e-12  # area across rays at the target per solid angle inside, over the square of its distance
SPREAD = (20.0, 2.0)  # concentrations of directions about the first guess
MIRRORED = 0.5  # probability to start as a flat boundary would reflect

_Steps = list["tuple[mi.Vector3f, mi.Vector3f]"]  # differentials of a ray's origin and direction, by two axes


@dataclass
class Connection:
    """A specular connection of a point inside with a point outside."""

    p: mi.Point3f  # where it leaves
    n: mi.Normal3f  # geometric, outwards
    d: mi.Vector3f  # direction inside, at the point inside
    w: mi.Vector3f  # direction outside
    T: mi.Float  # Fresnel transmittance, times the reflectance where it is reflected
    length: mi.Float  # inside
    density: mi.Float  # solid angle inside per area across the ray at the target
    valid: mi.Bool


def no_connection() -> Connection:
    return Connection(
        p=mi.Point3f(0), n=mi.Normal3f(0, 0, 1), d=mi.Vector3f(0, 0, 1), w=mi.Vector3f(0, 0, 1), T=mi.Float(0),
        length=mi.Float(0), density=mi.Float(0), valid=mi.Bool(False),
    )  # fmt: skip


# ---- Starts of Newton's method --------------------------------------------------------------------------------------


def refracted_connection(obj: TranslucentObject, p: mi.Point3f, target: mi.Point3f, active: mi.Bool) -> Connection:
    """The ray from p inside the object that is refracted towards `target` outside, found from the first guess."""
    toward = dr.normalize(target - p)
    _, n, _ = meet(obj, p, toward, mi.RayFlags.Minimal | mi.RayFlags.ShadingFrame, active)
    met = connect(obj, p, target, _refracted_inwards(obj, n, toward), False, FIRST, active)
    return replace(met, valid=met.valid & ~obstructed(obj, p, met.d, met.length, met.valid))


def trial(
    obj: TranslucentObject, ends: tuple[mi.Point3f, mi.Point3f], reflects: mi.Bool, random: mi.Bool,
    sampler: mi.Sampler, active: mi.Bool,
) -> Connection:  # fmt: skip
    """A connection from the first guess or from a random direction.
    `ends`: the point inside and the target outside. `reflects`: whether the ray is reflected once before it leaves; it
    then starts from any direction. `random`: whether it starts from a random direction, about the guess where it does
    not reflect."""
    # where the straight ray, or one of any direction, meets the boundary: its normal n
    (p, target), v, u = ends, sampler.next_1d(random), sampler.next_2d(random)
    toward, d = dr.normalize(target - p), mi.warp.square_to_uniform_sphere(u)
    si, n, _ = meet(obj, p, dr.select(reflects, d, toward), mi.RayFlags.Minimal | mi.RayFlags.ShadingFrame, active)

    # without reflection: the direction that refracts towards the target at n, or one about it
    guess = _refracted_inwards(obj, n, toward)
    about = mi.warp.square_to_von_mises_fisher(u, dr.select(v < 0.5, mi.Float(SPREAD[0]), SPREAD[1]))

    # with it: towards the image of the target in the tangent plane, m - 2 (m.n) n, or any direction
    mirror = dr.normalize(target - (p + n * (2 * dr.dot(si.p - p, n))))
    d = dr.select(v < MIRRORED, mirror - n * (2 * dr.dot(mirror, n)), d)

    start = dr.select(reflects, d, dr.select(random, mi.Frame3f(guess).to_world(about), guess))
    newton = dr.select(random, mi.UInt32(OTHERS[0]), FIRST[0]), dr.select(random, mi.Float(OTHERS[1]), FIRST[1])
    met = connect(obj, p, target, start, reflects, newton, active & (~reflects | si.is_valid()))
    return replace(met, valid=met.valid & ~obstructed(obj, p, met.d, met.length, met.valid))


def _refracted_inwards(obj: TranslucentObject, n: mi.Normal3f, w: mi.Vector3f) -> mi.Vector3f:
    """The direction inside, from the inner point, of light that arrives along -w where the normal outwards is n."""
    across = (w - n * dr.dot(w, n)) / obj.eta
    return dr.normalize(across + n * dr.sqrt(dr.maximum(1 - dr.squared_norm(across), 1e-4)))


# ---- Newton's method -------------------------------------------------------------------------------------------------


def connect(
    obj: TranslucentObject, p: mi.Point3f, target: mi.Point3f, start: mi.Vector3f, reflects: mi.Bool | bool,
    newton: tuple, active: mi.Bool,
) -> Connection:  # fmt: skip
    """A ray from p inside the object, reflected once or not, then refracted towards `target`; found from `start`.
    `p`, `target`: the ends. `reflects`: where the ray is reflected; where it is False itself, code for that is left
    out. `newton`: the number of steps, and the longest, radians."""
    steps, longest = newton
    least = LEAST_SPREAD * dr.squared_norm(target - p)

    def step(k: mi.UInt32, d: mi.Vector3f, best: Connection, active: mi.Bool) -> tuple:
        # ---- J delta = e: the step delta in two axes across d, J the derivative of the miss e by d
        e, J, met, valid = _miss(obj, (p, target), d, reflects, active)
        (a, b), (c, f) = J
        det = a * f - b * c
        inverse = dr.rcp(dr.select(dr.abs(det) > least, det, least))
        step_1, step_2 = (f * e[0] - b * e[1]) * inverse, (a * e[1] - c * e[0]) * inverse
        size = dr.sqrt(step_1 * step_1 + step_2 * step_2)
        shrink = dr.minimum(1, longest / dr.maximum(size, 1e-9))

        # ---- keep it where it is close, with the density 1 / |det J|
        miss = dr.sqrt(e[0] * e[0] + e[1] * e[1])
        close = valid & (miss < TOLERANCE * dr.norm(target - mi.Point3f(met[0])))
        at, n, w, T, length = met
        density = 1 / dr.maximum(dr.abs(det), least)
        new = Connection(p=at, n=n, d=d, w=w, T=T, length=length, density=density, valid=close)
        best = dr.select(active & close, new, best)

        # ---- go on where it is not exact: d + e_1 delta_1 + e_2 delta_2
        e_1, e_2 = mi.coordinate_system(d)
        moved = dr.normalize(d + (e_1 * step_1 + e_2 * step_2) * shrink)
        active = active & valid & (~close | (miss > EXACT * dr.norm(target - p))) & (k + 1 < steps)
        return k + 1, dr.select(active, moved, d), best, active

    state = (mi.UInt32(0), mi.Vector3f(start), no_connection(), mi.Bool(active))
    best = dr.while_loop(state, lambda k, d, best, active: active, step, label="connection")[2]
    return replace(best, valid=best.valid & active)


def _miss(
    obj: TranslucentObject, ends: tuple[mi.Point3f, mi.Point3f], d: mi.Vector3f, reflects: mi.Bool | bool,
    active: mi.Bool,
) -> tuple[tuple, tuple, tuple, mi.Bool]:  # fmt: skip
    """Miss of the target in two axes across the ray outside, its derivative by d, the passage, and its validity.

    With dw across d, t the length and d' = -d reflected:

        dx = (1 - d n / (d.n)) (dx + t dd),    dn = n_u du + n_v dv,
        reflected  d - 2 (d.n) n,              refracted  eta d + (c_t - eta c) n.
    """
    (p, target), zero = ends, mi.Vector3f(0)
    T, length, off, valid = mi.Float(1), mi.Float(0), mi.Vector3f(0), mi.Bool(active)
    steps, o = [(zero, mi.Vector3f(e)) for e in mi.coordinate_system(d)], p

    # ---- reflection: d - 2 (d.n) n, by differentials dd - 2 (n d(d.n) + (d.n) dn), with the reflectance F
    if reflects is not False:
        t, (si, n_out, n), arrived = _arrive(obj, o, d, off, steps, valid & reflects)
        c = dr.dot(d, n_out)
        dc = [dr.dot(dd, n_out) + dr.dot(d, dn) for _, dd, dn in arrived]
        onward = [(dx, dd - 2 * (n_out * k + dn * c)) for (dx, dd, dn), k in zip(arrived, dc)]
        F, back = mi.fresnel(dr.maximum(c, 0), 1 / obj.eta)[0], d - n_out * (2 * c)
        valid &= ~reflects | (si.is_valid() & (c > 0) & (dr.dot(back, n) < 0))
        T, length = dr.select(reflects, F, 1), dr.select(reflects, t, 0)
        off = dr.select(reflects, clear(n, back, obj.geometry.clearance), 0)
        o, d = dr.select(reflects, si.p, o), dr.select(reflects, back, d)
        steps = [tuple(dr.select(reflects, x, y) for x, y in zip(*pair)) for pair in zip(onward, steps)]

    # ---- refraction: w = eta d + (c_t - eta c) n, c = d.n, c_t² = 1 - eta² (1 - c²)
    t, (si, n_out, n), steps = _arrive(obj, o, d, off, steps, valid)
    w, F, passes = _refract(obj, d, n_out)
    eta, c = obj.eta, dr.dot(d, n_out)
    c_t = dr.sqrt(dr.maximum(1 - eta * eta * (1 - c * c), 1e-6))

    # ---- columns of J: dx + D dw in two axes across w, D the distance of the target along the ray
    D, f, columns = dr.dot(target - si.p, w), mi.coordinate_system(w), []
    for dx, dd, dn in steps:
        dc = dr.dot(dd, n_out) + dr.dot(d, dn)
        dw = eta * dd + dn * (c_t - eta * c) + n_out * (eta * eta * c * dc / c_t - eta * dc)
        moved = dx + dw * D
        columns.append((dr.dot(f[0], moved), dr.dot(f[1], moved)))
    J = ((columns[0][0], columns[1][0]), (columns[0][1], columns[1][1]))

    # ---- e: the target less the point x + D w of the ray, in the same axes
    miss = target - (si.p + w * D)
    e = (dr.dot(f[0], miss), dr.dot(f[1], miss))
    valid = valid & passes & si.is_valid() & (D > 0) & (dr.dot(w, n) > 0)
    return e, J, (mi.Point3f(si.p), mi.Normal3f(n), mi.Vector3f(w), T * (1 - F), length + t), valid


def _arrive(
    obj: TranslucentObject, o: mi.Point3f, d: mi.Vector3f, off: mi.Vector3f, steps: _Steps, active: mi.Bool
) -> tuple[mi.Float, tuple, list[tuple]]:
    """Length of a ray inside, where it meets the boundary as of `meet`, and differentials dx, dd, dn there."""
    si, n_out, n = met = meet(obj, o + off, d, mi.RayFlags.All | mi.RayFlags.dNSdUV, active)
    t, found = dr.maximum(si.t + dr.dot(off, d), 0), []
    flip = dr.select(dr.dot(si.sh_frame.n, n_out) > 0, 1.0, -1.0) * obj.geometry.curvature_sign
    tangents = obj.geometry.tangents(si, active & si.is_valid())
    for dx, dd in steps:
        # dx + t dd, moved along d into the tangent plane; dn = n_u du + n_v dv
        dx = dx + dd * t
        dx = dx - d * (dr.dot(dx, n) / dr.dot(d, n))
        du, dv = _surface_steps(tangents, dx)
        found.append((dx, dd, (si.dn_du * du + si.dn_dv * dv) * flip))
    return t, met, found


def _refract(obj: TranslucentObject, d: mi.Vector3f, n: mi.Normal3f) -> tuple[mi.Vector3f, mi.Float, mi.Bool]:
    """Direction outside, Fresnel reflectance, and whether light passes, for a ray inside along d."""
    eta = obj.eta
    c = dr.dot(d, n)
    c_t2 = 1 - eta * eta * (1 - c * c)
    F = mi.fresnel(dr.maximum(c, 0), 1 / eta)[0]
    w = eta * d + n * (dr.safe_sqrt(c_t2) - eta * c)
    return dr.normalize(w), F, (c > 0) & (c_t2 > 0)


def _surface_steps(tangents: tuple[mi.Vector3f, mi.Vector3f], dx: mi.Vector3f) -> tuple[mi.Float, mi.Float]:
    """(du, dv) with dp_du du + dp_dv dv = dx; 0 where the shape has no parametrisation. `tangents`: dp_du, dp_dv."""
    # normal equations of the 3 x 2 matrix (dp_du, dp_dv)
    dp_du, dp_dv = tangents
    a, b, c = dr.dot(dp_du, dp_du), dr.dot(dp_du, dp_dv), dr.dot(dp_dv, dp_dv)
    p, q = dr.dot(dp_du, dx), dr.dot(dp_dv, dx)
    det = a * c - b * b
    inverse = dr.select(det > 1e-14 * a * c, dr.rcp(det), 0)
    return (c * p - b * q) * inverse, (a * q - b * p) * inverse


# ---- The boundary seen from inside ----------------------------------------------------------------------------------


def meet(
    obj: TranslucentObject, p: mi.Point3f, d: mi.Vector3f, flags: int, active: mi.Bool
) -> tuple[mi.SurfaceInteraction3f, mi.Normal3f, mi.Normal3f]:
    """Interaction with the boundary, shading normal and geometric normal, both outwards (along d for a sheet)."""
    flags = flags | mi.RayFlags.All if obj.wrapping.bend is not None else flags
    si = obj.geometry.ray_intersect(mi.Ray3f(mi.Point3f(p), d), flags, False, active)
    si = obj.wrapping.bent(si, active & si.is_valid())
    sign = outward_sign(obj, si, d, active & si.is_valid())
    return si, turned(si.sh_frame.n, si.n) * sign, si.n * sign


def outward_sign(
    obj: TranslucentObject, si: mi.SurfaceInteraction3f, way_out: mi.Vector3f, active: mi.Bool = True
) -> mi.Float:
    """1 where the geometric normal of the shape points outwards, else -1; a sheet is a half-space from both sides."""
    if not obj.geometry.closed:
        return dr.select(dr.dot(si.n, way_out) > 0, 1.0, -1.0)
    return obj.geometry.side(si.prim_index, active)


def obstructed(obj: TranslucentObject, p: mi.Point3f, d: mi.Vector3f, length: mi.Float, active: mi.Bool) -> mi.Bool:
    """Whether something inside the object lies on a way from p."""
    inclusions = obj.geometry.inclusions
    return mi.Bool(False) if inclusions is None else inclusions.reach(p, d, length, active)[1]
