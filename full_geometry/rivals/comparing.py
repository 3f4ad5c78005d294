"""Variance of a sample of an object's light, over the squared mean, and its time, for ways of drawing entries.

Exits are uniform over the area with w_o by the cosine. With the estimates X of exit k,

    V = mean_k var(X_k) / (mean_k E[X_k])²,    mean over channels,

is what one sample contributes to the squared relative error of an image; V t, t its time, is what counts. An exit's own
work is shared by its N samples: V (t_exit/N + t_sample).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from full_geometry.flow.lights import Lighting
from full_geometry.learning.pairs import Numbers
from full_geometry.subject import Subject
from halfspace_sss.backend import kernel_seconds
from halfspace_sss.rendering.surface.horizon import cosine_above, lifted
from halfspace_sss.rendering.surface.object import turned
from halfspace_sss.rendering.transport.plane import Exit, number
from halfspace_sss.rendering.transport.protocols import Means
from halfspace_sss.tracing.walk import generator, pass_seed

__all__ = ["Cost", "Spread", "costs", "spread"]

TIMED_LANES, MANY = 2**14, 8
REPEATS = 6
LANES = 2**19


class Spread(NamedTuple):
    """V, mean over the channels, and the mean radiance of the exits per channel."""

    variance: float
    mean: np.ndarray


class Cost(NamedTuple):
    """Seconds a million: of what is done once for an exit, and of each of its samples."""

    exit: float
    sample: float

    def of(self, n: int) -> float:
        """Seconds a million samples, n for each exit."""
        return self.exit / n + self.sample


@dataclass(frozen=True, eq=False)
class _Exits:
    """Exits as a renderer has them, with their faces."""

    out: Exit
    face: Any


def _exits(subject: Subject, n: int, repeated: int, seed: int) -> _Exits:
    """n random exits, `repeated` neighbouring lanes for each."""
    import drjit as dr
    import mitsuba as mi

    rng = Numbers(generator(mi, n, pass_seed(seed, 31)))
    at = subject.points.sample(rng.next_1d(), rng.next_2d(), True)
    sign = number(subject.found.sign)
    n_out = mi.Normal3f(turned(at.n_shading, at.n) * sign)
    n_face = mi.Normal3f(at.n * sign)
    w, _ = cosine_above(n_out, n_face, rng.next_2d())
    found = (mi.Point3f(at.p), lifted(n_out, n_face, w), w, n_face, mi.UInt32(at.prim_index))
    dr.eval(found)
    k = dr.arange(mi.UInt32, n * repeated) // repeated
    p, n_out, w, n_face, face = (dr.gather(type(v), v, k) for v in found)
    dr.eval(p, n_out, w, n_face, face)
    return _Exits(Exit(p, n_out, w, mi.Float(sign), n_face), face)


def _estimates(means: Means, light: Lighting, exits: _Exits, rng: Any, n: int) -> Any:
    """Sum of n samples of each exit, per channel."""
    import mitsuba as mi

    on = mi.Bool(True)
    prepared = means.transport.prepare(exits.out, on)
    where = means.proposals.prepare(exits.out, prepared, on)
    total = mi.Spectrum(0)
    for _ in range(n):
        entry = means.proposals.sample(exits.out, exits.face, where, rng, on)
        w, value = light.sample(entry, rng.next_2d(), entry.weight > 0)
        total += means.transport.S_mu(prepared, entry, w, value > 0) * (entry.weight * value)
    return total


def spread(
    subject: Subject, means: Means, light: Lighting, *, exits: int = 256, samples: int = 2048, seed: int = 0
) -> Spread:
    """The variance of one sample of a transport by its proposals.

    Args:
        subject: the object.
        means: transport and proposals.
        light: that falls on it.
        exits, samples: random exits, and samples of each.
        seed: of both.
    """
    import drjit as dr
    import mitsuba as mi

    sums, per_pass = 0.0, max(min(LANES // exits, samples), 1)
    passes = max(samples // per_pass, 1)
    lanes = _exits(subject, exits, per_pass, seed)
    for k in range(passes):
        rng = Numbers(generator(mi, exits * per_pass, pass_seed(seed, 32, k)))
        found = _estimates(means, light, lanes, rng, 1)
        rows = [dr.block_sum(v, per_pass) for x in found for v in (x, x * x)]
        dr.eval(rows)
        sums = sums + np.stack([r.numpy().astype(float) for r in rows]).reshape(len(found), 2, exits)
    mean, square = np.moveaxis(sums / (passes * per_pass), 1, 0)
    total = mean.mean(axis=1)
    live = total > 0
    variance = (square - mean**2).mean(axis=1)[live] / total[live] ** 2
    return Spread(float(variance.mean()), total)


def costs(subject: Subject, all_means: Mapping[str, Means], light: Lighting) -> dict[str, Cost]:
    """Time of each; they take turns, and of the repeats the fastest counts, which is the one that least delayed."""
    import drjit as dr
    import mitsuba as mi

    lanes = _exits(subject, TIMED_LANES, 1, 5)
    rng = generator(mi, TIMED_LANES, pass_seed(6))
    dr.eval(rng.state, rng.inc)
    best = {(name, n): np.inf for name in all_means for n in (1, MANY)}
    for k in range(REPEATS + 1):  # the first compiles
        for name, n in best:
            numbers = Numbers(mi.PCG32(rng))
            seconds = kernel_seconds(lambda: _estimates(all_means[name], light, lanes, numbers, n))  # noqa: B023
            best[name, n] = min(best[name, n], seconds) if k else np.inf
    scale, found = 1e6 / TIMED_LANES, {}
    for name in all_means:
        each = max(best[name, MANY] - best[name, 1], 0.0) / (MANY - 1)
        found[name] = Cost(scale * max(best[name, 1] - each, 0.0), scale * each)
    return found
