"""The way of light to its first scattering event inside an object, without randomness.

From (x, w): refract, go to the boundary, lose the part that Fresnel lets out, reflect, until nothing is left or 32
times: thin things lead light by total reflection. Segments k of length l_k from o_k along d_k are reached with the
weight v_k: v_0 = 1, v_{k+1} = v_k exp(-sigma_t l_k) F_k, and

    P = sum_k v_k (1 - exp(-sigma_t l_k)),    P y = sum_k v_k ∫_0^{l_k} sigma_t exp(-sigma_t s) (o_k + s d_k) ds.

P is the probability to be scattered or absorbed before leaving; on a plane it is 1. What is still inside after the last
reflection is left out.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import drjit as dr
import mitsuba as mi

from full_geometry.object.subject import Subject, refract_in
from halfspace_sss.rendering.object.points import SurfacePoint, channel_mean, lifted, mirrored, number, turned

REFLECTIONS = 32
NEGLIGIBLE = 1e-3  # weight of what is still inside
CELLS, FIRST_CELL = 12, 0.25  # of a march; the first one in mean free paths


class FirstEvent(NamedTuple):
    """P per channel; y and the mean length of the way there, means over channels weighted by P; both per channel.

    Of a medium that varies also `local`: logarithms of its coefficients where light enters and at y.
    """

    P: Any
    y: Any
    length: Any
    ys: Any
    lengths: Any
    local: tuple[Any, ...] = ()


def flight(subject: Subject, o: Any, d: Any, l: Any) -> tuple[Any, Any]:  # noqa: E741
    """exp(-∫ sigma_t) over a length l from o along d, and ∫ s sigma_t exp(-∫ sigma_t) ds, per channel.

    A medium that varies is marched in cells that grow from a part of a mean free path on, each homogeneous.
    """

    def add(sigma_t: Any, T: Any, inner: Any, s: Any, h: Any) -> tuple[Any, Any]:
        through = dr.minimum(dr.exp(-sigma_t * h), 1)
        mean = dr.maximum((1 - through) / dr.maximum(sigma_t, 1e-20) - h * through, 0)  # rounding, of short ways
        return T * through, inner + T * (mean + s * (1 - through))

    T, inner = mi.Spectrum(1), mi.Spectrum(0)
    if subject.varying is None:
        return add(subject.sigma_t, T, inner, mi.Float(0), l)
    h = dr.minimum(l / CELLS, FIRST_CELL / dr.max(subject.sigma_t))
    growth = _growth(l / h)

    def cell(k: Any, s: Any, h: Any, T: Any, inner: Any) -> tuple:
        sigma_t = subject.walk_media.heterogeneous.sigma_t(mi.UInt32(0), o + d * (s + 0.5 * h))
        T, inner = add(sigma_t, T, inner, s, h)
        return k + 1, s + h, h * growth, T, inner

    state = (mi.UInt32(0), mi.Float(0), h, T, inner)
    return dr.while_loop(state, lambda k, *_: k < CELLS, cell, label="march")[3:]


def _growth(ratio: Any) -> Any:
    """q with 1 + q + ... + q^(CELLS-1) = ratio >= CELLS, by a few steps of Newton on its logarithm."""
    x = dr.maximum(dr.log(ratio) / CELLS, 1e-3)
    for _ in range(5):
        top, bottom = dr.exp(CELLS * x) - 1, dr.exp(x) - 1
        f = dr.log(top / bottom) - dr.log(ratio)
        slope = CELLS * (top + 1) / top - (bottom + 1) / bottom
        x = dr.maximum(x - f / slope, 1e-4)
    return dr.exp(x)


def first_event(subject: Subject, at: SurfacePoint, active: Any = True) -> FirstEvent:
    """Of light that goes in or out along w at a point of the surface."""
    sigma_t, eta, sign = subject.sigma_t, number(subject.eta), number(subject.object.sign)
    media = subject.walk_media
    d, _, valid = refract_in(at, eta)
    flags = mi.RayFlags.Minimal | mi.RayFlags.ShadingFrame

    def step(k: Any, o: Any, d: Any, skip: Any, v: Any, way: Any, sums: tuple, active: Any) -> tuple:
        P, moments, length = sums
        si = subject.object.scene.ray_intersect(mi.Ray3f(o + d * skip, d), flags, False, active)
        l = dr.select(si.is_valid(), si.t + skip, 1e4 / dr.min(sigma_t))  # noqa: E741
        through, inner = flight(subject, o, d, l)
        part, inner = v * (1 - through), v * inner
        moments = [moment + (o * a + d * b) for moment, a, b in zip(moments, part, inner)]
        length = length + part * way + inner
        n_face = si.n * sign
        n = lifted(turned(si.sh_frame.n, si.n) * sign, n_face, d)
        c = dr.dot(d, n)
        v = v * through * mi.fresnel(dr.abs(c), dr.select(c > 0, 1 / eta, eta))[0]
        onward = -mirrored(n * (2 * c) - d, n_face)
        goes_on = si.is_valid() & (c > 0) & (dr.max(v) > NEGLIGIBLE) & (k < REFLECTIONS)
        skip = media.clear(mi.UInt32(0), si.n, onward)
        onward = mi.Vector3f(onward)
        return k + 1, mi.Point3f(si.p), onward, skip, v, way + l, (P + part, moments, length), active & goes_on

    state = (
        mi.UInt32(0), mi.Point3f(at.p), d, media.clear(mi.UInt32(0), at.n, d), mi.Spectrum(1), mi.Float(0),
        (mi.Spectrum(0), [mi.Vector3f(0) for _ in subject.media], mi.Spectrum(0)), valid & active,
    )  # fmt: skip
    P, moments, length = dr.while_loop(state, lambda *s: s[-1], step, label="first event")[-2]
    total, each = dr.maximum(channel_mean(P), 1e-20), dr.maximum(P, 1e-20)
    y = dr.select(channel_mean(P) > 0, mi.Point3f(sum(moments) / (len(moments) * total)), at.p)
    ys = [dr.select(p > 0, mi.Point3f(moment / e), at.p) for moment, p, e in zip(moments, P, each)]
    local = (*subject.local(at.p), *subject.local(y))
    return FirstEvent(P, y, channel_mean(length) / total, ys, length / each, local)
