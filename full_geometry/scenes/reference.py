"""Long renders in passes: they can be killed and resumed, and stop at an error, a number of passes or a time.

    reference.render("scene.xml", "truth.exr", integrator={"type": "translucent_walk"}, target_error=0.01)
    truth = reference.load("truth.exr")             # .mean, .variance, .standard_error, .about

The seed of pass k depends on the seed of the run and on k only, and the size of a pass on the samples before it, so
that a resumed run gives the same image, also one that was to have more samples from the start.

A denoised render has a total error: each half of the samples is denoised alone and held to the other half. With A and B
the means of independent halves of the samples, V_A and V_B their variances, L the image without noise and D a denoiser,
B has no bias and is independent of D(A):

    E[(D(A) - B)²] = e_A² + V_B,    e_A² = E[(D(A) - L)²].

So s = e² / (e² + V), of the sums over the image, makes the error of (1 - s) D(A) + s B least. Noise falls in means over
pixels, the bias of a denoiser hardly does. A share of its own is therefore that of coarse differences G (B - D(A)), G a
Gaussian filter:

    P = D(A) + K (B - D(A)),    Q = D(B) + K (A - D(B)),    K = s + (s_coarse - s) G.

The image (P + Q) / 2, which comes to L with the samples as the denoiser gives way, has the mean squared error

    e² = E[(P - B)² + (Q - A)² + N² - (A - B - N)²] / 2 - E[(P - Q)²] / 4,    N = K (A - B),

with the bias of the denoiser in it. A bias of what is denoised, as that of precomputed light, is not in it. Rousselle,
Knaus and Zwicker (2012) hold the halves of a render to each other.
"""

from __future__ import annotations

import math
import os
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import mitsuba as mi
import numpy as np
from scipy.ndimage import gaussian_filter

from full_geometry.geometry.sensors import sampled_size, seeded
from full_geometry.geometry.snapshot import children, integrator_words, scene_hash
from full_geometry.integrators.bssrdf import is_bssrdf
from full_geometry.objects.objects import translucent_shapes
from full_geometry.scenes.reference_store import (
    BY_CHANCE,
    CHANNELS,
    DENOISED,
    LIGHT,
    Reference,
    finite_pixels,
    load,
    save,
)
from full_geometry.scenes.scene_files import first_cause
from full_geometry.settings import AUTO, check_variant
from full_geometry.surface.wrapped import surface_of
from halfspace_sss.checks import check_count, check_interval
from halfspace_sss.provenance import check_folder, one_writer, provenance

COARSE = 3.0  # pixels, standard deviation of the filter
Denoise = Callable[[np.ndarray], np.ndarray]  # an image (H, W, channels) -> its colours without noise (H, W, 3)


class Denoised(NamedTuple):
    """A denoised image.

    Args:
        image: linear radiance (H, W, 3).
        error: sqrt(sum of e² / sum of L²) over pixels and colours; infinite where there are no two halves.
        standard_error: of the error.
    """

    image: np.ndarray
    error: float
    standard_error: float

    @property
    def told(self) -> str:
        """The error as a sentence."""
        if not math.isfinite(self.error):
            return "error of the denoised image: not known after one pass"
        return f"error of the denoised image {self.error:.2%} ± {self.standard_error:.2%}, bias of denoising included"


class MixedHalves(NamedTuple):
    """Halves of the samples, means A and B, with their shares of noise, (H, W, 3): see the head of this module."""

    P: np.ndarray
    Q: np.ndarray
    N: np.ndarray
    A: np.ndarray
    B: np.ndarray

    @classmethod
    def of(cls, found: Reference, denoise: Denoise) -> MixedHalves:
        """The halves of a render of at least two passes, by the shares of noise that make errors least."""
        n, spp = found.half_spp, found.spp
        A, B = found.half, (spp * found.mean - n * found.half) / (spp - n)
        D_A, D_B, A, B = denoise(A), denoise(B), A[..., :3], B[..., :3]
        # ---- differences from the denoised halves, and those of the noise, which cells of light share among pixels
        to_B, to_A, noise = B - D_A, A - D_B, A - B
        coarse = [gaussian_filter(x, (COARSE, COARSE, 0)) for x in (to_B, to_A, noise)]
        s, s_coarse = (_share(*parts) for parts in ((to_B, to_A, noise), coarse))

        # ---- K of each, but none where nothing is seen
        s, s_coarse = (np.where((A == 0) & (B == 0) & (D_A == 0) & (D_B == 0), 0, share) for share in (s, s_coarse))
        P, Q, N = (s * x + (s_coarse - s) * low for x, low in zip((to_B, to_A, noise), coarse))
        return cls(D_A + P, D_B + Q, N, A, B)

    def squared(self) -> tuple[np.ndarray, np.ndarray]:
        """Estimates of e² of the pixels, (H, W, 3), whose sums have less noise, and their part that is noise."""
        P, Q, N, A, B = self
        apart = (P - Q) ** 2
        result = 0.5 * ((P - B) ** 2 + (Q - A) ** 2 + N**2 - (A - B - N) ** 2) - 0.25 * apart
        # P - Q + N is of the denoised halves alone
        return result, 0.25 * (np.square(P - Q + N) + N**2)


