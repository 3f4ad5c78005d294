"""Light at events of order 1 inside an object, gathered once: see `precomputed.inner`.

At each event one sampled emitter is connected with it, and a direction is walked to the boundary and out, three under
an environment that varies. What it meets there is emission, or of other surfaces the mean of what they send to the
points of the object near where it left. Most directions are those that an environment draws outside, bent by a flat
boundary: so its bright parts are found without a search.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from full_geometry.geometry.light_points import SurfacePoints
from full_geometry.geometry.points import opaque, place, wrapped
from full_geometry.geometry.rounding import ray_from
from full_geometry.geometry.sensors import independent
from full_geometry.integrators.ballistic_and_single import OneEventWalk, light_at_events
from full_geometry.integrators.lighting import Primal, RenderContext
from full_geometry.objects.objects import TranslucentObject
from full_geometry.precomputed.inner import Events, InnerLight, bands
from full_geometry.precomputed.transport_matrix import R_2
from full_geometry.settings import Settings

COUNT = 2**17  # events
BRIGHTEST = 1 / 8192  # of the events, which are as bright as the next at most
SHARING = 64  # groups of events beside each other
SEED = 300
UNEVEN = 3  # directions at an event under an environment that varies, but for a first look; else one
SKYWARD = 0.75  # of the directions by the environment


def inner_light(
    scene: mi.Scene, objects: list[TranslucentObject], k: int, settings: Settings, events: Events,
    others: tuple[SurfacePoints, mi.Float], uneven: int,
) -> InnerLight:  # fmt: skip
    """J of object k.
    `scene`, `objects`, `settings`: what is rendered. `events`: of the object. `others`: points of its surface, and the
    mean radiance of the other surfaces that each of them sees, by channel. `uneven`: directions at an event under an
    environment that varies."""
    # ---- n directions for each event, one lane each
    context, obj, count = RenderContext.of(scene, objects, settings, Primal()), objects[k], dr.width(events.p)
    sky = scene.environment()
    n = 1 if sky is None or "Constant" in sky.class_name() else uneven
    lane, turn = dr.arange(mi.UInt32, n * count), np.random.default_rng(SEED + k).random(4)
    event = lane // dr.opaque(mi.UInt32, n)
    at = dr.gather(tuple, (events.p, events.n), event)
    sampler = independent(SEED + k, n * count)

    # ---- light at events by connections and along directions; neighbours take both from one lattice each
    steps = [mi.Float(lane * int(2**32 * r)) * 2**-32 for r in R_2]
    u, u_emitter = (mi.Point2f(*(wrapped(x + opaque(t)) for x, t in zip(steps, part))) for part in np.split(turn, 2))
    d, inverse_pdf = _directions(sky, at, float(obj.media[0].eta), u)
    found = light_at_events(context, obj, at, (d, inverse_pdf), u_emitter, sampler)
    met = found.unconnected + found.weight * _beyond(context, obj, found.left, others)
    largest = bands(obj)

    # ---- ∫ Y_lm L dw: Σ over ways of Y_lm(w) times light
    values = [[mi.Spectrum(0)] for _ in range((largest + 1) ** 2)]
    for light, w in [*found.connected, (met, d)]:
        for total, Y in zip(values, dr.sh_eval(w, largest)):
            total[0] = total[0] + light * Y
    lanes = dr.zeros(mi.Float, n * count)

    # ---- the mean over the directions of an event
    channels = [total[0][c] + lanes for total in values for c in range(dr.size_v(mi.Spectrum))]
    dr.eval(channels)
    channels = [dr.block_sum(v, n) / n for v in channels] if n > 1 else channels
    sums = np.stack([np.array(v, dtype=float) for v in channels], axis=1).reshape(count, len(values), -1)
    return InnerLight.of(obj, events, _steadied(sums))


def _directions(
    sky: mi.Emitter | None, events: tuple[mi.Point3f, mi.Normal3f], eta: float, u: mi.Point2f
) -> tuple[mi.Vector3f, mi.Float]:
    """Directions inside at events, for pairs of uniform numbers, and the inverse of their density, sr.

    With e = max(eta, 1), n the normal, m = sqrt(1 - 1 / e²) and w a direction that the environment draws, d is in the
    plane of both, with

        sin_d = sin_w / e,  p(d) = p(w) e² cos_d / cos_w            where cos_w > 0, as a flat boundary refracts,
        cos_d = m - (1 + m) |cos_w|,  p(d) = p(w) / (1 + m)          elsewhere.

    Other directions are uniform. Events are places with the normals of a boundary near them.
    """
    if sky is None:
        return mi.warp.square_to_uniform_sphere(u), mi.Float(4 * dr.pi)
    # ---- w of the environment, bent as the boundary does, or a uniform direction
    e, skyward = opaque(max(eta, 1.0)), u.x < SKYWARD
    least, frame = dr.safe_sqrt(1 - dr.rcp(e * e)), mi.Frame3f(events[1])
    u = mi.Point2f(dr.select(skyward, u.x / SKYWARD, (u.x - SKYWARD) / (1 - SKYWARD)), u.y)
    at = dr.zeros(mi.Interaction3f, dr.width(u))
    at.p = events[0]
    w = frame.to_local(sky.sample_direction(at, u)[0].d)
    inside = dr.select(w.z > 0, dr.safe_sqrt(1 - (1 - w.z * w.z) / (e * e)), least + (1 + least) * w.z)
    d = dr.select(skyward, frame.to_world(_raised(w, inside)), mi.warp.square_to_uniform_sphere(u))

    # ---- density of both, the former by the direction w that would lead to d
    d_n = mi.Frame3f.cos_theta(frame.to_local(d))
    above = d_n > least
    outside = dr.select(above, dr.safe_sqrt(1 - (1 - d_n * d_n) * e * e), (d_n - least) / (1 + least))
    ds = dr.zeros(mi.DirectionSample3f)
    ds.d, ds.emitter = frame.to_world(_raised(frame.to_local(d), outside)), mi.EmitterPtr(sky)
    bends = dr.select(above, e * e * d_n / dr.maximum(outside, 1e-4), dr.rcp(1 + least))
    return d, dr.rcp(SKYWARD * sky.pdf_direction(at, ds) * bends + (1 - SKYWARD) * dr.inv_four_pi)


def _raised(w: mi.Vector3f, z: mi.Float) -> mi.Vector3f:
    """A direction of a frame, tilted to the cosine z."""
    scale = dr.safe_sqrt((1 - z * z) / dr.maximum(1 - w.z * w.z, 1e-12))
    return mi.Vector3f(w.x * scale, w.y * scale, z)


def _beyond(
    context: RenderContext, obj: TranslucentObject, left: OneEventWalk, others: tuple[SurfacePoints, mi.Float]
) -> mi.Spectrum:
    """Radiance that walks meet outside, but for that of emitters which connections may have found."""
    # emission, but for what connections find after at most one reflection
    ray = ray_from(place(left.o, left.n), left.d, obj.geometry.clearance)
    si = context.ray_intersect(ray, True, left.left)
    emitter = si.emitter(context.scene, left.left)
    shines = left.left & (emitter != None)  # noqa: E711
    counts = shines
    if context.small is not None:
        counts &= ~((left.reflections <= 1) & context.sampled_by_nee(emitter, left.d))
    L = dr.select(counts, emitter.eval(si, counts), 0)

    # other surfaces by the mean that points of the object near the exit see of them
    points, values = others
    on = left.left & si.is_valid() & ~shines
    size = dr.size_v(mi.Spectrum)
    return L + dr.select(on, mi.Spectrum(points.blend(values, size, left.o, left.n, on)), 0)


def _steadied(sums: np.ndarray) -> np.ndarray:
    """Sums without the brightest events, whose light goes to those beside them by what they have."""
    # what a group of neighbours loses goes to it by what it has left
    kept = cut_to_next(sums, BRIGHTEST).reshape(SHARING, -1, *sums.shape[1:])
    whole = sums[:, 0].reshape(*kept.shape[:2], -1).sum(axis=1) / np.maximum(kept[:, :, 0].sum(axis=1), 1e-30)
    return (kept * whole[:, None, None]).reshape(sums.shape)


def cut_to_next(values: np.ndarray, brightest: float) -> np.ndarray:
    """Values (n, ...) whose brightest share is cut to the size of the next one; as they are where that is 0."""
    # size: the largest |number| of each of the n
    size = np.abs(values).max(axis=tuple(range(1, values.ndim)), keepdims=True)
    most = np.quantile(size, 1 - brightest)
    return values * np.minimum(1, most / np.maximum(size, 1e-30)) if most > 0 else values
