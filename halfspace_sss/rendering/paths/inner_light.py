"""Light at events of order 1 inside an object, gathered once: see `gathered.inner`.

At each event one sampled emitter is connected with it, and one direction is walked to the boundary and out. What it
meets there is emission, or of other surfaces the mean of what they send to the points of the object near where it left.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import drjit as dr
import mitsuba as mi
import numpy as np

from halfspace_sss.rendering.gathered.inner import Events, InnerLight, bands
from halfspace_sss.rendering.gathered.transfer import R_2
from halfspace_sss.rendering.object.points import opaque, place, wrapped
from halfspace_sss.rendering.paths.lighting import Primal, RenderContext
from halfspace_sss.rendering.paths.low_orders import light_at_events

if TYPE_CHECKING:
    from halfspace_sss.rendering.gathered.points import SurfacePoints
    from halfspace_sss.rendering.object.objects import TranslucentObject
    from halfspace_sss.rendering.object.settings import Settings

COUNT = 2**18  # events
BRIGHTEST = 1 / 2048  # of the events, which are as bright as the next at most
SEED = 300


def inner_light(
    scene: mi.Scene, objects: list[TranslucentObject], k: int, settings: Settings, events: Events,
    others: tuple[SurfacePoints, mi.Float],
) -> InnerLight:  # fmt: skip
    """J of object k.

    Args:
        scene, objects, settings: what is rendered.
        events: of the object.
        others: points of its surface, and the mean radiance of the other surfaces that each of them sees, by channel.
    """
    context, obj, count = RenderContext.of(scene, objects, settings, Primal()), objects[k], dr.width(events.p)
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(SEED + k, count)
    # neighbours take directions, and points of emitters, of one lattice each
    lane, turn = dr.arange(mi.UInt32, count), np.random.default_rng(SEED + k).random(4)
    steps = [mi.Float(lane * int(2**32 * r)) * 2**-32 for r in R_2]
    u, u_emitter = (mi.Point2f(*(wrapped(x + opaque(t)) for x, t in zip(steps, part))) for part in np.split(turn, 2))
    d = mi.warp.square_to_uniform_sphere(u)
    found = light_at_events(context, obj, events.p, events.n, d, u_emitter, sampler)
    met = found.chance + found.weight * _beyond(context, found.left, others)
    largest = bands(obj)

    # ---- Σ over ways of Y_lm times light
    values = [[mi.Spectrum(0)] for _ in range((largest + 1) ** 2)]
    for light, w in [*found.connected, (met, d)]:
        for total, Y in zip(values, dr.sh_eval(w, largest)):
            total[0] = total[0] + light * Y
    lanes = dr.zeros(mi.Float, count)
    channels = [total[0][c] + lanes for total in values for c in range(dr.size_v(mi.Spectrum))]
    dr.eval(channels)
    sums = np.stack([np.array(v, dtype=float) for v in channels], axis=1).reshape(count, len(values), -1)
    return InnerLight.of(obj, events, _steadied(sums))


def _beyond(context: RenderContext, left: Any, others: tuple[SurfacePoints, mi.Float]) -> mi.Spectrum:
    """Radiance that walks meet outside, but for that of emitters which connections may have found."""
    ray = place(left.o, left.n).spawn_ray(left.d)
    si = context.ray_intersect(ray, True, left.left)
    emitter = si.emitter(context.scene, left.left)
    shines = left.left & (emitter != None)  # noqa: E711
    counts = shines
    if context.small is not None:
        counts &= ~((left.reflections <= 1) & context.sampled_by_nee(emitter, left.d))
    L = dr.select(counts, emitter.eval(si, counts), 0)
    points, values = others
    on = left.left & si.is_valid() & ~shines
    size = dr.size_v(mi.Spectrum)
    return L + dr.select(on, mi.Spectrum(points.blend(values, size, left.o, left.n, on)), 0)


def _steadied(sums: np.ndarray) -> np.ndarray:
    """Sums without the brightest events, whose light goes to all by what they have."""
    size = np.abs(sums).max(axis=(1, 2))
    most = np.quantile(size, 1 - BRIGHTEST)
    if not most > 0:
        return sums
    kept = sums * np.minimum(1, most / np.maximum(size, 1e-30))[:, None, None]
    whole = sums[:, 0].sum(axis=0) / np.maximum(kept[:, 0].sum(axis=0), 1e-30)
    return kept * whole
