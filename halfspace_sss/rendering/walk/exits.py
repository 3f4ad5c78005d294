"""Where walks from given exits leave an object: what a model of its light transport is learnt from.

A walk enters at x_o against the direction w_o and leaves at x_i into w_i with the throughput T of each channel. Both
refractions and absorption are in T; reflection at x_o is not, so that walks which never enter have none:

    ∫∫ S(x_i, w_i; x_o, w_o) mu_i f(x_i, w_i) dw_i dA_i = E[T f(x_i, w_i)]
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi

from halfspace_sss.rendering.object.points import SurfacePoint, lift, lifted, sided
from halfspace_sss.rendering.walk.media import WalkMedia
from halfspace_sss.rendering.walk.random_walk import (
    Crossing,
    Event,
    Visitor,
    Walk,
    Walker,
    draw,
    sample_bsdf,
    start_walk,
)
from halfspace_sss.tracing.walk import generator, pass_seed

__all__ = [
    "ExitVisitor",
    "WalkExits",
    "FirstExitVisitor",
    "FirstExits",
    "FirstExitRecord",
    "exits",
    "walk_from",
]


LANES = 2**13


@dataclass
class WalkExits:
    """Where walks leave, in the order of their starts."""

    left: mi.Bool  # whether the walk left, rather than ended inside; the rest is 0 if not
    x_i: mi.Point3f
    n_i: mi.Normal3f  # outward shading normal, as w_i sees it
    w_i: mi.Vector3f  # direction outside, away from the surface
    throughput: mi.Spectrum  # T
    order: mi.UInt32  # scattering events


@dataclass(frozen=True, eq=False)
class ExitVisitor:
    """Stores each exit at the number of its walk, which is the record, and ends the walk there."""

    exits: WalkExits

    def event(self, walk: Walk, record: mi.UInt32, event: Event) -> tuple[Walk, mi.UInt32]:
        return walk, record

    def boundary(
        self, walk: Walk, record: mi.UInt32, si: mi.SurfaceInteraction3f, active: mi.Bool
    ) -> tuple[Walk, mi.UInt32]:
        return walk, record

    def surface(
        self, walk: Walk, record: mi.UInt32, si: mi.SurfaceInteraction3f, bsdf: mi.BSDFPtr, k: mi.Int32
    ) -> tuple[Walk, mi.UInt32]:
        return walk, record

    def crossing(self, walk: Walk, record: mi.UInt32, crossing: Crossing) -> tuple[Walk, mi.UInt32]:
        leaves = walk.alive & crossing.leaves
        to, si = self.exits, crossing.si
        dr.scatter(to.left, mi.Bool(True), record, leaves)
        dr.scatter(to.x_i, si.p, record, leaves)
        dr.scatter(to.n_i, lifted(si.sh_frame.n, si.n, walk.d), record, leaves)
        dr.scatter(to.w_i, walk.d, record, leaves)
        dr.scatter(to.throughput, walk.weight, record, leaves)
        dr.scatter(to.order, walk.order, record, leaves)
        return replace(walk, alive=walk.alive & ~leaves), record


def exits(media: WalkMedia, k: int, start: SurfacePoint, seed: int | tuple[int, ...], lanes: int = LANES) -> WalkExits:
    """Where walks from points on object k leave it.

    Args:
        media, k, start, seed, lanes: as of `walk_from`.

    Returns:
        Exits in the order of the starts. A walk counts if its order is among the orders of the object.

    Raises:
        ValueError: there is no object k, or the arrays of `start` are of different lengths.
    """
    result = _nowhere(dr.width(start.p))
    dr.eval(result)
    walk_from(media, k, start, ExitVisitor(result), seed, lanes)
    dr.eval(result)
    return result


def walk_from(
    media: WalkMedia,
    k: int,
    start: SurfacePoint,
    visitor: Visitor,
    seed: int | tuple[int, ...],
    lanes: int = LANES,
    roulette_from: int = 1,
) -> None:
    """Walk from points on object k until the walks leave it or end inside.

    Args:
        media: the translucent objects of a scene, see `WalkMedia.of`.
        k: number of the object.
        start: p, n, n_out and w, arrays of one length; where w is below the surface, no walk enters.
        visitor: what is recorded; its record is the number of the walk. It has to end walks that leave.
        seed: one whole number or more.
        lanes: walks at a time; another number gives other walks.
        roulette_from: scattering events from which on roulette may end a walk.

    Raises:
        ValueError: there is no object k, or the arrays of `start` are of different lengths.
    """
    n = _check(media, k, start)
    if n == 0:
        return
    dr.eval(start)
    lanes = min(lanes, n)
    walker, total, k = Walker(media, visitor, roulette_from), dr.opaque(mi.UInt32, n), dr.opaque(mi.UInt32, k)

    def renew(walk: Walk, index: mi.UInt32) -> tuple[Walk, mi.UInt32]:
        return _enter(media, k, start, index + lanes, walk.rng), index + lanes

    def body(walk: Walk, index: mi.UInt32) -> tuple[Walk, mi.UInt32]:
        walk, index = dr.if_stmt((walk, index), walk.alive, walker.step, lambda *s: s, label="inside")
        return dr.if_stmt((walk, index), ~walk.alive, renew, lambda *s: s, label="renew")

    seeds = seed if isinstance(seed, tuple) else (seed,)
    index = dr.arange(mi.UInt32, lanes)
    walk = _enter(media, k, start, index, generator(mi, lanes, pass_seed(*seeds)))
    dr.while_loop((walk, index), lambda walk, index: index < total, body, label="walks")
    dr.eval()


def _nowhere(n: int) -> WalkExits:
    kinds = mi.Bool, mi.Point3f, mi.Normal3f, mi.Vector3f, mi.Spectrum, mi.UInt32
    return WalkExits(*(dr.zeros(kind, n) for kind in kinds))


def _check(media: WalkMedia, k: int, start: SurfacePoint) -> int:
    """The number of starts."""
    if not 0 <= k < len(media.objects):
        raise ValueError(f"k must be a whole number in [0, {len(media.objects) - 1}], got {k!r}")
    widths = [dr.width(v) for v in start[:4]]
    if len(set(widths)) > 1:
        raise ValueError(f"p, n, n_out and w of the starts must be of one length, got {widths}")
    return widths[0]


def _enter(media: WalkMedia, k: mi.UInt32, start: SurfacePoint, index: mi.UInt32, rng: mi.PCG32) -> Walk:
    """The walk of a start, refracted into the object."""
    known = index < dr.width(start.p)
    si = dr.zeros(mi.SurfaceInteraction3f, dr.width(index))
    si.p = dr.gather(mi.Point3f, start.p, index, known)
    si.n = dr.gather(mi.Normal3f, start.n, index, known)
    si.sh_frame = mi.Frame3f(dr.gather(mi.Normal3f, start.n_out, index, known))
    w = dr.gather(mi.Vector3f, start.w, index, known)
    si.wi = si.to_local(w)
    si = lift(si, w)
    ctx = mi.BSDFContext()
    ctx.type_mask = mi.BSDFFlags.Transmission
    bs, value = sample_bsdf(media.boundary(k), si, rng, ctx)
    d, _ = sided(si, bs.wo)
    walk = start_walk(si.p, d, rng)
    enters = known & (dr.dot(w, si.n) > 0) & (dr.dot(d, si.n) < 0) & (dr.max(value) > 0)
    enters &= mi.Frame3f.cos_theta(si.wi) > 0
    channel = draw(len(value), rng) if len(value) > 1 else walk.channel
    return replace(walk, alive=enters, object=mi.Int32(k) + dr.zeros(mi.Int32, dr.width(index)), weight=value,
                   skip=media.clear(k, si.n, d), scale=dr.square(bs.eta), channel=channel)  # fmt: skip


# ---- First exits of paths from the camera ------------------------------------------------------------------------
#
# While walks gather light for an image, where they leave is kept for learning. A path that meets an object first goes
# in at x_o against the direction w_o of the eye, or is reflected there, and leaves at x_i into w_i with the throughput
# T. Over all such paths, those included that do not enter,
#
#     ∫∫ S(x_i, w_i; x_o, w_o) mu_i f(x_i, w_i) dw_i dA_i = E[T f(x_i, w_i)].


@dataclass
class FirstExits:
    """One lane for each path; normals point outwards, directions away from the surface, which see shading normals."""

    object: mi.Int32  # the number of the object that the path meets first, or -1
    x_o: mi.Point3f
    n_o: mi.Normal3f  # geometric
    n_o_shading: mi.Normal3f
    w_o: mi.Vector3f
    throughput: mi.Spectrum  # T; 0 where no walk left
    x_i: mi.Point3f
    n_i: mi.Normal3f  # geometric
    n_i_shading: mi.Normal3f
    w_i: mi.Vector3f
    order: mi.UInt32  # scattering events
    face: mi.UInt32  # at x_i

    @classmethod
    def of(cls, scene: mi.Scene, media: WalkMedia, rays: mi.Ray3f) -> FirstExits:
        """What rays of the camera meet first, and room for where their walks leave."""
        si = scene.ray_intersect(rays, mi.RayFlags.All, coherent=True)
        k = media.index_of(si.shape, si.is_valid())
        si = media.seen(si, k, rays.d)
        n = dr.width(rays)
        kinds = mi.Spectrum, mi.Point3f, mi.Normal3f, mi.Normal3f, mi.Vector3f, mi.UInt32, mi.UInt32
        found = cls(k, mi.Point3f(si.p), mi.Normal3f(si.n), mi.Normal3f(si.sh_frame.n), mi.Vector3f(-rays.d),
                    *(dr.zeros(kind, n) for kind in kinds))  # fmt: skip
        dr.eval(found)
        return found

    def of_object(self, k: int) -> FirstExits:
        """The lanes of paths that meet object k first."""
        kept = dr.compress(self.object == k)
        lanes = {name: dr.gather(type(value), value, kept) for name, value in vars(self).items()}
        found = FirstExits(**lanes)
        dr.eval(found)
        return found

    def gather(self, lanes: mi.UInt32) -> FirstExits:
        """The paths of the given lanes."""
        return FirstExits(**{name: dr.gather(type(value), value, lanes) for name, value in vars(self).items()})


@dataclass
class FirstExitRecord:
    """What a visitor keeps of a path, the number of the path, and whether it is inside the object it met first."""

    record: Any
    index: mi.UInt32
    first: mi.Bool


@dataclass(frozen=True, eq=False)
class FirstExitVisitor:
    """Another visitor, beside which the first exit of each path is stored at the number of the path.

    Args:
        visitor: the other one.
        exits: where they are stored.
    """

    visitor: Visitor
    exits: FirstExits

    def event(self, walk: Walk, record: FirstExitRecord, event: Event) -> tuple[Walk, FirstExitRecord]:
        walk, kept = self.visitor.event(walk, record.record, event)
        return walk, replace(record, record=kept)

    def boundary(
        self, walk: Walk, record: FirstExitRecord, si: mi.SurfaceInteraction3f, active: mi.Bool
    ) -> tuple[Walk, FirstExitRecord]:
        walk, kept = self.visitor.boundary(walk, record.record, si, active)
        return walk, replace(record, record=kept)

    def surface(
        self, walk: Walk, record: FirstExitRecord, si: mi.SurfaceInteraction3f, bsdf: mi.BSDFPtr, k: mi.Int32
    ) -> tuple[Walk, FirstExitRecord]:
        walk, kept = self.visitor.surface(walk, record.record, si, bsdf, k)
        return walk, replace(record, record=kept)

    def crossing(self, walk: Walk, record: FirstExitRecord, crossing: Crossing) -> tuple[Walk, FirstExitRecord]:
        walk, kept = self.visitor.crossing(walk, record.record, crossing)
        to, si = self.exits, crossing.si
        leaves, n_shading = walk.alive & crossing.leaves & record.first, lifted(si.sh_frame.n, si.n, walk.d)
        pairs = ((to.throughput, walk.weight), (to.x_i, si.p), (to.n_i, si.n), (to.n_i_shading, n_shading),
                 (to.w_i, walk.d), (to.order, walk.order), (to.face, si.prim_index))  # fmt: skip
        for target, value in pairs:
            dr.scatter(target, type(target)(value), record.index, leaves)
        return walk, replace(record, record=kept)
