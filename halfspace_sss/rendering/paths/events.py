"""What may happen at a surface point: its BSDF, or in a translucent object light that entered elsewhere.

Each event is an estimate of one factor of the light. What decides where the path goes is kept apart (`detached`) from
what the light is multiplied with, as in a replay derivatives are those of the latter.
"""

from __future__ import annotations

from typing import Any, NamedTuple

from halfspace_sss.rendering.paths.single import single_scattering_at
from halfspace_sss.rendering.paths.world import World, sampled_light
from halfspace_sss.rendering.surface.derivatives import detached
from halfspace_sss.rendering.surface.object import turned
from halfspace_sss.rendering.transport.body import Body
from halfspace_sss.rendering.transport.plane import Exit, local_frame, place, plane_query

__all__ = ["Onward", "balance", "exit_at", "multiple", "nothing", "single", "surface"]


class Onward(NamedTuple):
    """Where a path goes on after a vertex: the point it leaves from, the direction, and what that is worth."""

    p: Any
    n: Any
    d: Any
    weight: Any  # spectrum
    pdf: Any
    emitter_share: Any  # of directions sampled by emitters at the vertex, 1 for a second sample beside d; for weights
    sky_only: Any  # all emitters but the environment have been counted
    aim: Any  # distance of the emitter that d was sampled for, and nothing else counts; negative: d goes anywhere


def nothing() -> Onward:
    """A path that ends."""
    import mitsuba as mi

    zero = mi.Float(0)
    return Onward(
        mi.Point3f(0), mi.Normal3f(0), mi.Vector3f(0), mi.Spectrum(0), zero, zero, mi.Bool(False), mi.Float(-1)
    )


def balance(pdf: Any, other: Any) -> Any:
    """The balance heuristic."""
    import drjit as dr

    total = pdf + other
    return dr.select(total > 0, pdf / dr.maximum(total, 1e-30), 0)


def surface(world: World, sampler: Any, ray: Any, si: Any, active: Any) -> tuple[Onward, Any]:
    """A direction sampled by the BSDF, and light sampled by emitters."""
    import drjit as dr
    import mitsuba as mi

    bsdf, ctx = si.bsdf(ray), mi.BSDFContext()
    smooth = active & mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth)
    ds, light = sampled_light(world, si, sampler.next_2d(), True, smooth)
    smooth &= ds.pdf != 0
    value, pdf = bsdf.eval_pdf(ctx, si, si.to_local(ds.d), smooth)
    share = dr.select(ds.delta, 1, balance(ds.pdf, dr.detach(pdf)))
    direct = mi.Spectrum(dr.select(smooth, value * light * share, 0))
    bs, weight = bsdf.sample(ctx, si, sampler.next_1d(), sampler.next_2d(), active)
    if world.books.tracks:
        weight = _differentiable(bsdf, ctx, si, bs, weight, active)
    bs = dr.detach(bs)
    delta = mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
    on = Onward(
        mi.Point3f(si.p), mi.Normal3f(si.n), si.to_world(bs.wo), weight, dr.select(delta, 1, bs.pdf),
        dr.select(delta, mi.Float(0), 1), mi.Bool(False), mi.Float(-1),
    )  # fmt: skip
    return on, direct


def _differentiable(bsdf: Any, ctx: Any, si: Any, bs: Any, weight: Any, active: Any) -> Any:
    """The weight of a sampled direction with the derivative of the BSDF there, the density held.

    A delta lobe has no value to ask for: its weight times the probability of the lobe has the derivative.
    """
    import drjit as dr
    import mitsuba as mi

    pdf = dr.detach(bs.pdf)
    inverse = dr.select(pdf > 0, dr.rcp(pdf), 0)
    lobe = weight * (bs.pdf * inverse)
    value = bsdf.eval(ctx, si, dr.detach(bs.wo), active) * inverse
    delta = mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
    return dr.replace_grad(dr.detach(weight), dr.select(delta, lobe, value))


def multiple(world: World, body: Body, sampler: Any, si: Any, active: Any) -> tuple[Onward, Any]:
    """Light that entered the body elsewhere and comes out here by its model, and what is seen of point lights so.

    S is evaluated once, the costly part: the direction is sampled by emitters or by the model (one-sample balance
    heuristic), and the ray that goes on is what tests visibility.
    """
    import drjit as dr
    import mitsuba as mi

    lights = world.lights
    with detached():
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
        ds, light = sampled_light(world, at, sampler.next_2d(), False, by_emitter)
        with detached():
            sky, delta = ds.emitter.is_environment(), by_emitter & ds.delta
            mu_i, rest = dr.clip(dr.dot(ds.d, entry.n_out), 0, 1), (mi.Float(0), mi.Float(0), mi.Float(1), mi.Float(0))
            by_model = model.pdf_direction(mu_i, *rest)
            d = dr.select(by_emitter, ds.d, d)
            pdf = dr.select(by_emitter, share * ds.pdf + dr.select(ds.delta, 0, (1 - share) * by_model), pdf)
            aim = dr.select(by_emitter, dr.select(sky, dr.inf, ds.dist), aim)
            active &= pdf > 0
    value = _S_mu(world, body, entry, d, out, active) * (entry.weight / dr.maximum(pdf, 1e-8))
    value = dr.select(active, value, 0)
    direct = mi.Spectrum(0)
    if lights.some_delta:
        seen = delta & ~world.scene.ray_test(at.spawn_ray_to(ds.p), False, delta)
        direct = dr.select(seen, value * light, 0)
    on = Onward(
        mi.Point3f(entry.p), mi.Normal3f(entry.n), d, dr.select(delta, 0, value), dr.select(aim < 0, pdf, 1),
        dr.select(aim < 0, mi.Float(share), 0), mi.Bool(False), aim,
    )  # fmt: skip
    return on, direct


def single(world: World, body: Body, sampler: Any, si: Any, active: Any) -> tuple[Onward, Any]:
    """Light that was scattered once inside the body, and that of emitters that came the same way."""
    import mitsuba as mi

    found = single_scattering_at(world, body, exit_at(body, si), sampler, active)
    zero = mi.Float(0)
    on = Onward(found.p, found.n, found.d, found.weight, mi.Float(1), zero, mi.Bool(True), mi.Float(-1))
    return on, found.direct


def exit_at(body: Body, si: Any) -> Exit:
    """The exit of light towards `si.wi`, with the normal that points outwards."""
    import drjit as dr
    import mitsuba as mi

    w, n = si.to_world(si.wi), mi.Normal3f(turned(si.sh_frame.n, si.n))
    sign = body.found.side(si.prim_index)
    if not body.found.closed:  # a sheet is a half-space from both sides
        sign = dr.select(dr.dot(n, w) > 0, 1.0, -1.0)
    return Exit(mi.Point3f(si.p), n * sign, w, sign)


def _S_mu(world: World, body: Body, entry: Any, w_i: Any, out: Exit, active: Any) -> Any:
    """S mu_i for each channel, 1/((scene unit)² sr)."""
    import drjit as dr
    import mitsuba as mi

    with detached():
        query = plane_query(entry.p, entry.n_out, w_i, out, world.settings.geometry)
        mu_i = query[1]
        lit = active & (mu_i > 0) & (query[3] > 0)
        values = [model.eval(*query) for model in body.models]
    values = [value * mu_i for value in body.variation.S(values, query)]
    return dr.select(lit, mi.Spectrum(*values) if len(values) > 1 else mi.Spectrum(values[0]), 0)
