"""The path loop of the integrator: surfaces by their BSDFs, and inside the translucent ones by the BSSRDF."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import drjit as dr
import mitsuba as mi

from halfspace_sss.rendering.paths.lighting import Books, Replay, Tally, World, balance, delta_light, sampled_light
from halfspace_sss.rendering.paths.low_orders import Leg, few_orders
from halfspace_sss.rendering.surface.derivatives import detached, tracking
from halfspace_sss.rendering.surface.horizon import lifted
from halfspace_sss.rendering.surface.object import turned
from halfspace_sss.rendering.transport.body import Body
from halfspace_sss.rendering.transport.plane import Exit, number, place
from halfspace_sss.rendering.transport.settings import Settings

__all__ = [
    "Candidate",
    "Choice",
    "Onward",
    "Vertex",
    "choose",
    "emitted",
    "entering_light",
    "exit_at",
    "few",
    "multiple",
    "nothing",
    "replay_paths",
    "surface",
    "trace_paths",
    "vertex",
]


# ---- Choice of event at a translucent surface ----------------------------------------------------------------------

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


# ---- BSSRDF: entry points by resampled importance sampling ---------------------------------------------------------


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


# ---- Events at a vertex --------------------------------------------------------------------------------------------


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


# ---- One vertex ----------------------------------------------------------------------------------------------------


class Vertex(NamedTuple):
    """Where a path is: interaction, the ray that led there, its throughput, whether this is the first, a second time.

    The second time stands for the orders below two of a body, the first time for the rest. `scattered` says whether a
    vertex before had more than one direction.
    """

    si: Any
    ray: Any
    throughput: Any
    first: Any
    second: Any
    scattered: Any
    active: Any


def emitted(world: World, sampler: Any, ray: Any, si: Any, last: tuple, shown: Any, scattered: Any, active: Any) -> Any:
    """Emitted light where a path arrives, weighted against the sampling of emitters at the last vertex.

    Emitters count where they are `shown`; delta lights behind what mirrors them if the path has `scattered` before.
    """
    p, n, pdf, emitter_share, sky_only, aim, mirrored = last
    with detached():
        emitter, mirrored = si.emitter(world.scene, active), active & mirrored & scattered
        active = active & shown & (emitter != None) & ~(sky_only & _counted(world, emitter, ray.d))  # noqa: E711
        active &= (aim < 0) | dr.select(si.is_valid(), dr.abs(si.t - aim) < 1e-3 * aim, aim == dr.inf)
        before = place(p, n)
        ds = mi.DirectionSample3f(world.scene, si, before)
        pdf_emitter = emitter_share * world.scene.pdf_emitter_direction(before, ds, active & (emitter_share > 0))
        share = balance(pdf, pdf_emitter)
    light = dr.select(active, share * emitter.eval(si, active), 0)
    return light + delta_light(world, sampler, ray, mirrored) if world.lights.some_delta else light


def _counted(world: World, emitter: Any, d: Any) -> Any:
    """Whether light of an emitter in the direction d was found by connections with the last event."""
    counted = ~emitter.is_environment()
    return counted | (world.small.index_of(emitter, d) >= 0) if world.suns else counted


def vertex(world: World, sampler: Any, at: Vertex, books: Books) -> tuple[Onward, Books]:
    """What happens at a surface point: its BSDF, or for the bodies the light that entered elsewhere."""
    (si, _, throughput, *_), choices = at, []
    with detached():
        for body in world.bodies:
            here = at.active & (si.shape == mi.ShapePtr(body.found.shape))
            choice = choose(body, si, here)
            if body.splits:
                once = at.first & at.second
                chance = dr.select(at.first, dr.select(at.second, mi.Float(1), 0), choice.few)
                choice = choice._replace(few=chance, reflection=dr.select(once, 0, choice.reflection))
            choices.append((body, here, choice))
    books = _evened(world, sampler, at, books, choices)
    books = _gathered(world, sampler, at, books, choices)
    on, books, taken = _outside(world, sampler, at, books, choices)
    share, events = taken.share, []
    for body, here, choice in choices:
        inside = here & ~taken.reflects
        by_few = inside & (taken.u < choice.few)
        share = dr.select(inside, share * dr.select(by_few, choice.few, 1 - choice.few), share)
        if body.transport is not None:
            by_more = inside & ~by_few
            more = partial(multiple, world, body, choice.leg.out, si.prim_index, sampler, by_more)
            events.append((by_more, more))
        if body.few:
            events.append((by_few, partial(few, world, body, choice.leg, sampler, at.scattered, by_few)))
    for mask, event in events:

        def below(books: Books, mask: Any = mask, event: Callable = event) -> tuple[Onward, Books]:
            on, direct = event()
            return on, world.books.settle(books, throughput / share * direct, on.weight, mask, mi.Spectrum(0))

        on, books = _instead(mask, sampler, on, books, world, below)
    return on._replace(weight=on.weight / share), books


def _evened(world: World, sampler: Any, at: Vertex, books: Books, choices: list) -> Books:
    """Adds what bodies are under the mean light of the sky, which the events inside leave out, see `sky`."""
    for body, here, choice in choices:
        if not world.evens(body):
            continue

        def known(books: Books, body: Body = body, here: Any = here, out: Exit = choice.leg.out) -> tuple[Books]:
            few, more = body.transport.alpha(out, here)
            few = dr.select(at.first & ~at.second, 0, few) if body.few else mi.Spectrum(0)
            light = (few + dr.select(at.first & at.second, 0, more)) * world.sky.mean
            return (world.books.add(books, at.throughput * light),)

        (books,) = _where(here, sampler, (books,), world, known)
    return books


def _gathered(world: World, sampler: Any, at: Vertex, books: Books, choices: list) -> Books:
    """Adds what leaves by light that was gathered."""
    for body, here, choice in choices:
        if body.gathered is None:
            continue

        def known(books: Books, body: Body = body, here: Any = here, out: Exit = choice.leg.out) -> tuple[Books]:
            return (world.books.add(books, at.throughput * body.gathered.radiance(out, here)),)

        (books,) = _where(here, sampler, (books,), world, known)
    return books


class _Taken(NamedTuple):
    """Whether a path goes on outside, the probability of that, and a uniform number for what comes next."""

    reflects: Any
    share: Any
    u: Any


def _outside(world: World, sampler: Any, at: Vertex, books: Books, choices: list) -> tuple[Onward, Books, _Taken]:
    """The BSDF. Of a body, light of emitters that it mirrors is added, and the path goes on if there may be more."""
    (si, ray, throughput, *_), u_event = at, sampler.next_1d()
    inside, glossy, reflection = mi.Bool(False), mi.Bool(False), mi.Float(0)
    for body, here, choice in choices:
        inside |= here
        reflection = dr.select(here, choice.reflection, reflection)
        if body.surface.inside.reflection:
            glossy |= here & ~(at.first & at.second)
    plain = at.active & ~inside

    def scatter(books: Books) -> tuple:
        u = sampler.next_2d(), sampler.next_1d(), sampler.next_2d()
        with detached():
            on, direct = surface(world, u, ray, si, plain | glossy)
        shown, meets, books = _mirrored(world, sampler, on, at, books, glossy)
        reflects = glossy & meets & (u_event < reflection)
        if world.books.tracks:  # again: no derivatives may be pending while others are passed on
            on, direct = surface(world, u, ray, si, plain | glossy)
        books = world.books.settle(books, throughput * direct, on.weight, plain | reflects, shown)
        return tuple(on), meets, books

    found, meets, books = _where(plain | glossy, sampler, (tuple(nothing()), mi.Bool(False), books), world, scatter)
    on, reflection = Onward(*found), dr.select(glossy & meets, reflection, 0)
    on = Onward(*(dr.select(glossy, a, b) for a, b in zip(_unlit(on), on)))
    reflects = plain | (u_event < reflection)
    on = on._replace(weight=dr.select(reflects, on.weight, 0))
    share = dr.select(plain, 1, dr.select(reflects, reflection, 1 - reflection))
    u = dr.select(reflects, 0, (u_event - reflection) / dr.maximum(1 - reflection, 1e-6))
    return on, books, _Taken(reflects, share, u)


def _mirrored(world: World, sampler: Any, on: Onward, at: Vertex, books: Books, active: Any) -> tuple[Any, Any, Books]:
    """Light of emitters that a body mirrors, which the reflected path leaves out; over the weight of the reflection.

    With it, whether the reflected ray meets a surface, from which more light may come.
    """

    def look(books: Books) -> tuple[Any, Any, Books]:
        ray = place(on.p, on.n).spawn_ray(on.d)
        si = world.scene.ray_intersect(ray, mi.RayFlags.All, False, active)
        light = at.throughput * emitted(world, sampler, ray, si, on.previous, mi.Bool(True), at.scattered, active)
        return light, active & si.is_valid(), world.books.add(books, on.weight * light)

    return _where(active, sampler, (mi.Spectrum(0), mi.Bool(False), books), world, look)


def _unlit(on: Onward) -> Onward:
    """The same path, to which no emitter counts at its next vertex."""
    return on._replace(pdf=mi.Float(0), emitter_share=mi.Float(0), mirrored=mi.Bool(False))


def _where(mask: Any, sampler: Any, otherwise: tuple, world: World, event: Callable[[Books], tuple]) -> tuple:
    """`event(books)` where the mask holds, and `otherwise`, which ends with the books, elsewhere.

    What no neighbouring lane asks for is not computed; derivatives do not leave the event.
    """

    def happens(sampler: Any, otherwise: tuple) -> tuple:
        with tracking(world.books.tracks):
            return sampler, dr.detach(tuple(event(otherwise[-1])))

    with detached():
        return dr.if_stmt((sampler, otherwise), mask, happens, lambda s, other: (s, other))[1]


def _instead(
    mask: Any, sampler: Any, on: Onward, books: Books, world: World, event: Callable[[Books], tuple[Onward, Books]]
) -> tuple[Onward, Books]:
    def happens(books: Books) -> tuple:
        found, books = event(books)
        return tuple(found), books

    found, books = _where(mask, sampler, (tuple(on), books), world, happens)
    return Onward(*found), books


def trace_paths(scene: Any, bodies: list[Body], settings: Settings, sampler: Any, ray: Any, active: Any) -> tuple:
    """Radiance along a ray, in two parts for a replay, and whether it hits anything.

    The second part is light of orders below two of the object that the ray meets first.
    """
    world = World.of(scene, bodies, settings, Tally())
    (parts, _), seen = _trace(world, sampler, ray, ((mi.Spectrum(0), mi.Spectrum(0)), ()), active)
    return parts, seen


def replay_paths(
    scene: Any, bodies: list[Body], settings: Settings, sampler: Any, ray: Any, L: tuple, d: Any, backward: bool
) -> Any:
    """The derivative of the radiance of traced paths.

    Args:
        sampler: as it was before the paths were traced.
        ray: rays of the paths.
        L: radiance that they brought, in two parts.
        d: backward: derivative of the outcome by the radiance, which is handed on to the parameters of the scene.
        backward: otherwise the derivative of the radiance is returned, for the derivatives that the parameters carry.
    """
    world = World.of(scene, bodies, settings, Replay(backward))
    return _trace(world, sampler, ray, (L, mi.Spectrum(0 if d is None else d)), mi.Bool(True))[0][1]


def _trace(world: World, sampler: Any, camera: Any, books: tuple, active: Any) -> tuple[tuple, Any]:
    """One loop over the vertices. At each, emitters are sampled and the direction goes on by the surface (balance
    heuristic between the two). At a translucent surface one of reflection, orders below two and the rest is chosen;
    light of emitters that it mirrors is added whatever is chosen, as highlights are bright.

    Where the first vertex is on a body, the path begins there a second time for its orders below two: choosing between
    them and the rest was most of the variance under a sky.
    """
    scene, settings, (parts, more) = world.scene, world.settings, books
    camera = mi.Ray3f(camera)
    unlinked = nothing()._replace(pdf=mi.Float(1)).previous

    def step(sampler: Any, ray: Any, books: Books, throughput: Any, last: tuple, depth: Any, turn: tuple, active: Any):
        (second, splits, kept, seen, scattered), first = turn, depth == 0
        si = scene.ray_intersect(ray, mi.RayFlags.All, first, active)
        with tracking(world.books.tracks):
            shown = ~first if settings.hide_emitters else mi.Bool(True)
            light = emitted(world, sampler, ray, si, last, shown, scattered, active & ~(first & second))
            books = world.books.add(books, throughput * light)
        seen = seen | (first & si.is_valid())
        active = active & si.is_valid() & (last[5] < 0) & (depth + 1 < _unsigned(settings.max_depth))
        splits = splits | (active & first & _on_splitting(world, si))
        on, books = vertex(world, sampler, Vertex(si, ray, throughput, first, second, scattered, active), books)
        throughput = dr.select(active, throughput * on.weight, throughput)
        best = dr.max(throughput)
        active = active & (best > 0)
        depth = dr.select(active, depth + 1, depth)
        survival = dr.select(depth >= settings.rr_depth, dr.minimum(best, 0.95), 1.0)
        active = active & (sampler.next_1d() < survival)
        throughput = throughput / survival
        ray = dr.select(active, place(on.p, on.n).spawn_ray(on.d), ray)
        last, scattered = on.previous, scattered | on.scattered
        again = ~active & splits & ~second
        kept, books = dr.select(again, books[0], kept), (dr.select(again, parts[1], books[0]), books[1])
        begun = (camera, mi.Spectrum(1), unlinked, mi.UInt32(0))
        ray, throughput, last, depth = dr.select(again, begun, (ray, throughput, last, depth))
        turn = (second | again, splits, kept, seen, scattered & ~again)
        return sampler, ray, books, throughput, last, depth, turn, active | again

    no, one = mi.Bool(False), mi.Spectrum(1)
    turn = (mi.Bool(no), mi.Bool(no), mi.Spectrum(0), mi.Bool(no), mi.Bool(no))
    state = (sampler, camera, (parts[0], more), one, unlinked, mi.UInt32(0), turn, mi.Bool(active))
    with detached():
        out = dr.while_loop(state, lambda *state: state[-1], step, label="bssrdf")
    (L, more), (second, _, kept, seen, _) = out[2], out[6]
    return ((dr.select(second, kept, L), dr.select(second, L, 0)), more), seen


def _on_splitting(world: World, si: Any) -> Any:
    """Whether a point is on a body with orders below two beside others."""
    found = mi.Bool(False)
    for body in world.bodies:
        if body.splits:
            found |= si.shape == mi.ShapePtr(body.found.shape)
    return found


def _unsigned(max_depth: int) -> int:
    return 0xFFFFFFFF if max_depth < 0 else max_depth
