"""What happens at a vertex of a path: which events are taken, and what each of them brings."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import drjit as dr
import mitsuba as mi

from halfspace_sss.rendering.paths.books import Books
from halfspace_sss.rendering.paths.choice import choose
from halfspace_sss.rendering.paths.events import Onward, few, multiple, nothing, surface
from halfspace_sss.rendering.paths.lights import balance
from halfspace_sss.rendering.paths.world import World, delta_light
from halfspace_sss.rendering.surface.derivatives import detached, tracking
from halfspace_sss.rendering.transport.body import Body
from halfspace_sss.rendering.transport.plane import Exit, place

__all__ = ["Vertex", "emitted", "vertex"]


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
