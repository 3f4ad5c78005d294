"""CPU seconds from a fresh scene to a total error of denoised path tracing, at kernels that are known.

All counts: light inside, albedo and normals for the denoiser, passes, and all denoising.

Passes grow as those of `render` do. Whenever the samples have grown by what the last errors ask for, the halves are
denoised and compared (`full_geometry.scenes.reference`), for pixels and for means over blocks of 8 x 8. No reference is
rendered: the error is estimated without bias from the halves, but for the bias of precomputed light, below .3 %. The
time of raw path tracing follows from its variance, and a lower bound of a denoised one that is given up from its error,
which falls by the root of the samples at most. Ways are walks with precomputed light and Mitsuba's `volpathmis`.
"""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import mitsuba as mi
import numpy as np
import pandas

from benchmarks.lit_objects import VOLUMES, LitObject
from benchmarks.total_error import BLOCK, PRECOMPUTED, image_of_pass, lit_scene
from figures.computing.scans import prepare
from figures.parts.part import Row
from full_geometry.scenes.reference import FEWEST_PASSES, Denoise, Limits, MixedHalves, samples_to
from full_geometry.scenes.reference_store import Reference
from full_geometry.trade.denoising import Denoiser


@dataclass(frozen=True)
class ErrorsWanted:
    """What is reached, and how it is measured.

    Args:
        pixels, blocks: relative errors.
        most: CPU seconds after which walks are given up.
        volume: the same of `volpathmis`.
        size: pixels of the square images.
        seed: of all renders.
    """

    pixels: float = 0.04
    blocks: float = 0.015
    most: float = 60.0
    volume: float = 12.0
    size: int = 512
    seed: int = 0


def times_to_error(
    cases: Sequence[LitObject], how: ErrorsWanted, folder: Path, progress: Callable[[str, int, int], None]
) -> Iterator[pandas.DataFrame]:
    """The table so far, ever longer: a row for each way and case, its seconds, denoised and raw, and its errors."""
    prepare()
    folder.mkdir(parents=True, exist_ok=True)
    rows = []
    for k, (way, case) in enumerate(itertools.product((PRECOMPUTED, VOLUMES[0]), cases)):
        progress(f"{case.name}, {case.light}", k, 2 * len(cases))
        rows.append(_row(case, way, how, folder))
        yield pandas.DataFrame(rows)


def _row(case: LitObject, way: str, how: ErrorsWanted, folder: Path) -> Row:
    """Passes of a fresh scene until both errors are reached; a scene before it compiles the kernels."""
    compiled = lit_scene(case, way, how.size, folder)
    _denoiser(compiled)
    for spp in (1, 2, 4):  # kernels of passes with more are these
        image_of_pass(compiled, spp, how.seed)
    scene, started, seed = lit_scene(case, way, how.size, folder), time.process_time(), how.seed + 1
    denoise = _denoiser(scene)
    found, wanted, most = None, 0.0, how.most if way == PRECOMPUTED else how.volume
    passes = Limits(seconds=most)
    while True:
        spp = passes.next_spp(found)
        image = image_of_pass(scene, spp, seed)
        found = (found or Reference.empty(image.shape, {}, halves=True)).add(image, spp, 0.0)
        seconds, seed = time.process_time() - started, seed + 1
        if found.passes < FEWEST_PASSES or (found.spp < wanted and seconds < most):
            continue
        errors = _errors(found, denoise)
        over = max(errors["pixels"] / how.pixels, errors["blocks"] / how.blocks)
        wanted = samples_to(over, 1.0, found.spp)
        seconds = time.process_time() - started
        reached = over <= 1
        if reached or seconds > most:
            break
    raw = max(errors["raw pixels"] / how.pixels, errors["raw blocks"] / how.blocks) ** 2 * seconds
    told = {f"{name}, %": 100 * value for name, value in errors.items()}
    return {
        "object": case.name, "light": case.light, "way": way, "seconds": seconds if reached else np.inf,
        "spp": found.spp, **told, "seconds, at least": max(over, 1) ** 2 * seconds, "seconds, raw": raw,
    }  # fmt: skip


def _denoiser(scene: mi.Scene | tuple[mi.Scene, ...]) -> Denoiser:
    return Denoiser(scene if isinstance(scene, mi.Scene) else scene[0])


def _errors(found: Reference, denoise: Denoise) -> dict[str, float]:
    """Relative errors of pixels and blocks, denoised and raw; infinite where the image is not above its noise."""
    mixed, mean, variance = MixedHalves.of(found, denoise), found.mean[..., :3], found.variance[..., :3]
    result = {}
    for name, size in (("pixels", 1), ("blocks", BLOCK)):
        means = MixedHalves(*(_means(x, size) for x in mixed))
        squared, noise = means.squared()
        # of the halves: cells of precomputed light share their noise among pixels
        raw = variance.sum() if size == 1 else 0.25 * np.square(means.A - means.B).sum()
        # sum L², an estimate, falls to 0 and below where noise hides the image
        whole = np.square(_means(mean, size)).sum() - raw
        for key, square in ((name, max(squared.sum(), noise.sum())), (f"raw {name}", raw)):
            result[key] = float(np.sqrt(square / whole)) if whole > 0 else np.inf
    return result


def _means(x: np.ndarray, size: int) -> np.ndarray:
    """Over blocks of `size` x `size` pixels."""
    n, m = x.shape[0] // size, x.shape[1] // size
    return x[: n * size, : m * size].reshape(n, size, m, size, -1).mean(axis=(1, 3))
