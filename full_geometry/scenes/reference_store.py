"""The file of a long render: mean and variance of the mean as channels of one EXR, what it is of in its header; its
picture.

Each quantity q is two float32 channels, q and q.rest, whose sum holds 48 bits: the state after a pass is rounded to
that, so that a run that is read back goes on with the same numbers as one that was never interrupted. For
denoised renders the file also has the mean of half of the passes.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np

from full_geometry.settings import LAYER
from halfspace_sss.provenance import write_together

FORMAT = "halfspace-sss reference 3"
HEADER = "halfspace_sss"
CHANNELS = "channels"  # their names
DENOISED = "denoised"  # error of the denoised image, its standard error, and the samples that it is of
LIGHT = "light"  # error that corrected light makes, the mean over samples and now; samples that have its walks; if all
BY_CHANCE = "squares_by_chance"  # of light that orders below two met by chance, summed over samples


@dataclass(frozen=True, eq=False)
class Reference:
    """The average of passes of a render.

    Args:
        mean: image, float64, shape (height, width, channels).
        variance: of the mean, per pixel and channel, from the spread of the passes; zero after one pass.
        spp: samples per pixel of all passes together.
        about: what was rendered: scene (hash), integrator, seed, and provenance.
        half: mean of the passes of one half, float64, shape of `mean`; None where no half is kept.
    """

    mean: np.ndarray
    variance: np.ndarray
    passes: int
    spp: int
    seconds: float
    about: dict[str, Any] = field(default_factory=dict)
    half: np.ndarray | None = None
    half_spp: int = 0

    @classmethod
    def empty(cls, shape: tuple[int, ...], about: dict[str, Any], halves: bool = False) -> Reference:
        """Before the first pass; with `halves` the mean of half of the passes is kept."""
        return cls(np.zeros(shape), np.zeros(shape), 0, 0, 0.0, about, np.zeros(shape) if halves else None)

    def without_halves(self) -> Reference:
        """As it would be if no half had been kept."""
        about = {name: value for name, value in self.about.items() if name != DENOISED}
        return replace(self, about=about, half=None, half_spp=0)

    @property
    def standard_error(self) -> np.ndarray:
        """The standard error of the mean, per pixel and channel; infinite after fewer than two passes."""
        return np.sqrt(self.variance) if self.passes > 1 else np.full_like(self.mean, np.inf)

    @property
    def relative_error(self) -> float:
        """sqrt(sum variance / sum mean²) over the colours of lit pixels (mean > 0), 0 if every pass was black.
        Infinite before two passes."""
        lit = self.mean[..., :3] > 0
        if self.passes < 2:
            return math.inf
        if not lit.any():
            return math.inf if self.mean[..., :3].any() else 0.0
        return float(np.sqrt(self.variance[..., :3][lit].sum() / np.sum(self.mean[..., :3][lit] ** 2)))

    @property
    def noise(self) -> float:
        """`relative_error`, or with halves the most that the denoised image is off: its error and one standard error.
        Infinite before that is known."""
        if self.half is None:
            return self.relative_error
        known = self.about.get(DENOISED)
        return known["error"] + known["standard_error"] if known else math.inf

    @property
    def light_error(self) -> float:
        """The error of corrected light in the image, which passes share, so that their spread does not show it."""
        return self.about.get(LIGHT, {}).get("error", 0.0)

    def share_of_interior(self, pixels: np.ndarray | slice = slice(None)) -> float:
        """sqrt(sum (L - L_e)² / sum L²) over pixels: how much of an error of light from inside is one of the image.
        L_e is the layer of emission; 1 without it."""
        names = self.about.get(CHANNELS, [])
        if names[:3] != ["R", "G", "B"] or names[-3:] != LAYER:
            return 1.0
        L, L_e, variance = (x[pixels] for x in (self.mean[..., :3], self.mean[..., -3:], self.variance[..., :3]))
        whole = np.square(L).sum() - variance.sum()
        return min(float(np.sqrt(np.square(L - L_e).sum() / whole)), 1.0) if whole > 0 else 1.0

    @property
    def error(self) -> float:
        """What the image is off: its noise and `light_error`, without a layer of emission as if objects filled it."""
        return math.hypot(self.noise, self.light_error)

    @property
    def share_by_chance(self) -> float | None:
        """Most of the variance that is light which orders below two meet by chance; None where it is not known.
        At most: the square of its mean is not taken off, which is small where it makes much noise. Other filters than a
        box, which share samples among pixels, make it larger, and so do samples of low discrepancy."""
        whole = self.variance[..., :3].sum()
        if BY_CHANCE not in self.about or self.passes < 2:
            return None
        return min(self.about[BY_CHANCE] / self.spp**2 / whole, 1.0) if whole > 0 else 0.0

    def add(self, image: np.ndarray, spp: int, seconds: float) -> Reference:
        """The average with one more pass of spp samples per pixel, rounded to what a file keeps.
        Passes count by their samples n_k: mean m = sum n_k x_k / N, variance of the mean sum n_k (x_k - m)² / ((K - 1)
        N), updated as by West (1979). A pass joins the half of fewer samples."""
        n, passes = self.spp + spp, self.passes + 1
        delta = image.astype(np.float64) - self.mean
        mean = self.mean + delta * (spp / n)
        squares = self.variance * self.spp * (self.passes - 1) + spp * delta * (image - mean)
        variance = squares / (n * (passes - 1)) if passes > 1 else np.zeros_like(mean)
        half, half_spp = self.half, self.half_spp
        if half is not None and 2 * half_spp <= self.spp:
            half_spp += spp
            half = sum(_two_floats(half + (image - half) * (spp / half_spp)))
        mean, variance = sum(_two_floats(mean)), sum(_two_floats(variance))
        seconds += self.seconds
        return Reference(mean, variance, passes, n, seconds, self.about, half, half_spp)


def finite_pixels(name: str, image: mi.TensorXf) -> np.ndarray:
    """An image that was rendered, (height, width, channels) in float32; ValueError if a value of it is not finite."""
    pixels = np.array(image, dtype=np.float32)
    pixels = pixels[..., None] if pixels.ndim == 2 else pixels
    if not np.isfinite(pixels).all():
        bad = int((~np.isfinite(pixels)).any(axis=2).sum())
        raise ValueError(f"{name} must be finite, got {bad} pixels that are not")
    return pixels


def _two_floats(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A float64 array as the sum of two whose values are float32."""
    high = values.astype(np.float32).astype(np.float64)
    return high, (values - high).astype(np.float32).astype(np.float64)


