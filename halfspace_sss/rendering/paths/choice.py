"""Which events are taken at the surface of a translucent object: by what each is expected to bring."""

from __future__ import annotations

from typing import Any, NamedTuple

import drjit as dr
import mitsuba as mi

from halfspace_sss.rendering.paths.few import Leg
from halfspace_sss.rendering.surface.horizon import lifted
from halfspace_sss.rendering.surface.object import turned
from halfspace_sss.rendering.transport.body import Body
from halfspace_sss.rendering.transport.plane import Exit, number, place

__all__ = ["Choice", "choose", "exit_at"]

LEAST_REFLECTION = 0.05  # probability of reflection where there is light to come; Fresnel's is 0.04 face on
LEAST_FEW, MOST_FEW = 0.03, 0.95
FEW_BOOST = 2.0  # as its light varies more from one walk to the next
LEAST_PASSING = 0.3  # of T, where order 0 does not count: reflected back, a walk may be scattered yet


class Choice(NamedTuple):
    """At a point of a body: probability of reflection and, of the events inside, of orders below two; their way in."""

    reflection: Any
    few: Any
    leg: Leg


def choose(body: Body, si: Any, active: Any) -> Choice:
    """Probabilities of the events.

    With T the mean transmittance along the refracted ray to the other side, R_1 and R_2 the reflectances of the
    half-space by single scattering and more, and albedo a, the expected light is T of order 0,
    (1 - T) (R_1 + (a - R_1) T) of order 1 and (1 - T) R_2 of the rest.
    """
    out = exit_at(body, si)
    mu = dr.dot(out.w, out.n)
    F, mu_in, _, into = mi.fresnel(dr.maximum(mu, 0), body.eta)
    along = mi.Vector3f(dr.normalize(-into * out.w + out.n * (into * mu - dr.abs(mu_in))))
    valid = active & (mu > 0) & (dr.dot(along, out.n_face) < 0)
    reflection = dr.clip(F, LEAST_REFLECTION, 0.95) if body.surface.inside.reflection else mi.Float(0)
    if not body.few:
        return Choice(reflection, mi.Float(0), Leg(out, along, 1 - F, valid, mi.Float(0)))
    T = _transmittance(body, out, along, valid)
    expected = body.expected
    passing = T if 0 in body.few else LEAST_PASSING * T
    albedo, single, multiple = (number(v) for v in (expected.albedo, expected.single, expected.multiple))
    scattered = FEW_BOOST * (1 - T) * (single + (albedo - single) * T)
    both = passing + scattered
    few = mi.Float(1)
    if body.transport is not None:
        few = dr.clip(both / dr.maximum(both + (1 - T) * multiple, 1e-20), LEAST_FEW, MOST_FEW)
    passing = dr.select(both > 0, passing / dr.maximum(both, 1e-20), 1)
    return Choice(reflection, few, Leg(out, along, 1 - F, valid, passing))


def _transmittance(body: Body, out: Exit, along: Any, active: Any) -> Any:
    """To the other side, mean over channels; light of the path does not count, as choices hold in derivatives."""
    ray = place(out.p, out.n_face).spawn_ray(along)
    wall = body.found.scene.ray_intersect(ray, mi.RayFlags.Minimal, False, active)
    T = mi.Float(0)
    for m in body.media:
        T = T + dr.exp(-number(m.sigma_t) * wall.t) / len(body.media)
    return dr.select(active & wall.is_valid(), T, 0)


def exit_at(body: Body, si: Any) -> Exit:
    """The exit of light towards `si.wi`, with the normal that points outwards, as `si.wi` sees it."""
    w, n_face = si.to_world(si.wi), mi.Normal3f(si.n)
    sign = body.found.side(si.prim_index)
    if not body.found.closed:  # a sheet is a half-space from both sides
        sign = dr.select(dr.dot(n_face, w) > 0, 1.0, -1.0)
    n = lifted(turned(si.sh_frame.n, n_face), n_face, w)
    return Exit(mi.Point3f(si.p), n * sign, w, sign, n_face * sign)
