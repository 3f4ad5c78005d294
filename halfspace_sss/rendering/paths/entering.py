"""Light that entered a body elsewhere and comes out here by its transport: N entries are drawn, and one is followed.

The direction at an entry is drawn by emitters or by the proposals, for all entries of an exit alike (one-sample balance
heuristic), and the ray that goes on is what tests visibility. Of N entries with F_k = S mu_i / density, k is followed
with the probability w_k / Σ w, w_k the largest channel of F_k times the light of a sampled emitter, and is worth
F_k Σ w / (N w_k) (resampled importance sampling, Talbot, Cline and Egbert 2005): the mean of all without their rays.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import drjit as dr
import mitsuba as mi

from halfspace_sss.rendering.paths.lights import balance
from halfspace_sss.rendering.paths.world import World, sampled_light
from halfspace_sss.rendering.surface.derivatives import detached
from halfspace_sss.rendering.transport.body import Body
from halfspace_sss.rendering.transport.plane import Exit, place

__all__ = ["Candidate", "entering_light"]


class _Exit(NamedTuple):
    """An exit, its face, and what transport and proposals have made of it."""

    out: Exit
    prim_index: Any
    prepared: Any
    where: Any


class Candidate(NamedTuple):
    """An entry with a direction of light."""

    p: Any
    n: Any
    d: Any
    value: Any  # spectrum: S mu_i over the density
    pdf: Any  # of d
    aim: Any  # distance of the emitter that d was sampled for; negative: d goes anywhere
    delta: Any  # whether no ray can hit that emitter
    target: Any  # point of it
    light: Any  # spectrum: its light over the density, where delta
    hope: Any  # that it is chosen by
    aims: Any  # whether d is drawn by emitters, where there is an entry
    sky: Any  # weight of d among the ways to draw directions of the sky


def entering_light(world: World, body: Body, out: Exit, prim_index: Any, sampler: Any, active: Any) -> Candidate:
    """One entry for light that leaves at `out`, drawn among as many as the settings or the model say."""
    with detached():
        prepared = body.transport.prepare(out, active)
        where = body.proposals.prepare(out, prepared, active)

    def draw(aims: Any = None) -> Candidate:
        return _candidate(world, body, _Exit(out, prim_index, prepared, where), aims, sampler, active)

    n, kept = world.entries(body), draw()
    if n == 1:
        return kept
    total = dr.detach(kept.hope)
    for _ in range(n - 1):
        other = draw(kept.aims)
        total = total + dr.detach(other.hope)
        take = sampler.next_1d() * total < dr.detach(other.hope)
        kept = Candidate(*(dr.select(take, a, b) for a, b in zip(other, kept)))
    hope = dr.detach(kept.hope)
    return kept._replace(value=kept.value * dr.select(hope > 0, total / (n * dr.maximum(hope, 1e-30)), 0))


def _candidate(world: World, body: Body, exit: _Exit, aims: Any, sampler: Any, active: Any) -> Candidate:
    share, proposals = world.lights.share, body.proposals
    with detached():
        entry = proposals.sample(exit.out, exit.prim_index, exit.where, sampler, active)
        active = active & (entry.weight > 0)
        d, pdf = proposals.sample_direction(entry, exit.out, sampler.next_2d())
        at, pdf, aim = place(entry.p, entry.n), (1 - share) * pdf, mi.Float(-1)
    delta, target, light, bright = mi.Bool(False), mi.Point3f(0), mi.Spectrum(0), mi.Float(1)
    sky = mi.Float(1) if world.evens(body) else mi.Float(0)
    aims = mi.Bool(False) if share == 0 else sampler.next_1d() < share if aims is None else aims
    if share > 0:
        by_emitter = active & aims
        ds, light = sampled_light(world, at, sampler.next_2d(), False, by_emitter)
        with detached():
            delta, target = by_emitter & ds.delta, mi.Point3f(ds.p)
            if world.evens(body):
                of_sky = share * world.sky.density(world.scene, at, d, active & ~aims)
                sky = dr.select(by_emitter, dr.select(ds.emitter.is_environment(), 1, 0), balance(pdf, of_sky))
            by_model = proposals.pdf_direction(entry, exit.out, ds.d)
            d = dr.select(by_emitter, ds.d, d)
            pdf = dr.select(by_emitter, share * ds.pdf + dr.select(ds.delta, 0, (1 - share) * by_model), pdf)
            far = dr.select(ds.emitter.is_environment(), dr.inf, ds.dist)
            aim = dr.select(by_emitter, far, aim)
            active = active & (pdf > 0)
            bright = dr.select(by_emitter, dr.max(light) * dr.select(ds.delta, 1, ds.pdf), 1)
    S_mu = body.transport.S_mu(exit.prepared, entry, d, active)
    value = dr.select(active, S_mu * (entry.weight / dr.maximum(pdf, 1e-8)), 0)
    hope = dr.detach(dr.max(value)) * bright
    p, n = mi.Point3f(entry.p), mi.Normal3f(entry.n)
    return Candidate(p, n, d, value, pdf, aim, delta, target, light, hope, aims, sky)
