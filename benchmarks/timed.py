"""Renders against the clock: equal passes of several scenes in turn, so that what else runs slows all of them alike."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from halfspace_sss.checks import check_interval
from halfspace_sss.progress import Progress

if TYPE_CHECKING:
    import mitsuba as mi

MOST_LANES = 2**22  # camera rays of a pass, for memory
GROWTH, MOST_TRIALS = 16, 8  # of the number of samples of a pass that is looked for


@dataclass(frozen=True, eq=False)
class TimedRender:
    """Passes of a scene.
    `images`: of each pass, linear radiance, float32 (passes, H, W, 3). `spp`: samples per pixel of all together.
    `pass_seconds`: of each pass, without compilation."""

    images: np.ndarray
    spp: int
    pass_seconds: tuple[float, ...]

    @property
    def image(self) -> np.ndarray:
        """Their average, float64."""
        return self.images.mean(axis=0, dtype=np.float64)

    @property
    def seconds(self) -> float:
        """Of all passes."""
        return float(sum(self.pass_seconds))


def rendered(scene: mi.Scene, spp: int, *seed: int) -> tuple[np.ndarray, float]:
    """An image (H, W, 3) and the seconds it took; ValueError if it is not finite.
    Of a tuple of scenes the first gives the first channel, and so on; their times add up."""
    import mitsuba as mi

    number = int(np.random.SeedSequence(seed).generate_state(1)[0])
    started = time.perf_counter()
    if isinstance(scene, tuple):
        results = [np.array(mi.render(one, spp=spp, seed=number + k))[..., k] for k, one in enumerate(scene)]
        image = np.stack(results, axis=2)
    else:
        image = np.array(mi.render(scene, spp=spp, seed=number), dtype=np.float32)[..., :3]
    seconds = time.perf_counter() - started
    if not np.isfinite(image).all():
        raise ValueError(f"a render must be finite, got {int((~np.isfinite(image)).sum())} values that are not")
    return image, seconds


def pass_size(scene: mi.Scene, seconds: float, seed: int = 0) -> int:
    """Samples per pixel of a pass that takes so many seconds or half as many; its kernels are compiled then.
    `seconds`: aimed at; one sample per pixel may take longer. `seed`: of what is rendered for it. ValueError if seconds
    is not above 0."""
    check_interval("seconds", seconds, 1e-6, 1e6)
    pixels = int(np.prod(np.array(scene.sensors()[0].film().crop_size())))
    most, spp, results = max(1, MOST_LANES // pixels), 1, []
    for k in range(MOST_TRIALS):
        rendered(scene, spp, seed, 2 * k)  # compiles, in some integrators for each number of samples
        results.append((spp, rendered(scene, spp, seed, 2 * k + 1)[1]))
        least = 1 if k or results[-1][1] > seconds else 2  # one sample may have taken what any render takes
        wanted = power_of_two(min(most, GROWTH * spp, max(least, _samples_in(seconds, results))))
        if wanted == spp:
            break
        spp = wanted
    return results[-1][0]


def power_of_two(samples: float) -> int:
    """The largest power of two that is no more, at least 1: any number would have kernels of its own in every run."""
    return 2 ** max(math.floor(math.log2(samples)), 0) if samples > 0 else 1


def _samples_in(seconds: float, result: list[tuple[int, float]]) -> int:
    """Samples in so many seconds from what the smallest and the largest number took: a render has a cost of its own."""
    (few, least), (many, longest) = min(result), max(result)
    each = longest / many if many == few else max((longest - least) / (many - few), 0.2 * longest / many)
    return max(1, many + round((seconds - longest) / each))


def alternating(
    scenes: Mapping[str, mi.Scene], spp: Mapping[str, int], seed: int, seconds: float, progress: Progress | None = None
) -> dict[str, TimedRender]:
    """Render scenes in turn, a pass of each, until every one has its seconds.

    Args:
        scenes: by name; compiled before, e.g. by `pass_size`.
        spp: of a pass, by name.
        seconds: of each scene; it ends with the pass that comes nearest.
        progress: called with (done, in all).

    Raises:
        ValueError: seconds is out of range.
    """
    check_interval("seconds", seconds, 1e-6, 1e6)
    images: dict[str, list[np.ndarray]] = {name: [] for name in scenes}
    times: dict[str, list[float]] = {name: [] for name in scenes}

    def share(name: str) -> float:
        """Done of what is to be done; half a pass before the end of the time it is all done."""
        took = times[name]
        return (sum(took) + 0.5 * sum(took) / len(took)) / seconds if took else 0.0

    while waiting := [name for name in scenes if share(name) < 1]:
        for name in waiting:
            image, took = rendered(scenes[name], spp[name], seed, list(scenes).index(name), len(times[name]) + 1)
            images[name].append(image)
            times[name].append(took)
            if progress is not None:
                progress(int(1000 * sum(min(share(n), 1.0) for n in scenes)), 1000 * len(scenes))
    return {name: TimedRender(np.stack(images[name]), len(t) * spp[name], tuple(t)) for name, t in times.items()}
