"""What every path needs to know of a scene: its emitters, the mean radiance of its sky, its objects; and its tally.

A tally is the radiance of a path, or in a replay the derivatives of its radiance. Derivatives follow path replay
backpropagation (Vicini, Speierer and Jakob 2021). A path is traced, then traced again with the same random numbers. At
every vertex of the replay the radiance still to come is known. Each factor is then differentiated on its own with the
others held, and no loop is recorded. Directions and densities are held too.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np

from full_geometry.geometry.instances import InstanceScene, InstanceTransform
from full_geometry.geometry.rounding import blocked
from full_geometry.objects.objects import TranslucentObject
from full_geometry.objects.small_emitters import WIDE, SmallEmitters, is_delta
from full_geometry.settings import AUTOMATIC, Settings


@dataclass
class PathTally:
    """What the paths of a launch sum up."""

    L: mi.Spectrum  # primal: radiance so far; replay: radiance still to come
    derivative: mi.Spectrum | tuple[()]  # replay forward: derivative of L; backward: adjoint of L; primal: nothing
    chance: mi.Spectrum  # primal: of L, light that orders below two have met by chance


@dataclass(frozen=True)
class Primal:
    """The first pass: radiance is added up."""

    tracks = False

    def add(self, tally: PathTally, light: mi.Spectrum) -> PathTally:
        """Add the light of one estimator of the path."""
        return replace(tally, L=tally.L + light)

    def note_chance(self, tally: PathTally, light: mi.Spectrum) -> PathTally:
        """Note light, which is in the tally already, as met by chance."""
        return replace(tally, chance=tally.chance + light)

    def settle(
        self, tally: PathTally, light: mi.Spectrum, weight: mi.Spectrum, continues: mi.Bool, shown: mi.Spectrum | float
    ) -> PathTally:
        """Add the light of a vertex.

        Args:
            light: light of next-event estimation at the vertex.
            weight: factor of the throughput at the vertex.
            continues: whether the path goes on with that weight.
            shown: light per weight that has the weight too and is in the tally already.
        """
        return self.add(tally, light)


@dataclass(frozen=True)
class Replay:
    """The second pass: radiance is taken away again, and each factor is differentiated.

    Args:
        backward: whether adjoints are handed on to the parameters, or derivatives of parameters to the radiance.
    """

    backward: bool
    tracks = True

    def add(self, tally: PathTally, light: mi.Spectrum) -> PathTally:
        """Take the light of one estimator away, and differentiate it."""
        tally = self._differentiate(tally, light)
        return replace(tally, L=tally.L - dr.detach(light))

    def note_chance(self, tally: PathTally, light: mi.Spectrum) -> PathTally:
        """Nothing: what is met by chance is known from the first pass."""
        return tally

    def settle(
        self, tally: PathTally, light: mi.Spectrum, weight: mi.Spectrum, continues: mi.Bool, shown: mi.Spectrum | float
    ) -> PathTally:
        """As of `Primal`; d(light + weight L_next) with L_next = (L - light) / weight held."""
        L = tally.L - dr.detach(light)
        fixed = dr.detach(weight)
        L_next = dr.select(continues & (fixed != 0), L / dr.select(fixed != 0, fixed, 1), 0)
        return self._differentiate(replace(tally, L=L), light + weight * (L_next + shown))

    def _differentiate(self, tally: PathTally, value: mi.Spectrum) -> PathTally:
        if not dr.grad_enabled(value):
            return tally
        if self.backward:
            dr.backward_from(tally.derivative * value)
            return tally
        return replace(tally, derivative=tally.derivative + dr.forward_to(value))


NEE_SHARE = 0.5
SKY_DIRECTIONS = 128  # squared
DIM_ALONE, DIM = 0.1, 1.0  # of the mean radiance of the sky, expected of surfaces before it
MOST_LEFT = 0.5  # of the mean square of the radiance of the sky, once its mean is taken away


def mis_weight(pdf: mi.Float, other: mi.Float) -> mi.Float:
    """MIS weight of a sample of density `pdf` against a strategy of density `other`, by the balance heuristic."""
    total = pdf + other
    return dr.select(total > 0, pdf / dr.maximum(total, 1e-30), 0)


@dataclass(frozen=True)
class Lights:
    """Kinds of emitters of a scene.

    Args:
        nee_share: share of the directions at points of entry that next-event estimation draws; 0 for a constant
            environment alone, which the directions of the proposals find better.
        some_local: whether there is an emitter beside the environment.
        some_shaped: whether there is one with a shape, which rays can hit.
        some_delta: whether there is one that no ray can hit (point, spot, directional).
        sky_alone: whether the environment is the only one, and varies.
    """

    nee_share: float
    some_local: bool
    some_shaped: bool
    some_delta: bool
    sky_alone: bool

    @property
    def entry_share(self) -> float:
        """`nee_share` of entries, where such directions are apart from those that may meet anything."""
        return 0.0 if self.sky_alone else self.nee_share

    @classmethod
    def of(cls, scene: mi.Scene) -> Lights:
        """The kinds of emitters of a scene."""
        emitters = scene.emitters()
        even = all("Constant" in emitter.class_name() for emitter in emitters)
        delta = any(map(is_delta, emitters))
        local = any(not emitter.is_environment() for emitter in emitters)
        shaped = any(emitter.get_shape() is not None for emitter in emitters)
        return cls(0.0 if even else NEE_SHARE, local, shaped, delta, not even and not local)


class Sky(NamedTuple):
    """The environment of a scene with its mean radiance c, a control variate for transports of known albedo.

    With the directional albedo alpha = ∫ S mu_i dw_i dA_i of a point of an object

        L_o = alpha c + ∫ S mu_i (L_i - c) dw_i dA_i,

    so that nothing is left to be random where L_i = c. c is the mean over directions with the inverse of the sampling
    density as weight: bright directions, which are sampled often, have little noise of their own.
    """

    mean: mi.Spectrum  # c

    @classmethod
    def of(cls, scene: mi.Scene, lights: Lights, objects: list[TranslucentObject]) -> Sky | None:
        """The sky of a scene; None without one, without an object that has `alpha`, or where c is of little use.

        c is left out where it is not most of the light in the square, as under a sun: it costs time there and takes
        no noise away.
        """
        emitter = scene.environment()
        if emitter is None or all(obj.alpha is None for obj in objects):
            return None
        with dr.suspend_grad():
            k = dr.arange(mi.UInt32, SKY_DIRECTIONS**2)
            u = mi.Point2f(k % SKY_DIRECTIONS + 0.5, k // SKY_DIRECTIONS + 0.5) / SKY_DIRECTIONS
            si = dr.zeros(mi.SurfaceInteraction3f, SKY_DIRECTIONS**2)
            si.wi = -mi.warp.square_to_uniform_sphere(u)
            pdf = (1 - lights.nee_share) * mi.warp.square_to_uniform_sphere_pdf(si.wi)
            if lights.nee_share > 0:
                pdf += lights.nee_share * scene.pdf_emitter_direction(si, _towards(emitter, -si.wi))
            L, weight = np.array(mi.Spectrum(emitter.eval(si)) + 0 * pdf), 1 / np.array(pdf)
            c = np.average(L, axis=1, weights=weight)
            left = np.average((L - c[:, None]) ** 2, axis=1, weights=weight).sum()
            if left > MOST_LEFT * np.average(L**2, axis=1, weights=weight).sum():
                return None
            return cls(dr.opaque(mi.Spectrum, c.tolist()))


def _towards(emitter: mi.Emitter, d: mi.Vector3f) -> mi.DirectionSample3f:
    """A direction of the environment."""
    ds = dr.zeros(mi.DirectionSample3f)
    ds.d, ds.emitter = d, mi.EmitterPtr(emitter)
    return ds


@dataclass(frozen=True, eq=False)
class RenderContext:
    """What every path needs.

    Args:
        scene: the Mitsuba scene.
        lights: its kinds of emitters.
        objects: its translucent objects.
        settings: those of the integrator.
        mode: whether paths are traced or replayed.
        sky: its mean radiance, where that serves.
        small: its emitters that look small, if there are any.
    """

    scene: mi.Scene
    lights: Lights
    objects: list[TranslucentObject]
    settings: Settings
    mode: Primal | Replay
    sky: Sky | None = None
    small: SmallEmitters | None = None

    @classmethod
    def of(
        cls, scene: mi.Scene, objects: list[TranslucentObject], settings: Settings, mode: Primal | Replay
    ) -> RenderContext:
        """The context of a scene and its translucent objects."""
        lights = Lights.of(scene)
        with dr.suspend_grad():
            small = SmallEmitters.of(scene)
        return cls(scene, lights, objects, settings, mode, Sky.of(scene, lights, objects), small)

    @cached_property
    def instance_scene(self) -> InstanceScene:
        """What rays meet in the scene."""
        return self.objects[0].instance_scene if self.objects else InstanceScene.of(self.scene, [])

    def ray_intersect(self, ray: mi.Ray3f, coherent: mi.Bool | bool, active: mi.Bool) -> mi.SurfaceInteraction3f:
        """What a ray meets, with all that is known of the surface there."""
        return self.instance_scene.intersect(self.scene, ray, mi.RayFlags.All, coherent, active)

    def instance_transform(self, si: mi.SurfaceInteraction3f) -> InstanceTransform | None:
        """Where the instance stands that a ray has met; None where no object is shown by one."""
        return self.instance_scene.transform(si) if any(obj.repeated for obj in self.objects) else None

    @property
    def suns(self) -> bool:
        """Whether the environment has suns, which are sampled like small emitters."""
        return self.small is not None and len(self.small.suns) > 0

    def uses_sky(self, obj: TranslucentObject) -> bool:
        """Whether the mean radiance of the sky is a control variate for an object."""
        return self.sky is not None and obj.alpha is not None

    def sky_means(self, obj: TranslucentObject) -> tuple[mi.Spectrum, mi.Spectrum]:
        """c in the channels where alpha is known, else 0: for orders below two and for the others."""
        low_orders, others = obj.alpha.known
        return low_orders * self.sky.mean, others * self.sky.mean

    def entries(self, obj: TranslucentObject) -> int:
        """Candidates of resampling for an exit: one where c is nearly all light and the settings leave it open."""
        alone = self.uses_sky(obj) and not self.lights.some_local
        return 1 if alone and self.settings.entries == AUTOMATIC else obj.entries

    @property
    def dim(self) -> float:
        """Radiance that is expected of surfaces before the sky, over its own: less where an object has itself alone."""
        return DIM_ALONE if len(self.scene.shapes()) == 1 else DIM

    def sample_sky(
        self, at: mi.Interaction3f, u: mi.Point2f, active: mi.Bool
    ) -> tuple[mi.Vector3f, mi.Float, mi.Spectrum]:
        """A direction of the sky, the only emitter, its density, 1/sr, and the radiance from there."""
        ds, light = self.scene.sample_emitter_direction(at, u, False, active)
        return ds.d, ds.pdf, light * ds.pdf

    def pdf_sky(self, at: mi.Interaction3f, d: mi.Vector3f, active: mi.Bool) -> mi.Float:
        """Density of emitter sampling for a direction of the sky, 1/sr."""
        return self.scene.pdf_emitter_direction(at, _towards(self.scene.environment(), d), active)

    def eval_sky(self, at: mi.Interaction3f, d: mi.Vector3f, active: mi.Bool) -> tuple[mi.Float, mi.Spectrum]:
        """The density of a direction by `sample_sky`, and the radiance from there."""
        si = dr.zeros(mi.SurfaceInteraction3f)
        si.wi, si.wavelengths = -d, at.wavelengths
        return self.pdf_sky(at, d, active), self.scene.environment().eval(si, active)

    def connects_sky(self, obj: TranslucentObject) -> bool:
        """Whether scattering events are connected with the sky: where it varies and c does not take its noise away."""
        return self.scene.environment() is not None and self.lights.nee_share > 0 and not self.uses_sky(obj)

    def sampled_by_nee(self, emitter: mi.EmitterPtr, d: mi.Vector3f) -> mi.Bool:
        """Whether emitter connections find an emitter in the direction d: any but a sky without a sun there."""
        local = ~emitter.is_environment()
        return local | (self.small.index_of(emitter, d) >= 0) if self.suns else local


def sample_emitter(
    context: RenderContext, ref: mi.Interaction3f, u: mi.Point2f, seen: bool, active: mi.Bool
) -> tuple[mi.DirectionSample3f, mi.Spectrum]:
    """A direction of next-event estimation, and light over its density; derivatives are those of the light.

    With `seen` of what `ref`, a surface that a ray has met, sees: the density and the light are 0 where it does not.
    """
    with dr.suspend_grad():
        ds, light = context.scene.sample_emitter_direction(ref, u, False, active)
        if seen:
            shadow = context.instance_scene.ray_to_emitter(ref, ds, context.instance_scene.rounding(ref))
            hidden = blocked(context.scene, shadow, active & (ds.pdf > 0))
            ds.pdf, light = dr.select(hidden, 0, ds.pdf), dr.select(hidden, 0, light)
        inverse = dr.select(ds.pdf > 0, dr.rcp(ds.pdf), 0)
    if not context.mode.tracks:
        return ds, light
    shines = active & (ds.pdf > 0)
    return ds, dr.replace_grad(light, context.scene.eval_emitter_direction(ref, ds, shines) * inverse)


def delta_light(
    context: RenderContext, sampler: mi.Sampler, ray: mi.Ray3f, active: mi.Bool
) -> tuple[mi.UInt32, mi.Spectrum]:
    """One of the delta lights, and its light along a ray, spread over a wide cone, over its probability."""
    n = context.small.n_delta
    which = mi.UInt32(dr.minimum(sampler.next_1d() * n, n - 1)) if n > 1 else mi.UInt32(0)
    return which, n * context.small.spread(which, ray, mi.Float(WIDE), active)
