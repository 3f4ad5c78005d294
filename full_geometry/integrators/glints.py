"""Pixels in which emission seen in the mirror of objects varies much: glints of a sun or a lamp, and their rims.

The reflection of a sun in a curved boundary fills a small part of a pixel, which few rays of the camera meet: each that
does is a firefly. Pixels with such reflections are found once for a view, and their emission then at many more places.
Rays find reflections that fill a part of a pixel or its neighbours, faces of meshes (`mirroring_faces`) those that are
smaller. In a rectangle about the latter lie half of the places, with MIS weights:

    L = Σ_j f(x_j) / (N q(x_j)),    q = 1/2 + 1/2 [x in the rectangle] / area.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy.ndimage import uniform_filter

from full_geometry.geometry.points import of_rows
from full_geometry.geometry.sensors import path_numbers, rays_by, sampled_size, seeded
from full_geometry.integrators.mirroring_faces import mirroring_faces
from full_geometry.integrators.walk_paths import PathTracer
from full_geometry.walk.random_walk import PATH_LANES, on_device
from halfspace_sss.arrays import aligned

GLINT, GLINTS, CANDIDATES = 8.0, 128, 8  # least variance over the light, one of so many pixels at most, those looked at
PLACES, MOST_PLACES, SHARE = 32, 1024, 4  # least and most in each, for a sample; one for so many samples of the image
NEAR = 1.5  # steps from pixel to pixel, within which what they mirror may be a rim
FEWEST_TRIALS, TRIALS, TRIAL_RAYS = 2, 16, 4  # rays through each pixel that find them; through candidates, a pixel
LIT_RAYS = 2**13  # that tell the light
SMALLEST = 0.01  # edge of a rectangle, pixels


class Glints(NamedTuple):
    """Numbers of pixels, and in each the corners of a rectangle about small reflections, the whole where none is known,
    from 0 to 1."""

    pixels: mi.UInt32
    low: mi.Point2f
    high: mi.Point2f


def glint_light(
    tracer: PathTracer, sensor: mi.Sensor, glints: Glints, seed: int, samples: tuple[int, int]
) -> mi.Spectrum:
    """Emission that samples of pixels with glints see in objects, each the mean over many places of its pixel.
    `samples`: the number of the first of each pixel, and how many."""
    (first, spp), number = samples, dr.width(glints.pixels)
    each = int(dr.prod(sampled_size(sensor.film()))) // (SHARE * number)
    each = 2 ** (min(max(each, PLACES), MOST_PLACES).bit_length() - 2)
    low, high = (dr.repeat(v, spp * each) for v in glints[1:])
    area, result = (high.x - low.x) * (high.y - low.y), mi.Spectrum(0)
    whole = dr.opaque(mi.Point2f, 0), dr.opaque(mi.Point2f, 1)
    for half, (a, b) in enumerate((whole, (low, high))):
        # ---- places uniform in the pixel, or in its rectangle
        numbers = path_numbers(seeded(seed, 1 + half), number, first * each, spp * each)
        x = dr.clip(dr.lerp(a, b, numbers.next_2d()), a, b)  # rounding puts none beside its rectangle, where q is small
        rays, weight, _ = rays_by(sensor, numbers, glints.pixels, x)
        q = 0.5 + dr.select(dr.all((x >= low) & (x <= high)), 0.5 / area, 0)
        found = weight * tracer.seen_emission(tracer.shown(rays)) / q
        result += mi.Spectrum([dr.block_sum(v, each) / (2 * each) for v in found])
    return result


def glints_of(tracer: PathTracer, sensor: mi.Sensor, trial: int) -> Glints:
    """Pixels in which emission seen in objects varies much more than other light, or a face may mirror a small emitter.
    `trial`: rays of each pixel that look for it."""
    width, height = (int(v) for v in sampled_size(sensor.film()))
    near, most = _near_mirrored(tracer, sensor), width * height // GLINTS
    corners = _rectangles(tracer, sensor)
    pixels = aligned(mi.UInt32, np.arange(width * height, dtype=np.uint32))
    # of all pixels by few rays those about which it varies most, or may; of these by more rays
    for first, wide, kept in ((True, 5, CANDIDATES * most), (False, 3, most)):
        more = min(max(TRIAL_RAYS * width * height // max(dr.width(pixels), 1), PLACES), MOST_PLACES)
        rays = trial if first else 2 ** (more.bit_length() - 1)
        numbers = path_numbers(seeded(0, 3, rays), dr.width(pixels), 0, rays)
        places, weight, _ = rays_by(sensor, numbers, pixels)
        light = np.array(weight * tracer.seen_emission(tracer.shown(places)), dtype=float)
        light = light.reshape(len(light), -1, rays)
        if first:  # other light is not asked for where nothing is seen
            least = GLINT * _other_light(tracer, sensor) if light.any() or near.any() else np.inf
        found = np.zeros((2, len(light), height * width))
        found[..., np.array(pixels)] = light.mean(axis=2), (light**2).mean(axis=2)
        means, squares = uniform_filter(found.reshape(2, -1, height, width), (0, 0, wide, wide))
        variance = (squares - means**2).sum(axis=0).ravel()
        variance[near] += np.inf if first else 0
        number = min(int(np.count_nonzero(variance > least)), kept)
        pixels = aligned(mi.UInt32, np.sort(np.argsort(variance)[len(variance) - number :]))
        if number == 0:
            break
    # with those that faces tell of
    on_faces = np.flatnonzero((corners[0] < corners[1]).all(axis=-1))
    found = np.union1d(np.array(pixels), on_faces).astype(np.uint32)
    low, high = corners.reshape(2, -1, 2)[:, found]
    none = (low > high).any(axis=-1)
    low[none], high[none] = 0, 1
    return Glints(aligned(mi.UInt32, found), of_rows(mi.Point2f, low), of_rows(mi.Point2f, high))


def _rectangles(tracer: PathTracer, sensor: mi.Sensor) -> np.ndarray:
    """Of each pixel the corners of the rectangle about small reflections of small emitters in faces of meshes, (2,
    height, width, 2), the first beyond the second in pixels without one."""
    # ---- rectangles about triangles, cut at the edges of up to four pixels
    height, width = tuple(sampled_size(sensor.film()))[::-1]
    result = np.stack([np.full((height, width, 2), np.inf), np.full((height, width, 2), -np.inf)])
    corners = mirroring_faces(tracer.visitor.scene, tracer.visitor.media, tracer.visitor.small, sensor)
    low, high = corners.min(axis=1), corners.max(axis=1)
    for step in np.ndindex(2, 2):
        x = np.floor(low).astype(int) + step
        a, b = np.maximum(low - x, 0), np.minimum(high - x, 1)
        held = ((x >= 0) & (x < (width, height)) & (a < b)).all(axis=1)
        at = x[held, 1], x[held, 0]
        np.minimum.at(result[0], at, a[held])
        np.maximum.at(result[1], at, b[held])

    # ---- none of no area
    seen = result[0] < result[1]
    middle = np.where(seen, 0.5 * result.clip(0, 1).sum(axis=0), 0.5).clip(0.5 * SMALLEST, 1 - 0.5 * SMALLEST)
    result[0][seen] = np.minimum(result[0], middle - 0.5 * SMALLEST)[seen]
    result[1][seen] = np.maximum(result[1], middle + 0.5 * SMALLEST)[seen]
    return result


def _near_mirrored(tracer: PathTracer, sensor: mi.Sensor) -> np.ndarray:
    """Whether what pixels mirror is as near to the rim of a small emitter as to what the next ones mirror."""
    width, height = (int(v) for v in sampled_size(sensor.film()))
    small, result = tracer.visitor.small, np.zeros(width * height, dtype=bool)
    if small is None:
        return result
    rays, _, _ = rays_by(sensor, path_numbers(seeded(0, 4), width * height, 0, 1))
    o, d, mirrors = tracer.mirrored(tracer.shown(rays))
    for k in range(small.n_delta, len(small)):
        k = dr.opaque(mi.UInt32, k)
        off = np.array(dr.select(mirrors, d - small.direction(k, o)[0], dr.nan)).reshape(3, height, width)
        step = np.full((height, width), np.nan)
        for axis in (0, 1):
            change = np.linalg.norm(np.diff(off, axis=axis + 1), axis=0)
            ends = [(0, 0), (0, 0)]
            for ends[axis] in ((0, 1), (1, 0)):
                step = np.fmax(step, np.pad(change, ends, constant_values=np.nan))
        rim = np.array(dr.sqrt(small.angle2(k, o)) + dr.zeros(mi.Float, width * height)).reshape(height, width)
        result |= (np.abs(np.linalg.norm(off, axis=0) - rim) < NEAR * step).ravel()
    return result


def _other_light(tracer: PathTracer, sensor: mi.Sensor) -> float:
    """The mean square of the light of objects without the emission seen in them."""
    pixels = int(dr.prod(sampled_size(sensor.film())))
    pixels = aligned(mi.UInt32, np.linspace(0, pixels - 1, LIT_RAYS).astype(np.uint32))
    rays, weight, _ = rays_by(sensor, path_numbers(seeded(0, 2), LIT_RAYS, 0, 1), pixels)
    apart = dr.opaque(mi.Bool, True, LIT_RAYS)
    L, hit, _ = replace(tracer, apart=apart).trace(tracer.shown(rays), on_device(PATH_LANES), (0, 2))
    light = np.array(weight * L, dtype=float)[:, np.array(hit)]
    return float((light**2).sum() / max(light.shape[1], 1))
