"""Total error over seconds: what an image of an object is off, noise, bias, edges and reflections included.

The error of an image X over a reference R is

    sqrt(sum (X - R)² / sum R²)

over all pixels of the object and channels, of pixels and of means over blocks of 8 x 8. R is a long image by walks
whose light is sampled, which has no bias, or precomputed, which has less noise; its variance is taken off. Ways are
path tracing by Mitsuba's `volpathmis` at two roulette depths, walks with sampled and with precomputed light, and light
that is gathered by a model and corrected by walks, each as rendered and denoised by Open Image Denoise.
Beside it stand the error over these pixels that a render tells without R, means over R, and the variance of a sample
times its CPU seconds, summed over the pixels, over that of `volpathmis` at its better depth.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import mitsuba as mi
import numpy as np
import pandas

from benchmarks.lit_objects import VOLUMES, LitObject
from benchmarks.methods import ready
from figures.computing.scans import prepare
from figures.parts.part import Row
from full_geometry.geometry.sensors import sampled_size
from full_geometry.scenes.reference import Denoise, MixedHalves
from full_geometry.scenes.reference_store import CHANNELS, LIGHT, Reference
from full_geometry.scenes.scene_files import PATH_TRACED, load_scene
from full_geometry.settings import LAYER
from full_geometry.trade.denoising import Denoiser, cover

SAMPLED, PRECOMPUTED = "walk, light sampled", "walk, light precomputed"
MODEL, CORRECTED = "better_dipole", "better_dipole, light corrected"
REFERENCE = "reference"
PASSING = (*VOLUMES, SAMPLED, PRECOMPUTED)  # whose passes are independent
WAYS = (*PASSING, CORRECTED)
BLOCK = 8  # pixels of its side
REFERENCE_SPP = 64  # of a pass of the reference
LEAST_SPP, MOST_SPP = 1, 1024  # of a pass; of corrected light half of an image
SHARE = 4  # passes in the shortest time: their spread tells the variance


@dataclass(frozen=True)
class TotalErrors:
    """How errors are measured.

    Args:
        seconds: CPU times of an image, ascending.
        reference: CPU seconds of the reference.
        size: pixels of the square images.
        seed: of all renders.
        ways: of `WAYS`.
        truth: SAMPLED or PRECOMPUTED, the way of the reference.
    """

    seconds: tuple[float, ...] = (5.0, 20.0, 80.0)
    reference: float = 600.0
    size: int = 128
    seed: int = 0
    ways: tuple[str, ...] = WAYS
    truth: str = SAMPLED


class Measured(NamedTuple):
    """What total errors were measured.

    Args:
        table: a row for each case, way, time, raw and denoised.
        images: of the first case after the middle time, by way with "raw" or "denoised", and REFERENCE.
    """

    table: pandas.DataFrame
    images: dict[str, np.ndarray]


def total_errors(
    cases: Sequence[LitObject], how: TotalErrors, folder: Path, progress: Callable[[str, int, int], None]
) -> Iterator[Measured]:
    """Errors of all ways and times, of ever more cases."""
    prepare()
    folder.mkdir(parents=True, exist_ok=True)
    rows: list[Row] = []
    images: dict[str, np.ndarray] = {}
    for k, case in enumerate(cases):
        progress(f"{case.name}, {case.light}", k, len(cases))
        found, seen = _measured(case, how, folder)
        rows, images = rows + found, images or seen
        yield Measured(pandas.DataFrame(rows), images)


def lit_scene(case: LitObject, way: str, size: int, folder: Path) -> mi.Scene | tuple[mi.Scene, ...]:
    """The scene of a case for a way; that of `volpathmis` may be three, one for each channel."""
    found = case.description(size, folder)
    if way in VOLUMES:
        return ready(way, found, case.key, case.medium)
    if way == CORRECTED:
        return load_scene(found, MODEL, settings={"light": "corrected", "layers": True})
    kind = "sampled" if way == SAMPLED else "precomputed"
    return load_scene(found, PATH_TRACED, settings={"light": kind, "layers": True})


def _measured(case: LitObject, how: TotalErrors, folder: Path) -> tuple[list[Row], dict[str, np.ndarray]]:
    scenes = {way: lit_scene(case, way, how.size, folder) for way in PASSING if way in how.ways}
    truth = lit_scene(case, how.truth, how.size, folder)
    inside, denoise = cover(truth) > 0, Denoiser(truth)
    reference = _passes(truth, how.reference, REFERENCE_SPP, how.seed + 1)[0][..., :3]
    R, noise = reference.mean(axis=0), reference.var(axis=0, ddof=1) / len(reference)

    # ---- images of every way after each time: means of passes, and corrected light from its beginning
    found: dict[tuple[str, float], Reference] = {}
    costs = {}
    for way, scene in scenes.items():
        spp = _samples(scene, how.seconds[0] / SHARE, how.seed)
        images, seconds = _passes(scene, how.seconds[-1], spp, how.seed + 1000)
        for limit in how.seconds:
            n = int(np.clip(np.searchsorted(np.cumsum(seconds), limit, side="right"), 1, len(seconds)))
            found[way, limit] = _averaged(images[:n], spp)
        costs[way] = _cost(images[..., :3], seconds, inside)
    for limit in how.seconds if CORRECTED in how.ways else ():
        found[CORRECTED, limit] = _corrected(lambda: lit_scene(case, CORRECTED, how.size, folder), limit, how.seed)
    best = min((costs[way] for way in VOLUMES if way in costs), default=np.nan)

    # ---- a row for each, raw and denoised
    rows, images, middle = [], {REFERENCE: R}, how.seconds[len(how.seconds) // 2]
    for (way, limit), average in found.items():
        for name, (result, told) in zip(("raw", "denoised"), _results(average, denoise, inside)):
            pixels, blocks = (_error(result, R, noise, inside, size) for size in (1, BLOCK))
            if limit == middle:
                images[f"{way}, {name}"] = result
            mean = result[inside].mean(axis=0) / R[inside].mean(axis=0)
            rows.append(
                {
                    "object": case.name, "light": case.light, "way": f"{way}, {name}", "seconds": limit,
                    "spp": average.spp, "pixels, %": 100 * pixels, "blocks, %": 100 * blocks, "told, %": 100 * told,
                    "mean R": mean[0], "mean G": mean[1], "mean B": mean[2],
                    "variance x time": best / costs[way] if name == "raw" and way in costs else np.nan,
                }
            )  # fmt: skip
    return rows, images


def _results(found: Reference, denoise: Denoise, inside: np.ndarray) -> list[tuple[np.ndarray, float]]:
    """The image raw and denoised, and what halves and light tell of its error over the pixels of the object."""
    raw = found.mean[..., :3]
    if found.passes < 2:
        return [(raw, np.inf), (denoise(found.mean), np.inf)]
    mixed, variance = MixedHalves.of(found, denoise), found.variance[inside, :3].sum()
    squared, noise = (x[inside].sum() for x in mixed.squared())
    whole = max(np.square(raw[inside]).sum() - variance, 1e-30)
    each = (raw, variance), (0.5 * (mixed.P + mixed.Q), max(squared, noise))
    light = found.light_error * found.share_of_interior(inside)
    return [(image, float(np.hypot(np.sqrt(off / whole), light))) for image, off in each]


def _averaged(images: np.ndarray, spp: int, light: float = 0.0) -> Reference:
    """The mean of passes, with that of half of them, and the error of the light that they share."""
    names = ["R", "G", "B", *LAYER]
    result = Reference.empty(images.shape[1:], {LIGHT: {"error": light}, CHANNELS: names}, halves=True)
    for image in images:
        result = result.add(image, spp, 0.0)
    return result


def _corrected(fresh: Callable[[], mi.Scene], limit: float, seed: int) -> Reference:
    """Two passes of most samples, a power of two, whose light and pixels take so many CPU seconds from fresh scenes."""
    spp, best = LEAST_SPP, None
    mi.render(fresh(), spp=1, seed=seed)  # compiles
    while spp <= MOST_SPP:
        scene, started = fresh(), time.process_time()
        scene.integrator().prepare(scene, 2 * spp * int(np.prod(sampled_size(scene.sensors()[0].film()))))
        images = np.array([image_of_pass(scene, spp, seed + k) for k in range(2)], dtype=np.float64)
        if time.process_time() - started > limit and best is not None:
            break
        best, spp = _averaged(images, spp, scene.integrator().corrections.error or 0.0), 2 * spp
    return best


def _samples(scene: mi.Scene | tuple[mi.Scene, ...], seconds: float, seed: int) -> int:
    """Samples of a pixel, a power of two, that take at most so many CPU seconds, but not half as many; at least one."""
    spp = 1
    _passes(scene, 0.0, spp, seed)  # compiles
    # the first pass of so many samples may compile
    while spp < MOST_SPP and min(_passes(scene, 0.0, 2 * spp, seed + spp + k)[1][0] for k in range(2)) < seconds:
        spp *= 2
    return spp


def _passes(
    scene: mi.Scene | tuple[mi.Scene, ...], seconds: float, spp: int, seed: int
) -> tuple[np.ndarray, list[float]]:
    """Images of passes until these have taken so many CPU seconds, and what each took; at least one."""
    images: list[np.ndarray] = []
    took: list[float] = []
    while not took or sum(took) < seconds:
        started = time.process_time()
        images.append(image_of_pass(scene, spp, seed + len(took)))
        took.append(time.process_time() - started)
    return np.array(images, dtype=np.float64), took


def image_of_pass(scene: mi.Scene | tuple[mi.Scene, ...], spp: int, seed: int) -> np.ndarray:
    """One image; three scenes have a channel each."""
    scenes = scene if isinstance(scene, tuple) else (scene,)
    parts = [np.array(mi.render(one, spp=spp, seed=seed + 100_000 * k)) for k, one in enumerate(scenes)]
    return parts[0] if len(parts) == 1 else np.stack([part[..., k] for k, part in enumerate(parts)], axis=2)


def _cost(images: np.ndarray, seconds: list[float], inside: np.ndarray) -> float:
    """Variance of a pass times its seconds, summed over the pixels of the object."""
    return float(images[:, inside].var(axis=0, ddof=1).sum() * np.mean(seconds))


def _error(image: np.ndarray, R: np.ndarray, noise: np.ndarray, inside: np.ndarray, size: int) -> float:
    """Of means over blocks of the object's pixels; the noise of the reference is taken off."""
    n = inside.shape[0] // size
    weight = inside[: n * size, : n * size].reshape(n, size, n, size).sum(axis=(1, 3))
    kept = weight >= size * size / 4

    def means(x: np.ndarray) -> np.ndarray:
        masked = np.where(inside[..., None], x, 0)[: n * size, : n * size]
        return masked.reshape(n, size, n, size, -1).sum(axis=(1, 3))[kept] / weight[kept][:, None]

    squares = (means(image) - means(R)) ** 2 - means(noise) / weight[kept][:, None]
    return float(np.sqrt(max(squares.sum(), 0) / (means(R) ** 2).sum()))
