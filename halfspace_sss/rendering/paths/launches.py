"""An image in launches that last about a second at most, between which an interrupt is heard."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np

from halfspace_sss.rendering.light.interruptible import hear_again

__all__ = ["SAMPLES_PER_LAUNCH", "Launch", "launches"]

SAMPLES_PER_LAUNCH = 2**20  # half a second on 2 cores


class Launch(NamedTuple):
    """Seed and samples per pixel."""

    seed: int
    spp: int


def launches(sensor: Any, seed: Any, spp: int, stopped: Callable[[], bool]) -> Iterator[Launch]:
    """Launches of equally many samples, each to be rendered to the film of a sensor, which holds their mean in the end.

    Args:
        sensor, seed, spp: what is rendered; the first launch has the seed itself.
        stopped: whether Mitsuba, whose handler takes signals while it renders, was told to stop.

    Raises:
        KeyboardInterrupt: a launch was interrupted.
    """
    film, total = sensor.film(), None
    spp, seed = spp or sensor.sampler().sample_count(), int(mi.UInt32(seed)[0])
    n = min(math.ceil(spp * int(dr.prod(film.crop_size())) / SAMPLES_PER_LAUNCH), spp)
    for k in range(n):
        yield Launch(_seed(seed, k), (spp * (k + 1)) // n - (spp * k) // n)
        raw = film.develop(raw=True)
        total = raw if total is None else total + raw
        dr.eval(total)
        dr.sync_thread()
        hear_again()
        if stopped():
            raise KeyboardInterrupt
    if n > 1:
        film.prepare([])
        film.put_block(mi.ImageBlock(total, film.crop_offset(), film.rfilter(), False))


def _seed(seed: int, k: int) -> int:
    return seed if k == 0 else int(np.random.SeedSequence([seed, k]).generate_state(1)[0])
