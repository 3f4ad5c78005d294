"""Exact single scattering inside an object: one scattering event between the refracted ray of exit and that of entry.

    L_o = T_o ∫_0^s_max ds sigma_s exp(-sigma_t s) ∫ dw p(w) exp(-sigma_t s_i) T_i L_i(x_i, w_i)

s and s_i are the lengths of the rays of exit and of entry, T_o and T_i the Fresnel transmittances where they cross the
boundary; the factors eta² of radiance cancel. Light that is reflected inside at the boundary belongs to higher orders.
The environment is found by directions of the phase function; other emitters by the ray that is refracted towards a
sampled point of them, see `refracted_connection`. The boundary refracts as if it were smooth.
"""

from __future__ import annotations

from typing import Any, NamedTuple

from halfspace_sss.physics.phase import eval_hg, sample_hg
from halfspace_sss.rendering.paths.refraction import leave, refracted_connection
from halfspace_sss.rendering.paths.world import World, sampled_light
from halfspace_sss.rendering.surface.derivatives import detached
from halfspace_sss.rendering.transport.body import Body
from halfspace_sss.rendering.transport.plane import Exit, number, place

__all__ = ["Scattered", "single_scattering_at"]


class Scattered(NamedTuple):
    """Where a path leaves the body after one scattering event, and light of emitters that came the same way."""

    p: Any
    n: Any
    d: Any
    weight: Any  # spectrum
    direct: Any  # spectrum


class _Event(NamedTuple):
    """A scattering event: position, direction of travel towards the exit reversed, what a path through it is worth."""

    p: Any
    along: Any
    weight: Any  # spectrum: T_o sigma_s exp(-sigma_t s) / density of s


def single_scattering_at(world: World, body: Body, out: Exit, sampler: Any, active: Any) -> Scattered:
    """One scattering event for light that leaves at `out` of a body: point, normal and direction."""
    import drjit as dr
    import mitsuba as mi

    event, active = _event(body, out, sampler, active)
    with detached():
        g_mean = number(sum(float(m.g) for m in body.media) / len(body.media))
        u = sampler.next_2d()
        cosine = sample_hg(u.x, g_mean)
        sin_phi, cos_phi = dr.sincos(2 * dr.pi * u.y)
        sine = dr.safe_sqrt((1 - cosine) * (1 + cosine))
        d = mi.Frame3f(event.along).to_world(mi.Vector3f(sine * cos_phi, sine * sin_phi, cosine))
        passed = leave(body, event.p, d, active)
        density = eval_hg(cosine, g_mean)
    ratio = _phase(body, cosine) / density
    weight = dr.select(passed.valid, event.weight * ratio * _extinction(body, passed.length) * passed.T, 0)
    direct = mi.Spectrum(0)
    if world.lights.some_local:
        direct = _connected(world, body, event, sampler, active)
    return Scattered(passed.p, passed.n, passed.w, weight, direct)


def _event(body: Body, out: Exit, sampler: Any, active: Any) -> tuple[_Event, Any]:
    """An event on the refracted ray of exit: exponential in the length, a channel by chance, balance heuristic."""
    import drjit as dr
    import mitsuba as mi

    eta = body.surface.inside.medium.eta
    with detached():
        mu_o = dr.dot(out.w, out.n)
        active = active & (mu_o > 0)
        F, mu_in, _, into = mi.fresnel(dr.maximum(mu_o, 0), eta)
        along = dr.normalize(-into * out.w + out.n * (into * mu_o - dr.abs(mu_in)))
        wall = body.found.scene.ray_intersect(place(out.p, out.n).spawn_ray(along), mi.RayFlags.Minimal, False, active)
        furthest = dr.select(wall.is_valid(), wall.t, number(1e3 * body.found.size))
        s, density = _free_path(body, furthest, sampler)
    scattered = [sigma_s * dr.exp(-sigma_t * s) / density for sigma_s, sigma_t, _ in _coefficients(body)]
    weight = dr.select(active, (1 - F) * _spectrum(scattered), 0)
    return _Event(mi.Point3f(out.p + along * s), mi.Vector3f(along), weight), active


def _free_path(body: Body, furthest: Any, sampler: Any) -> tuple[Any, Any]:
    """A length up to `furthest`, and its density."""
    import drjit as dr
    import mitsuba as mi

    sigma_t = [number(m.sigma_t) for m in body.media]
    u_channel, u = sampler.next_1d(), sampler.next_1d()
    chosen, total = mi.Float(0), mi.Float(0)
    for k, s in enumerate(sigma_t):
        chosen = dr.select(mi.UInt32(u_channel * len(sigma_t)) == k, s, chosen)
    chosen = dr.maximum(chosen, 1e-12)
    s = -dr.log(1 - u * (1 - dr.exp(-chosen * furthest))) / chosen
    for t in sigma_t:
        total += t * dr.exp(-t * s) / dr.maximum(1 - dr.exp(-t * furthest), 1e-12)
    return s, dr.maximum(total / len(sigma_t), 1e-30)


def _connected(world: World, body: Body, event: _Event, sampler: Any, active: Any) -> Any:
    """Light of a sampled emitter that is refracted at the boundary into the event."""
    import drjit as dr
    import mitsuba as mi

    at = place(event.p, mi.Normal3f(0, 0, 0))
    ds, light = sampled_light(world, at, sampler.next_2d(), False, active)
    with detached():
        distant = mi.has_flag(ds.emitter.flags(), mi.EmitterFlags.Infinite)
        active = active & (ds.pdf > 0) & ~ds.emitter.is_environment()
        reach = dr.select(distant, number(1e4 * body.found.size), ds.dist)
        target = event.p + ds.d * reach
        met = refracted_connection(body, event.p, target, active)
        # solid angle at the event per solid angle of the straight direction, over which the emitter was sampled
        facing = dr.select(dr.squared_norm(ds.n) > 0, dr.abs(dr.dot(ds.n, met.w)) / dr.abs(dr.dot(ds.n, ds.d)), 1)
        spread = dr.select(ds.delta, 1, facing) * reach * reach * met.density
        cosine, passed = dr.dot(event.along, met.d), met.T * spread
    value = event.weight * _phase(body, cosine) * _extinction(body, met.length) * passed * light
    edge = place(met.p, met.n)
    blocked = world.scene.ray_test(edge.spawn_ray_to(target), False, met.valid)
    return dr.select(met.valid & ~blocked, value, 0)


def _coefficients(body: Body) -> list[tuple[Any, Any, Any]]:
    return body.variation.coefficients(body.media)


def _phase(body: Body, cosine: Any) -> Any:
    return _spectrum([eval_hg(cosine, g) for _, _, g in _coefficients(body)])


def _extinction(body: Body, length: Any) -> Any:
    import drjit as dr

    return _spectrum([dr.exp(-sigma_t * length) for _, sigma_t, _ in _coefficients(body)])


def _spectrum(values: list[Any]) -> Any:
    import mitsuba as mi

    return mi.Spectrum(*values) if len(values) > 1 else mi.Spectrum(values[0])
