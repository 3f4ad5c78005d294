"""Radiance of random exits of one object, by walks and by a model, under constant light and four lobes.

Exits are uniform over the area with w_o by the cosine. Light is 1 from everywhere, or one of four lobes
max(0, w . l)^16; nothing blocks it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from full_geometry.object.pairs import EntryProposals
from full_geometry.object.patches import ExitTable
from full_geometry.object.subject import Subject
from full_geometry.object.walks import trace_exits
from halfspace_sss.checks import check_count
from halfspace_sss.rendering.object.points import SurfacePoint, Transport
from halfspace_sss.tracing.walk import generator, pass_seed

LOBES = np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]]) / np.sqrt(3.0)
POWER = 16
LANES = 2**20  # of one pass


@dataclass(frozen=True, eq=False)
class ExitRadiance:
    """Radiance of exits under all lights and its variance, (channels, exits, lights)."""

    mean: np.ndarray
    variance: np.ndarray


@dataclass(frozen=True, eq=False)
class ExitTruth:
    """Exits and what walks say of them."""

    exits: SurfacePoint
    truth: ExitRadiance


class _Sums:
    """Sums of value and square over the samples of each exit."""

    def __init__(self, n_exits: int) -> None:
        self.n_exits, self.n, self.sums = n_exits, 0, 0.0

    def add(self, value: Any, w: Any, per_exit: int) -> None:
        """Samples of all exits, `per_exit` neighbouring lanes for each: value per channel of unit light from w."""
        lights = [mi.Float(1)] + [dr.maximum(dr.dot(w, mi.Vector3f(*axis.tolist())), 0) ** POWER for axis in LOBES]
        rows = []
        for v in value:
            products = [v * light for light in lights]
            parts = [dr.block_sum(p + 0 * v, per_exit) for p in (*products, *(p * p for p in products))]
            dr.eval(parts)
            rows.append(np.stack([p.numpy() for p in parts], axis=-1).astype(float))
        self.sums = self.sums + np.stack(rows)
        self.n += per_exit

    def estimate(self) -> ExitRadiance:
        first, second = np.split(self.sums / self.n, 2, axis=-1)
        return ExitRadiance(first, (second - first**2) / (self.n - 1))


def _passes(n_exits: int, per_exit: int) -> list[int]:
    """Samples of each exit in each pass."""
    most = max(LANES // n_exits, 1)
    return [min(most, per_exit - done) for done in range(0, per_exit, most)]


def reference(subject: Subject, exits: int = 256, walks: int = 8192, seed: int = 0, fewest: int = 2) -> ExitTruth:
    """Exits and their radiance by walks.

    Args:
        exits, walks: number of exits, and of walks of each; seed: of both.
        fewest: scattering events that count.
    """
    for name, value, least in (("exits", exits, 2), ("walks", walks, 2), ("seed", seed, 0)):
        check_count(name, value, least)
    points = subject.random_points(generator(mi, exits, pass_seed(seed, 17)))
    dr.eval(points)
    return ExitTruth(points, traced(subject, points, walks, (seed, 18), fewest=fewest))


def traced(subject: Subject, exits: SurfacePoint, walks: int, seed: tuple[int, ...], **orders: int) -> ExitRadiance:
    """Radiance of exits by so many walks of each; `orders` as for `trace_exits`."""
    sums = _Sums(dr.width(exits.p))
    for k, per_exit in enumerate(_passes(sums.n_exits, walks)):
        ends = trace_exits(subject, _repeated(exits, per_exit), (*seed, k), **orders)
        sums.add(ends.T, ends.at.w, per_exit)
    return sums.estimate()


def _repeated(points: SurfacePoint, times: int) -> SurfacePoint:
    return points.gather(dr.arange(mi.UInt32, dr.width(points.p) * times) // times)


def modelled(
    transport: Transport, proposals: EntryProposals, exits: SurfacePoint, samples: int, seed: int = 0
) -> ExitRadiance:
    """Radiance of exits by a model.

    Args:
        transport: the model.
        proposals: where its entries are drawn.
        exits: from a reference.
        samples, seed: entries of each exit; of the entries.
    """
    n = dr.width(exits.p)
    sums = _Sums(n)
    table = ExitTable(proposals.patches, exits) if proposals.patches else None
    for k, per_exit in enumerate(_passes(n, samples)):
        points, lanes = _repeated(exits, per_exit), dr.arange(mi.UInt32, n * per_exit)
        rng = generator(mi, n * per_exit, pass_seed(seed, 19, k))
        entries, weight = proposals.sample(points, rng, table, lanes // per_exit)
        value = transport.S(transport.prepare(points), entries, weight > 0) * weight
        dr.eval(value, entries)
        sums.add(value, entries.w, per_exit)
    return sums.estimate()