def _share(A: np.ndarray, B: np.ndarray, noise: np.ndarray) -> float:
    """The share s of noisy halves, for differences of each denoised half from the other and of the noisy ones."""
    V = float(np.square(noise).sum())
    e = max(float(np.square(A).sum() + np.square(B).sum()) - V, 0.0)
    return e / (e + V) if e + V > 0 else 0.0


def cross_denoised(found: Reference, denoise: Denoise) -> Denoised:
    """The mean of both denoised halves of a render; all of it denoised where no halves are known.

    Args:
        found: with its half.
        denoise: a denoiser, as `trade.denoising.Denoiser`.
    """
    if found.half is None or found.passes < 2:
        return Denoised(denoise(found.mean), math.inf, math.inf)
    mixed = MixedHalves.of(found, denoise)
    squared, noise = mixed.squared()
    squared = squared.sum(axis=2).ravel()
    whole = max(float(np.square(found.mean[..., :3]).sum() - found.variance[..., :3].sum()), 1e-30)
    error = math.sqrt(max(float(squared.sum()), float(noise.sum())) / whole)
    spread = math.sqrt(squared.size) * float(squared.std()) / whole
    return Denoised(0.5 * (mixed.P + mixed.Q), error, spread / (2 * max(error, math.sqrt(spread), 1e-15)))


FEWEST_PASSES = 8  # before the spread of the passes is trusted to stop a run
SHARE = 4  # a growing pass has at most a quarter of the samples so far: enough passes for their spread, few launches
MOST_PIXELS = 2**26  # 8192 x 8192: the numbers of the pixels alone take some 10 GB
SOONEST, LATEST = 1.25, 4.0  # times the samples, at which the error of a denoised image is computed anew
LARGEST_PASS = 64  # samples per pixel: an interrupt waits for one pass
Progress = Callable[[Reference], None]


def render(
    scene: mi.Scene | dict[str, Any] | str | os.PathLike[str],
    path: str | os.PathLike[str],
    *,
    integrator: dict[str, Any] | None = None,
    sensor: int = 0,
    seed: int = 0,
    resume: bool | str | os.PathLike[str] = True,
    progress: Progress | None = None,
    denoise: Denoise | None = None,
    **limits: float | None,
) -> Reference:
    """Render a scene in passes into an EXR file, or go on with the file that is there.

    The run ends as soon as one of `spp`, `passes`, `target_error` and `seconds` is reached; all count what the file
    holds already. Under an interrupt or an error the passes so far are kept.

    Args:
        scene: a dict, the path of an XML file, or a Mitsuba scene.
        path: of the EXR file; a JSON file beside it repeats its header.
        integrator: dict of the integrator; by default that of the scene.
        sensor: number of the sensor.
        seed: of the run.
        resume: True goes on with the file at `path` if there is one, False begins anew, another path goes on with the
            file there and leaves it as it is.
        progress: called after each pass.
        denoise: a denoiser; then halves of the samples are kept, and `target_error` is the error of the denoised
            image, see `cross_denoising`.
        limits: fields of `Limits`, one of `spp`, `passes`, `target_error` and `seconds` at least.

    Raises:
        ValueError: an argument is out of range, the file is damaged, of another render or written by another run, or a
            pass has values that are not finite.
    """
    check_variant()
    until = Limits(**limits)
    check_count("seed", seed, 0)
    path = Path(path)
    if path.suffix.lower() != ".exr":
        raise ValueError(f"path must end in .exr, got {str(path)!r}")
    check_folder(path.parent)
    scene, integrator = loaded(scene, integrator, sensor)
    with one_writer(path):
        about = about_render(scene, integrator, sensor, seed) | chosen(scene, integrator)
        about["learnt"] = learnt(scene, integrator)
        return _in_passes(scene, integrator, path, about, until, resume, progress, denoise)


