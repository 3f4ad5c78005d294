"""The Mitsuba integrator `bssrdf`: paths that enter translucent objects through the BSSRDF of the half-space."""

from __future__ import annotations

import gc
import math
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any, NamedTuple

import drjit as dr
import mitsuba as mi

from full_geometry.geometry import mesh
from full_geometry.geometry.instances import InstanceScene
from full_geometry.geometry.sensors import (
    checked_samples,
    past_emitters,
    path_numbers,
    rays_by,
    sampled_size,
    seeded_sampler,
    shows_sky,
    splat,
)
from full_geometry.integrators.correction import Corrections
from full_geometry.integrators.gathering import Gathering
from full_geometry.integrators.lit_entries import LitEntries
from full_geometry.integrators.surface_paths import replay_paths, trace_paths
from full_geometry.objects.inclusions import check_sensors
from full_geometry.objects.objects import KnowsUnit, TranslucentObject
from full_geometry.objects.small_emitters import check_emitters, check_sampled
from full_geometry.settings import GATHERED_LIGHTS, LAYER, Choices, Settings, per_variant, read_settings
from full_geometry.surface.translucent import is_translucent
from full_geometry.surface.wrapped import wraps
from full_geometry.transport.prepare import Chooser, TranslucentObjects, choices_of, make_objects
from halfspace_sss.interrupts import checkpoint, interruptible

SAMPLES_PER_LAUNCH = 2**20  # half a second on 2 cores
GEOMETRY = ("to_world", mesh.POSITIONS, mesh.NORMALS, mesh.TEXCOORDS)


# ---- The plugin -----------------------------------------------------------------------------------------------------


def is_bssrdf(integrator: mi.Integrator | None) -> bool:
    """Whether an integrator is `bssrdf`, which has settings and makes models of objects before it renders."""
    return isinstance(integrator, integrator_class())


