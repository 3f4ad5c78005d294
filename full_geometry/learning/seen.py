"""Exits that the camera sees, beside random ones: its walks are data for the fit as they come.

The likelihood holds for any distribution of exits, as long as proposals begin at the same ones: where walks begin in
shares of two kinds, proposals do so too. Random exits stay half of them or more, so that all of an object is learnt.
"""

from __future__ import annotations

import math
import time
from typing import Any, NamedTuple

import numpy as np

from full_geometry.learning.exits import Exits
from full_geometry.learning.pairs import Pairs, PairSource, shuffled
from full_geometry.subject import SurfacePoint
from halfspace_sss.rendering.scenes.camera_walks import TRIAL

__all__ = ["Schedule", "Seen"]

SHARE = 0.5  # of the walks of a chunk, at most, that the camera begins
PASSES = 4  # of a chunk
MOST_RAYS = 4  # times that share: where an object is small in the picture, its paths would take all of the time


class Schedule(NamedTuple):
    """Samples per pixel of a pass, passes of a chunk that has them, and of how many chunks one has."""

    spp: int
    passes: int
    every: int

    def numbers(self, k: int) -> list[int]:
        """Of the passes of chunk k."""
        return [] if k % self.every else [k // self.every * self.passes + j for j in range(self.passes)]

    @classmethod
    def of(cls, walks: float, hits: int, pixels: int) -> Schedule | None:
        """For so many walks of a chunk, where `hits` of `pixels` paths meet the object; None if none do."""
        if hits == 0:
            return None
        spp = min(SHARE * walks / hits, MOST_RAYS * SHARE * walks / pixels)
        if spp >= PASSES:  # more than one, whose spread is the variance of their image
            return cls(int(spp / PASSES), PASSES, 1)
        return cls(1, 1, math.ceil(1 / spp))


class Seen:
    """The part of each chunk that comes from the camera.

    Args:
        source: of the pairs.
        camera: a `CameraWalks`.
        walks: of a chunk, those of the camera included.
        seed: of the run.
    """

    def __init__(self, source: PairSource, camera: Any, walks: int, seed: int) -> None:
        self.source, self.camera, self.walks, self.seed = source, camera, walks, seed
        self.shape = source.subject.found.shape
        self.schedule = Schedule.of(walks, camera.hits(self.shape), camera.pixels)

    def seconds_more(self) -> float:
        """Of a chunk in the mean, by the second one; compiles what passes need."""
        if self.schedule is None or self.schedule.every == 1:
            return 0.0
        for _ in range(2):
            started = time.monotonic()
            self.camera.exits(self.shape, TRIAL, self.schedule.spp)
        return (time.monotonic() - started) * self.schedule.passes / self.schedule.every

    def data(self, k: int, proposed: int) -> tuple[Pairs, Pairs]:
        """Walks and proposals of chunk k.

        Args:
            k: number of the chunk.
            proposed: number of proposals.
        """
        import drjit as dr

        seed, order = (self.seed, k), np.random.default_rng([self.seed, k, 1])
        parts = []
        if self.schedule:
            parts = self._exits(self.schedule.numbers(k), order)
        walks, proposals = [], []
        for j, (starts, ends) in enumerate(parts):
            n = dr.width(starts.p)
            m = round(proposed * n / self.walks)
            at = starts.gather(_lanes(order.integers(0, n, m)))
            walks.append(self.source.ended(starts, ends, (*seed, 5, j)))
            proposals.append(self.source.proposed(m, (*seed, 3, j), at))
        wanted = (self.walks, walks), (proposed, proposals)
        left = [total - sum(part.drawn for part in done) for total, done in wanted]
        walks.append(self.source.walks(left[0], seed))
        proposals.append(self.source.proposed(left[1], seed))
        return (shuffled(walks, order), shuffled(proposals, order)) if parts else (walks[0], proposals[0])

    def _exits(self, numbers: list[int], order: np.random.Generator) -> list[tuple[SurfacePoint, Exits]]:
        """Starts and ends of walks from the camera, launch by launch; of too many a random choice."""
        import drjit as dr

        launches = [part for number in numbers for part in self.camera.exits(self.shape, number, self.schedule.spp)]
        found = [part for part in launches if dr.width(part.object)]
        ends = np.cumsum([0, *(dr.width(part.object) for part in found)])
        chosen = np.sort(order.permutation(int(ends[-1]))[: int(SHARE * self.walks)])
        parts = []
        for part, a, b in zip(found, ends, ends[1:]):
            own = chosen[(chosen >= a) & (chosen < b)] - a
            if len(own):
                parts.append(_points(part.gather(_lanes(own))))
        dr.eval(parts)
        return parts


def _points(part: Any) -> tuple[SurfacePoint, Exits]:
    """First exits of the camera as walks of this package, of the orders from one on."""
    import drjit as dr

    starts = SurfacePoint(part.x_o, part.n_o, part.n_o_shading, part.w_o)
    ends = SurfacePoint(part.x_i, part.n_i, part.n_i_shading, part.w_i)
    return starts, Exits(ends, dr.select(part.order >= 1, part.throughput, 0), part.order, part.face)


def _lanes(numbers: np.ndarray) -> Any:
    import mitsuba as mi

    return mi.UInt32(numbers.astype(np.uint32))