def _in_passes(
    scene: mi.Scene, integrator: mi.Integrator, path: Path, about: dict[str, Any], limits: Limits,
    resume: bool | str | os.PathLike[str], progress: Progress | None, denoise: Denoise | None,
) -> Reference:  # fmt: skip
    """Take passes until a limit is reached, and write the file now and then and at the end."""
    result = None
    if resume is not False and (resume is not True or path.exists()):
        before = path if resume is True else Path(resume)
        result = load(before)
        check_same(result, before, about)
    if denoise is not None and result is not None and result.half is None:
        raise ValueError(f"{path} must hold the halves of a denoised render to go on with it, got none; delete it")
    if denoise is None and result is not None:
        result = result.without_halves()
    written = result if resume is True else None
    last = time.monotonic()
    try:
        while not limits.reached(result):
            start = result or Reference.empty((), about, denoise is not None)
            result = _pass(start, scene, integrator, limits)
            if denoise is not None and limits.target_error is not None:
                result = _with_error(result, denoise, limits.target_error)
            if time.monotonic() - last >= limits.interval:
                _keep(path, result)
                written, last = result, time.monotonic()
            if progress is not None:
                progress(result)
    finally:
        if result is not None and result is not written:
            _keep(path, result)
    return result


def samples_to(error: float, target: float, spp: int) -> float:
    """Samples at which an error that falls by their root comes down to a target, `SOONEST` to `LATEST` times `spp`."""
    return spp * min(max((error / target) ** 2, SOONEST), LATEST)


def _with_error(found: Reference, denoise: Denoise, target: float) -> Reference:
    """A render that knows the error of its denoised image, of now or of the samples before it may be at the target."""
    known = found.about.get(DENOISED)
    if found.passes < FEWEST_PASSES or (known and found.spp < samples_to(found.error, target, known["spp"])):
        return found
    _, error, standard_error = cross_denoised(found, denoise)
    known = {"spp": found.spp, "error": error, "standard_error": standard_error}
    return replace(found, about={**found.about, DENOISED: known})


def _keep(path: Path, reference: Reference) -> None:
    """Save, also if an interrupt comes in the middle of it."""
    try:
        save(path, reference)
    except KeyboardInterrupt:
        save(path, reference)
        raise


