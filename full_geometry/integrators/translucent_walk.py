"""The Mitsuba integrator `translucent_walk`: light inside translucent objects by exact random walks."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import Any

import drjit as dr
import mitsuba as mi

from full_geometry.geometry.sensors import (
    checked_samples,
    rays_by,
    sampled_size,
    seeded,
    seeded_sampler,
    splat,
    widened,
)
from full_geometry.geometry.shape import SceneMark
from full_geometry.geometry.snapshot import Snapshot, same_objects
from full_geometry.integrators.bssrdf import Launch, is_independent, undisturbed
from full_geometry.integrators.gathering import OutgoingLight, light_state
from full_geometry.integrators.glints import SEARCH, Glints, glint_light, glints_of, trial_of
from full_geometry.integrators.walk_paths import FirstExits, LightVisitor, PathTracer
from full_geometry.objects.inclusions import check_sensors
from full_geometry.objects.objects import KnowsUnit, check_size, places_of, translucent_shapes
from full_geometry.objects.small_emitters import SmallEmitters
from full_geometry.precomputed.unscattered_light import (
    ImageSamples,
    UnscatteredLight,
    holds_scattered,
    inside_cells_of,
    obstacle,
    unscattered_light,
)
from full_geometry.settings import (
    LAYER,
    MM_PER_UNIT,
    OF_MITSUBA,
    WALK_LIGHTS,
    check_depth,
    check_parameters,
    per_variant,
)
from full_geometry.surface.textured import shown
from full_geometry.surface.varying import equivalent
from full_geometry.surface.wrapped import surface_of
from full_geometry.walk.emitter_connections import InnerLights, find_connections, find_directions
from full_geometry.walk.media import WalkMedia
from full_geometry.walk.random_walk import PATH_LANES, on_device
from full_geometry.walk.scores import PathScores, with_derivatives
from full_geometry.walk.straight_light import find_straight_light
from halfspace_sss.backend import clock
from halfspace_sss.checks import check_choice, check_flag, check_interval
from halfspace_sss.interrupts import checkpoint, interruptible

SUN = 0.02  # radians, below which what a clear object shows of an emitter after reflections is fireflies
PARAMETERS = ("mm_per_unit", "max_depth", "rr_depth", "hide_emitters", "connection_share", "blur", "light", "layers")
SAMPLES_PER_LAUNCH = 2**19
FEWEST_RAYS = 2**16  # of light, for each object
PREVIEW_RAYS = 2**14  # of a first look at light that has changed
FOREVER, DEPTHS = 2**31 - 1, {"max_depth": -1, "rr_depth": 5}
WIDEST = 20.0  # blur: 1 and 3 radians
Keep = Callable[[FirstExits], None]


def precomputes_light(integrator: mi.Integrator | None, scene: mi.Scene) -> bool:
    """Whether an integrator is `translucent_walk`, and precomputes light for images of a scene."""
    return isinstance(integrator, walk_integrator_class()) and integrator.precomputes(scene, integrator.media(scene))


@per_variant
def walk_integrator_class() -> type:
    """The class of the integrator for the current variant of Mitsuba."""

    @KnowsUnit.register
    class TranslucentWalk(mi.SamplingIntegrator):
        """Path tracer whose paths walk through objects with the surface `translucent`.

        Parameters: `mm_per_unit` (1), `max_depth` (-1: no limit; counts surfaces seen from outside), `rr_depth` (5),
        `hide_emitters` (false), `connection_share` (0.5; probability of a connection with a small emitter from a
        scattering event near the boundary, 0 leaves all light to chance), `blur` (1; scale of the cones over
        which delta lights are spread where no strategy reaches them: less has less bias and more noise, 0 leaves that
        light out), `light` ("auto"; "precomputed" finds light inside on a grid, see `unscattered_light`
        and `scattered_light`, which has 2.5 to 15 times less variance in the same time and a bias of less than .3 %;
        "sampled" meets it by chance and by connections, without that bias; "auto" precomputes it where that is
        possible and there is more than an even sky, and samples it for derivatives), `layers` (false; true adds the
        channels emission.R, .G and .B to the image: emitters that the camera sees at once and, with precomputed light,
        in the mirror of an object and straight through it, which leaves the rest for a denoiser).
        """

        def __init__(self, props: mi.Properties) -> None:
            check_parameters("translucent_walk", props, (*PARAMETERS, *OF_MITSUBA))
            mi.SamplingIntegrator.__init__(self, props)
            self.mm_per_unit, self.hidden = props.get("mm_per_unit", 1.0), props.get("hide_emitters", False)
            self.max_depth, self.rr_depth = (_depth(name, props.get(name, n)) for name, n in DEPTHS.items())
            self.connection_share, self.blur = props.get("connection_share", 0.5), props.get("blur", 1.0)
            self.light, self.layers = props.get("light", "auto"), props.get("layers", False)
            check_interval("mm_per_unit", self.mm_per_unit, *MM_PER_UNIT)
            check_interval("connection_share", self.connection_share, 0.0, 1.0)
            check_interval("blur", self.blur, 0.0, WIDEST)
            check_choice("light", self.light, WALK_LIGHTS)
            check_flag("layers", self.layers)
            self._prepared: tuple[SceneMark | None, list, list, Any] = (None, [], [], None)
            self._checked: tuple[Any, str] = (None, "")
            self._cells: tuple[Any, list] = (None, [])
            self._kept: tuple[Snapshot | None, UnscatteredLight | None] = (None, None)
            self._glints: tuple[Any, Glints | None] = (None, None)
            self.filling, self.outgoing, self.ends = 0.0, None, False

        def media(self, scene: mi.Scene) -> WalkMedia:
            """The objects of a scene, made ready once."""
            self._prepared = _prepared(scene, self._prepared, self.mm_per_unit)
            return self._prepared[-1]

        def take_over(self, other: mi.Integrator) -> None:
            """Take the media and the cells of another integrator of this class that differs in light alone."""
            self._prepared, self._checked, self._cells = other._prepared, other._checked, other._cells

        def take(self, scene: mi.Scene, outgoing: OutgoingLight, light: UnscatteredLight | None) -> None:
            """Light that leaves objects of a scene, by which walks end, and light inside; until something changes."""
            self.outgoing, self._kept = outgoing, (light_state(scene), light)

        def prepare(self, scene: mi.Scene, image: ImageSamples, seed: int = 0) -> None:
            """Precompute light once for all calls of `sample`, until objects or emitters change.

            `filling` has the seconds that each image takes for it; media and cells are made once.
            `image`: that the light is for.

            Raises:
                ValueError: light cannot be precomputed in this scene, and is asked for.
            """
            with interruptible(), undisturbed(), dr.suspend_grad():
                self._kept = light_state(scene), self.tracer(scene, seed, image).visitor.unscattered

        def tracer(
            self, scene: mi.Scene, seed: int = 0, image: ImageSamples | None = None, scored: bool = False,
            light: UnscatteredLight | None = None, exits: bool = False, fewest: int = FEWEST_RAYS,
        ) -> PathTracer:  # fmt: skip
            """What paths through a scene need; its objects are made ready once, its emitters may have been edited.

            Args:
                seed: of the light that is precomputed.
                image: that it is for; None leaves light to be sampled.
                scored: whether derivatives are asked for, which leave light to be sampled.
                light: that is known already.
                exits: whether walks have to leave, so that scattered light is not precomputed.
                fewest: rays of light of each object.
            """
            # ---- objects and inner lights, made once for a scene
            media, small = self.media(scene), SmallEmitters.of(scene)
            inner = InnerLights.of(media, self.blur)

            # ---- light inside, precomputed by as many rays as the samples of the image pay
            if image is not None and self.precomputes(scene, media):
                if self._cells[0] is not media:
                    self._cells = media, inside_cells_of(media, *self._cells)
                if light is None:
                    started = clock()
                    ends = holds_scattered(media) and inner is None and self.max_depth == FOREVER and not exits
                    light = unscattered_light(scene, media, seed, self._cells[1], image, fewest, ends)
                    self.filling = clock() - started
                connections, directions, straight = None, None, None
                if light.forward and not self.ends:
                    directions = find_directions(scene, media, small, self.connection_share)

            # ---- or sampled: connections with small emitters, directions to them, straight light
            else:
                connections, light = find_connections(scene, media, small, self.connection_share, scored), None
                directions = find_directions(scene, media, small, self.connection_share, scored)
                if scored and inner is not None:
                    raise ValueError("objects must hold no delta lights for derivatives of translucent_walk")
                straight = find_straight_light(scene, media, self.max_depth == FOREVER, scored)
            visitor = LightVisitor(
                scene=scene, media=media, small=small, connections=connections, directions=directions,
                straight_light=straight, inner_lights=inner, blur=self.blur, unscattered=light, outgoing=self.outgoing,
                reflections=light is not None and light.clear and no_sun(media, small),
            )  # fmt: skip
            return PathTracer(visitor, self.max_depth, self.rr_depth, self.hidden, self.layers)

        def precomputes(self, scene: mi.Scene, media: WalkMedia) -> bool:
            """Whether images find unscattered light precomputed; if that is left to us, not that of an even sky alone.

            Every walk meets an even sky where it leaves, with less noise than the sky has inside.

            Raises:
                ValueError: `light` is "precomputed", and it cannot be in this scene.
            """
            # nothing to precompute without objects
            if self.light == "sampled" or not media.objects or not len(media.scene.shapes()):
                return False
            if self._checked[0] is not media:
                self._checked = media, obstacle(media)
            reason = self._checked[1]
            if reason and self.light == "precomputed":
                raise ValueError(f"light must be auto or sampled, got 'precomputed': {reason}")
            # an even sky alone is met by every walk, and light inside would only add its noise; not by walks that end
            uneven = any("Constant" not in emitter.class_name() for emitter in scene.emitters())
            return not reason and (uneven or self.light == "precomputed" or self.ends)

        def render(
            self, scene: mi.Scene, sensor: mi.Sensor | int = 0, seed: mi.UInt32 | int = 0, spp: int = 0,
            develop: bool = True, evaluate: bool = True, keep: Keep | None = None,
        ) -> mi.TensorXf | None:  # fmt: skip
            """The image; `keep` is called with the first exits of each launch, which are stored for it."""
            sensor = scene.sensors()[sensor] if isinstance(sensor, int) else sensor
            spp = checked_samples(sensor, spp)
            with interruptible(), undisturbed(), dr.suspend_grad():
                seed = int(mi.UInt32(seed)[0])
                pixels = int(dr.prod(sampled_size(sensor.film())))
                light = self._kept[1] if self.outgoing is not None else None
                tracer = self.tracer(
                    scene, seed, ImageSamples(spp * pixels, pixels), light=light, exits=keep is not None
                )
                _render(tracer, sensor, seed, spp, keep, False, self._glints_in(scene, tracer, sensor, SEARCH))
                return sensor.film().develop() if develop else None

        def preview(
            self, scene: mi.Scene, sensor: mi.Sensor, seed: int, spp: int, glints: bool = False
        ) -> mi.TensorXf:  # fmt: skip
            """The image by the light inside that is kept, which outlives the camera: a look at a scene that changes.

            Once objects or emitters have changed, a little light is found anew; `prepare` finds more.
            `glints`: whether many places of their pixels are asked for them, which a search has to find.
            """
            with interruptible(), undisturbed(), dr.suspend_grad():
                light = self._kept_light(scene)
                tracer = self.tracer(scene, seed, ImageSamples(0, 1), light=light, fewest=PREVIEW_RAYS)
                if light is None:
                    self._kept = light_state(scene), tracer.visitor.unscattered
                found = self._glints_in(scene, tracer, sensor, 0) if glints else None
                _render(tracer, sensor, seed, spp, None, False, found)
                return sensor.film().develop()

        def _kept_light(self, scene: mi.Scene) -> UnscatteredLight | None:
            """The light inside that is kept; None once objects or emitters have changed."""
            known, light = self._kept
            return light if light is not None and known == light_state(scene) else None

        def _glints_in(self, scene: mi.Scene, tracer: PathTracer, sensor: mi.Sensor, rays: int) -> Glints | None:
            """`glints_of` by so many rays, the same for a view; None where that emission is met by chance or not.

            Only of box filters, which do not ask where in a pixel light is.
            """
            if not tracer.mirrors or tracer.visitor.unscattered is None or not sensor.film().rfilter().is_box_filter():
                return None
            trial = trial_of(rays, sensor)
            state = trial, Snapshot(sensor), light_state(scene)
            if self._glints[0] != state:
                self._glints = state, glints_of(tracer, sensor, trial)
            return self._glints[1]

        def sample(
            self,
            scene: mi.Scene,
            sampler: mi.Sampler,
            ray: mi.Ray3f,
            medium: mi.Medium | None = None,
            active: mi.Bool = True,
        ) -> tuple:
            with undisturbed(), dr.suspend_grad():
                seed = tuple(int(2**24 * sampler.next_1d()[0]) for _ in range(2))
                n = sampler.wavefront_size()
                tracer = self.tracer(scene, seed[0], ImageSamples(n, n), light=self._kept_light(scene))
                rays = tracer.shown(widened(ray, sampler.wavefront_size()))
                L, seen, emission = tracer.trace(rays, on_device(PATH_LANES), seed)
            layer = list(mi.Color3f(emission)) if self.layers else []
            return dr.select(active, L, 0), active & seen, layer

        def render_forward(
            self, scene: mi.Scene, params: Any, sensor: mi.Sensor | int = 0, seed: mi.UInt32 | int = 0, spp: int = 0
        ) -> mi.TensorXf:
            """The derivative of the image along that of the parameters."""
            with undisturbed(), dr.suspend_grad():
                image = self._differentiable(scene, sensor, seed, spp)
                with dr.resume_grad():
                    dr.forward_to(image)
                    return dr.grad(image)

        def render_derivatives(
            self, scene: mi.Scene, variables: Sequence[Any], sensor: mi.Sensor | int = 0, seed: mi.UInt32 | int = 0,
            spp: int = 0,
        ) -> tuple[mi.TensorXf, list[mi.TensorXf]]:  # fmt: skip
            """The image, and its derivative along each of the variables that media come from: all of the same paths.
            `variables`: arrays with gradients enabled; all their numbers change alike."""
            with undisturbed(), dr.suspend_grad():
                image, found = self._differentiable(scene, sensor, seed, spp), []
                with dr.resume_grad():
                    for x in variables:
                        dr.clear_grad(image)
                        dr.set_grad(x, 1.0)
                        dr.forward_from(x, dr.ADFlag.ClearInput | dr.ADFlag.ClearInterior)
                        found.append(dr.grad(image))
                        dr.eval(found[-1])
                return dr.detach(image), found

        def render_backward(
            self, scene: mi.Scene, params: Any, grad_in: mi.TensorXf, sensor: mi.Sensor | int = 0,
            seed: mi.UInt32 | int = 0, spp: int = 0,
        ) -> None:  # fmt: skip
            """Add to the gradients of parameters what that of the image, `grad_in`, makes of them."""
            with undisturbed(), dr.suspend_grad():
                image = self._differentiable(scene, sensor, seed, spp)
                with dr.resume_grad(), _one_thread():
                    dr.set_grad(image, grad_in)
                    dr.enqueue(dr.ADMode.Backward, image)
                    dr.traverse(dr.ADMode.Backward)
                    dr.eval()

        def _differentiable(
            self, scene: mi.Scene, sensor: mi.Sensor | int, seed: mi.UInt32 | int, spp: int
        ) -> mi.TensorXf:
            if mi.is_spectral:
                raise ValueError(f"derivatives must be of an RGB or mono variant, got {mi.variant()}")
            _check_followed(scene)
            sensor = scene.sensors()[sensor] if isinstance(sensor, int) else sensor
            spp = checked_samples(sensor, spp)
            with interruptible(), undisturbed():
                _render(self.tracer(scene, scored=True), sensor, int(mi.UInt32(seed)[0]), spp, None, True)
                with dr.resume_grad():
                    return sensor.film().develop()

        def aov_names(self) -> list[str]:
            return LAYER if self.layers else []

        def to_string(self) -> str:
            # all of them: renders are known by these words
            shown = {name: self.hidden if name == "hide_emitters" else getattr(self, name) for name in PARAMETERS}
            return f"TranslucentWalk[{', '.join(f'{name} = {value!r}' for name, value in shown.items())}]"

    return TranslucentWalk


def _prepared(scene: mi.Scene, before: tuple, mm_per_unit: float) -> tuple[SceneMark, list, list, Any]:
    """Mark, shapes, places and media of a scene: those of before, unless shapes, inner lights or media changed.
    ValueError, whatever changed, if a camera is inside an object."""
    # ---- what was made before still holds
    shapes = scene.shapes()  # the scene itself, which holds its integrator, would never be freed
    mark, places = SceneMark(scene), places_of(scene)
    same = before[0] == mark and same_objects(before[1], shapes) and before[2] == places
    if before[3] is not None and same and before[3].is_current(scene):
        check_sensors(scene, before[3].objects)
        return before

    # ---- media anew, and warnings of cameras inside objects and of doubtful units
    media = (before[3].renewed() if before[3] is not None and same else None) or WalkMedia.of(scene, mm_per_unit)
    check_sensors(scene, media.objects)
    for each, inside in zip(media.objects, media.specs):
        known = equivalent(inside, each) if inside.textured else inside
        check_size(each, [mm_per_unit * float(m.sigma_t) for m in known.channels()], mm_per_unit)
    return mark, shapes, places, media


@contextlib.contextmanager
def _one_thread() -> Iterator[None]:
    """Let one thread work, so that sums over many paths, such as those of texels, have the same bits in each run."""
    threads = dr.thread_count()
    dr.sync_thread()
    dr.set_thread_count(1)
    try:
        yield
        dr.sync_thread()
    finally:
        dr.set_thread_count(threads)


def _check_followed(scene: mi.Scene) -> None:
    """Refuse derivatives that scores of walks do not have.
    ValueError if gradients are enabled for another parameter than albedo, sigma_t and g of translucent surfaces and
    what their textures show, or a delta light stands inside an object."""
    # ---- parameters whose scores walks know: of translucent surfaces, their textures, and attributes that these show
    parameters, owners, attributes = mi.traverse(scene), [], set()
    for shape in translucent_shapes(scene):
        textured = surface_of(shape).spec.textured
        owners.append(surface_of(shape))
        for texture in textured.textures.values() if textured else ():
            owners += mi.traverse(texture).hierarchy
            attributes |= {(id(shape), name) for _, name in shown(texture)}

    # ---- no other parameter may have gradients enabled
    for key, (_, _, owner, _) in parameters.properties.items():
        with dr.resume_grad():
            enabled = dr.grad_enabled(parameters[key])
        name = key.rsplit(".", 1)[-1]
        if enabled and not (any(owner is each for each in owners) or (id(owner), name) in attributes):
            raise ValueError(
                f"{key} must not have gradients enabled: translucent_walk differentiates light by albedo, sigma_t and "
                "g of translucent surfaces and by their textures; bssrdf by emitters and other textures too"
            )


def no_sun(media: WalkMedia, small: SmallEmitters | None) -> bool:
    """Whether no emitter that rays meet looks smaller than SUN from the objects."""
    if small is None or not small.some_met:
        return True
    k = dr.arange(mi.UInt32, small.n_delta, len(small))
    return bool(dr.all(small.angle2(k, mi.Point3f(media.scene.bbox().center())) > SUN**2))


def _render(
    tracer: PathTracer, sensor: mi.Sensor, seed: int, spp: int, keep: Keep | None, scored: bool = False,
    glints: Glints | None = None,
) -> None:  # fmt: skip
    """Fill the film of a sensor, in launches between which an interrupt is heard."""
    check_sensors(tracer.visitor.scene, tracer.visitor.media.outermost, [sensor])
    for obj, inside in zip(tracer.visitor.media.objects, tracer.visitor.media.specs):
        if inside.spectral is not None:
            inside.spectral.check_covers(obj.name, sensor)
    sensor.film().prepare(LAYER if tracer.layers else [])
    # launches are so small that their arrays fit, and that an interrupt is heard between them
    most = max(1, on_device(SAMPLES_PER_LAUNCH) // int(dr.prod(sampled_size(sensor.film()))))
    for number, start in enumerate(range(0, spp, most)):
        checkpoint()
        _launch(tracer, sensor, Launch(start, min(most, spp - start)), (seed, number), keep, scored, glints)


def _launch(
    tracer: PathTracer, sensor: mi.Sensor, launch: Launch, seed: tuple[int, int], keep: Keep | None, scored: bool,
    glints: Glints | None = None,
) -> None:  # fmt: skip
    """Trace the rays of a launch and add them to the film, with derivatives if `scored`."""
    # with precomputed light places in a pixel are its noise: numbers of low discrepancy go on from launch to launch
    even = tracer.visitor.unscattered is not None and is_independent(sensor.sampler())
    sampler = launch.sampler(sensor, seeded(seed[0])) if even else seeded_sampler(sensor, launch.spp, seeded(*seed))
    rays, weight, position = rays_by(sensor, sampler)
    spp = sampler.sample_count()
    rays = tracer.shown(rays)

    # ---- with derivatives: L + sum of scores times parameters, whose derivative is that of the mean
    if scored:
        media = tracer.visitor.media
        with dr.resume_grad():
            scores = PathScores.of(media, dr.width(rays))
        L, seen, _ = tracer.trace(rays, on_device(PATH_LANES), seed, scores=scores)
        with dr.resume_grad():
            splat(sensor.film(), rays, with_derivatives(L, scores, media) * weight, seen, position, spp)
        return

    # ---- without, and with the layer of emission
    exits = FirstExits.of(tracer.visitor.scene, tracer.visitor.media, rays) if keep else None
    if glints is not None:
        apart = dr.opaque(mi.Bool, False, dr.width(rays))  # a literal would be another kernel
        if dr.width(glints.pixels):
            lanes = dr.arange(mi.UInt32, dr.width(glints.pixels) * spp)
            lanes = dr.gather(mi.UInt32, glints.pixels, lanes // spp) * spp + lanes % spp
            dr.scatter(apart, True, lanes)
        dr.eval(apart)
        tracer = replace(tracer, apart=apart, brightest=glints.brightest)
    L, seen, emission = tracer.trace(rays, on_device(PATH_LANES), seed, exits)
    if keep:
        keep(exits)
    L, emission = weight * L, weight * emission

    # ---- in some pixels, emission in mirrors at many more places
    if glints is not None and dr.width(glints.pixels):
        found = glint_light(tracer, sensor, glints, seed[0], (launch.first, spp))
        for target in (L, emission) if tracer.layers else (L,):
            dr.eval(target)
            dr.scatter_add(target, found, lanes)
    splat(sensor.film(), rays, L, seen, position, spp, list(mi.Color3f(emission)) if tracer.layers else [])


def _depth(name: str, value: int) -> int:
    """A number of vertices; -1 stands for no limit."""
    check_depth(name, value)
    return FOREVER if value == -1 else value
