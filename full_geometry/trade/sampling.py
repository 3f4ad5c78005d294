"""One way of rendering, against the clock: radiance of exits from random samples, what they cost, where exits are."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np

from full_geometry.geometry.instances import InstanceScene, bounds_of, shapes_of
from full_geometry.geometry.points import floats
from full_geometry.geometry.rounding import ray_from
from full_geometry.geometry.sensors import independent, seeded
from full_geometry.integrators.bssrdf import is_bssrdf
from full_geometry.integrators.correction import FEWEST as FEWEST_WALKS
from full_geometry.integrators.correction import SAMPLES_PER_WALK
from full_geometry.integrators.gathering import PART
from full_geometry.precomputed.transport_matrix import R_2
from full_geometry.precomputed.unscattered_light import ImageSamples
from full_geometry.scenes.scene_files import PATH_TRACED
from full_geometry.settings import variant_channels
from full_geometry.surface.wrapped import surface_of
from full_geometry.trade.statistics import RadianceEstimate
from full_geometry.trade.techniques import CORRECTED, FEWEST_LIT, MOST_LIT, PRECOMPUTED, Stage, Technique
from halfspace_sss.backend import clock

LANES = 2**18  # of a launch
PILOT, FEWEST = 48, 8  # samples of each exit of the first launch, and of a launch that is worth it
LEAST_SHARE = 0.2  # of the time of a launch that its samples take
BLUR = 8.0  # 0.4 radians
FILLING = 0.4  # seconds for each part of precomputed light, whose rays are as many as that allows


@dataclass(eq=False)
class Sampled:
    """The samples of an object by a technique, with what they cost.

    Attributes:
        estimate: radiance of the exits.
        preparation: seconds, of tables, cells, surveys and gathering of all light, once for a scene.
        preparing: seconds that it took here, where a part of the light is gathered; 0 if it was known.
        compilation: seconds of the first launch beyond those of the same one again, if it compiled a kernel, by the
            clock on the wall.
        compiling: the same by `clock`.
        overhead: seconds of a launch whatever its samples: its paths are recorded, and their kernel is found again.
        launches: (samples of all exits, seconds) of each launch that compiled nothing.
        beside: seconds that a sample brings along, of walks for corrected light, or of precomputed light.
        memory: most bytes that Dr.Jit held while it ran.
        blur: of walks in a scene with delta lights, what of their light is blurred, see `sample_blur`.
    """

    estimate: RadianceEstimate
    preparation: float
    preparing: float
    compilation: float = 0.0
    compiling: float = 0.0
    overhead: float = 0.0
    beside: float = 0.0
    memory: int = 0
    launches: list[tuple[int, float]] = field(default_factory=list)
    blur: RadianceEstimate | None = None

    @property
    def pace(self) -> float:
        """Seconds of one sample, the least of all launches, without the overhead of a launch, as images are larger."""
        return min(max(took - self.overhead, LEAST_SHARE * took) / n for n, took in self.launches)

    @property
    def seconds(self) -> float:
        """Seconds of one sample of an image."""
        return self.beside + self.pace


def first_sample(
    stage: Stage, technique: Technique, exits: Exits, seed: int, each: int = PILOT, object: int = 0
) -> Sampled:
    """Make a way ready and take few samples, which compiles its kernels; nothing if an earlier look knows its pace.
    ValueError if the way refuses the scene."""
    if (object, technique) in stage.paces:
        estimate = RadianceEstimate(variant_channels(), exits.n)
        return replace(stage.paces[object, technique], estimate=estimate, preparing=0.0, compilation=0.0, compiling=0.0)
    preparation = preparing = _prepared_in(stage, technique)
    if technique.gathers and technique.part:  # of all samples, after what parts and whole have in common
        made, light = stage.integrator(technique).gathering.seconds
        preparation = max(preparing - made - light, 0.0) + made / PART + 2 * light
        same = stage.paces.get((object, replace(technique, light="sampled", part=0)))  # which made the objects for both
        preparation += same.preparation if same else 0.0
    result = Sampled(RadianceEstimate(variant_channels(), exits.n), preparation, preparing)
    if technique.light == CORRECTED:  # larger images have more walks
        seconds = stage.integrator(technique).corrections.seconds
        result.beside = seconds / (FEWEST_WALKS * SAMPLES_PER_WALK) / max(exits.share, 1e-9)
    if technique.light == PRECOMPUTED:  # and more light
        filling = stage.integrator(technique).filling
        result.preparation = max(preparation - filling, 0.0)
        result.beside = filling / stage.light_samples / max(exits.share, 1e-9)
    _first_launch(stage, technique, exits, result, each, seeded(seed, 31))
    stage.paces[object, technique] = result
    return result


def _prepared_in(stage: Stage, technique: Technique) -> float:
    """Seconds in which a way was made ready; of what is made as a whole once more where kernels were compiled."""
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        started = clock()
        _prepare(stage, technique)
        seconds = clock() - started
        known = all(kernel["cache_hit"] for kernel in dr.kernel_history([dr.KernelType.JIT]))
    if known or technique.light != CORRECTED:
        return seconds
    stage.forget(technique)
    started = clock()
    _prepare(stage, technique)
    return clock() - started


def _first_launch(stage: Stage, technique: Technique, exits: Exits, sampled: Sampled, each: int, seed: int) -> None:
    """`each` samples of every exit; where a kernel was compiled the same again, for the time alone."""
    began = time.perf_counter()
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        launch = _launch(stage, technique, exits, sampled.estimate, each, seed)
        kernels = dr.kernel_history([dr.KernelType.JIT])
    ended = time.perf_counter()
    if not all(kernel["cache_hit"] for kernel in kernels):
        again = _launch(stage, technique, exits, RadianceEstimate(variant_channels(), exits.n), each, seed)
        sampled.compiling = max(launch.seconds - again.seconds, 0.0)
        sampled.compilation = max(2 * ended - began - time.perf_counter(), 0.0)
        launch = again
    sampled.overhead = launch.recording + 1e-3 * sum(kernel["codegen_time"] for kernel in kernels)
    sampled.memory = launch.memory
    sampled.launches.append((exits.n * each, launch.seconds))


def warm_up(stage: Stage, techniques: Sequence[Technique]) -> None:
    """Compile what preparation needs, by the first way that does not refuse the scene, and forget that way again."""
    for technique in (
        () if any(technique in [known for _, known in stage.paces] for technique in techniques) else techniques
    ):
        with contextlib.suppress(ValueError, RuntimeError):
            if technique.light == PRECOMPUTED:
                stage.light_samples = FEWEST_LIT
            _prepare(stage, technique)
            stage.forget(technique)
            return


def _prepare(stage: Stage, technique: Technique) -> None:
    integrator, scene = stage.integrator(technique), stage.scene
    if technique.light == PRECOMPUTED:
        integrator.prepare(scene, ImageSamples(stage.light_samples, stage.pixels), technique.part)
        most = int(stage.light_samples * FILLING / max(integrator.filling, 1e-9))
        if technique.part == 1 and stage.light_samples == FEWEST_LIT and most > 2 * FEWEST_LIT:
            stage.light_samples = min(most, MOST_LIT)
            integrator.prepare(scene, ImageSamples(stage.light_samples, stage.pixels), technique.part)
    else:
        (integrator.prepare if is_bssrdf(integrator) else integrator.tracer)(scene)


def sample_more(
    stage: Stage,
    technique: Technique,
    exits: Exits,
    sampled: Sampled,
    seed: int,
    *,
    seconds: float = 0.0,
    samples: int | None = None,
) -> None:
    """Sample further, for so many seconds or a number of samples of each exit.
    `sampled`: what is there already. `samples`: of each exit, instead; the outcome then depends on the seed alone."""
    most, started = max(LANES // exits.n, 2), clock()
    while True:
        if samples:
            each = samples - sampled.estimate.samples
        else:
            left = max(seconds - (clock() - started) - sampled.overhead, 0)
            each = int(left / (sampled.pace * exits.n))
        if not sampled.estimate.samples:
            each = max(each, PILOT)
        if each < FEWEST:
            return
        each = min(each, most)
        number = seeded(seed, 32, sampled.estimate.samples)
        launch = _launch(stage, technique, exits, sampled.estimate, each, number)
        sampled.memory = max(sampled.memory, launch.memory)
        sampled.launches.append((exits.n * each, launch.seconds))


def sample_blur(stage: Stage, exits: Exits, seed: int, samples: int) -> RadianceEstimate:
    """Light of delta lights that walks find by no strategy, but spread over a cone, see `objects.small_emitters`.
    Those are the same paths with and without it, the cone so wide that few samples tell. `samples`: of each exit."""
    techniques = [Technique(PATH_TRACED, blur=blur) for blur in (0.0, BLUR)]
    estimate, most = RadianceEstimate(variant_channels(), exits.n), max(LANES // exits.n, 2)
    while (each := min(samples - estimate.samples, most)) > 0:
        number, rays = seeded(seed, 33, estimate.samples), exits.rays(each)
        without, spread = (
            radiance(stage.scene, stage.integrator(w), independent(number, dr.width(rays)), rays) for w in techniques
        )
        estimate.add(*_sums([b - a for a, b in zip(without, spread)], each), each)
    return estimate


class TimedLaunch(NamedTuple):
    """Bytes and seconds that it took, and seconds of these until its kernel ran."""

    memory: int
    seconds: float
    recording: float


def _launch(
    stage: Stage, technique: Technique, exits: Exits, estimate: RadianceEstimate, each: int, seed: int
) -> TimedLaunch:
    rays = exits.rays(each)
    dr.flush_malloc_cache()
    dr.detail.malloc_clear_statistics()
    started = clock()
    L = _recorded(stage.scene, stage.integrator(technique), independent(seed, dr.width(rays)), rays)
    recorded = clock()
    dr.eval(L)
    first, second = _sums(L, each)
    ended = clock()
    memory = int(dr.detail.malloc_watermark(dr.backend_v(mi.Float)))
    estimate.add(first, second, each)
    estimate.add_bright(np.array([c.numpy() for c in L]), each)
    return TimedLaunch(memory, ended - started, recorded - started)


def _sums(L: list[mi.Float], each: int) -> tuple[np.ndarray, np.ndarray]:
    """Sums of values and of squares over the samples of each exit, (channels, n)."""

    sums = [dr.block_sum(v, each) for c in L for v in (c, c * c)]
    dr.eval(sums)
    dr.sync_thread()
    rows = np.array([s.numpy() for s in sums], dtype=np.float64)
    if not np.isfinite(rows).all():
        raise ValueError(f"samples must be finite, got {int((~np.isfinite(rows)).sum())} exits that are not")
    return rows[0::2], rows[1::2]


def radiance(scene: mi.Scene, integrator: mi.Integrator, sampler: mi.Sampler, ray: mi.Ray3f) -> list[mi.Float]:
    """Radiance of rays, by channel, by one kernel for all that it is asked for.
    It is evaluated at once, as sums evaluate what they are given and would trace all paths for each channel anew.
    `sampler`: of a number for each ray at a time."""
    L = _recorded(scene, integrator, sampler, ray)
    dr.eval(L)
    return L


def _recorded(scene: mi.Scene, integrator: mi.Integrator, sampler: mi.Sampler, ray: mi.Ray3f) -> list[mi.Float]:
    """Radiance of rays that is to be evaluated."""
    sampler.schedule_state()
    dr.schedule(ray.o, ray.d)
    dr.eval()
    ray, nothing = mi.Ray3f(ray.o, ray.d), dr.zeros(mi.Float, sampler.wavefront_size())
    return [c + nothing for c in integrator.sample(scene, sampler, ray, None, mi.Bool(True))[0]]


# --------------------------------------------------------------------------------------------------
# Where the camera sees an object: rays to its visible points, straight or through clear things such as glass about it,
# and how much of the image they fill.
#
# Points in which the boundary mirrors a lamp, or through which one would be seen if the inside were clear, are left
# out: by chance the few of them that are drawn would decide all means.


LAUNCH, LAUNCHES = 2**16, 16  # rays of a look at the scene, and the most looks for an object that is hardly seen
FEWEST_EXITS = 32  # exits of an object that is assessed
CLEAR = mi.BSDFFlags.DeltaTransmission | mi.BSDFFlags.Null
MOST_CLEAR = 6  # boundaries of clear things before an object
CHAIN = 4  # boundaries that light of a lamp may meet without scattering, mirrored by all or passing through


@dataclass(frozen=True, eq=False)
class Exits:
    """Rays of the camera that see an object.
    `o`, `d`: origins and directions, float32 (3, n). `share`: of the image that the object fills. `pixels`: of the film
    that it fills."""

    o: np.ndarray
    d: np.ndarray
    share: float
    pixels: float

    @property
    def n(self) -> int:
        return self.o.shape[1]

    def first(self, n: int) -> Exits:
        """The first n of them, which are as random as all."""
        return replace(self, o=self.o[:, :n], d=self.d[:, :n])

    def rays(self, each: int) -> mi.Ray3f:
        """Every ray `each` times, next to each other."""
        index = dr.arange(mi.UInt32, self.n * each) // dr.opaque(mi.UInt32, each)
        o, d = (mi.TensorXf(v) for v in (self.o, self.d))
        columns = [dr.gather(mi.Float, table.array, index + k * self.n) for table in (o, d) for k in range(3)]
        ray = mi.Ray3f(mi.Point3f(*columns[:3]), mi.Vector3f(*columns[3:]))
        dr.eval(ray)
        return ray


def visible_exits(scene: mi.Scene, shapes: list[mi.Shape], sensor: int, n: int, seed: int) -> list[Exits | None]:
    """Find n rays of a sensor that see each shape; fewer where it is hardly seen, None where it is not.
    `n`: rays of each."""
    camera = scene.sensors()[sensor]
    pixels = int(np.prod(np.array(camera.film().crop_size())))
    results: list[list[np.ndarray]] = [[] for _ in shapes]
    drawn = 0
    for k in range(LAUNCHES):
        rays, hit = _look(scene, camera, shapes, (seed, k))
        drawn += LAUNCH
        for mine, mask in zip(results, hit):
            mine.append(rays[:, mask])
        if all(sum(part.shape[1] for part in mine) >= n for mine in results):
            break
    made: list[Exits | None] = []
    for mine in results:
        rays = np.concatenate(mine, axis=1)
        share = rays.shape[1] / drawn
        few = rays.shape[1] < FEWEST_EXITS
        made.append(None if few else Exits(rays[:3, :n], rays[3:, :n], share, share * pixels))
    return made


def _look(
    scene: mi.Scene, camera: mi.Sensor, shapes: list[mi.Shape], seed: tuple[int, int]
) -> tuple[np.ndarray, list[np.ndarray]]:
    """Random rays of a camera, (6, LAUNCH), evenly over its film, and which of them see each shape."""
    rng = np.random.default_rng([*seed, 23])
    rows = rng.random((5, LAUNCH))
    rows[1:3] = (rows[1:3, :1] + np.arange(LAUNCH) * np.array(R_2)[:, None]) % 1
    u = [floats(row) for row in np.minimum(rows, 1 - 2**-24)]
    ray, _ = camera.sample_ray_differential(camera.shutter_open(), u[0], mi.Point2f(*u[1:3]), mi.Point2f(*u[3:]))
    si = seen_through(scene, shapes, scene.ray_intersect(mi.Ray3f(ray), mi.RayFlags.All, coherent=False))
    plain = si.is_valid() & ~(_shows_lamp(scene, shapes, si, False) | _shows_lamp(scene, shapes, si, True))
    hit = [np.array((si.shape == mi.ShapePtr(shape)) & plain) for shape in shapes]
    columns = np.concatenate([np.array(v, dtype=np.float32).reshape(3, -1) for v in (ray.o, ray.d)])
    return np.broadcast_to(columns, (6, LAUNCH)) if columns.shape[1] == 1 else columns, hit


def seen_through(scene: mi.Scene, shapes: list[mi.Shape], si: mi.SurfaceInteraction3f) -> mi.SurfaceInteraction3f:
    """What is seen where a ray has met something: this, or what is behind clear things that are none of the shapes."""
    clear = [shape for shape in shapes_of(scene, ()) if not surface_of(shape) and shape.bsdf().flags() & CLEAR]
    ctx = mi.BSDFContext()
    ctx.type_mask = CLEAR
    for _ in range(MOST_CLEAR if clear else 0):
        # refraction, or the way straight on, by what is clear
        through = mi.Bool(False)
        for shape in clear:
            through |= si.is_valid() & (si.shape == mi.ShapePtr(shape))
        bs, _ = si.bsdf().sample(ctx, si, 0.5, mi.Point2f(0.5), through)
        through &= bs.pdf > 0
        behind = scene.ray_intersect(si.spawn_ray(si.to_world(bs.wo)), mi.RayFlags.All, False, through)
        si = dr.select(through, behind, si)
    return si


def _shows_lamp(scene: mi.Scene, shapes: list[mi.Shape], si: mi.SurfaceInteraction3f, through: bool) -> mi.Bool:
    """Whether smooth boundaries show an emitter other than the environment, as mirrors or `through` clear objects."""
    active, result, instance_scene = si.is_valid(), mi.Bool(False), InstanceScene([], {}, bounds_of(scene.shapes()))
    for _ in range(CHAIN):
        eta, translucent = mi.Float(1), mi.Bool(False)
        for shape in shapes:
            here = si.shape == mi.ShapePtr(shape)
            eta, translucent = (
                dr.select(here, float(surface_of(shape).spec.channels()[0].eta), eta),
                translucent | here,
            )
        active &= translucent
        cosine = mi.Frame3f.cos_theta(si.wi)
        reflectance, cosine_t, _, eta_ti = mi.fresnel(cosine, eta)
        passes = ((cosine < 0) | through) & (reflectance < 1)
        onwards = dr.select(passes, mi.refract(si.wi, cosine_t, eta_ti), mi.reflect(si.wi))
        onward = ray_from(si, si.to_world(onwards), instance_scene.rounding(si))
        si = scene.ray_intersect(onward, mi.RayFlags.All, False, active)
        active &= si.is_valid()
        result |= active & (si.emitter(scene) != None)  # noqa: E711
    return result
