"""Small images of a scene by each way, and how different they look: FLIP."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np

from full_geometry.geometry.sensors import independent, seeded
from full_geometry.objects.objects import translucent_shapes
from full_geometry.scenes.reference import Halves
from full_geometry.scenes.scene_files import PATH_TRACED
from full_geometry.trade.denoising import GUIDE_SPP, GUIDES, denoised, guides_of
from full_geometry.trade.image_differences import mean_flip
from full_geometry.trade.results import Assessment, TechniqueTrade
from full_geometry.trade.sampling import radiance
from full_geometry.trade.statistics import Number, ratio
from full_geometry.trade.techniques import Stage, Technique, stage
from halfspace_sss.backend import clock

SIDE, SPP = 40, 32


def small_images(
    on: Stage, chosen: Sequence[Technique], sensor: int, seed: int, side: int = SIDE, spp: int = SPP
) -> dict[str, np.ndarray]:
    """Linear images (H, W, 3) of the ways that do not refuse the scene, by name; one seed for all.
    `chosen`: ways. `side`: longest side, pixels."""
    camera = on.scene.sensors()[sensor]
    film = camera.film()
    small = _film(np.array(film.crop_size(), dtype=int), side)
    results = {}
    for k, technique in enumerate(chosen):
        try:
            image = _rendered(on.scene, camera, on.integrator(technique), small, spp, seeded(seed, 51, k))
        except (ValueError, RuntimeError):
            continue
        results[technique.name] = image
    return results


def _film(size: np.ndarray, side: int) -> tuple[int, int]:
    scale = min(side / size.max(), 1.0)
    return tuple(int(v) for v in np.maximum(np.rint(size * scale), 4))


def _rendered(
    scene: mi.Scene, camera: mi.Sensor, integrator: mi.Integrator, size: tuple[int, int], spp: int, seed: int
) -> np.ndarray:
    """Rays of the camera over its whole film, averaged in fewer pixels."""

    def traced(sampler: mi.Sampler, ray: mi.Ray3f, weight: mi.Spectrum) -> list[mi.Float]:
        return [w * c for w, c in zip(weight, radiance(scene, integrator, sampler, ray))]

    image = _averaged(camera, Window.of(size), spp, seed, traced)
    return np.maximum(image.repeat(3, axis=2) if image.shape[2] == 1 else image, 0).astype(np.float32)


class Window(NamedTuple):
    """Pixels of a film: how many, where they begin, and how many the film has."""

    size: tuple[int, int]
    corner: tuple[int, int]
    film: tuple[int, int]

    @classmethod
    def of(cls, film: tuple[int, int]) -> Window:
        """All pixels."""
        return cls(film, (0, 0), film)


def _averaged(
    camera: mi.Sensor, window: Window, spp: int, seed: int,
    traced: Callable[[mi.Sampler, mi.Ray3f, mi.Spectrum], list[mi.Float]],
) -> np.ndarray:  # fmt: skip
    """Means over the samples of each pixel (H, W, columns) of what rays of the camera bring."""
    size, film = window.size, window.film
    n = size[0] * size[1] * spp
    sampler = independent(seed, n)
    index = dr.arange(mi.UInt32, n) // dr.opaque(mi.UInt32, spp)
    x, y = index % dr.opaque(mi.UInt32, size[0]), index // dr.opaque(mi.UInt32, size[0])
    corner = mi.Vector2f(*(dr.opaque(mi.Float, c) for c in window.corner))
    inverse = mi.Vector2f(dr.opaque(mi.Float, 1 / film[0]), dr.opaque(mi.Float, 1 / film[1]))
    position = (mi.Vector2f(x, y) + corner + sampler.next_2d()) * inverse
    ray, weight = camera.sample_ray_differential(camera.shutter_open(), 0.5, mi.Point2f(position), sampler.next_2d())
    ray = mi.Ray3f(ray.o + dr.zeros(mi.Point3f, n), ray.d + dr.zeros(mi.Vector3f, n))
    columns = [dr.block_sum(c + dr.zeros(mi.Float, n), spp).numpy() / spp for c in traced(sampler, ray, weight)]
    return np.stack(columns, axis=1).reshape(size[1], size[0], -1)


# --------------------------------------------------------------------------------------------------
# Walks whose image is denoised: what is left of their noise and what the denoiser blurs, by tiles of the image.
#
# Halves of the passes are denoised and held to each other, see `scenes.cross_denoising`. Tiles have pixels as large as
# those of the image: what a denoiser blurs is as large as some pixels. Emission that the camera sees, at once or in a
# mirror, is not denoised.


TILE, MARGIN, TILES, MOST_TILES = 40, 4, 3, 8  # pixels; beside the margin errors of a whole image are the same
PASSES, LEVELS = 8, (2, 4, 8)  # of a half; passes that are denoised
BLOCK = 4  # pixels, beyond which errors of a denoised image are taken to be independent


class DenoisingBudget(NamedTuple):
    """What denoised walks are measured by: seconds for all objects, the tolerance if there is one, sensor and seed."""

    seconds: float
    tolerance: float | None
    sensor: int
    seed: int


def denoised_rows(
    on: Stage, technique: Technique, found: Sequence[tuple[float, TechniqueTrade] | None], budget: DenoisingBudget
) -> list[TechniqueTrade | None]:
    """What denoised walks are worth on each object. The row of an object is of the fewest samples of a pixel that keep
    the tolerance, of the most if none does. `technique`: denoised walks. `found`: mean radiance of each object, and the
    row of the same walks as they are; None where it is not seen."""
    # ---- tiles of the image, with guides and covers of objects
    camera, tolerance = on.scene.sensors()[budget.sensor], budget.tolerance or 0.0
    film = tuple(int(n) for n in camera.film().crop_size())
    tiles, whole = _tiles(on, camera, film, [k for k, each in enumerate(found) if each], budget.seed)
    started = clock()
    aovs = [_averaged(camera, tile, GUIDE_SPP, seeded(budget.seed, 61), _aovs_of(on.scene)) for tile in tiles]
    guiding = clock() - started

    # ---- as many samples as the time allows, and as much time as the plainer walks leave worth it
    seconds = sum(float((a[..., 6 + k] > 0).sum()) * f[1].seconds for a in aovs for k, f in enumerate(found) if f)
    enough = max(f[1].variance for f in found if f) / (tolerance or 0.01) ** 2 / PASSES
    spp = max(int(min(budget.seconds / max(2 * PASSES * seconds, 1e-12), enough)), 1)
    errors: list[list[_TileErrors]] = []
    for number, (tile, a) in enumerate(zip(tiles, aovs)):
        pair = (technique.halves[0], technique.halves[-1])
        halves = [_passes(on, h, camera, tile, spp, seeded(budget.seed, 62, number, k)) for k, h in enumerate(pair)]
        started = clock()
        clean = [[denoised(_mean(h[:n]), *guides_of(a[..., :6]))[0] for n in LEVELS] for h in halves]
        guiding += (clock() - started) / (2 * len(LEVELS))
        errors.append([_tile_errors(tile, a[..., 6 + k] > 0, halves, clean) for k in range(len(found))])

    # ---- seconds of an image beside its samples, and the fewest of these
    beside = guiding * math.prod(film) / sum(math.prod(tile.size) for tile in tiles)
    rows: list[TechniqueTrade | None] = []
    for k, each in enumerate(found):
        if each is None:
            rows.append(None)
            continue
        values = [_over_tiles([tile[k] for tile in errors], level, each[0]) for level in range(len(LEVELS))]
        allowed = tolerance**2 - max(each[1].bias2, 0.0) - each[1].bias2_error
        kept = [n for n, e in enumerate(values) if e.value + e.error <= allowed]
        level = min(kept, default=len(LEVELS) - 1)
        n, e = LEVELS[level] * spp, values[level]
        of_sample = beside / max(float(whole[k]) * math.prod(film) * n, 1e-9)
        # both halves have the bias of the walks
        bias2, doubt = max(each[1].bias2, 0.0) + e.value, math.hypot(each[1].bias2_error, e.error)
        samples = 2 * PASSES * spp * sum(int(tile[k].number.sum()) for tile in errors)
        rows.append(replace(
            each[1], way=technique.name, bias2=bias2, bias2_error=doubt, variance=0.0, variance_error=0.0,
            seconds=each[1].seconds + of_sample, samples=samples, least=n,
        ))  # fmt: skip
    return rows


def _mean(passes: np.ndarray) -> np.ndarray:
    return passes.mean(axis=0).astype(np.float32)


def _tiles(
    on: Stage, camera: mi.Sensor, film: tuple[int, int], objects: Sequence[int], seed: int
) -> tuple[list[Window], np.ndarray]:
    """Tiles around random places of objects, and the share of the film that each object covers."""
    rng, small = np.random.default_rng(seed), _film(np.array(film), SIDE)
    covers = _averaged(camera, Window.of(small), 4, seeded(seed, 60), _aovs_of(on.scene))[..., 6:]
    size, result = np.minimum(film, TILE), []
    for k in range(min(max(TILES, len(objects)), MOST_TILES)):
        seen = covers[..., objects[k % len(objects)]].ravel()
        at = rng.choice(len(seen), p=seen / seen.sum()) if seen.any() else 0
        centre = (np.array([at % small[0], at // small[0]]) + rng.random(2)) * np.array(film) / small
        corner = np.clip(centre - size / 2, 0, np.array(film) - size).astype(int)
        result.append(Window(tuple(int(n) for n in size), tuple(int(n) for n in corner), film))
    return result, covers.mean(axis=(0, 1))


class _TileErrors(NamedTuple):
    """Of an object, sums over blocks of a tile: squared errors of each level (levels, blocks), and pixels (blocks,)."""

    squares: np.ndarray
    number: np.ndarray


def _tile_errors(
    tile: Window, mask: np.ndarray, halves: Sequence[np.ndarray], clean: Sequence[Sequence[np.ndarray]]
) -> _TileErrors:
    inner = np.ones_like(mask)
    for axis in (0, 1):  # a border of the film is one of the whole image too
        first, size, film = tile.corner[1 - axis], tile.size[1 - axis], tile.film[1 - axis]
        lines = np.arange(size)
        near = ((lines < MARGIN) & (first > 0)) | ((lines >= size - MARGIN) & (first + size < film))
        inner &= ~near[:, None] if axis == 0 else ~near[None]
    mask = mask & inner
    y, x = np.nonzero(mask)
    _, block = np.unique(y // BLOCK * mask.shape[1] + x // BLOCK, return_inverse=True)
    means, noise = zip(*((half.mean(axis=0), half.var(axis=0, ddof=1) / len(half)) for half in halves))
    rows = []
    for D in zip(*clean):
        e_A, e_B = Halves(*means, *noise, *D).held()
        rows.append(np.bincount(block, 0.5 * (e_A + e_B).mean(axis=2)[mask]))
    return _TileErrors(np.array(rows), np.bincount(block))


def _over_tiles(tiles: Sequence[_TileErrors], level: int, radiance: float) -> Number:
    """Mean squared error over the squared mean radiance, with the spread over blocks and over tiles as its error."""
    blocks = np.concatenate([tile.squares[level] for tile in tiles]), np.concatenate([tile.number for tile in tiles])
    if len(blocks[1]) < 2:
        return Number(math.nan, math.inf)
    of_blocks = ratio(*blocks)
    seen = [tile for tile in tiles if len(tile.number)]
    sums = np.array([tile.squares[level].sum() for tile in seen]), np.array([tile.number.sum() for tile in seen])
    of_tiles = ratio(*sums).error if len(seen) > 1 else 0.0
    return Number(of_blocks.value / radiance**2, max(of_blocks.error, of_tiles) / radiance**2)


def _aovs_of(scene: mi.Scene) -> Callable[..., list[mi.Float]]:
    """Traces guides of a denoiser, and the cover of each translucent object."""
    integrator, shapes = mi.load_dict({"type": "aov", "aovs": GUIDES}), translucent_shapes(scene)

    def traced(sampler: mi.Sampler, ray: mi.Ray3f, weight: mi.Spectrum) -> list[mi.Float]:
        aovs = integrator.sample(scene, sampler, mi.RayDifferential3f(ray), None, mi.Bool(True))[2]
        si = scene.ray_intersect(ray)
        return [*aovs, *(dr.select(si.is_valid() & (si.shape == mi.ShapePtr(each)), mi.Float(1), 0) for each in shapes)]

    return traced


def _passes(on: Stage, technique: Technique, camera: mi.Sensor, window: Window, spp: int, seed: int) -> np.ndarray:
    """Images of passes without the emission that is told apart, (passes, H, W, 3)."""
    integrator = on.integrator(technique)

    def traced(sampler: mi.Sampler, ray: mi.Ray3f, weight: mi.Spectrum) -> list[mi.Float]:
        L, _, emission = integrator.sample(on.scene, sampler, ray, None, mi.Bool(True))
        columns = [w * (c - e) for w, c, e in zip(weight, L, emission)]
        return columns if len(columns) == 3 else columns * 3

    return np.maximum([_averaged(camera, window, spp, seeded(seed, k), traced) for k in range(PASSES)], 0)


def with_flip(
    on: Stage,
    chosen: Sequence[Technique],
    assessment: Assessment,
    sensor: int,
    seed: int,
    images: Mapping[str, np.ndarray] | None = None,
    spp: int = SPP,
) -> Assessment:
    """The assessment with FLIP of the whole small image, where the evaluator is installed and something shines.
    `chosen`: ways, path traced first. `images`: of `small_images`, if they have been rendered, with `spp` samples a
    pixel."""
    if find_spec("flip_evaluator") is None or all(o.is_dark for o in assessment.objects):
        return assessment
    measured = {PATH_TRACED, *(w.way for o in assessment.objects for w in o.ways if not w.refusal)}
    shown = [
        technique for technique in chosen if technique.name in measured
    ]  # others would gather light for a number that is not told
    images = small_images(on, shown, sensor, seed, spp=spp) if images is None else images
    truth = images[PATH_TRACED]
    again = small_images(on, [chosen[0]], sensor, seeded(seed, 52), max(truth.shape), spp)[PATH_TRACED]
    noise = mean_flip(truth, again)
    values = {name: noise if name == PATH_TRACED else mean_flip(truth, image) for name, image in images.items()}
    objects = []
    for o in assessment.objects:
        rows = tuple(replace(w, flip=values.get(w.way), flip_noise=noise) if not w.refusal else w for w in o.ways)
        objects.append(replace(o, ways=rows))
    return replace(assessment, objects=tuple(objects))


# --------------------------------------------------------------------------------------------------
# What the figure of a trade is drawn from.


PAGE_SIDE = 128  # of the images of the page


@dataclass(frozen=True, eq=False)
class TradePicture:
    """A trade to be drawn.
    `found`: what was measured. `tolerance`: that was asked. `sentences`: of the recommendation. `images`: linear
    radiance (H, W, 3) by name of the way, path traced first."""

    title: str
    found: Assessment
    tolerance: float
    sentences: tuple[str, ...] = ()
    images: Mapping[str, np.ndarray] = field(default_factory=dict)


def picture_of(
    file: Path, assessment: Assessment, tolerance: float, sentences: Sequence[str], how: Mapping[str, Any]
) -> TradePicture:
    """The picture of a recommendation for a scene file, whose images are rendered for it.
    `assessment`: what was measured. `tolerance`: that was asked. `sentences`: of the recommendation. `how`: sensor,
    seed and parameters, as for `assess`."""
    names = dict.fromkeys(w.way for o in assessment.objects for w in o.ways if not w.refusal)
    images: Mapping[str, np.ndarray] = {}
    if names:
        on = stage(file, how["parameters"])
        images = small_images(on, [Technique.of(name) for name in names], how["sensor"], how["seed"], PAGE_SIDE, SPP)
    return TradePicture(file.stem, assessment, tolerance, tuple(sentences), images)
