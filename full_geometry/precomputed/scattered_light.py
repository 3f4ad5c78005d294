"""Light that has scattered inside objects, precomputed in the cells of unscattered light.

A walk from the camera that looks up unscattered light L_0 alone goes on until it leaves: most of its noise and time lie
in its later events. Light L_s that comes to a point by way of other events is smooth there, and so is most light L_u
that has not scattered, but comes by way of other objects or of the outside of the same one. Paths from the emitters
bring both to the cells, once for an image. At event FEW of a stay in an object a walk adds

    weight ∫ p(w.w') (L_0 + L_u + L_s)(x, w') dw'

and ends. Events before that one add L_0 + L_u. So each path is found once: one of fewer than FEW events since the
camera's path entered at the last of them, all others at event FEW.

A path of light begins as rays of unscattered light do, or at glass over or about objects, and may also be reflected
there. It walks through objects and between them, and through glass in or over them. Each of its events adds the weight
with which it arrives over sigma_s, the estimate of ∫ L dw dx by collisions, but for those that L_0 holds: the first
event of a path that has met nothing but the boundary of its first object. Light by way of other surfaces is left to
paths from the camera: a share of them goes on for that.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi

from full_geometry.geometry.points import lane_numbers, opaque, sided
from full_geometry.precomputed.inside_cells import CellIndex
from full_geometry.precomputed.lit_points import bend, lit_points
from full_geometry.walk.emission import MOST_SURVIVAL
from full_geometry.walk.media import WalkMedia
from full_geometry.walk.random_walk import (
    OUTSIDE,
    PATH_LANES,
    Crossing,
    Event,
    Visitor,
    Walk,
    Walker,
    behind_of,
    draw_channel,
    on_device,
    sample_bsdf,
    skip,
    start_walk,
)
from halfspace_sss.interrupts import checkpoint
from halfspace_sss.tracing.walk import generator, pass_seed

FEW = 3  # dragon of marble: 2, 3 and 5 have 20, 13 and 7 times less variance x time, ever less of the noise of cells
MOST_ADJOINT = 4.0
AT_ONCE, CANDIDATES = 2**17, 2  # paths, and points with light for each of them
PROBES = 2**12  # points that tell how much light reaches an object
ONWARD = 0.25  # share of walks that go on beyond FEW events where other surfaces than objects may send light


@dataclass
class LightPath:
    """What a walk from an emitter carries.
    `flux`: where it began. `direct`: whether it has met nothing but the boundary of that object since. `scattered`:
    whether it has met events."""

    flux: mi.Spectrum
    direct: mi.Bool
    scattered: mi.Bool


@dataclass(frozen=True, eq=False)
class ScatteredLight(Visitor):
    """Paths from emitters that add ∫ L_s x_j dx dw to cells at their events.
    `scene`, `media`: of Mitsuba, and its objects. `index`: of the cells of all objects. `tables`: by the number of an
    object, as of `UnscatteredLight`. `D`: of each slot and channel ∫ L_s (1, x, y, z) dx dw, x from the centre of the
    cell by its edge, then the same of L_u. `slots`: of all objects."""

    scene: mi.Scene
    media: WalkMedia
    index: CellIndex
    tables: dict[str, Any]
    D: mi.Float
    slots: int

    def flux(self, k: int, seed: int) -> float:
        """About the flux of the emitters at object or glass k, of the brightest channel."""
        rng = generator(mi, PROBES, pass_seed(seed, k, 2))
        _, flux = lit_points(self.scene, self.media, k, PROBES, (seed, k, 2), rng)
        return float(dr.sum(dr.max(dr.abs(flux)))[0])

    def trace(self, k: int, number: int, seed: int) -> None:
        """Add the light of so many paths that begin on object or glass k, or a few more."""
        parts = math.ceil(number / AT_ONCE)
        for part in range(parts):
            checkpoint()
            starts = self._starts(k, math.ceil(number / parts), parts, (seed, k, part))
            if starts is not None:
                self._trace(starts, (seed, k, part))

    def _starts(self, k: int, number: int, parts: int, seed: tuple[int, ...]) -> tuple | None:
        """Where paths of about equal flux begin: o, d, off, object, `Walk.within`, whether there is light, the path.
        None where no light reaches."""
        # ---- points of the surface with a sample of the emitters, refracted or reflected there: flux *= f cos / p
        many = CANDIDATES * number
        rng = generator(mi, many, pass_seed(*seed, 1))
        si, flux = lit_points(self.scene, self.media, k, many, (*seed, 1), rng)
        glass = k >= len(self.media.instance_table)
        boundary = self.media.inner.priorities.boundary(k) if glass else self.media.boundary(k)
        bs, value = sample_bsdf(boundary, si, rng, mi.BSDFContext(mi.TransportMode.Importance))
        d, _ = sided(si, bs.wo)
        enters = dr.dot(d, si.n) < 0
        flux = dr.select(bs.pdf > 0, flux * value * bend(si, bs.wo, d), 0)
        o, off = self.media.depart(si, d, enters)
        size, u = dr.max(dr.abs(flux)), rng.next_float32()
        dr.eval(o, d, off, enters, flux, size, u)

        # ---- of these a few, each with the probability of its flux, in order along the faces
        ends = dr.cumsum(dr.float64_array_t(mi.Float)(size))
        total = float(ends[-1])
        if total == 0:
            return None
        first, step = (dr.opaque(type(ends), v) for v in (float(u[0]), total / number))
        at = (dr.arange(type(ends), number) + first) * step
        which = dr.binary_search(0, many - 1, lambda i: dr.gather(type(ends), ends, i) < at)
        o, d, off, enters, flux, size = dr.gather(tuple, (o, d, off, enters, flux, size), which)
        flux = dr.select(size > 0, flux * (opaque(total / (number * parts)) / dr.maximum(size, 1e-30)), 0)
        within: mi.UInt32 | tuple[()] = ()
        if self.media.overlaps:
            within = dr.select(enters, self.media.inner.priorities.start(dr.opaque(mi.UInt32, k)), mi.UInt32(0))
        inside = enters & (not glass)
        path = LightPath(flux, inside, enters & False)
        return o, d, off, dr.select(inside, mi.Int32(k), OUTSIDE), within, size > 0, path

    def _trace(self, starts: tuple, seed: tuple[int, ...]) -> None:
        """Walk from so many starts; lanes take those of index, index + lanes, ... until none is left."""
        dr.eval(starts)
        number = dr.width(starts[0])
        lanes = min(on_device(PATH_LANES), number)
        total, step = (dr.opaque(mi.UInt32, v) for v in (number, lanes))
        walker = Walker(self.media, self)

        def begin(index: mi.UInt32, rng: mi.PCG32) -> tuple[Walk, LightPath]:
            known = index < total
            o, d, off, k, within, alive, path = dr.gather(tuple, starts, index, known)
            channel, density = draw_channel(self.media.shares(dr.maximum(k, 0)), rng.next_float32())
            walk = replace(start_walk(o, d, rng), off=off, object=k, alive=alive & known, within=within)
            return replace(walk, channel=channel, density=density), path

        def renew(walk: Walk, index: mi.UInt32, path: LightPath) -> tuple[Walk, mi.UInt32, LightPath]:
            walk, path = begin(index + step, walk.rng)
            return walk, index + step, path

        def body(walk: Walk, index: mi.UInt32, path: LightPath) -> tuple[Walk, mi.UInt32, LightPath]:
            inside = walk.alive & (walk.object >= 0)
            walk, path = dr.if_stmt((walk, path), inside, walker.step, _same, label="inside")
            (walk,) = dr.if_stmt((walk,), walk.alive & (walk.object < 0), self._outside, _same, label="outside")
            return dr.if_stmt((walk, index, path), ~walk.alive, renew, _same, label="renew")

        index = lane_numbers(lanes)
        walk, path = begin(index, generator(mi, lanes, pass_seed(*seed, 2)))
        dr.while_loop((walk, index, path), lambda walk, index, path: index < total, body, label="paths of light")
        dr.eval(self.D)

    def _outside(self, walk: Walk) -> tuple[Walk]:
        """A ray between objects, as far as the next surface, which passes or ends it."""
        media = self.media
        si = media.instance_scene.intersect(self.scene, mi.Ray3f(walk.o, walk.d), mi.RayFlags.All)
        if not len(walk.within):
            return self._bounce(walk, si)
        walk, skips = skip(media, walk, si)
        return dr.if_stmt((walk, si), ~skips, self._bounce, lambda walk, si: (walk,), label="bounce")

    def _bounce(self, walk: Walk, si: mi.SurfaceInteraction3f) -> tuple[Walk]:
        """An object, or glass in or over one, reflects a ray or lets it in."""
        # ---- the object whose outside is met, or what is behind glass
        media, k = self.media, self.media.index_of(si, si.is_valid())
        translucent, near = k >= 0, dr.maximum(k, 0)
        si = media.seen(si, k, walk.d)
        bsdf, passed, behind = media.boundary(near), translucent & (dr.dot(si.n, walk.d) < 0), None
        if media.inner is not None:
            bsdf = dr.select(translucent, media.boundary_pointer(near), si.bsdf())
            behind = behind_of(media, walk, si, bsdf, translucent)
            bsdf, passed = behind.bsdf, passed | behind.member

        # ---- weight *= f cos / p and what light has beyond the camera's paths
        bs, value = sample_bsdf(bsdf, si, walk.rng)
        d, _ = sided(si, bs.wo)
        weight, alive = walk.weight, passed & (bs.pdf > 0)
        enters = translucent & (dr.dot(d, si.n) < 0)
        if behind is not None:
            # glass keeps light by total reflection, without roulette for ever
            d = dr.select(translucent, d, si.to_world(bs.wo))
            through = behind.member & (dr.dot(d, si.n) * dr.dot(walk.d, si.n) > 0)
            alive &= ~behind.member | (walk.rng.next_float32() < MOST_SURVIVAL)
            weight = dr.select(behind.member, weight / MOST_SURVIVAL, weight)
            walk, near, enters = behind.entered(walk, through, near, enters)
        weight = weight * value * adjoint(si, walk.d, d)

        # ---- the way on
        o, off = media.depart(si, d, enters)
        return (replace(walk, o=o, d=d, off=off, alive=alive, order=mi.UInt32(0) & walk.order,
                        object=dr.select(alive & enters, near, OUTSIDE), weight=weight,
                        scale=walk.scale * dr.square(bs.eta)),)  # fmt: skip

    # ---- visitor of walks

    def event(self, walk: Walk, path: LightPath, event: Event) -> tuple[Walk, LightPath]:
        """Add what arrives, to L_u before the first event of a path."""
        at = dr.gather(dict, self.tables, self.media.place_of(event.object))
        x = mi.Point3f((event.p - at["low"]) * at["scale"])
        slot, y, _, held = self.index.find(x, at["first"], at["counts"], ~path.direct | path.scattered)
        # refraction by the camera's paths has 1 / scale, flux has not
        light = path.flux * walk.weight * (walk.scale / dr.maximum(event.m.sigma_s, 1e-30))
        n, slot = len(light), mi.UInt32(slot) + dr.select(path.scattered, 0, dr.opaque(mi.UInt32, self.slots))
        for c in range(n):
            dr.scatter_add(self.D, mi.Vector4f(1, y.x, y.y, y.z) * light[c], slot * n + c, held)
        return walk, replace(path, scattered=mi.Bool(True))

    def crossing(self, walk: Walk, path: LightPath, crossing: Crossing) -> tuple[Walk, LightPath]:
        stays = crossing.reflected(self.media, walk.d)
        weight = dr.select(stays, walk.weight, walk.weight * adjoint(crossing.si, crossing.along, walk.d))
        return replace(walk, weight=weight), replace(path, direct=path.direct & crossing.brings(self.media, walk.d))


def adjoint(si: mi.SurfaceInteraction3f, along: mi.Vector3f, d: mi.Vector3f) -> mi.Float:
    """What light from `along` into d has beyond the camera's paths: |along.n_s| |d.n| / (|along.n| |d.n_s|)."""
    n, n_s = si.n, si.sh_frame.n
    of_light, of_camera = dr.dot(along, n_s) * dr.dot(d, n), dr.dot(along, n) * dr.dot(d, n_s)
    return dr.minimum(dr.abs(of_light) / dr.maximum(dr.abs(of_camera), 1e-6), MOST_ADJOINT)


def _same(*state: object) -> tuple:
    return state
