"""The path loop of the integrator: surfaces by their BSDFs, and inside the translucent ones by the BSSRDF."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

from halfspace_sss.rendering.paths.books import Books, Replay, Tally
from halfspace_sss.rendering.paths.events import nothing
from halfspace_sss.rendering.paths.vertex import Vertex, emitted, vertex
from halfspace_sss.rendering.paths.world import World
from halfspace_sss.rendering.surface.derivatives import detached, tracking
from halfspace_sss.rendering.transport.body import Body
from halfspace_sss.rendering.transport.plane import place
from halfspace_sss.rendering.transport.settings import Settings

__all__ = ["replay_paths", "trace_paths"]


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