@per_variant
def integrator_class() -> type:
    """The class of the integrator for the current variant of Mitsuba."""

    @KnowsUnit.register
    class BSSRDFIntegrator(mi.SamplingIntegrator):
        """Renders scenes with `translucent` objects; parameters as in `Settings`.

        It trains nothing: an object whose model has to be trained, and has not been, is refused.

        Images can be differentiated by emitters, surfaces, textures and the medium of each object (`albedo`, `sigma_t`,
        `g`), forward and backward; where paths go is held, and derivatives by geometry are refused.
        `choose`: says what stands for the model "auto" in a scene."""

        def __init__(self, props: mi.Properties, choose: Chooser) -> None:
            mi.SamplingIntegrator.__init__(self, props)
            self.settings = read_settings(props)
            self.mm_per_unit = self.settings.mm_per_unit
            self._objects = TranslucentObjects(self.settings, choose)
            self.gathering, self.corrections = Gathering(), Corrections()
            self._lit_entries = LitEntries()
            self._lit: list[TranslucentObject] | None = None  # while an image is rendered
            self._unconnected = dr.zeros(mi.Float64, 1)

        def prepare(self, scene: mi.Scene, samples: int = 1) -> list[TranslucentObject]:
            """The translucent objects of a scene, made ready once; ValueError if the scene cannot be rendered.
            `samples`: of an image, by which corrected light has its walks; 0 for a first look."""
            with undisturbed(), dr.suspend_grad():
                return self._checked(scene, samples)[0]

        def _checked(self, scene: mi.Scene, samples: int) -> tuple[list[TranslucentObject], mi.Integrator | None]:
            """`_ready`, of a scene that can be rendered."""
            check_parameters(scene)
            check_emitters(scene)
            return self._ready(scene, samples)

        def _ready(self, scene: mi.Scene, samples: int = 1) -> tuple[list[TranslucentObject], mi.Integrator | None]:
            """The objects, and the walks that render them where their light is corrected."""
            settings, light = self.settings, self.settings.light
            objects = self.corrections.without_model(scene, settings) if light == "corrected" else None
            if objects is None:
                objects, light = self._objects.of(scene), self._objects.choices.light
                if light != "corrected":
                    check_sampled(scene)
                if light in GATHERED_LIGHTS:
                    objects = self.gathering.of(scene, objects, settings, quick=not samples)
            return objects, self.corrections.of(scene, objects, settings, samples) if light == "corrected" else None

        def take_over(self, other: mi.Integrator) -> None:
            """Take the objects of another integrator of this class that differs in light alone."""
            self._objects.take_over(other._objects)

        def check(self, scene: mi.Scene, without: Collection[str] = ()) -> None:
            """ValueError if the scene cannot be rendered, as far as can be told without the objects `without`."""
            check_parameters(scene)
            check_emitters(scene)
            with dr.suspend_grad():
                if self.settings.light == "corrected" and self.corrections.without_model(scene, self.settings):
                    return
                make_objects(scene, self.settings, choices_of(scene, self.settings, self._objects.choose), without)

        def render(
            self, scene: mi.Scene, sensor: mi.Sensor | int = 0, seed: mi.UInt32 | int = 0, spp: int = 0,
            develop: bool = True, evaluate: bool = True,
        ) -> mi.TensorXf | None:  # fmt: skip
            """The image, in launches, between which an interrupt is heard."""
            sensor = scene.sensors()[sensor] if isinstance(sensor, int) else sensor
            with interruptible(), undisturbed(), dr.suspend_grad():
                samples = checked_samples(sensor, spp) * int(dr.prod(sampled_size(sensor.film())))
                self._render(scene, samples, sensor, seed, spp)
                return sensor.film().develop() if develop else None

        def preview(self, scene: mi.Scene, sensor: mi.Sensor, seed: int, spp: int) -> mi.TensorXf:
            """The image without new walks for a correction of light, and by half of the light that is gathered: a first
            look at a scene that has changed."""
            with interruptible(), undisturbed(), dr.suspend_grad():
                self._render(scene, 0, sensor, seed, spp)
                return sensor.film().develop()

        def _render(self, scene: mi.Scene, samples: int, sensor: mi.Sensor, seed: mi.UInt32 | int, spp: int) -> None:
            """Fill the film of a sensor, in launches."""
            objects, walk = self._checked(scene, samples)
            if walk is not None:
                walk.render(scene, sensor, seed, spp, develop=False)
                return

            # ---- proposals for entries of the objects by the light
            check_sensors(scene, [obj.geometry for obj in objects], [sensor])
            for obj in objects:
                if obj.spectral is not None:
                    obj.spectral.check_covers(obj.geometry.name, sensor)
            self._lit = self._by_light(scene, objects, sensor, spp)
            self._unconnected = dr.zeros(mi.Float64, 1)

            # ---- launches, each added to the film
            try:
                sensor.film().prepare([])
                for launch in launches(sensor, spp):
                    checkpoint()
                    self._launch(scene, sensor, int(mi.UInt32(seed)[0]), launch)
                    dr.sync_thread()
            finally:
                self._lit = None

        def _launch(self, scene: mi.Scene, sensor: mi.Sensor, seed: int, launch: Launch) -> None:
            """Add the samples of a launch to the film."""
            # camera rays, L of each, and its weight by the reconstruction filter
            sampler = launch.sampler(sensor, seed)
            ray, weight, position = rays_by(sensor, sampler)
            dr.eval(ray, weight, position)  # the crop is in their kernel alone
            L, hit, _ = self.sample(scene, sampler, ray)
            splat(sensor.film(), ray, L * weight, hit, position, launch.spp)

        def _by_light(
            self, scene: mi.Scene, objects: list[TranslucentObject], sensor: mi.Sensor, spp: int
        ) -> list[TranslucentObject]:
            """The objects with entries drawn by light, where that pays."""
            if self._objects.choices.light in GATHERED_LIGHTS:
                return objects
            # the more samples an image has, the more are spent on where light arrives
            spp, pixels = checked_samples(sensor, spp), int(dr.prod(sensor.film().crop_size()))
            proposals = self._lit_entries.of(scene, objects, self.settings, spp * pixels)
            return [replace(obj, proposals=given) for obj, given in zip(objects, proposals)]

        def render_forward(self, scene: mi.Scene, *args: Any, **more: Any) -> mi.TensorXf:
            objects = self._differentiable(scene)
            with undisturbed():
                return replayer(objects, self.settings).render_forward(scene, *args, **more)

        def render_backward(self, scene: mi.Scene, *args: Any, **more: Any) -> None:
            objects = self._differentiable(scene)
            with undisturbed():
                replayer(objects, self.settings).render_backward(scene, *args, **more)

        def _differentiable(self, scene: mi.Scene) -> list[TranslucentObject]:
            if mi.is_spectral:
                raise ValueError(f"derivatives must be of an RGB or mono variant, got {mi.variant()}")
            if self.settings.light != "sampled":
                raise ValueError(f"light must be sampled for derivatives, got {self.settings.light}")
            return self.prepare(scene)

        def sample(
            self, scene: mi.Scene, sampler: mi.Sampler, ray: mi.RayDifferential3f, medium: mi.Medium | None = None,
            active: mi.Bool = True,
        ) -> tuple[mi.Spectrum, mi.Bool, list]:  # fmt: skip
            check_outermost(scene)
            with undisturbed(), dr.suspend_grad():
                objects, walk = self._ready(scene) if self._lit is None else (self._lit, None)
                if walk is not None:
                    return walk.sample(scene, sampler, ray, medium, active)
                ray = shown(scene, objects, self.settings, ray)
                parts, hit, unconnected = trace_paths(scene, objects, self.settings, sampler, ray, active)
                # the sum of squares tells how much of the variance phase sampling alone brings
                squares = dr.select(hit & active, mi.Float64(dr.squared_norm(unconnected)), 0)
                dr.scatter_add(self._unconnected, squares, mi.UInt32(0))
            return parts[0] + parts[1], hit | mi.Bool(shows_sky(scene, self.settings.hide_emitters)), []

        @property
        def choices(self) -> Choices:
            """What stands for "auto"; known when a scene has been prepared."""
            return self._objects.choices

        @property
        def unconnected(self) -> float:
            """Squares of light of orders 0 and 1 that phase sampling alone hits, summed over the samples."""
            return float(self._unconnected[0])

        @property
        def layers(self) -> bool:
            """Whether images have the layer of emission."""
            return self.settings.layers

        def aov_names(self) -> list[str]:
            return LAYER if self.layers else []

        @property
        def gathered(self) -> list[str]:
            """A sentence on the light that was gathered, or corrected, for each object, with its error."""
            return self.corrections.told() or self.gathering.told()

        def to_string(self) -> str:
            return f"BSSRDFIntegrator[{self.settings}]"

    return BSSRDFIntegrator


