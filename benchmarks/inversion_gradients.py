"""Gradients of an image by the medium of an object, measured: `translucent_walk` beside Mitsuba's `prbvolpath`.

A step is the image and the derivative of its mean by the albedo of each channel, under a lamp and a dim sky: of walks
by the same paths, as `fit` takes them; of `prbvolpath` by a render and a pass backwards. With v the variance of a
gradient over its square, mean over channels, and t the CPU seconds of a step, v t is what counts. `prbvolpath` leaves
out all that is scattered more often than its depth. First steps include compilation, where Dr.Jit's cache has no
kernels (`DRJIT_CACHE_DIR` may name an empty folder).
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np

from benchmarks.mitsuba_media import with_media
from figures.computing.scans import SCANS, scan_scene
from full_geometry.scenes.scene_files import PATH_TRACED, load_scene
from halfspace_sss.progress import NamedProgress

CASES = {f"{scan}, eta {eta}": (scan, eta) for scan in ("bunny", "dragon") for eta in (1.0, 1.4)}
DEPTHS = (64, 256)
MEDIUM = {"albedo": "0.95, 0.89, 0.82", "sigma_t": "2.4"}  # 1/mm
REPEATS, WALK_REPEATS = 20, 12


class Steps(NamedTuple):
    """Gradients (n, 3) of steps of independent samples, their variance (3,), CPU seconds of one, and of the first."""

    gradients: np.ndarray
    variances: np.ndarray
    seconds: float
    first: float

    @property
    def variance(self) -> float:
        """Of a step over the squared gradient, mean over channels."""
        return float((self.variances / self.gradients.mean(axis=0) ** 2).mean())

    @property
    def red(self) -> tuple[float, float]:
        """The gradient by the albedo of the first channel, the largest, and its standard error."""
        return float(self.gradients[:, 0].mean()), float(np.sqrt(self.variances[0] / len(self.gradients)))


def gradient_rows(case: str, size: int, spp: int, seed: int, progress: NamedProgress | None = None) -> list[dict]:
    """Of each way: the gradient, how far it is below that of the walk, its noise and time.

    Args:
        case: of `CASES`.
        size: pixels of the square image.
        spp: samples a pixel.
        seed: of all samples.
        progress: called with (what, done, total).
    """
    scan, eta = CASES[case]
    description = scan_scene("potato", size, scan=scan)
    description[scan]["bsdf"] = {"type": "translucent", **MEDIUM, "eta": eta}
    description["sky"] = {"type": "constant", "radiance": 0.15}
    unit = SCANS[scan].mm_per_unit
    description["integrator"] = {"type": "translucent_walk", "mm_per_unit": unit}
    ways: dict[str, Callable[[], mi.Scene]] = {"walk": lambda: load_scene(description, PATH_TRACED)}
    for depth in DEPTHS:
        prb = {"type": "prbvolpath", "max_depth": depth}
        ways[f"prbvolpath, depth {depth}"] = lambda prb=prb: with_media(description, unit, prb)
    rows, walk = [], None
    for k, (way, made) in enumerate(ways.items()):
        if progress:
            progress(f"{case}, {way}", k, len(ways))
        found = _steps(made(), spp, REPEATS if walk else WALK_REPEATS, seed)
        walk = walk or found
        (g, error), (of_walk, its_error) = found.red, walk.red
        below = 1 - g / of_walk
        rows.append({
            "case": case, "way": way, "gradient R": g, "below the walk, %": 100 * below,
            "±": 100 * (1 - below) * float(np.hypot(error / g, its_error / of_walk)) if found is not walk else 0.0,
            "noise of a step, %": 100 * found.variance**0.5, "CPU s a step": found.seconds,
            "first step, CPU s": found.first,
            "time for equal noise": found.variance * found.seconds / (walk.variance * walk.seconds),
        })  # fmt: skip
    return rows


def _steps(scene: mi.Scene, spp: int, repeats: int, seed: int) -> Steps:
    parameters = mi.traverse(scene)
    key = next(k for k in parameters.keys() if k.endswith(("bsdf.albedo", "albedo.value.value")))
    gradients, pixels, seconds, walks = [], [], [], hasattr(scene.integrator(), "render_derivatives")
    for k in range(repeats + 1):  # the first compiles
        seeds = np.random.SeedSequence([seed, k]).generate_state(2)
        value = type(parameters[key])(dr.detach(parameters[key]))
        at = time.process_time()
        dr.enable_grad(value)
        parameters[key] = value
        parameters.update()
        if walks:
            _, (slopes,) = scene.integrator().render_derivatives(scene, [value], seed=int(seeds[0]), spp=spp)
            slopes = np.array(slopes, dtype=float) / 3
            gradients.append(slopes.mean(axis=(0, 1)))
            pixels.append(slopes)
        else:
            image = mi.render(scene, parameters, spp=spp, seed=int(seeds[0]), seed_grad=int(seeds[1]))
            dr.backward(dr.mean(image, axis=None))
            gradients.append(np.ravel(np.array(dr.grad(parameters[key]), dtype=float)))
        seconds.append(time.process_time() - at)
    variances = np.var(gradients, axis=0, ddof=1)
    if walks:  # of the sum of independent pixels, of which there are many
        variances = np.var(pixels, axis=0, ddof=1).mean(axis=(0, 1)) / pixels[0][..., 0].size
    return Steps(np.array(gradients), variances, float(np.median(seconds[1:])), seconds[0])
