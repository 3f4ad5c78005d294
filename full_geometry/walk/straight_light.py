"""Light of emitters that reaches events straight, through boundaries of relative index 1.

A boundary without refraction hides no emitter. Each event samples one of the emitters and weights it against the
direction that the phase function draws, as volume path tracers do through boundaries that are `null`.
On its way out light may leave the object and pass it again. Both strategies know the same ways: the object of the
event, and nothing else, lies between the event and the emitter, and the first way out is no longer than `FARTHEST`
mean free paths. All other light is left to chance, and so is that of an even sky: its samples add more noise than they
take away.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from full_geometry.geometry.points import channel_mean
from full_geometry.geometry.rounding import before
from full_geometry.geometry.shape import by_pointer, looked_up, pointer_numbers
from full_geometry.walk.emission import mis_weight
from full_geometry.walk.media import WalkMedia, WalkMedium, interaction_of, ray_of
from full_geometry.walk.random_walk import Event, draw, eval_phase
from full_geometry.walk.scores import Score, phase_score

FARTHEST = 16.0  # mean free paths: e^-16 is below what float32 adds to 1


@dataclass
class LightWay:
    """Loop variables of a way from an event to an emitter."""

    ray: mi.Ray3f
    left: mi.Float  # distance to the emitter
    inside: mi.Bool
    going: mi.Bool
    arrives: mi.Bool
    length: mi.Float  # inside the object
    T: mi.Spectrum
    rng: mi.PCG32


@dataclass(frozen=True, eq=False)
class StraightLight:
    """Emitters as events see them through boundaries of index 1.

    Args:
        emitters: those that are sampled.
        tables: `pointer`, what Dr.Jit's registry calls each of them, and from that number to its place, `index`.
        again: whether light may pass an object again on its way: not where walks carry their medium, nor where paths
            have a limit of depth.
        scored: whether light comes with its slopes.
    """

    scene: mi.Scene
    media: WalkMedia
    emitters: list[mi.Emitter]
    tables: dict[str, mi.UInt32 | mi.Int32]
    again: bool
    scored: bool = False

    def passes_again(self, k: mi.Int32) -> mi.Bool:
        """Whether light that has left object k may pass it again."""
        return self.media.straight(k) & self.media.counts(k, mi.UInt32(0)) & self.again

    def reach(self, k: mi.Int32, p: mi.Point3f, medium: WalkMedium | tuple[()] = ()) -> mi.Float:
        """The longest first way out of object k from the point p."""
        return FARTHEST / dr.min(self.media.coefficients(k, p, medium).mean_t)

    def pdf(self, k: mi.Int32, p: mi.Point3f, cosine: mi.Float, medium: WalkMedium | tuple[()] = ()) -> mi.Float:
        """Density of the phase function for a direction at the point p of object k, 1/sr."""
        return channel_mean(eval_phase(self.media.coefficients(k, p, medium), cosine))

    def pdf_emitter(self, at: mi.Interaction3f, ds: mi.DirectionSample3f, active: mi.Bool) -> mi.Float:
        """Density of `light` for a direction to an emitter, 1/sr; 0 of emitters that are not sampled."""
        # p_e = pdf / n of the emitters that are sampled
        active = active & (looked_up(self.tables["index"], ds.emitter, -1) >= 0)
        return dr.select(active, ds.emitter.pdf_direction(at, ds, active) / len(self.emitters), 0)

    def light(self, event: Event, rng: mi.PCG32) -> tuple[mi.Spectrum, Score | tuple[()]]:
        """An estimate of the light that an event sends on, per weight of the walk, and its slopes."""
        # ---- one of n emitters, and a direction to it: density p_e = pdf / n
        at, n, emitter = interaction_of(event.p, event.medium), len(self.emitters), self.emitters[0]
        if n > 1:
            pointer = dr.gather(mi.UInt32, self.tables["pointer"], draw(n, rng))
            emitter = dr.reinterpret_array(mi.EmitterPtr, pointer)
        ds, light = emitter.sample_direction(at, mi.Point2f(rng.next_float32(), rng.next_float32()))

        # ---- p(cos) L_e / p_e  p_e / (p_e + p_phase)
        cosine = dr.dot(event.along, ds.d)
        phase = eval_phase(event.m, cosine)
        weight = dr.select(ds.delta, 1, mis_weight(ds.pdf / n, channel_mean(phase)))
        value = dr.select(ds.pdf > 0, phase * light * (n * weight), 0)
        lit = (dr.max(value) > 0) & dr.isfinite(channel_mean(value))

        # ---- exp(-∫ sigma_t) on the way, 0 where something else is on it
        way = self._way(event, ds, lit, rng)
        result = dr.select(lit & way.arrives, value * way.T, 0)
        if not self.scored:
            return result, ()
        return result, Score(mi.Float(0), way.length, phase_score(event.m.g, cosine)) * result

    def _way(self, event: Event, ds: mi.DirectionSample3f, active: mi.Bool, rng: mi.PCG32) -> LightWay:
        """Through the object to the emitter, or to what is between."""
        # ---- segments inside the object and outside, until the emitter or something else is met
        media, k, medium, again = self.media, event.object, event.medium, self.passes_again(event.object)
        reach = FARTHEST / dr.min(event.m.mean_t)

        def go(way: LightWay) -> LightWay:
            # to the own boundary or to what is before the emitter; the first way out no further than `reach`
            ray = mi.Ray3f(way.ray)
            first = way.inside & (way.length == 0)
            ray.maxt = dr.select(first, dr.minimum(reach, way.left), way.left)
            si = media.instance_scene.intersect(self.scene, ray, mi.RayFlags.Minimal, active=way.going)
            hit = si.is_valid()
            own = hit & (media.index_of(si, hit) == k)
            leaves = dr.dot(si.n, ray.d) * media.side(k, si.prim_index) > 0
            passed = own & way.inside & leaves

            # T *= exp(-sigma_t t) of a segment inside; on through the boundary along the same direction
            T = media.transmittance(k, ray, dr.select(passed, si.t, 0), way.rng, medium)
            o = mi.Point3f(ray.o + ray.d * si.t + media.clear(k, si.n, ray.d))
            going = way.going & (passed | (own & ~way.inside & ~leaves & again))
            return LightWay(
                ray=ray_of(o, ray.d, medium), left=way.left - si.t, inside=~way.inside, going=going,
                arrives=way.arrives | (way.going & ~hit & ~way.inside),
                length=way.length + dr.select(passed, si.t, 0), T=dr.select(passed, way.T * T, way.T), rng=way.rng,
            )  # fmt: skip

        # the ray ends before the surface of the emitter, as far as rounding may put it
        left = ds.dist - before(ds.p, ds.dist, media.instance_scene.rounding_of(ds.emitter))
        start = LightWay(
            ray=ray_of(event.p, ds.d, medium), left=left, inside=mi.Bool(True) | active, going=mi.Bool(active),
            arrives=~active & active, length=dr.zeros(mi.Float, dr.width(event.p)), T=mi.Spectrum(1), rng=rng,
        )  # fmt: skip
        return dr.while_loop((start,), lambda way: way.going, lambda way: (go(way),), label="way to an emitter")[0]


def find_straight_light(scene: mi.Scene, media: WalkMedia, again: bool, scored: bool = False) -> StraightLight | None:
    """Straight light of a scene; None without an object of index 1 that can have it, or an emitter to sample."""
    emitters = [emitter for emitter in scene.emitters() if "Constant" not in emitter.class_name()]
    if not media.any_straight or not emitters:
        return None
    # emitters by number, and their numbers by what Dr.Jit's registry calls them
    pointers = [mi.EmitterPtr(emitter) for emitter in emitters]
    numbers = mi.UInt32(pointer_numbers(pointers))
    tables = {"pointer": numbers, "index": by_pointer(pointers, np.arange(len(pointers)), -1)}
    dr.make_opaque(tables)
    return StraightLight(scene, media, emitters, tables, again and not media.carried, scored)