def shown(scene: mi.Scene, objects: list[TranslucentObject], settings: Settings, ray: mi.Ray3f) -> mi.Ray3f:
    """The rays of a camera, which begin behind emitters that it does not see."""
    instance_scene = objects[0].instance_scene if objects else InstanceScene.of(scene, [])
    return past_emitters(scene, instance_scene, ray) if settings.hide_emitters else ray


@contextmanager
def undisturbed() -> Iterator[None]:
    """No garbage collection while a kernel is recorded.
    It would free objects of earlier scenes. A call that is recorded before that has other targets than the same call
    after it, and Dr.Jit then writes the same function twice, which LLVM refuses."""
    collects = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if collects:
            gc.enable()


# ---- Launches of an image, between which an interrupt is heard -----------------------------------------------------


class Launch(NamedTuple):
    """Samples of each pixel: how many have been taken before, and how many are taken."""

    first: int
    spp: int

    def sampler(self, sensor: mi.Sensor, seed: int) -> mi.Sampler:
        """Its random numbers: of `path_numbers` in place of independent ones, else of the sampler of a sensor."""
        if is_independent(sensor.sampler()):
            return path_numbers(seed, int(dr.prod(sampled_size(sensor.film()))), *self)
        return seeded_sampler(sensor, self.spp, seed)


def is_independent(sampler: mi.Sampler) -> bool:
    """Whether a sampler is Mitsuba's `independent`."""
    return sampler.class_name() == "IndependentSampler"


