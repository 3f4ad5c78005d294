"""Whether gathered light as control variate leaves the means of a model as they are: a z-test of many samples."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas

from figures.beyond.speeds import LitObject, scene_of, train
from figures.computing.images import cover
from figures.computing.scenes import prepare
from figures.computing.timed import rendered
from halfspace_sss.neural.store import weights_in

WITHOUT, WITH = "sampled", "corrected"


@dataclass(frozen=True)
class Testing:
    """What is tested.

    Args:
        models: of `speeds.MODELS`.
        samples: of all pixels and both kinds, of each model.
        size: pixels of the square images.
        passes: images that the samples are parted into, each with light gathered anew, at least 8.
        seconds: CPU time of a training of `full_geometry`.
        seed: of all renders.
    """

    models: tuple[str, ...]
    samples: int = 10**7
    size: int = 64
    passes: int = 40
    seconds: float = 12.0
    seed: int = 0


def means(
    case: LitObject, how: Testing, folder: Path, progress: Callable[[str, int, int], None] = lambda *_: None
) -> pandas.DataFrame:
    """For each model the mean over the object with the control variate over that without, and z-values.

    Orders from two on, as the others have no control variate. With the difference d_k of two images of the same seed,
    z = mean(d) / sqrt(variance(d) / passes). Light that is gathered for an image is in all its pixels, and so in d_k.

    Args:
        case: an object in its light.
        how: it is tested.
        folder: for weights and meshes.
        progress: called with what, done and all.

    Raises:
        ValueError: the images are too small for a control variate to pay, so that there is none.
    """
    prepare()
    spp, total, rows = max(how.samples // (2 * how.passes * how.size**2), 1), len(how.models) * how.passes, []
    if "full_geometry" in how.models:
        train(case, how.seconds, folder)
    for k, model in enumerate(how.models):
        with weights_in(folder):
            scenes = [
                scene_of(case, f"{model}, {kind}", how.size, folder, orders="multiple") for kind in (WITHOUT, WITH)
            ]
            inside, images = cover(scenes[0]) > 0.999, []
            for n in range(how.passes):
                progress(model, k * how.passes + n, total)
                images.append([rendered(scene, spp, how.seed, k, n)[0][inside] for scene in scenes])
            if all((one == other).all() for one, other in images):
                raise ValueError(f"size must be larger for a control variate of {model} to pay, got {how.size}")
        rows.append({"model": model, **_compared(np.array(images, dtype=np.float64))})
    return pandas.DataFrame(rows)


def _compared(images: np.ndarray) -> dict[str, Any]:
    """Of (passes, kinds, pixels, channels): ratios of means, z of each channel, and those of pixels."""
    mean, variance = images.mean(axis=(0, 2)), images.var(axis=0, ddof=1).mean(axis=(1, 2))
    difference = images[:, 1] - images[:, 0]
    (z, error), pixels = _z(difference.mean(axis=1)), _z(difference)[0]
    found: dict[str, Any] = {}
    for c, of_one in enumerate(mean[0]):
        found |= {f"ratio {c}": mean[1, c] / of_one, f"± {c}": error[c] / of_one, f"z {c}": z[c]}
    return {
        **found, "variance, with over without": variance[1] / variance[0], "pixels x channels": pixels.size,
        "of |z| > 2": float(np.mean(np.abs(pixels) > 2)), "largest |z|": float(np.abs(pixels).max()),
    }  # fmt: skip


def _z(difference: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """z of the mean over passes, and its standard error."""
    error = difference.std(axis=0, ddof=1) / np.sqrt(len(difference))
    return difference.mean(axis=0) / np.maximum(error, 1e-30), error
