"""What may happen at a surface point: its BSDF, or in a translucent object light that entered elsewhere.

Each event is an estimate of one factor of the light. What decides where the path goes is kept apart (`detached`) from
what the light is multiplied with, as in a replay derivatives are those of the latter.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import drjit as dr
import mitsuba as mi

from halfspace_sss.rendering.paths.entering import entering_light
from halfspace_sss.rendering.paths.few import Leg, few_orders
from halfspace_sss.rendering.paths.lights import balance
from halfspace_sss.rendering.paths.world import World, sampled_light
from halfspace_sss.rendering.transport.body import Body
from halfspace_sss.rendering.transport.plane import Exit, place

__all__ = ["Onward", "few", "multiple", "nothing", "surface"]


class Onward(NamedTuple):
    """Where a path goes on after a vertex: the point it leaves from, the direction, and what that is worth."""

    p: Any
    n: Any
    d: Any
    weight: Any  # spectrum
    pdf: Any
    emitter_share: Any  # of directions sampled by emitters at the vertex, 1 for a second sample beside d; for weights
    sky_only: Any  # all emitters but the environment, and its suns, have been counted
    aim: Any  # distance of the emitter that d was sampled for, and nothing else counts; negative: d goes anywhere
    mirrored: Any  # d was the only direction, so that emitter sampling had none
    scattered: Any  # it was not

    @property
    def previous(self) -> tuple:
        """What the next vertex has to know of this one, see `vertex.emitted`."""
        return self.p, self.n, self.pdf, self.emitter_share, self.sky_only, self.aim, self.mirrored


def nothing() -> Onward:
    """A path that ends."""
    zero = mi.Float(0)
    return Onward(
        mi.Point3f(0), mi.Normal3f(0), mi.Vector3f(0), mi.Spectrum(0), zero, zero, mi.Bool(False), mi.Float(-1),
        mi.Bool(False), mi.Bool(False),
    )  # fmt: skip


def surface(world: World, u: tuple[Any, Any, Any], ray: Any, si: Any, active: Any) -> tuple[Onward, Any]:
    """A direction sampled by the BSDF, and light sampled by emitters, for uniform numbers u: a pair, one, a pair."""
    bsdf, ctx = si.bsdf(ray), mi.BSDFContext()
    smooth = active & mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth)
    ds, light = sampled_light(world, si, u[0], True, smooth)
    smooth &= ds.pdf != 0
    value, pdf = bsdf.eval_pdf(ctx, si, si.to_local(ds.d), smooth)
    share = dr.select(ds.delta, 1, balance(ds.pdf, dr.detach(pdf)))
    direct = mi.Spectrum(dr.select(smooth, value * light * share, 0))
    bs, weight = bsdf.sample(ctx, si, u[1], u[2], active)
    if world.books.tracks:
        weight = _differentiable(bsdf, ctx, si, bs, weight, active)
    bs = dr.detach(bs)
    delta = mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
    on = Onward(
        mi.Point3f(si.p), mi.Normal3f(si.n), si.to_world(bs.wo), weight, dr.select(delta, 1, bs.pdf),
        dr.select(delta, mi.Float(0), 1), mi.Bool(False), mi.Float(-1), delta, ~delta,
    )  # fmt: skip
    return on, direct


def _differentiable(bsdf: Any, ctx: Any, si: Any, bs: Any, weight: Any, active: Any) -> Any:
    """The weight of a sampled direction with the derivative of the BSDF there, the density held.

    A delta lobe has no value to ask for: its weight times the probability of the lobe has the derivative.
    """
    pdf = dr.detach(bs.pdf)
    inverse = dr.select(pdf > 0, dr.rcp(pdf), 0)
    lobe = weight * (bs.pdf * inverse)
    value = bsdf.eval(ctx, si, dr.detach(bs.wo), active) * inverse
    delta = mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
    return dr.replace_grad(dr.detach(weight), dr.select(delta, lobe, value))


def multiple(world: World, body: Body, out: Exit, face: Any, sampler: Any, active: Any) -> tuple[Onward, Any]:
    """Light that entered the body elsewhere and comes out here by its model, and what is seen of point lights so.

    Where the body is known under the mean light of the sky, that is left out, see `sky`.
    """
    found = entering_light(world, body, out, face, sampler, active)
    direct = -found.value * found.sky * world.even(body)[1] if world.evens(body) else mi.Spectrum(0)
    if world.lights.some_delta:
        shadow = place(found.p, found.n).spawn_ray_to(found.target)
        seen = found.delta & ~world.scene.ray_test(shadow, False, found.delta)
        direct = direct + dr.select(seen, found.value * found.light, 0)
    anywhere = found.aim < 0
    on = Onward(
        found.p, found.n, found.d, dr.select(found.delta, 0, found.value), dr.select(anywhere, found.pdf, 1),
        dr.select(anywhere, mi.Float(world.lights.share), 0), mi.Bool(False), found.aim, mi.Bool(False), mi.Bool(True),
    )  # fmt: skip
    return on, direct


def few(world: World, body: Body, leg: Leg, sampler: Any, scattered: Any, active: Any) -> tuple[Onward, Any]:
    """Light that was scattered at most once inside the body, and that of emitters that came the same way.

    The mean light of the sky as in `multiple`.
    """
    found = few_orders(world, body, leg, sampler, scattered, active)
    zero = mi.Float(0)
    on = Onward(found.p, found.n, found.d, found.weight, mi.Float(1), zero, found.connected, mi.Float(-1),
                mi.Bool(False), mi.Bool(found.once))  # fmt: skip
    direct = found.direct - found.weight * world.even(body)[0] if world.evens(body) else found.direct
    return on, direct