def launches(sensor: mi.Sensor, spp: int) -> Iterator[Launch]:
    """Launches of about equally many samples, each to be rendered to the film of a sensor.
    Only samples of the sampler `independent` are split, as those of `path_numbers` go on in the next launch. Other
    samplers round the samples of each launch up to a square or another number of strata: they have one launch."""
    spp = checked_samples(sensor, spp)
    # n launches of about `SAMPLES_PER_LAUNCH`, the first and last sample of each
    n = min(math.ceil(spp * int(dr.prod(sensor.film().crop_size())) / SAMPLES_PER_LAUNCH), spp)
    ends = [(spp * k) // n for k in range(n + 1)] if is_independent(sensor.sampler()) else [0, spp]
    for first, last in zip(ends, ends[1:]):
        yield Launch(first, last - first)


# ---- Derivatives: Mitsuba's radiative backpropagation around a replay of the paths ---------------------------------


def check_parameters(scene: mi.Scene) -> None:
    """Refuse derivatives that a replay with fixed paths does not have.
    ValueError if gradients are enabled for the geometry of a shape, for a sensor or film, or for what Mitsuba does not
    differentiate by, such as the index of a smooth dielectric."""
    parameters = mi.traverse(scene)
    for key, (_, _, owner, flags) in parameters.properties.items():
        with dr.resume_grad():
            if not dr.grad_enabled(parameters[key]):
                continue
        name = key.rsplit(".", 1)[-1]
        # what moves paths is held in a replay, so that derivatives by it would be wrong
        fixed = bool(flags & int(mi.ParamFlags.NonDifferentiable))
        if fixed or name in GEOMETRY or _moves(owner, name) or _selects(parameters, owner, name):
            raise ValueError(
                f"{key} must not have gradients enabled: bssrdf differentiates light by emitters, surfaces, textures "
                "and media, with paths held where they are"
            )


def check_outermost(scene: mi.Scene) -> None:
    """Refuse derivatives of another integrator that asks this one for samples: they would be missing in silence.
    ValueError if gradients are enabled for a parameter of the scene, and followed."""
    followed = [key for key, value in mi.traverse(scene).items() if dr.grad_enabled(value)]
    if followed:
        raise ValueError(
            f"bssrdf must be the outermost integrator for derivatives, got one around it for {followed[0]}"
        )


def _moves(owner: mi.Object, name: str) -> bool:
    """Whether a parameter moves a shape or a sensor; attributes of vertices and faces are textures."""
    if isinstance(owner, mi.Shape):
        return not name.startswith(("vertex_", "face_"))
    return isinstance(owner, (mi.Sensor, mi.Film))


def _selects(parameters: mi.SceneParameters, owner: mi.Object | None, name: str) -> bool:
    """Whether a parameter does more than scale light: the share of a mirror in a blend, the index that a medium has."""
    # up the tree of BSDFs: the weight of a blend with a delta lobe chooses, the index of a translucent surface bends
    own = True
    while owner is not None:
        if isinstance(owner, mi.BSDF):
            if wraps(owner):
                return own  # its mask or map: what it is around is asked by itself
            if owner.class_name() == "BlendBSDF":
                return bool(owner.flags() & int(mi.BSDFFlags.Delta))
            own = False
        owner = parameters.hierarchy[owner][0]
        if is_translucent(owner) and name == "eta":
            return True
    return False


def replayer(objects: list[TranslucentObject], settings: Settings) -> mi.Integrator:
    """An integrator of Mitsuba's radiative backpropagation around the paths through a scene with these objects.
    ValueError as of `TranslucentObject.prepare_derivatives`."""
    from mitsuba.python.ad.integrators.common import RBIntegrator

    for obj in objects:
        obj.prepare_derivatives()

    class Replayer(RBIntegrator):
        """Mitsuba's camera rays and films, this project's paths."""

        def sample(self, mode: dr.ADMode, scene: mi.Scene, sampler: mi.Sampler, ray: mi.Ray3f, **given: Any) -> tuple:
            ray = shown(scene, objects, settings, ray)
            # the first pass keeps L; the replay takes the light of each vertex from it, see `lighting.Replay`
            if mode == dr.ADMode.Primal:
                parts, hit, _ = trace_paths(scene, objects, settings, sampler, ray, given["active"])
                return parts[0] + parts[1], hit | mi.Bool(shows_sky(scene, settings.hide_emitters)), [], parts
            parts, backward = given["state_in"], mode == dr.ADMode.Backward
            d = replay_paths(scene, objects, settings, sampler, ray, parts, d=given["δL"], backward=backward)
            return d, mi.Bool(True), [], parts

    return Replayer(mi.Properties())
