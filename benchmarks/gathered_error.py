"""How far gathered light is off: from the same model by sampled light, and from walks."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import pandas

from benchmarks.lit_objects import LitObject, scene_of, train
from benchmarks.timed import rendered
from figures.computing.contenders import WALK
from figures.computing.scans import prepare
from figures.parts.part import Row
from full_geometry.integrators.gathering import Gathering
from full_geometry.trade.denoising import cover
from halfspace_sss.neural.store import weights_in

if TYPE_CHECKING:
    import mitsuba as mi

PASS = 64  # samples of a pixel at a time
SAMPLED, ADDED, GATHERED = KINDS = "sampled over walks", "gathered over sampled", "gathered over walks"


@dataclass(frozen=True)
class Comparing:
    """What is compared.

    Args:
        models: of `lit_objects.MODELS`.
        spp: samples of a pixel of sampled images and of walks, an eighth for each gathering; at least 16.
        gatherings: by different seeds, at least 2.
        size: pixels of the square images.
        seconds: CPU time of a training of `full_geometry`.
        seed: of all renders.
    """

    models: tuple[str, ...]
    spp: int = 2048
    gatherings: int = 3
    size: int = 64
    seconds: float = 24.0
    seed: int = 0


class Off(NamedTuple):
    """Root mean square of differences over that of the reference, its standard error, and the ratio of means."""

    rms: float
    error: float
    mean: float


def gathered_errors(
    cases: Sequence[LitObject], how: Comparing, folder: Path, progress: Callable[[str, int, int], None]
) -> pandas.DataFrame:
    """For each object in its light and each model the errors of sampled and gathered light in %, all orders.

    Args:
        cases: objects in their light.
        how: they are compared.
        folder: for weights and meshes.
        progress: called with what, done and all.

    Raises:
        ValueError: a model refuses an object.
    """
    prepare()
    rows, total = [], len(cases) * len(how.models)
    for k, case in enumerate(cases):
        if "full_geometry" in how.models:
            train(case, how.seconds, folder)
        with weights_in(folder):  # first, as they may refuse the object
            scenes = {model: scene_of(case, f"{model}, gathered", how.size, folder) for model in how.models}
        walk = scene_of(case, WALK, how.size, folder)
        inside = cover(walk) > 0.999
        progress(f"{case.name}, {case.light}", k * len(how.models), total)
        walked = _halves(walk, how.spp, inside, how.seed, 0)
        for j, (model, gathers) in enumerate(scenes.items(), 1):
            with weights_in(folder):
                samples = scene_of(case, f"{model}, sampled", how.size, folder)
            rows.append({"object": case.name, "light": case.light, "model": model})
            rows[-1] |= _of_model(gathers, samples, how, inside, walked)
            progress(f"{case.name}, {case.light}", k * len(how.models) + j, total)
    return pandas.DataFrame(rows)


def _of_model(gathers: mi.Scene, samples: mi.Scene, how: Comparing, inside: np.ndarray, walked: np.ndarray) -> Row:
    """Errors by the scenes of a model."""
    found = []
    for k in range(how.gatherings):
        gathers.integrator().gathering = Gathering(seed=k)
        found.append(_halves(gathers, how.spp // 8, inside, how.seed, 1 + k))
    images, sampled = np.array(found), _halves(samples, how.spp, inside, how.seed, 1 + how.gatherings)
    row = _row(SAMPLED, off(sampled[None], walked)) | _row(ADDED, off(images, sampled))
    return row | _row(GATHERED, off(images, walked))


def _row(kind: str, found: Off) -> dict[str, float]:
    return {f"{kind}, %": 100 * found.rms, f"± {kind}": 100 * found.error, f"mean, {kind}": found.mean}


def shown(table: pandas.DataFrame) -> pandas.DataFrame:
    """Errors with what is uncertain of them, and means of the image, as text."""
    found = table[["object", "light", "model"]].copy()
    for kind in KINDS:
        rows = table[[f"{kind}, %", f"± {kind}", f"mean, {kind}"]].to_numpy()
        found[f"{kind}, %"] = [f"{rms:.1f} ± {error:.1f}" for rms, error, _ in rows]
        found[f"mean, {kind}"] = [f"{mean:.3f}" for *_, mean in rows]
    return found


def _halves(scene: mi.Scene, spp: int, inside: np.ndarray, *seed: int) -> np.ndarray:
    """Two independent images of half the samples, (2, pixels, channels)."""
    each = min(PASS, spp // 2)
    passes = spp // (2 * each)
    return np.array(
        [
            np.mean([rendered(scene, each, *seed, half, n)[0][inside] for n in range(passes)], axis=0, dtype=float)
            for half in (0, 1)
        ]
    )


def off(found: np.ndarray, reference: np.ndarray) -> Off:
    """How far images are off, without the noise of their samples.

    Halves are independent, so that the mean of (x_1 - y_1) (x_2 - y_2) is that of the square of the difference.

    Args:
        found: halves x by each gathering, (gatherings, 2, pixels, channels).
        reference: halves y, (2, pixels, channels).
    """
    square = (found - reference).prod(axis=1).mean(axis=-1)  # of gatherings and pixels
    whole = reference.prod(axis=0).mean()
    gatherings, pixels = square.shape
    variance = square.mean(axis=0).var(ddof=1) / pixels
    if gatherings > 1:
        variance += square.mean(axis=1).var(ddof=1) / gatherings
    rms = np.sqrt(max(square.mean(), 0.0) / whole)
    error = np.sqrt(variance) / whole / max(2 * rms, variance**0.25 / whole**0.5)
    return Off(float(rms), float(error), float(found.mean() / reference.mean()))