def _names(channels: int, about: dict[str, Any]) -> list[str]:
    """Names of channels: those in `about` if all their parts differ, else colours or numbers."""
    given, known = about.get(CHANNELS, []), {1: ["Y"], 3: ["R", "G", "B"], 4: ["R", "G", "B", "A"]}
    if len(given) == channels and len(set(_of_parts(given, True))) == 6 * channels:
        return given
    return known.get(channels) or [f"channel{k}" for k in range(channels)]


def _of_parts(names: list[str], halves: bool) -> list[str]:
    parts = ("{}", "variance.{}", "rest.{}", "variance.rest.{}", "half.{}", "half.rest.{}")
    return [part.format(name) for part in parts[: 6 if halves else 4] for name in names]


def save(path: Path, reference: Reference) -> None:
    """Write the EXR, whole or not at all, and beside it the JSON of its header for people to read, never of another."""
    (mean, mean_rest), (variance, variance_rest) = _two_floats(reference.mean), _two_floats(reference.variance)
    halves = [] if reference.half is None else _two_floats(reference.half)
    parts = [mean, variance, mean_rest, variance_rest, *halves]
    pixels = np.ascontiguousarray(np.concatenate(parts, axis=2), dtype=np.float32)
    header = {
        "format": FORMAT,
        "passes": reference.passes,
        "spp": reference.spp,
        "seconds": reference.seconds,
        **({"half_spp": reference.half_spp} if halves else {}),
        "relative_error": reference.relative_error if math.isfinite(reference.relative_error) else None,
        "share_by_chance": reference.share_by_chance,
        "pixels": hashlib.sha256(pixels.tobytes()).hexdigest(),
        **reference.about,
    }
    names = _of_parts(_names(reference.mean.shape[2], reference.about), bool(halves))
    bitmap = mi.Bitmap(pixels, mi.Bitmap.PixelFormat.MultiChannel, channel_names=names)
    text = json.dumps(header, indent=1)
    bitmap.metadata()[HEADER] = text
    write_together({path: _written(bitmap, mi.Bitmap.FileFormat.OpenEXR), path.with_suffix(".json"): text + "\n"})


