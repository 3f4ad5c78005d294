"""The way of light to its first scattering event inside an object, without randomness.

From (x, w): refract, go to the boundary, lose the part that Fresnel lets out, reflect, at most four times. Segments k
of length l_k from o_k along d_k are reached with the weight v_k: v_0 = 1, v_{k+1} = v_k exp(-sigma_t l_k) F_k, and

    P = sum_k v_k (1 - exp(-sigma_t l_k)),    P y = sum_k v_k ∫_0^{l_k} sigma_t exp(-sigma_t s) (o_k + s d_k) ds.

P is the probability to be scattered or absorbed before leaving; on a plane it is 1. What is still inside after the last
reflection is left out.
"""

from __future__ import annotations

from typing import Any, NamedTuple

from full_geometry.subject import Subject, SurfacePoint, refract_in
from halfspace_sss.rendering.surface.object import turned
from halfspace_sss.rendering.transport.plane import number

__all__ = ["REFLECTIONS", "FirstEvent", "first_event"]

REFLECTIONS = 4
NEGLIGIBLE = 1e-3  # weight of what is still inside


class FirstEvent(NamedTuple):
    """P per channel; y and the mean length of the way there, means over channels weighted by P; both per channel."""

    P: Any
    y: Any
    length: Any
    ys: Any
    lengths: Any


def first_event(subject: Subject, at: SurfacePoint, active: Any = True) -> FirstEvent:
    """Of light that goes in or out along w at a point of the surface."""
    import drjit as dr
    import mitsuba as mi

    sigma_t, eta, sign = subject.sigma_t, number(subject.eta), number(subject.found.sign)
    media = subject.walk_media
    d, _, valid = refract_in(at, eta)
    flags = mi.RayFlags.Minimal | mi.RayFlags.ShadingFrame

    def step(k: Any, o: Any, d: Any, skip: Any, v: Any, way: Any, found: tuple, active: Any) -> tuple:
        P, moments, length = found
        si = subject.found.scene.ray_intersect(mi.Ray3f(o + d * skip, d), flags, False, active)
        l = dr.select(si.is_valid(), si.t + skip, 1e4 / dr.min(sigma_t))  # noqa: E741
        through = dr.exp(-sigma_t * l)
        part = v * (1 - through)
        inner = v * ((1 - through) / sigma_t - l * through)
        moments = [moment + (o * a + d * b) for moment, a, b in zip(moments, part, inner)]
        length = length + part * way + inner
        n = turned(si.sh_frame.n, si.n) * sign
        c = dr.dot(d, n)
        v = v * through * mi.fresnel(dr.abs(c), dr.select(c > 0, 1 / eta, eta))[0]
        onward = d - n * (2 * c)
        goes_on = si.is_valid() & (dr.dot(onward, si.n) * sign < 0) & (dr.max(v) > NEGLIGIBLE) & (k < REFLECTIONS)
        skip = media.clear(mi.UInt32(0), si.n, onward)
        onward = mi.Vector3f(onward)
        return k + 1, mi.Point3f(si.p), onward, skip, v, way + l, (P + part, moments, length), active & goes_on

    state = (
        mi.UInt32(0), mi.Point3f(at.p), d, media.clear(mi.UInt32(0), at.n, d), mi.Spectrum(1), mi.Float(0),
        (mi.Spectrum(0), [mi.Vector3f(0) for _ in subject.media], mi.Spectrum(0)), valid & active,
    )  # fmt: skip
    P, moments, length = dr.while_loop(state, lambda *s: s[-1], step, label="first event")[-2]
    total, each = dr.maximum(dr.mean(P), 1e-20), dr.maximum(P, 1e-20)
    y = dr.select(dr.mean(P) > 0, mi.Point3f(sum(moments) / (len(moments) * total)), at.p)
    ys = [dr.select(p > 0, mi.Point3f(moment / e), at.p) for moment, p, e in zip(moments, P, each)]
    return FirstEvent(P, y, dr.mean(length) / total, ys, length / each)
