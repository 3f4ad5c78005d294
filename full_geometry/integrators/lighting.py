"""What every path of `bssrdf` needs to know: emitters, the mean of the environment, objects; and its radiance.

Derivatives follow path replay backpropagation (PRB; Vicini, Speierer and Jakob 2021). A path is traced, then traced
again with the same random numbers. At every vertex of the replay the radiance still to come is known. Each factor is
then differentiated on its own with the others held, and no loop is recorded. Directions and densities are held too.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np

from full_geometry.geometry.instances import InstanceScene, InstanceTransform
from full_geometry.objects.objects import TranslucentObject
from full_geometry.objects.small_emitters import WIDE, SmallEmitters, is_delta
from full_geometry.settings import AUTOMATIC, Settings
from full_geometry.walk.random_walk import below


@dataclass
class PathRadiance:
    """Radiance of a path, or in a replay what is still to come of it and the derivatives."""

    L: mi.Spectrum  # primal: radiance so far; replay: radiance still to come
    derivative: mi.Spectrum | tuple[()]  # replay forward: derivative of L; backward: adjoint of L; primal: nothing
    unconnected: (
        mi.Spectrum
    )  # primal: of L, light of orders 0 and 1 that phase sampling has hit and no connection finds


@dataclass(frozen=True)
class Primal:
    """The first pass: radiance is added up."""

    tracks = False

    def add(self, radiance: PathRadiance, light: mi.Spectrum) -> PathRadiance:
        """Add the light of one estimator of the path."""
        return replace(radiance, L=radiance.L + light)

    def add_unconnected(self, radiance: PathRadiance, light: mi.Spectrum) -> PathRadiance:
        """Note light, which is in L already, as hit by phase sampling alone."""
        return replace(radiance, unconnected=radiance.unconnected + light)

    def update(
        self,
        radiance: PathRadiance,
        light: mi.Spectrum,
        weight: mi.Spectrum,
        continues: mi.Bool,
        shown: mi.Spectrum | float,
    ) -> PathRadiance:
        """Add the light of a vertex.

        Args:
            radiance: so far.
            light: of next-event estimation at the vertex.
            weight: factor of the throughput at the vertex.
            continues: whether the path goes on with that weight.
            shown: light per weight that has the weight too and is in L already.
        """
        return self.add(radiance, light)


@dataclass(frozen=True)
class Replay:
    """The second pass: radiance is taken away again, and each factor is differentiated.
    `backward`: whether adjoints are handed on to the parameters, or derivatives of parameters to the radiance."""

    backward: bool
    tracks = True

    def add(self, radiance: PathRadiance, light: mi.Spectrum) -> PathRadiance:
        """Take the light of one estimator away, and differentiate it."""
        # d light, all that light is made of held but for one factor; then L without it
        radiance = self._differentiate(radiance, light)
        return replace(radiance, L=radiance.L - dr.detach(light))

    def add_unconnected(self, radiance: PathRadiance, light: mi.Spectrum) -> PathRadiance:
        """Nothing: the first pass has noted it."""
        return radiance

    def update(
        self,
        radiance: PathRadiance,
        light: mi.Spectrum,
        weight: mi.Spectrum,
        continues: mi.Bool,
        shown: mi.Spectrum | float,
    ) -> PathRadiance:
        """The PRB update: d(light + weight L_next) with L_next = (L - light) / weight held; as of `Primal`."""
        # L without the light of this vertex, and per weight: what comes from the vertices behind
        L = radiance.L - dr.detach(light)
        fixed = dr.detach(weight)
        L_next = dr.select(continues & (fixed != 0), L / dr.select(fixed != 0, fixed, 1), 0)
        return self._differentiate(replace(radiance, L=L), light + weight * (L_next + shown))

    def _differentiate(self, radiance: PathRadiance, value: mi.Spectrum) -> PathRadiance:
        if not dr.grad_enabled(value):
            return radiance
        # backward: the adjoint of L times d value goes to the parameters; forward: d value to the derivative of L
        if self.backward:
            dr.backward_from(radiance.derivative * value)
            return radiance
        return replace(radiance, derivative=radiance.derivative + dr.forward_to(value))


NEE_SHARE = 0.5
MEAN_DIRECTIONS = 128  # squared
DIM_ALONE, DIM = 0.1, 1.0  # of the mean radiance of the environment, expected of surfaces before it
MOST_LEFT = 0.5  # of the mean square of the radiance of the environment, once its mean is taken away


@dataclass(frozen=True)
class Lights:
    """Kinds of emitters of a scene.

    Args:
        nee_share: share of the directions at points of entry that next-event estimation draws; 0 for a constant
            environment alone, which the directions of the proposals find better.
        some_local: whether there is an emitter beside the environment.
        some_shaped: whether there is one with a shape, which rays can hit.
        some_delta: whether there is one that no ray can hit (point, spot, directional).
        environment_alone: whether the environment is the only one, and varies.
    """

    nee_share: float
    some_local: bool
    some_shaped: bool
    some_delta: bool
    environment_alone: bool

    @property
    def entry_share(self) -> float:
        """`nee_share` of entries, where such directions are apart from those that may meet anything."""
        return 0.0 if self.environment_alone else self.nee_share

    @classmethod
    def of(cls, scene: mi.Scene) -> Lights:
        """The kinds of emitters of a scene."""
        # next-event estimation adds noise alone where all light is an even environment
        emitters = scene.emitters()
        even = all("Constant" in emitter.class_name() for emitter in emitters)
        delta = any(map(is_delta, emitters))
        local = any(not emitter.is_environment() for emitter in emitters)
        shaped = any(emitter.get_shape() is not None for emitter in emitters)
        return cls(0.0 if even else NEE_SHARE, local, shaped, delta, not even and not local)


class EnvironmentMean(NamedTuple):
    """Mean radiance c of the environment of a scene, a control variate for transports of known directional albedo.

    With the directional albedo alpha = ∫ S mu_i dw_i dA_i of a point of an object

        L_o = alpha c + ∫ S mu_i (L_i - c) dw_i dA_i,

    so that nothing is left to be random where L_i = c. c is the mean over directions with the inverse of the sampling
    density as weight: bright directions, which are sampled often, have little noise of their own.
    """

    mean: mi.Spectrum  # c

    @classmethod
    def of(cls, scene: mi.Scene, lights: Lights, objects: list[TranslucentObject]) -> EnvironmentMean | None:
        """c of a scene; None without an environment, without an object that has `alpha`, or where c is of little use.
        c is left out where it is not most of the light in the square, as under a sun: it costs time there and takes no
        noise away."""
        emitter = scene.environment()
        if emitter is None or all(obj.alpha is None for obj in objects):
            return None
        with dr.suspend_grad():
            # radiance along a grid of directions of uniform density
            k = dr.arange(mi.UInt32, MEAN_DIRECTIONS**2)
            u = mi.Point2f(k % MEAN_DIRECTIONS + 0.5, k // MEAN_DIRECTIONS + 0.5) / MEAN_DIRECTIONS
            si = dr.zeros(mi.SurfaceInteraction3f, MEAN_DIRECTIONS**2)
            si.wi = -mi.warp.square_to_uniform_sphere(u)
            # density by which paths draw them: (1 - share) / 4 pi + share p_e
            pdf = (1 - lights.nee_share) * mi.warp.square_to_uniform_sphere_pdf(si.wi)
            if lights.nee_share > 0:
                pdf += lights.nee_share * scene.pdf_emitter_direction(si, _towards(emitter, -si.wi))
            L, weight = np.array(mi.Spectrum(emitter.eval(si)) + 0 * pdf), 1 / np.array(pdf)
            # c = Σ L / pdf / Σ 1 / pdf; it serves where E[(L - c)²] is much less than E[L²]
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
        environment_mean: mean radiance of its environment, where that serves as a control variate.
        small: its emitters that look small, if there are any.
    """

    scene: mi.Scene
    lights: Lights
    objects: list[TranslucentObject]
    settings: Settings
    mode: Primal | Replay
    environment_mean: EnvironmentMean | None = None
    small: SmallEmitters | None = None

    @classmethod
    def of(
        cls, scene: mi.Scene, objects: list[TranslucentObject], settings: Settings, mode: Primal | Replay
    ) -> RenderContext:
        """The context of a scene and its translucent objects."""
        lights = Lights.of(scene)
        with dr.suspend_grad():
            small = SmallEmitters.of(scene)
        return cls(scene, lights, objects, settings, mode, EnvironmentMean.of(scene, lights, objects), small)

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

    def uses_environment_mean(self, obj: TranslucentObject) -> bool:
        """Whether the mean radiance of the environment is a control variate for an object."""
        return self.environment_mean is not None and obj.alpha is not None

    def environment_means(self, obj: TranslucentObject) -> tuple[mi.Spectrum, mi.Spectrum]:
        """c in the channels where alpha is known, else 0: for orders 0 and 1 and for the others."""
        once, others = obj.alpha.known
        return once * self.environment_mean.mean, others * self.environment_mean.mean

    def entries(self, obj: TranslucentObject) -> int:
        """Candidates of resampling for an exit: one where c is nearly all light and the settings leave it open."""
        # what resampling would choose by is nearly even where c is taken off
        alone = self.uses_environment_mean(obj) and not self.lights.some_local
        return 1 if alone and self.settings.entries == AUTOMATIC else obj.entries

    @property
    def dim(self) -> float:
        """Radiance expected of surfaces before the environment, over its own: less where an object has itself alone."""
        return DIM_ALONE if len(self.scene.shapes()) == 1 else DIM

    def sample_environment(
        self, at: mi.Interaction3f, u: mi.Point2f, active: mi.Bool
    ) -> tuple[mi.Vector3f, mi.Float, mi.Spectrum]:
        """A direction of the environment, the only emitter, its density, 1/sr, and the radiance from there."""
        # L, from L / p_e
        ds, light = self.scene.sample_emitter_direction(at, u, False, active)
        return ds.d, ds.pdf, light * ds.pdf

    def pdf_environment(self, at: mi.Interaction3f, d: mi.Vector3f, active: mi.Bool) -> mi.Float:
        """Density of emitter sampling for a direction of the environment, 1/sr."""
        return self.scene.pdf_emitter_direction(at, _towards(self.scene.environment(), d), active)

    def eval_environment(self, at: mi.Interaction3f, d: mi.Vector3f, active: mi.Bool) -> tuple[mi.Float, mi.Spectrum]:
        """Density of a direction by `sample_environment`, and the radiance from there."""
        si = dr.zeros(mi.SurfaceInteraction3f)
        si.wi, si.wavelengths = -d, at.wavelengths
        return self.pdf_environment(at, d, active), self.scene.environment().eval(si, active)

    def connects_environment(self, obj: TranslucentObject) -> bool:
        """Whether events are connected with the environment: where it varies and c does not take its noise away."""
        return (
            self.scene.environment() is not None and self.lights.nee_share > 0 and not self.uses_environment_mean(obj)
        )

    def sampled_by_nee(self, emitter: mi.EmitterPtr, d: mi.Vector3f) -> mi.Bool:
        """Whether emitter connections find an emitter in the direction d: all but an environment without a sun."""
        local = ~emitter.is_environment()
        return local | (self.small.index_of(emitter, d) >= 0) if self.suns else local


def delta_light(
    context: RenderContext, sampler: mi.Sampler, ray: mi.Ray3f, active: mi.Bool
) -> tuple[mi.UInt32, mi.Spectrum]:
    """One of the delta lights, and its light along a ray, spread over a wide cone, over its probability."""
    # n E / Ω of one of n lights
    n = context.small.n_delta
    which = below(n, sampler.next_1d()) if n > 1 else mi.UInt32(0)
    return which, n * context.small.spread(which, ray, mi.Float(WIDE), active)
