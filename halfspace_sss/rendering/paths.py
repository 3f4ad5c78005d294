"""The path loop of the integrator: surfaces by their BSDFs, and inside the translucent ones by the BSSRDF."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

from halfspace_sss.rendering.lights import Lights
from halfspace_sss.rendering.surface.object import turned
from halfspace_sss.rendering.transport.body import Body
from halfspace_sss.rendering.transport.plane import Exit, local_frame, number, place, plane_query
from halfspace_sss.rendering.transport.settings import Settings
from halfspace_sss.rendering.transport.single import single_scattering_at

__all__ = ["trace_paths"]

LEAST_REFLECTION = 0.05  # probability of reflection at a surface that reflects; Fresnel's is 0.04 face on


class Onward(NamedTuple):
    """Where a path goes on after a vertex: the point it leaves from, the direction, and what that is worth."""

    p: Any
    n: Any
    d: Any
    weight: Any  # spectrum
    pdf: Any
    emitter_share: Any  # of directions sampled by emitters at the vertex, 1 for a second sample beside d; for weights
    sky_only: Any  # all emitters but the environment are in `direct`
    aim: Any  # distance of the emitter that d was sampled for, and nothing else counts; negative: d goes anywhere
    direct: Any  # spectrum: light that was sampled at the vertex


def trace_paths(scene: Any, bodies: list[Body], settings: Settings, sampler: Any, ray: Any, active: Any) -> tuple:
    """Radiance along a ray, and whether it hits anything.

    One loop over the vertices. At each, emitters are sampled and the direction goes on by the surface (balance
    heuristic between the two). At a translucent surface one of reflection, multiple and single scattering is chosen;
    light of emitters that it mirrors is added whatever is chosen, as highlights are bright.
    """
    import drjit as dr
    import mitsuba as mi

    lights = Lights.of(scene)

    def step(sampler: Any, ray: Any, L: Any, throughput: Any, last: tuple, depth: Any, seen: Any, active: Any) -> tuple:
        si = scene.ray_intersect(ray, mi.RayFlags.All, depth == 0, active)
        L = L + throughput * _emitted(scene, settings, si, last, depth, active)
        seen = seen | ((depth == 0) & si.is_valid())
        active = active & si.is_valid() & (last[-1] < 0) & (depth + 1 < _unsigned(settings.max_depth))
        on, mirrored = _vertex(scene, lights, bodies, settings, sampler, ray, si, active)
        L = L + dr.select(active, throughput * (on.direct + mirrored), 0)
        throughput = dr.select(active, throughput * on.weight, throughput)
        best = dr.max(throughput)
        active = active & (best > 0)
        depth = dr.select(active, depth + 1, depth)
        survival = dr.select(depth >= settings.rr_depth, dr.minimum(best, 0.95), 1.0)
        active = active & (sampler.next_1d() < survival)
        throughput = throughput / survival
        ray = dr.select(active, place(on.p, on.n).spawn_ray(on.d), ray)
        last = (on.p, on.n, on.pdf, on.emitter_share, on.sky_only, on.aim)
        return sampler, ray, L, throughput, last, depth, seen, active

    last = (mi.Point3f(0), mi.Normal3f(0), mi.Float(1), mi.Float(0), mi.Bool(False), mi.Float(-1))
    state = (
        sampler, mi.Ray3f(ray), mi.Spectrum(0), mi.Spectrum(1), last, mi.UInt32(0), mi.Bool(False), mi.Bool(active),
    )  # fmt: skip
    out = dr.while_loop(state, lambda *state: state[-1], step, label="bssrdf")
    return out[2], out[6]


def _unsigned(max_depth: int) -> int:
    return 0xFFFFFFFF if max_depth < 0 else max_depth


def _emitted(scene: Any, settings: Settings, si: Any, last: tuple, depth: Any, active: Any) -> Any:
    """Emitted light where the path arrives, weighted against the sampling of emitters at the last vertex."""
    import drjit as dr
    import mitsuba as mi

    p, n, pdf, emitter_share, sky_only, aim = last
    emitter = si.emitter(scene, active)
    active = active & (emitter != None) & ~(sky_only & ~emitter.is_environment())  # noqa: E711
    active &= (aim < 0) | dr.select(si.is_valid(), dr.abs(si.t - aim) < 1e-3 * aim, aim == dr.inf)
    if settings.hide_emitters:
        active = active & (depth > 0)
    before = place(p, n)
    ds = mi.DirectionSample3f(scene, si, before)
    pdf_emitter = emitter_share * scene.pdf_emitter_direction(before, ds, active & (emitter_share > 0))
    return dr.select(active, _balance(pdf, pdf_emitter) * emitter.eval(si, active), 0)


def _balance(pdf: Any, other: Any) -> Any:
    import drjit as dr

    total = pdf + other
    return dr.select(total > 0, pdf / dr.maximum(total, 1e-30), 0)


def _vertex(
    scene: Any, lights: Lights, bodies: list[Body], settings: Settings, sampler: Any, ray: Any, si: Any, active: Any
) -> tuple[Onward, Any]:
    """What happens at a surface point: its BSDF, or for the bodies the light that entered elsewhere.

    Also the light of emitters that a body mirrors, which the reflected path leaves out.
    """
    import drjit as dr
    import mitsuba as mi

    u_event = sampler.next_1d()
    inside, glossy, share, events = mi.Bool(False), mi.Bool(False), mi.Float(1), []
    for body in bodies:
        here = active & (si.shape == mi.ShapePtr(body.found.shape))
        reflect = _reflection_probability(body, si)
        once = (1 - reflect) * number(body.single_share)
        single = here & (u_event < once)
        multiple = here & (u_event >= once + reflect)
        inside |= single | multiple
        if body.surface.inside.reflection:
            glossy |= here
        taken = dr.select(single, once, dr.select(multiple, 1 - reflect - once, reflect))
        share = dr.select(here, taken, share)
        if body.models:
            events.append((multiple, partial(_multiple, scene, lights, body, settings, sampler, si, multiple)))
        if body.single_share > 0:
            events.append((single, partial(_single, scene, lights, body, sampler, si, single)))
    plain = glossy | (active & ~inside)
    on = _instead(plain, sampler, _nothing(), partial(_surface, scene, sampler, ray, si, plain))
    (mirrored,) = _where(glossy, sampler, (mi.Spectrum(0),), lambda: (_mirrored(scene, settings, on, glossy),))
    on = Onward(*(dr.select(glossy, a, b) for a, b in zip(_unlit(on), on)))
    for mask, event in events:
        on = _instead(mask, sampler, on, event)
    return on._replace(weight=on.weight / share, direct=on.direct / share), mirrored


def _mirrored(scene: Any, settings: Settings, on: Onward, active: Any) -> Any:
    """Light of emitters by a reflection: sampled at the vertex, and met by the ray that goes on."""
    import mitsuba as mi

    si = scene.ray_intersect(place(on.p, on.n).spawn_ray(on.d), mi.RayFlags.All, False, active)
    last = (on.p, on.n, on.pdf, on.emitter_share, on.sky_only, on.aim)
    return on.direct + on.weight * _emitted(scene, settings, si, last, mi.UInt32(1), active)


def _unlit(on: Onward) -> Onward:
    """The same path, to which no emitter counts at its next vertex."""
    import mitsuba as mi

    return on._replace(pdf=mi.Float(0), emitter_share=mi.Float(0), direct=mi.Spectrum(0))


def _nothing() -> Onward:
    import mitsuba as mi

    zero = mi.Float(0)
    return Onward(
        mi.Point3f(0), mi.Normal3f(0), mi.Vector3f(0), mi.Spectrum(0), zero, zero, mi.Bool(False), mi.Float(-1),
        mi.Spectrum(0),
    )  # fmt: skip


def _where(mask: Any, sampler: Any, otherwise: tuple, event: Callable[[], tuple]) -> tuple:
    """`event()` where the mask holds, and `otherwise` elsewhere; what no neighbouring lane asks for is not computed."""
    import drjit as dr

    return dr.if_stmt((sampler, otherwise), mask, lambda s, _: (s, tuple(event())), lambda s, other: (s, other))[1]


def _instead(mask: Any, sampler: Any, on: Onward, event: Callable[[], Onward]) -> Onward:
    return Onward(*_where(mask, sampler, tuple(on), event))


def _reflection_probability(body: Body, si: Any) -> Any:
    import drjit as dr
    import mitsuba as mi

    if not body.surface.inside.reflection:
        return mi.Float(0)
    F = mi.fresnel(dr.abs(dr.dot(si.wi, mi.Vector3f(0, 0, 1))), body.surface.inside.medium.eta)[0]
    return dr.clip(F, LEAST_REFLECTION, 0.95)


def _surface(scene: Any, sampler: Any, ray: Any, si: Any, active: Any) -> Onward:
    """Light sampled by emitters, and a direction sampled by the BSDF."""
    import drjit as dr
    import mitsuba as mi

    bsdf, ctx = si.bsdf(ray), mi.BSDFContext()
    smooth = active & mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth)
    ds, light = scene.sample_emitter_direction(si, sampler.next_2d(), True, smooth)
    smooth &= ds.pdf != 0
    wo = si.to_local(ds.d)
    value, pdf = bsdf.eval_pdf(ctx, si, wo, smooth)
    weight = dr.select(ds.delta, 1, _balance(ds.pdf, pdf))
    direct = dr.select(smooth, value * light * weight, 0)
    bs, bsdf_weight = bsdf.sample(ctx, si, sampler.next_1d(), sampler.next_2d(), active)
    delta = mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
    return Onward(
        mi.Point3f(si.p), mi.Normal3f(si.n), si.to_world(bs.wo), bsdf_weight, dr.select(delta, 1, bs.pdf),
        dr.select(delta, mi.Float(0), 1), mi.Bool(False), mi.Float(-1), mi.Spectrum(direct),
    )  # fmt: skip


def _multiple(scene: Any, lights: Lights, body: Body, settings: Settings, sampler: Any, si: Any, active: Any) -> Onward:
    """Light that entered the body elsewhere and comes out here by its model.

    S is evaluated once, the costly part: the direction is sampled by emitters or by the model (one-sample balance
    heuristic), and the ray that goes on is what tests visibility.
    """
    import drjit as dr
    import mitsuba as mi

    out = exit_at(body, si)
    entry = body.positions.sample(out, si.prim_index, sampler, active)
    active = active & (entry.weight > 0)
    at, share, model = place(entry.p, entry.n), lights.share, body.models[0]

    u = sampler.next_2d()
    frame = local_frame(entry.n_out, out.p - entry.p)
    drawn = model.sample_direction(mi.Float(0), mi.Float(1), mi.Float(0), (u.x, u.y))
    d, pdf, aim = mi.Vector3f(frame.direction(drawn.mu_i, drawn.phi_i)), (1 - share) * drawn.pdf, mi.Float(-1)
    delta, light = mi.Bool(False), mi.Spectrum(0)
    if share > 0:
        by_emitter = active & (sampler.next_1d() < share)
        ds, light = scene.sample_emitter_direction(at, sampler.next_2d(), False, by_emitter)
        sky, delta = ds.emitter.is_environment(), by_emitter & ds.delta
        mu_i, rest = dr.clip(dr.dot(ds.d, entry.n_out), 0, 1), (mi.Float(0), mi.Float(0), mi.Float(1), mi.Float(0))
        by_model = model.pdf_direction(mu_i, *rest)
        d = dr.select(by_emitter, ds.d, d)
        pdf = dr.select(by_emitter, share * ds.pdf + dr.select(ds.delta, 0, (1 - share) * by_model), pdf)
        aim = dr.select(by_emitter, dr.select(sky, dr.inf, ds.dist), aim)
        active &= pdf > 0
    value = dr.select(active, _S_mu(body, settings, entry, d, out, active) * entry.weight / dr.maximum(pdf, 1e-8), 0)
    direct = mi.Spectrum(0)
    if lights.some_delta:
        direct = dr.select(delta & ~scene.ray_test(at.spawn_ray_to(ds.p), False, delta), value * light, 0)
    return Onward(
        mi.Point3f(entry.p), mi.Normal3f(entry.n), d, dr.select(delta, 0, value), dr.select(aim < 0, pdf, 1),
        dr.select(aim < 0, mi.Float(share), 0), mi.Bool(False), aim, direct,
    )  # fmt: skip


def _single(scene: Any, lights: Lights, body: Body, sampler: Any, si: Any, active: Any) -> Onward:
    """Light that was scattered once inside the body."""
    import mitsuba as mi

    found = single_scattering_at(scene, body, exit_at(body, si), sampler, lights.some_local, active)
    return Onward(
        found.p, found.n, found.d, found.weight, mi.Float(1), mi.Float(0), mi.Bool(True), mi.Float(-1), found.direct
    )


def exit_at(body: Body, si: Any) -> Exit:
    """The exit of light towards `si.wi`, with the normal that points outwards."""
    import drjit as dr
    import mitsuba as mi

    w, n = si.to_world(si.wi), mi.Normal3f(turned(si.sh_frame.n, si.n))
    sign = body.found.side(si.prim_index)
    if not body.found.closed:  # a sheet is a half-space from both sides
        sign = dr.select(dr.dot(n, w) > 0, 1.0, -1.0)
    return Exit(mi.Point3f(si.p), n * sign, w, sign)


def _S_mu(body: Body, settings: Settings, entry: Any, w_i: Any, out: Exit, active: Any) -> Any:
    """S mu_i for each channel, 1/((scene unit)² sr)."""
    import drjit as dr
    import mitsuba as mi

    query = plane_query(entry.p, entry.n_out, w_i, out, settings.geometry)
    mu_i = query[1]
    lit = active & (mu_i > 0) & (query[3] > 0)
    values = [model.eval(*query) * mu_i for model in body.models]
    return dr.select(lit, mi.Spectrum(*values) if len(values) > 1 else mi.Spectrum(values[0]), 0)