@dataclass(frozen=True)
class Limits:
    """Limits of a run, whichever comes first, and how it goes there; None is no limit.

    Args:
        spp: samples per pixel in all.
        passes: number of passes in all.
        target_error: `Reference.error` to come down to; looked at from the 8th pass on. Where corrected light
            has all its walks, it is enough that noise is below it and below the error of light.
        seconds: of rendering in all.
        spp_per_pass: samples per pixel of a pass; by default passes grow with what is there, from 1 to 64. The last
            one is cut to `spp`.
        interval: seconds between writes of the file; 0 writes after every pass.
    """

    spp: int | None = None
    passes: int | None = None
    target_error: float | None = None
    seconds: float | None = None
    spp_per_pass: int | None = None
    interval: float = 30.0

    def __post_init__(self) -> None:
        ends = ("spp", "passes", "target_error", "seconds")
        if all(getattr(self, name) is None for name in ends):
            raise ValueError(f"one of {', '.join(ends)} must be given, got none")
        for name in ("spp", "passes", "spp_per_pass"):
            if getattr(self, name) is not None:
                check_count(name, getattr(self, name), 1)
        if self.target_error is not None:
            check_interval("target_error", self.target_error, 1e-6, 1.0)  # 4 is meant as 4 %
        if self.seconds is not None and not (math.isfinite(self.seconds) and self.seconds > 0):
            raise ValueError(f"seconds must be finite and > 0, got {self.seconds!r}")
        if not self.interval >= 0:
            raise ValueError(f"interval must be >= 0, got {self.interval!r}")

    def next_spp(self, reference: Reference | None) -> int:
        """Samples per pixel of the next pass; a power of two where it grows, for Mitsuba compiles others anew."""
        done = reference.spp if reference else 0
        size = self.spp_per_pass or min(2 ** (max(done // SHARE, 1).bit_length() - 1), LARGEST_PASS)
        return size if self.spp is None else min(size, self.spp - done)

    def reached(self, reference: Reference | None) -> bool:
        if reference is None:
            return False
        trusted = reference.passes >= FEWEST_PASSES
        pairs = ((self.spp, reference.spp), (self.passes, reference.passes), (self.seconds, reference.seconds))
        certain = self.target_error is not None and trusted and self._certain(reference)
        return certain or any(limit is not None and value >= limit for limit, value in pairs)

    def _certain(self, reference: Reference) -> bool:
        light = reference.about.get(LIGHT, {"finest": False})
        # light that has all its walks gets no better
        enough = light["finest"] and reference.noise <= min(light["now"], self.target_error)
        return enough or reference.error <= self.target_error

    def share(self, reference: Reference) -> float:
        """The share of the work that is done, 0 to 1."""
        pairs = ((reference.spp, self.spp), (reference.passes, self.passes), (reference.seconds, self.seconds))
        shares = [value / limit for value, limit in pairs if limit is not None]
        if self.target_error is not None and reference.passes > 1:
            error = reference.error
            shares.append((self.target_error / error) ** 2 if error > self.target_error else 1.0)
        return min(max(shares, default=0.0), 1.0)


def _pass(start: Reference, scene: mi.Scene, integrator: mi.Integrator, limits: Limits) -> Reference:
    about, number, spp = start.about, start.passes, limits.next_spp(start if start.passes else None)
    started, sensor, seed = time.perf_counter(), about["sensor"], seeded(about["seed"], number)
    # corrected light, as asked for or as chosen
    if is_bssrdf(integrator) and (integrator.settings.light == "corrected" or integrator.corrections.told()):
        samples = (start.spp + spp) * int(np.prod(sampled_size(scene.sensors()[sensor].film())))
        integrator.prepare(scene, _samples_of_light(start, samples, limits))
    image = mi.render(scene, sensor=sensor, integrator=integrator, seed=seed, spp=spp)
    image = finite_pixels(f"pass {number}", image)
    if not number:
        names = channel_names(scene.sensors()[sensor].film(), integrator, image.shape[2])
        about = {**about, CHANNELS: names} if names else about
        start = Reference.empty(image.shape, about, start.half is not None)
    result = start.add(image, spp, time.perf_counter() - started)
    if not is_bssrdf(integrator):
        return result
    made = integrator.corrections
    if made.error is not None:
        now = made.error * result.share_of_interior()
        error = (start.light_error * start.spp + now * spp) / result.spp
        light = {"error": float(f"{error:.6g}"), "now": float(f"{now:.6g}")}
        light |= {"samples": made.samples, "finest": made.finest}
        result = replace(result, about={**result.about, LIGHT: light})
    if mi.is_spectral:
        return result
    squares = float(f"{start.about.get(BY_CHANCE, 0.0) + integrator.unconnected:.6g}")
    return replace(result, about={**result.about, BY_CHANCE: squares})


def _samples_of_light(start: Reference, samples: int, limits: Limits) -> int:
    """Samples whose walks corrected light has in a pass: all so far, to a power of two, or twice those of the pass
    before while light takes more than half of the square of an asked error."""
    result, light = 2 ** (samples.bit_length() - 1), start.about.get(LIGHT)
    if limits.target_error is not None and light and light["now"] > math.sqrt(0.5) * limits.target_error:
        result = max(result, 2 * light["samples"])
    return result


def channel_names(film: mi.Film, integrator: mi.Integrator, channels: int) -> list[str]:
    """Names of the channels of an image that `integrator` rendered to a film; none of an image of colours alone.

    The integrator `aov` gives the images of those inside it, each with the colours of the film, then its own
    quantities, such as albedo.R; its film has four colours of each.
    """
    of_film, more = [channel.name for channel in film.bitmap().struct_()], integrator.aov_names()
    colours, inner = of_film[: len(of_film) - len(more)], []
    for name in more:
        parts = [name[:-1] + colour for colour in "RGBA"]
        inner += [name[:-2]] if name.endswith(".R") and set(parts) <= set(more) else []
    own = [name for name in more if name[:-2] not in inner]
    of_inner = [f"{name}.{colour}" if k else colour for k, name in enumerate(inner) for colour in colours]
    known = (of_film, of_inner + own) if more else ()
    return next((names for names in known if len(names) == channels), [])


def loaded(
    scene: mi.Scene | dict[str, Any] | str | os.PathLike[str], integrator: dict[str, Any] | None, sensor: int
) -> tuple[mi.Scene, mi.Integrator]:
    """The scene and its integrator as Mitsuba objects; errors as of `render`."""
    if isinstance(scene, (str, os.PathLike)) and not Path(scene).is_file():
        raise ValueError(f"scene must be a dict, a Mitsuba scene or a file, got {os.fspath(scene)!r}")
    try:
        if isinstance(scene, dict):
            scene = mi.load_dict(scene, parallel=False)
        elif isinstance(scene, (str, os.PathLike)):
            scene = mi.load_file(os.fspath(scene), parallel=False)
        integrator = mi.load_dict(integrator) if integrator is not None else scene.integrator()
    except RuntimeError as error:
        raise ValueError(first_cause(error)) from error
    if integrator is None:
        raise ValueError("integrator must be given, for the scene has none")
    check_sensor(scene, sensor)
    return scene, integrator


def check_sensor(scene: mi.Scene, sensor: int) -> None:
    """ValueError unless there is such a sensor, with a film that has pixels and fits into memory."""
    n = len(scene.sensors())
    if n == 0:
        raise ValueError("the scene must have a sensor, got none")
    check_count("sensor", sensor, 0)
    if sensor >= n:
        raise ValueError(f"sensor must be below {n}, the number of sensors of the scene, got {sensor}")
    width, height = (int(size) for size in scene.sensors()[sensor].film().crop_size())
    if not 0 < width * height <= MOST_PIXELS:
        raise ValueError(f"a film must have 1 to {MOST_PIXELS} pixels, got {width} x {height}")


def about_render(scene: mi.Scene, integrator: mi.Integrator, sensor: int, seed: int) -> dict[str, Any]:
    """The identity of a render, with its provenance."""
    about = {
        "scene": scene_hash(scene, integrator),
        "integrator": integrator_words(integrator),
        "sensor": sensor,
        "seed": int(seed),
        "variant": mi.variant(),
    }
    return {**about, "provenance": provenance(**about)}


def chosen(scene: mi.Scene, integrator: mi.Integrator) -> dict[str, Any]:
    """The choice of "auto" and its reasons; it is made now if it has not been."""
    if not is_bssrdf(integrator):
        return {}
    models = [surface.spec.model for surface in map(surface_of, translucent_shapes(scene))]
    if AUTO not in (integrator.settings.model, integrator.settings.light, *models):
        return {}
    integrator.prepare(scene)
    result = integrator.choices
    return {"choices": result.sentences, "chosen": [result.light, *result.models.values()]}


def check_same(reference: Reference, path: Path, about: dict[str, Any]) -> None:
    """ValueError if an image of a file is of another render, so that it cannot be gone on with."""
    for key in ("scene", "integrator", "sensor", "seed", "variant", "learnt", "chosen"):
        there, here = reference.about.get(key, []), about.get(key, [])
        if there != here:
            raise ValueError(
                f"{path} must be of the same render to go on with it: {key} is {there!r} there and {here!r} here; "
                "choose another file or delete it"
            )
    versions = [p["provenance"]["versions"] for p in (reference.about, about)]
    if versions[0] != versions[1]:
        raise ValueError(f"{path} must be of the same versions to go on with it, got {versions[0]} and {versions[1]}")


def learnt(scene: mi.Scene, integrator: mi.Integrator) -> list[str]:
    """Checksums of what the models of the objects have learnt, for an integrator that asks them, or holds one.

    The same scene is another render after a training.
    """
    if is_bssrdf(integrator):
        objects = (obj.gathered.object if obj.gathered else obj for obj in integrator.prepare(scene))
        transports = (obj.transport for obj in objects if obj.transport is not None)
        return sorted({checksum for transport in transports for checksum in transport.checksums})
    return [checksum for inner in children(integrator) for checksum in learnt(scene, inner)]
