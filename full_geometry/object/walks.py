"""Walks inside one object, from where light is seen to leave back to where it entered: samples of S mu_i.

A walk begins at x_o, goes inwards along the refracted w_o with the weight F_t(mu_o), is scattered, is reflected at the
boundary from inside, and leaves at x_i along w_i with the throughput T of each channel. Then

    L_o(x_o, w_o) = E[T L_i(x_i, w_i)],    E[T delta(x - x_i, w - w_i)] = S(x, w; x_o, w_o) mu.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import drjit as dr
import mitsuba as mi

from full_geometry.object.subject import Subject, surface_point
from halfspace_sss.checks import check_count
from halfspace_sss.rendering.object.points import SurfacePoint
from halfspace_sss.rendering.walk import exits as walk_exits
from halfspace_sss.rendering.walk.random_walk import Crossing, Event, Walk

LANES = 2**15
ROULETTE_FROM = 8  # scattering events: from 2 on weak channels of ketchup have 10 times the variance, for no time less


class WalkEnds(NamedTuple):
    """Ends of walks, one lane for each: T is 0 where it ended inside or left at an order that is not kept."""

    at: SurfacePoint
    T: Any
    order: Any
    face: Any


@dataclass(frozen=True, eq=False)
class _Store:
    """A visitor that keeps the end of every walk at its number, and ends it there."""

    exits: WalkEnds
    fewest: Any
    most: Any

    @classmethod
    def of(cls, n: int, fewest: int, most: int) -> _Store:
        at = SurfacePoint(*(dr.zeros(kind, n) for kind in (mi.Point3f, mi.Normal3f, mi.Normal3f, mi.Vector3f)))
        exits = WalkEnds(at, dr.zeros(mi.Spectrum, n), dr.zeros(mi.UInt32, n), dr.zeros(mi.UInt32, n))
        dr.eval(exits)
        return cls(exits, *(dr.opaque(mi.UInt32, order) for order in (fewest, most)))

    def event(self, walk: Walk, record: Any, event: Event) -> tuple[Walk, Any]:
        return walk, record

    def boundary(self, walk: Walk, record: Any, si: Any, active: Any) -> tuple[Walk, Any]:
        return walk, record

    def surface(self, walk: Walk, record: Any, si: Any, bsdf: Any, k: Any) -> tuple[Walk, Any]:
        return walk, record

    def crossing(self, walk: Walk, record: Any, crossing: Crossing) -> tuple[Walk, Any]:
        leaves, si = walk.alive & crossing.leaves, crossing.si
        at = surface_point(si.p, si.n, si.sh_frame.n, walk.d)
        kept = leaves & (walk.order >= self.fewest) & (walk.order <= self.most)
        targets, values = (*self.exits.at[:4], *self.exits[1:]), (*at[:4], walk.weight, walk.order, si.prim_index)
        for target, value in zip(targets, values):
            dr.scatter(target, type(target)(value), record, kept)
        return replace(walk, alive=walk.alive & ~leaves), record


def trace_exits(
    subject: Subject,
    starts: SurfacePoint,
    seed: tuple[int, ...],
    *,
    fewest: int = 2,
    most: int = 2**31 - 1,
    roulette_from: int = ROULETTE_FROM,
) -> WalkEnds:
    """One walk from each start.

    Args:
        starts: where light is seen to leave, and the direction towards the eye.
        seed: of the pass, as for `walk.pass_seed`.
        fewest, most: numbers of scattering events that are kept.
        roulette_from: scattering events, from which on walks of little weight are ended by chance.

    Raises:
        ValueError: fewest is not a whole number >= 0.
    """
    check_count("fewest", fewest, 0)
    store = _Store.of(dr.width(starts.p), fewest, most)
    walk_exits.walk_from(subject.walk_media, 0, starts, store, seed, LANES, roulette_from)
    dr.eval(store.exits)
    return store.exits
