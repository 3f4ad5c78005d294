"""Walks whose image is denoised: what is left of their noise and what the denoiser blurs, by tiles of the image.

The samples of a tile are in two halves A and B. A denoised part D of the samples of A is held to the rest A' of A and
to B, see `scenes.reference`. Each half has precomputed light of its own with noise W; the denoiser leaves s of that:

    E[(D - A')²] - V_A' = e² + (1 - s)² W,    E[(D - B)²] - V_B = e² + (1 + s²) W.

Their difference 2 s W tells s where W is known, from plain walks by both lights. Over the samples n of a pixel e²
falls as c n^-a. Parts of more and more samples tell c and a by least squares with the covariance of blocks of pixels:
what the noise of A' adds to all parts alike is not taken for error. The light of a half is for m samples, and an image
of n samples has that of as many. A render mixes denoised halves with what was denoised (`MixedHalves`), whose noise is
V / n:

    e²(n) = c n^-a (V / n) / (c n^-a + V / n) + W m / n.

Tiles have pixels as large as those of the image: what a denoiser blurs is as large as some pixels. Emission that the
camera sees, at once or in a mirror, is not denoised. Fireflies (`statistics`) count as the next brightest sample: one
of them would be the error of all tiles.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy.ndimage import uniform_filter
from scipy.special import ndtr

from full_geometry.geometry.sensors import seeded
from full_geometry.objects.objects import translucent_shapes
from full_geometry.trade.denoising import GUIDE_SPP, GUIDES, clean_guides, denoised, guides_of
from full_geometry.trade.images import film_of, pixel_means, pixels_of
from full_geometry.trade.results import DOUBT, TechniqueTrade
from full_geometry.trade.sampling import seen_through
from full_geometry.trade.statistics import Number
from full_geometry.trade.techniques import PRECOMPUTED, Effort, Stage, Technique
from halfspace_sss.backend import clock

SIDE, MARGIN = 24, 4  # of a tile, pixels; beside the margin errors of a whole image are the same
TILES, WANTED = (4, 25), 48  # of an image, by the samples of a half that are wanted
PILOT = 8  # samples of each place that say where tiles are drawn
SPREAD = 0.5  # relative, of e² in tiles of an object
LEAST_DENSITY = 0.02  # of tiles, over the largest
PASSES, LEVELS = 4, (1, 2)  # of a half; passes that are denoised after each round
BLOCK = 8  # pixels, beyond which errors of a denoised image are taken to be independent
LANES = 2**20  # samples of a launch
FIRST, FURTHER = 1 / 16, 3  # share of the time for the first samples; times the samples so far, the next
KNOWN = 0.15  # relative standard error of e² that is enough
POWERS, POWER, POWER_SPREAD = np.linspace(0.1, 1.1, 21), 0.6, 0.1  # of seven scenes: 0.52 to 0.70
TIMED = 128  # pixels along the image by which the denoiser is timed
TOLD = 2.0  # standard errors of W from which on it is told apart, and of what is taken off for it
UNKNOWN = 1e6  # e²
SAMPLES = 2.0 ** (np.arange(81) / 4)  # of a pixel


class Walked(NamedTuple):
    """Plain walks of an object.

    Args:
        radiance: its mean.
        row: what was found of them.
        pace: seconds of a sample without precomputing light.
        limits: of each channel, the brightest samples that are no fireflies.
        light: W m, over the square of the mean radiance.
        lit: m.
    """

    radiance: float
    row: TechniqueTrade
    pace: float
    limits: np.ndarray
    light: Number
    lit: float

    @property
    def variance(self) -> float:
        """Variance of a sample, without that of light."""
        return max(self.row.variance - self.light.value, 1e-12)


def denoised_rows(
    on: Stage, technique: Technique, found: Sequence[Walked | None], effort: Effort, seconds: float,
    tolerance: float | None, enough: float,
) -> list[TechniqueTrade | None]:  # fmt: skip
    """What denoised walks are worth on each object: rows whose variance falls by a power of their samples, as it is
    where they keep the tolerance. `technique`: denoised walks. `found`: of the same walks as they are; None for an
    object that is not seen. `seconds`: for all objects. `enough`: relative error of e² that ends it where there is a
    tolerance."""
    # ---- tiles of the image, as many as leave each the samples that are wanted
    started = clock()
    camera, seed, quick = on.scene.sensors()[effort.sensor], effort.seed, technique.light == PRECOMPUTED
    film = tuple(int(n) for n in camera.film().crop_size())
    seen, halves = [k for k, each in enumerate(found) if each], (technique.halves[0], technique.halves[-1])
    of_tile = 2 * SIDE**2 * max(found[k].pace for k in seen)
    number = int(np.clip(seconds / (WANTED * of_tile), *TILES))
    limits = np.max([found[k].limits for k in seen], axis=0)
    places = _places(on, halves[0], camera, film, limits, seed)
    tiles = Tiles(on, camera, film, [places[seen[k % len(seen)]] for k in range(number)], seed)

    # ---- samples of both halves, until errors are known or the time is over
    expected = each = 2 * PASSES * sum(float(tiles.seen[k]) * found[k].pace for k in seen)  # seconds of a sample of all
    spp = 0
    while True:
        left = int((seconds + started - clock()) / each)
        more = min(left, FURTHER * spp) if spp else max(int(FIRST * left), 1)
        if more < max(spp / 2, 1):
            break
        began = clock()
        for half, part in enumerate(halves):
            number = seeded(seed, 62, half, spp)
            passes = _passes(on, part, camera, film, tiles.pixels, limits, (PASSES, more, number))
            tiles.take(half, passes, spp, more)
        spp, each = spp + more, (clock() - began) / more
        tiles.denoise(spp, quick)
        laws = {k: _law(tiles, k, found[k]) for k in seen}
        ends = [laws[k].end(found[k].row, tolerance, PASSES * spp) for k in seen]
        alone = [laws[k].denoised(n) for k, n in zip(seen, ends)]
        if tolerance and all(e.error <= enough * e.value for e in alone):
            break

    # ---- the law of each object about the samples that keep the tolerance
    black = np.zeros((TIMED, TIMED, 3), dtype=np.float32)
    of_half, of_guide = (denoised(black, black, black, clean=True, quick=each)[1] for each in (quick, True))
    # two halves are denoised, two guides lose their noise, and to render these takes as long as one of them
    of_image = (2 * of_half + 3 * of_guide) / black[..., 0].size * math.prod(film) / len(seen)
    rows: list[TechniqueTrade | None] = [None] * len(found)
    for k, n in zip(seen, ends):
        plain, e = found[k].row, laws[k].at(n)
        pace = plain.seconds + (each / expected - 1) * found[k].pace
        power = float(np.clip(math.log(e.value / laws[k].at(2 * n).value) / math.log(2), 0.05, 2.0))
        rows[k] = replace(
            plain, way=technique.name, variance=e.value * n**power, variance_error=e.error * n**power, power=power,
            seconds=pace, of_image=of_image, samples=2 * PASSES * spp * int(tiles.seen[k]),
        )  # fmt: skip
    return rows


# --------------------------------------------------------------------------------------------------
# Tiles, and their samples.
#
# Errors of denoised images gather at edges, tips and in shadows. Where samples differ more, tiles are drawn more often,
# and count the less.


class Tiles:
    """Windows of the film.

    Attributes:
        pixels: x and y of all (n, 2), row by row of each window.
        guides: albedo and normals of the denoiser without their noise, each (rows H, columns W, 3), side by side.
        shape: tiles, H, W.
        weights: inverse densities of the pixels of each object that count, else 0, (tiles, H, W, objects).
        seen: how many pixels show each object.
        halves: means of the passes of each half, (passes, tiles, H, W, 3).
        parts: samples of a pixel, and both halves of so many samples denoised.
    """

    def __init__(
        self, on: Stage, camera: mi.Sensor, film: tuple[int, int], densities: Sequence[np.ndarray], seed: int
    ) -> None:
        """Windows about places drawn from densities over the film, (H, W), one for each; without samples yet."""
        # ---- places, by numbers that are even over all densities
        rng, size = np.random.default_rng(seed), np.minimum(film, SIDE)
        corners = []
        for k, p in enumerate(densities):
            at = np.searchsorted(np.cumsum(p.ravel()), (k + rng.random()) / len(densities) * p.sum())
            y, x = divmod(min(int(at), p.size - 1), film[0])
            corners.append(np.clip(np.array([x, y]) - size // 2, 0, np.array(film) - size))

        # ---- guides, covers and weights
        self.pixels = pixels = np.concatenate([pixels_of(size, corner) for corner in corners])
        shape = (len(corners), int(size[1]), int(size[0]))
        found = pixel_means(camera, film, pixels, GUIDE_SPP, seeded(seed, 61), _aovs_of(on.scene)).reshape(*shape, -1)
        near = sum(uniform_filter(p, SIDE - 2 * MARGIN, mode="constant") for p in densities)
        drawn = near[pixels[:, 1], pixels[:, 0]].reshape(*shape, 1)
        self.guides, self.shape = clean_guides(guides_of(_side_by_side(found[..., :6]))), shape
        covered = found[..., 6:] > 0
        self.weights, self.seen = covered / np.maximum(drawn, LEAST_DENSITY * drawn.max()), covered.sum(axis=(0, 1, 2))
        for tile, corner in zip(self.weights, corners):
            tile *= _inner(size, corner, film)[..., None]
        self.halves: list[np.ndarray] = [np.zeros(())] * 2
        self.parts: list[tuple[int, list[np.ndarray]]] = []

    def take(self, half: int, passes: np.ndarray, before: int, spp: int) -> None:
        """Add `spp` samples to the passes of a half, (passes, pixels, 3), of `before` samples so far."""
        passes = passes.reshape(PASSES, *self.shape, 3)
        self.halves[half] = (before * self.halves[half] + spp * passes) / (before + spp)

    def denoise(self, spp: int, quick: bool) -> None:
        """Denoise the first passes of each half, which have so many samples, all tiles side by side; `quick`: see
        `denoised`."""
        for n in LEVELS:
            images = [_side_by_side(half[:n].mean(axis=0)) for half in self.halves]
            clean = [denoised(x, *self.guides, clean=True, quick=quick)[0] for x in images]
            self.parts.append((n * spp, [_apart(x, self.shape) for x in clean]))

    def squares(self, k: int) -> tuple[np.ndarray, np.ndarray]:
        """Sums over blocks of object k, (2 parts, blocks), and their weights: squared differences of each part from the
        rest of its half, then from the other half, without the noise of these."""
        means, noise = zip(*((half.mean(axis=0), half.var(axis=0, ddof=1) / PASSES) for half in self.halves))
        rest = [half[max(LEVELS) :] for half in self.halves]
        own, own_noise = zip(*((each.mean(axis=0), each.var(axis=0, ddof=1) / len(each)) for each in rest))

        def held(D: Sequence[np.ndarray], to: Sequence[np.ndarray], V: Sequence[np.ndarray]) -> np.ndarray:
            return sum(0.5 * ((d - mean) ** 2 - v) for d, mean, v in zip(D, to, V)).mean(axis=3)

        rows = [held(D, own, own_noise) for _, D in self.parts]
        rows += [held(D, means[::-1], noise[::-1]) for _, D in self.parts]
        at = np.nonzero(self.weights[..., k])
        w = self.weights[..., k][at]
        _, block = np.unique([at[0], at[1] // BLOCK, at[2] // BLOCK], axis=1, return_inverse=True)
        block = block.ravel()
        return np.array([np.bincount(block, w * row[at]) for row in rows]), np.bincount(block, w)


def _side_by_side(tiles: np.ndarray) -> np.ndarray:
    """One image (rows H, columns W, channels) of tiles (n, H, W, channels), single precision."""
    n, height, width, channels = tiles.shape
    columns = math.ceil(math.sqrt(n))
    whole = np.zeros((math.ceil(n / columns) * columns, height, width, channels), dtype=np.float32)
    whole[:n] = tiles
    grid = whole.reshape(-1, columns, height, width, channels).swapaxes(1, 2)
    return np.ascontiguousarray(grid).reshape(-1, columns * width, channels)


def _apart(image: np.ndarray, shape: tuple[int, int, int]) -> np.ndarray:
    """The tiles (n, H, W, channels) of an image of them; `shape`: n, H, W."""
    n, height, width = shape
    grid = image.reshape(-1, height, image.shape[1] // width, width, image.shape[2]).swapaxes(1, 2)
    return grid.reshape(-1, height, width, image.shape[2])[:n]


def _places(
    on: Stage, technique: Technique, camera: mi.Sensor, film: tuple[int, int], limits: np.ndarray, seed: int
) -> list[np.ndarray]:
    """Densities of tiles of each object over the film, (H, W)."""
    small = film_of(np.array(film))
    pixels = pixels_of(small)
    covers = pixel_means(camera, small, pixels, PILOT, seeded(seed, 60), _aovs_of(on.scene))[:, 0, 6:]
    found = _passes(on, technique, camera, small, pixels, limits, (PILOT, 1, seeded(seed, 63)))
    spread = found.std(axis=0).mean(axis=1)
    rows, columns = (np.arange(n) * m // n for n, m in ((film[1], small[1]), (film[0], small[0])))
    places = []
    for cover in covers.T:
        p = cover * (spread + (cover * spread).sum() / max(cover.sum(), 1e-9)) + 1e-12
        places.append((p / p.sum()).reshape(small[1], small[0])[rows][:, columns])
    return places


def _inner(size: np.ndarray, corner: np.ndarray, film: tuple[int, int]) -> np.ndarray:
    """Pixels of a tile that are no margin; a border of the film is one of the whole image too."""
    inner = []
    for axis in (1, 0):
        lines = np.arange(size[axis])
        near = (lines < MARGIN) & (corner[axis] > 0)
        inner.append(~(near | ((lines >= size[axis] - MARGIN) & (corner[axis] + size[axis] < film[axis]))))
    return inner[0][:, None] & inner[1][None]


def _aovs_of(scene: mi.Scene) -> Callable[..., list[mi.Float]]:
    """Traces guides of a denoiser, and the cover of each translucent object."""
    integrator, shapes = mi.load_dict({"type": "aov", "aovs": GUIDES}), translucent_shapes(scene)

    def traced(sampler: mi.Sampler, ray: mi.Ray3f, weight: mi.Spectrum) -> list[mi.Float]:
        aovs = integrator.sample(scene, sampler, mi.RayDifferential3f(ray), None, mi.Bool(True))[2]
        si = seen_through(scene, shapes, scene.ray_intersect(ray))
        return [*aovs, *(dr.select(si.is_valid() & (si.shape == mi.ShapePtr(each)), mi.Float(1), 0) for each in shapes)]

    return traced


def _passes(
    on: Stage, technique: Technique, camera: mi.Sensor, film: tuple[int, int], pixels: np.ndarray, limits: np.ndarray,
    how: tuple[int, int, int],
) -> np.ndarray:  # fmt: skip
    """Passes over pixels without the emission that is told apart, (passes, pixels, 3).
    `limits`: of samples of each channel. `how`: passes, samples of each, seed."""
    integrator, (passes, spp, seed) = on.integrator(technique), how
    limits = [dr.opaque(mi.Float, float(limit)) for limit in limits]

    def traced(sampler: mi.Sampler, ray: mi.Ray3f, weight: mi.Spectrum) -> list[mi.Float]:
        L, _, emission = integrator.sample(on.scene, sampler, ray, None, mi.Bool(True))
        columns = [w * dr.minimum(c - e, limit) for w, c, e, limit in zip(weight, L, emission, limits)]
        return columns if len(columns) == 3 else columns * 3

    most, done, whole = max(LANES // (len(pixels) * passes), 1), 0, 0.0
    while done < spp:
        n = min(most, spp - done)
        found = pixel_means(camera, film, pixels, n, seeded(seed, done), traced, passes)
        whole, done = whole + n * found, done + n
    return np.maximum(whole / spp, 0).transpose(1, 0, 2)


# --------------------------------------------------------------------------------------------------
# What levels of samples say of other numbers of samples.


class ErrorLaw(NamedTuple):
    """The squared error of a denoised image over its samples n of a pixel, as in the head of this module.

    Args:
        powers: a, (k,).
        weights: how likely each of them is, (k,).
        means, errors: of c, which is not below 0, with standard errors, (k,).
        variance: V.
        light: W m.
        spread: relative standard error of c beside `errors`.
    """

    powers: np.ndarray
    weights: np.ndarray
    means: np.ndarray
    errors: np.ndarray
    variance: float
    light: Number
    spread: float = 0.0

    @classmethod
    def of(
        cls, n: Sequence[float], values: np.ndarray, covariance: np.ndarray, variance: float, light: Number
    ) -> ErrorLaw:
        """The law of e² at several n.
        `values`, `covariance`: of e², relative to the squared mean radiance."""
        levels, rows = np.asarray(n, dtype=float), []
        inverse = np.linalg.pinv(covariance, rcond=1e-9, hermitian=True)
        for a in POWERS:
            x = levels**-a
            square = float(x @ inverse @ x)
            c, error = float(x @ inverse @ values) / square, square**-0.5
            r = values - c * x
            weight = math.exp(-0.5 * ((a - POWER) / POWER_SPREAD) ** 2 - 0.5 * min(float(r @ inverse @ r), 400.0))
            rows.append((weight * error * max(float(ndtr(c / error)), 1e-300), *not_negative(Number(c, error))))
        weights, means, errors = np.array(rows).T
        return cls(POWERS, weights / max(weights.sum(), 1e-300), means, errors, variance, light)

    def denoised(self, n: float) -> Number:
        """c n^-a."""
        x = n**-self.powers
        value = float(self.weights @ (x * self.means))
        square = float(self.weights @ (x**2 * (self.means**2 + self.errors**2)))
        return Number(value, math.sqrt(max(square - value**2, 0.0) + (self.spread * value) ** 2))

    def at(self, n: float) -> Number:
        """e² of n samples of a pixel."""
        c, light = self.denoised(n), self.light
        share = self.variance / n / (c.value + self.variance / n)
        return Number(c.value * share + light.value / n, math.hypot(c.error * share**2, light.error / n))

    def end(self, plain: TechniqueTrade, tolerance: float | None, measured: float) -> float:
        """The fewest samples that bring e² and the bias² of the walks within the tolerance, `measured` without one."""
        left = (tolerance or 0.0) ** 2 - max(plain.bias2, 0.0)
        for n in SAMPLES if left > 0 else ():
            e = self.at(n)
            if e.value + DOUBT * math.hypot(e.error, plain.bias2_error) <= left:
                return float(n)
        return float(measured)


def not_negative(found: Number) -> Number:
    """Mean and standard deviation of what was measured as `found` and cannot be below 0, by a normal distribution."""
    t = found.value / found.error
    if t < -6:  # the tail is exponential there
        return Number(found.error / -t, found.error / -t)
    ratio = math.exp(-0.5 * t * t) / math.sqrt(2 * math.pi) / float(ndtr(t))
    spread = max(1 - t * ratio - ratio**2, 0.0)
    return Number(found.value + found.error * ratio, found.error * math.sqrt(spread))


def _law(tiles: Tiles, k: int, found: Walked) -> ErrorLaw:
    sums, pixels = tiles.squares(k)
    if len(pixels) < 2:  # so little of it is in the tiles that the plain noise is all that is known
        one = np.ones(1)
        return ErrorLaw(POWER * one, one, UNKNOWN * one, 0 * one, found.variance, found.light)
    values = sums.sum(axis=1) / pixels.sum()
    rest = (sums - np.outer(values, pixels)) / (pixels.sum() * found.radiance**2)
    covariance = rest @ rest.T * len(pixels) / (len(pixels) - 1)
    n = [n for n, _ in tiles.parts]
    own, other = values.reshape(2, len(n)) / found.radiance**2
    own_light = np.zeros(len(n))
    if found.light.value > TOLD * found.light.error:
        W = found.light.value / found.lit
        own_light = W * (1 - np.clip((other - own) / (2 * W), 0, 1)) ** 2
    known = covariance[: len(n), : len(n)] + np.diag(own_light / TOLD) ** 2
    law = ErrorLaw.of(n, own - own_light, known, found.variance, found.light)
    return law._replace(spread=SPREAD / math.sqrt(len(tiles.weights)))
