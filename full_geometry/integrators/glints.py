"""Pixels in which emission seen in the mirror of objects varies much: glints of a sun or a lamp, and their rims.

The reflection of a sun in a curved boundary fills a small part of a pixel, which few rays of the camera meet: each that
does is a firefly. Pixels with such reflections are found once for a view, and their emission then at many more places.
Rays find reflections that fill a part of a pixel or its neighbours, faces of meshes (`mirroring_faces`) those that are
smaller. In a rectangle about the latter lie half of the places, with MIS weights:

    L = Σ_j f(x_j) / (N q(x_j)),    q = 1/2 + 1/2 [x in the rectangle] / area.

In all other pixels, what few paths find of emitters is cut (`PathTracer`): mostly less than a thousandth of the light,
in place of pixels that no number of samples brings to their mean.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np

from full_geometry.geometry.points import of_rows
from full_geometry.geometry.sensors import path_numbers, rays_by, sampled_size, seeded
from full_geometry.integrators.mirroring_faces import mirroring_faces
from full_geometry.integrators.walk_paths import PathTracer
from full_geometry.walk.random_walk import PATH_LANES, on_device
from halfspace_sss.arrays import aligned

GLINT, CANDIDATES = 8.0, 8  # least variance over the light; times as many pixels are looked at
GLINTS, SMALL_IMAGE, GLINTS_THERE = 128, 2**16, 32  # one of so many pixels at most; of images of fewer pixels
PLACES, MOST_PLACES, SHARE = 32, 1024, 4  # least and most in each, for a sample; one for so many samples of the image
NEAR = 1.5  # steps from pixel to pixel, within which what they mirror may be a rim
FEWEST_TRIALS, TRIALS, SEARCH = 4, 64, 2**20  # rays through each pixel that find them, if so few; through all
TRIAL_RAYS = 2  # through candidates, for each pixel of the image
LIT_RAYS, FORWARD_LIT_RAYS = 2**13, 2**16  # that tell the light; where a lamp behind forward scattering has much of it
SMALLEST = 0.01  # edge of a rectangle, pixels
BRIGHTEST = 64.0  # times the RMS of the other light of objects and the mean of the emission seen in them


class Glints(NamedTuple):
    """Pixels in which emission is asked for at many places.

    Args:
        pixels: their numbers.
        low, high: corners of a rectangle about small reflections in each, the whole where none is known, from 0 to 1.
        brightest: most that a path elsewhere finds of emitters where few paths meet them.
    """

    pixels: mi.UInt32
    low: mi.Point2f
    high: mi.Point2f
    brightest: mi.Float


def glint_light(
    tracer: PathTracer, sensor: mi.Sensor, glints: Glints, seed: int, samples: tuple[int, int]
) -> mi.Spectrum:
    """Emission that samples of pixels with glints see in objects, each the mean over many places of its pixel.
    `samples`: the number of the first of each pixel, and how many."""
    (first, spp), number = samples, dr.width(glints.pixels)
    each = PixelGrid.of(sensor).pixels // (SHARE * number)
    each = 2 ** (min(max(each, PLACES), MOST_PLACES).bit_length() - 2)
    pixel = dr.arange(mi.UInt32, number * spp * each) // dr.opaque(mi.UInt32, spp * each)
    low, high = (dr.gather(mi.Point2f, v, pixel) for v in glints[1:3])
    area, result = (high.x - low.x) * (high.y - low.y), mi.Spectrum(0)
    whole = dr.zeros(mi.Point2f, number), dr.full(mi.Point2f, 1, number)
    dr.make_opaque(whole)
    for half, rectangles in enumerate((whole, glints[1:3])):
        # ---- places uniform in the pixel, or in its rectangle
        numbers = path_numbers(seeded(seed, 1 + half), number, first * each, spp * each)
        a, b = (dr.gather(mi.Point2f, v, pixel) for v in rectangles)
        x = dr.clip(dr.lerp(a, b, numbers.next_2d()), a, b)  # rounding puts none beside its rectangle, where q is small
        rays, weight = _rays(tracer, sensor, numbers, glints.pixels, x)
        q = 0.5 + dr.select(dr.all((x >= low) & (x <= high)), 0.5 / area, 0)
        found = weight * tracer.seen_emission(rays) / q
        dr.eval(found)  # a sum evaluates what it is of: that of each channel would trace all rays anew
        result += mi.Spectrum([dr.block_sum(v, each) / (2 * each) for v in found])
    return result


def trial_of(rays: int, sensor: mi.Sensor) -> int:
    """Rays through each pixel, a power of two, of so many in all."""
    each = min(max(rays // PixelGrid.of(sensor).pixels, FEWEST_TRIALS), TRIALS)
    return 2 ** (each.bit_length() - 1)


def glints_of(tracer: PathTracer, sensor: mi.Sensor, trial: int) -> Glints:
    """Pixels in which emission seen in objects varies much more than other light, or a face may mirror a small emitter.
    `trial`: rays of each pixel that look for it."""
    film = PixelGrid.of(sensor)
    near = _near_mirrored(tracer, sensor, film)
    most = max(film.pixels // GLINTS, min(film.pixels // GLINTS_THERE, SMALL_IMAGE // GLINTS))

    # Keep of all pixels, by few rays, those about which emission varies most or a small emitter may be mirrored.
    pixels = dr.arange(mi.UInt32, film.pixels)
    dr.make_opaque(pixels)
    light = _emission(tracer, sensor, pixels, trial)
    other, brightest = _limits(tracer, sensor, film, light)
    moments = _moments(film, light, pixels, trial)
    own, around = _variance(moments), _variance(film.windowed(moments, 5))
    pixels = _largest(dr.select(near, dr.inf, around), GLINT * other, CANDIDATES * most)

    # Keep of these, by more rays, as many as are wanted; what few rays have met is not lost.
    if dr.width(pixels):
        more = min(max(TRIAL_RAYS * film.pixels // dr.width(pixels), PLACES), MOST_PLACES)
        rays = 2 ** (more.bit_length() - 1)
        moments = _moments(film, _emission(tracer, sensor, pixels, rays), pixels, rays)
        variance = dr.maximum(_variance(film.windowed(moments, 3)), own)
        pixels = _largest(variance, GLINT * other, most)

    # Join them with the pixels that faces tell of.
    on_faces, corners = _rectangles(tracer, sensor, film)
    found = np.union1d(np.array(pixels), on_faces).astype(np.uint32)
    low, high = np.zeros((len(found), 2)), np.ones((len(found), 2))
    at = np.searchsorted(found, on_faces)
    low[at], high[at] = corners
    corners = of_rows(mi.Point2f, low), of_rows(mi.Point2f, high)
    return Glints(aligned(mi.UInt32, found), *corners, dr.opaque(mi.Float, float(brightest)))


def _emission(tracer: PathTracer, sensor: mi.Sensor, pixels: mi.UInt32, rays: int) -> mi.Spectrum:
    """Emission that so many rays of each pixel see in objects, evaluated."""
    numbers = path_numbers(seeded(0, 3, rays), dr.width(pixels), 0, rays)
    places, weight = _rays(tracer, sensor, numbers, pixels)
    light = mi.Spectrum(weight * tracer.seen_emission(places))
    dr.eval(light)
    return light


def _limits(tracer: PathTracer, sensor: mi.Sensor, film: PixelGrid, light: mi.Spectrum) -> tuple[float, float]:
    """Mean square of the other light of objects, and the brightest that a path may bring by chance; infinite where no
    emission is seen. `light`: that rays of all pixels see."""
    if tracer.visitor.small is None and not dr.any(dr.max(light) > 0):
        return np.inf, np.inf
    other, share = _other_light(tracer, sensor, film)
    mirrored = np.linalg.norm([float(dr.mean(v)[0]) for v in light]) / max(share, 1 / FORWARD_LIT_RAYS)
    return other, BRIGHTEST * (np.sqrt(other) + mirrored) or np.inf


def _moments(film: PixelGrid, light: mi.Spectrum, pixels: mi.UInt32, rays: int) -> list[mi.Float64]:
    """E[L_c] of each channel and E[Σ_c L_c²] of each pixel of the film."""
    channels = [mi.Float64(v) for v in light]
    moments = [*channels, sum(v * v for v in channels)]
    return [film.scattered(dr.block_sum(v, rays) / rays, pixels) for v in moments]


def _variance(moments: list[mi.Float64]) -> mi.Float64:
    """Σ_c E[L_c²] - E[L_c]² of E[L_c] and E[Σ_c L_c²]."""
    *means, square = moments
    return square - sum(mean * mean for mean in means)


def _rays(
    tracer: PathTracer, sensor: mi.Sensor, numbers: mi.Sampler, pixels: mi.UInt32 | None = None,
    places: mi.Point2f | None = None,
) -> tuple[mi.Ray3f, mi.Spectrum]:  # fmt: skip
    """Rays of pixels as the tracer shows them, and their weights, evaluated: Mitsuba has the film in their kernel."""
    rays, weight, _ = rays_by(sensor, numbers, pixels, places)
    rays = tracer.shown(rays)
    dr.eval(rays, weight)
    return rays, weight


class PixelGrid(NamedTuple):
    """Pixels of a film in rows, as data of kernels."""

    width: int
    height: int

    @classmethod
    def of(cls, sensor: mi.Sensor) -> PixelGrid:
        """Those that rays of the sensor are sent through."""
        return cls(*(int(v) for v in sampled_size(sensor.film())))

    @property
    def pixels(self) -> int:
        """How many there are."""
        return self.width * self.height

    def beside(self, x: int, y: int) -> mi.UInt32:
        """Numbers of the pixels so far to the right of each and below; of the rim where there are none."""
        width, height = (dr.opaque(mi.Int32, v) for v in self)
        lane = dr.arange(mi.Int32, self.pixels)
        column, row = lane % width + x, lane // width + y
        return mi.UInt32(dr.clip(row, 0, height - 1) * width + dr.clip(column, 0, width - 1))

    def scattered(self, values: mi.Float64, pixels: mi.UInt32) -> mi.Float64:
        """Values of some pixels among all, 0 elsewhere."""
        result = dr.zeros(mi.Float64, self.pixels)
        dr.scatter(result, values, pixels)
        return result

    def windowed(self, values: list[mi.Float64], wide: int) -> list[mi.Float64]:
        """Means over the `wide` x `wide` pixels about each."""
        steps = range(-(wide // 2), wide // 2 + 1)
        for beside in ([self.beside(k, 0) for k in steps], [self.beside(0, k) for k in steps]):
            values = [sum(dr.gather(mi.Float64, v, j) for j in beside) / wide for v in values]
            dr.eval(values)
        return values


def _largest(values: mi.Float64, least: float, most: int) -> mi.UInt32:
    """Numbers of the largest values above `least`, in order, `most` of them at most."""
    above = dr.compress(values > dr.opaque(mi.Float64, least))
    if dr.width(above) <= most:
        return above
    found = np.array(dr.gather(mi.Float64, values, above))
    return aligned(mi.UInt32, np.array(above)[np.sort(np.argsort(found)[len(found) - most :])])


def _rectangles(tracer: PathTracer, sensor: mi.Sensor, film: PixelGrid) -> tuple[np.ndarray, np.ndarray]:
    """Numbers of pixels with small reflections of small emitters in faces of meshes, and the corners of the rectangle
    about these, (2, n, 2)."""
    # ---- rectangles about triangles, cut at the edges of up to four pixels
    corners = mirroring_faces(tracer.visitor.scene, tracer.visitor.media, tracer.visitor.small, sensor)
    low, high, cut = corners.min(axis=1), corners.max(axis=1), []
    for step in np.ndindex(2, 2):
        x = np.floor(low).astype(int) + step
        a, b = np.maximum(low - x, 0), np.minimum(high - x, 1)
        held = ((x >= 0) & (x < film) & (a < b)).all(axis=1)
        cut.append((x[held] @ (1, film.width), a[held], b[held]))
    number, a, b = (np.concatenate(part) for part in zip(*cut))

    # ---- one about all of a pixel, none of no area
    number, at = np.unique(number, return_inverse=True)
    low, high = np.full((len(number), 2), np.inf), np.full((len(number), 2), -np.inf)
    np.minimum.at(low, at, a)
    np.maximum.at(high, at, b)
    middle = (0.5 * (low + high)).clip(0.5 * SMALLEST, 1 - 0.5 * SMALLEST)
    return number, np.stack([np.minimum(low, middle - 0.5 * SMALLEST), np.maximum(high, middle + 0.5 * SMALLEST)])


def _near_mirrored(tracer: PathTracer, sensor: mi.Sensor, film: PixelGrid) -> mi.Bool:
    """Whether what pixels mirror is as near to the rim of a small emitter as to what the next ones mirror."""
    small, result = tracer.visitor.small, dr.opaque(mi.Bool, False, film.pixels)
    if small is None:
        return result
    rays, _ = _rays(tracer, sensor, path_numbers(seeded(0, 4), film.pixels, 0, 1))
    o, d, mirrors = tracer.mirrored(rays)
    dr.eval(o, d, mirrors)
    for k in range(small.n_delta, len(small)):
        k = dr.opaque(mi.UInt32, k)
        off, step = mi.Vector3f(d - small.direction(k, o)[0]), mi.Float(-1)
        dr.eval(off)
        for x, y in ((-1, 0), (1, 0), (0, -1), (0, 1)):
            j = film.beside(x, y)
            both = mirrors & dr.gather(mi.Bool, mirrors, j)
            step = dr.maximum(step, dr.select(both, dr.norm(dr.gather(mi.Vector3f, off, j) - off), -1))
        result |= mirrors & (dr.abs(dr.norm(off) - dr.sqrt(small.angle2(k, o))) < NEAR * step)
    dr.eval(result)
    return result


def _other_light(tracer: PathTracer, sensor: mi.Sensor, film: PixelGrid) -> tuple[float, float]:
    """The mean square of the light of objects without the emission seen in them, and the share of rays with any."""
    n = FORWARD_LIT_RAYS if tracer.visitor.forward else LIT_RAYS
    pixels = aligned(mi.UInt32, np.linspace(0, film.pixels - 1, n).astype(np.uint32))
    rays, weight = _rays(tracer, sensor, path_numbers(seeded(0, 2), n, 0, 1), pixels)
    apart = dr.opaque(mi.Bool, True, n)
    tracer = replace(tracer, apart=apart, brightest=dr.opaque(mi.Float, np.inf))  # the kernel of the image
    L, hit, _ = tracer.trace(rays, on_device(PATH_LANES), (0, 2))
    light = np.array(weight * L, dtype=float)[:, np.array(hit)]
    return float((light**2).sum() / max(light.shape[1], 1)), light.shape[1] / n