def load(path: str | os.PathLike[str]) -> Reference:
    """Read the file of a reference.
    ValueError if there is no such file, or it is damaged or not one of these; the message names it."""
    name = os.fspath(path)
    if not Path(name).is_file():
        raise ValueError(f"reference must be a file, got {name!r}")
    try:
        bitmap = mi.Bitmap(name)
        pixels = np.array(bitmap)
        header = json.loads(bitmap.metadata()[HEADER])
    except (RuntimeError, KeyError, json.JSONDecodeError) as error:
        raise ValueError(f"{name} must be an EXR file written by reference.render: {error}") from error
    names = [channel.name for channel in bitmap.struct_()]
    halves = isinstance(header, dict) and "half_spp" in header
    parts = 6 if halves else 4
    wanted = _of_parts(_names(len(names) // parts, header), halves) if isinstance(header, dict) else []
    if not isinstance(header, dict) or header.get("format") != FORMAT or sorted(names) != sorted(wanted):
        raise ValueError(f"{name} must have the format {FORMAT!r}, got channels {names}")
    pixels = np.ascontiguousarray(pixels[..., [names.index(key) for key in wanted]])
    if hashlib.sha256(pixels.tobytes()).hexdigest() != header.pop("pixels", None):
        raise ValueError(f"{name} is damaged: its pixels are not those that were written")
    try:
        passes, spp, seconds = int(header.pop("passes")), int(header.pop("spp")), float(header.pop("seconds"))
        half_spp = int(header.pop("half_spp", 0))
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(f"{name} must tell passes, spp and seconds: {error!r}") from error
    for key in ("format", "relative_error", "share_by_chance"):
        header.pop(key, None)
    mean, variance, mean_rest, variance_rest, *half = np.split(pixels.astype(np.float64), parts, axis=2)
    half = sum(half) if halves else None
    return Reference(mean + mean_rest, variance + variance_rest, passes, spp, seconds, header, half, half_spp)


# --------------------------------------------------------------------------------------------------
# A finished render as what people look at.


@dataclass(frozen=True, eq=False)
class Picture:
    """A render to be drawn.

    Args:
        title: name of the scene and the model.
        image: linear radiance (H, W, 3).
        numbers: name -> what is known of it.
        caption: a sentence.
        clean: the denoised image (H, W, 3), and numbers of it; None if there is none.
    """

    title: str
    image: np.ndarray
    numbers: Mapping[str, str]
    caption: str
    clean: tuple[np.ndarray, Mapping[str, str]] | None = None


def as_exr(image: np.ndarray) -> bytes:
    """Numbers (H, W, channels) as they are."""
    return _written(mi.Bitmap(np.ascontiguousarray(image, dtype=np.float32)), mi.Bitmap.FileFormat.OpenEXR)


def as_png(image: np.ndarray) -> bytes:
    """Linear radiance (H, W, channels) as a display shows it."""
    return _written(mi.util.convert_to_bitmap(mi.TensorXf(image.astype(np.float32))), mi.Bitmap.FileFormat.PNG)


def _written(bitmap: mi.Bitmap, kind: mi.Bitmap.FileFormat) -> bytes:
    stream = mi.MemoryStream()
    bitmap.write(stream, kind)
    return bytes(stream.raw_buffer())
