"""Rays of a sensor through all pixels of its film, and what they bring to the film: of both integrators."""

from __future__ import annotations

from collections.abc import Sequence

import drjit as dr
import mitsuba as mi
import numpy as np

from full_geometry.geometry.instances import InstanceScene
from full_geometry.geometry.rounding import ray_from
from full_geometry.settings import per_variant


def sampled_size(film: mi.Film) -> mi.ScalarVector2u:
    """Pixels through which rays are sent: those of the crop, and a border that the filter of the film may need."""
    size = film.crop_size()
    return size + 2 * film.rfilter().border_size() if film.sample_border() else size


def seeded(*numbers: int) -> int:
    """A seed of 32 bits; other numbers give independent ones."""
    return int(np.random.SeedSequence([int(n) for n in numbers]).generate_state(1)[0])


def independent(seed: int, n: int) -> mi.Sampler:
    """Independent numbers for n lanes."""
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(seed, n)
    return sampler


def checked_samples(sensor: mi.Sensor, spp: int) -> int:
    """Samples of a pixel: spp, or those of the sampler where spp is 0; ValueError below that."""
    if spp < 0:
        raise ValueError(f"spp must be at least 1, or 0 for the samples of the sampler, got {spp}")
    return spp or sensor.sampler().sample_count()


def camera_rays(sensor: mi.Sensor, spp: int, seed: tuple[int, int]) -> tuple[mi.Ray3f, mi.Spectrum, mi.Vector2f]:
    """`rays_by` the sampler of the sensor."""
    return rays_by(sensor, seeded_sampler(sensor, spp, seeded(*seed)))


def seeded_sampler(sensor: mi.Sensor, spp: int, seed: int) -> mi.Sampler:
    """A copy of the sampler of a sensor for spp samples of each pixel, or more: some samplers take squares only."""
    sampler = sensor.sampler().clone()
    sampler.set_sample_count(spp)
    sampler.set_samples_per_wavefront(sampler.sample_count())
    sampler.seed(seed, int(dr.prod(sampled_size(sensor.film()))) * sampler.sample_count())
    return sampler


def rays_by(
    sensor: mi.Sensor, sampler: mi.Sampler, pixels: mi.UInt32 | None = None, places: mi.Point2f | None = None
) -> tuple[mi.Ray3f, mi.Spectrum, mi.Vector2f]:
    """Rays of all samples of each pixel, their weights, and their positions on the film.
    `sensor`: its film has been prepared. `sampler`: with a lane for each ray, pixel by pixel. `pixels`: numbers of the
    pixels; all where None. `places`: of the rays in their pixels, 0 to 1; those of the sampler where None."""
    spp = sampler.sample_count()
    film, size = sensor.film(), sampled_size(sensor.film())
    border = film.rfilter().border_size() if film.sample_border() else 0
    n = (int(dr.prod(size)) if pixels is None else dr.width(pixels)) * spp
    index, width = dr.arange(mi.UInt32, n) // dr.opaque(mi.UInt32, spp), dr.opaque(mi.UInt32, int(size[0]))
    index = index if pixels is None else dr.gather(mi.UInt32, pixels, index)
    first, scale = mi.ScalarVector2i(film.crop_offset()) - border, 1 / mi.ScalarVector2f(film.crop_size())
    offset = -mi.ScalarVector2f(film.crop_offset()) * scale
    first, scale, offset = (mi.Vector2i(first), mi.Vector2f(scale), mi.Vector2f(offset))
    dr.make_opaque(first, scale, offset)  # a kernel then serves all crops
    pixel = mi.Vector2i(index % width, index // width) + first
    position = mi.Vector2f(pixel) + (sampler.next_2d() if places is None else places)
    aperture = sampler.next_2d() if sensor.needs_aperture_sample() else mi.Point2f(0.5)
    time = sensor.shutter_open()
    if sensor.shutter_open_time() > 0:
        time += sampler.next_1d() * sensor.shutter_open_time()
    ray, weight = sensor.sample_ray_differential(time, sampler.next_1d(), dr.fma(position, scale, offset), aperture)
    # in a box filter a position that rounding puts on the edge of a pixel belongs to the neighbour too
    return widened(ray, n), weight, mi.Vector2f(pixel) if film.rfilter().is_box_filter() else position


def past_emitters(scene: mi.Scene, instance_scene: InstanceScene, ray: mi.Ray3f) -> mi.Ray3f:
    """Rays of a camera that sees no emitters: those that meet one begin behind it."""
    if all(emitter.get_shape() is None for emitter in scene.emitters()):
        return ray

    def step(o: mi.Point3f, active: mi.Bool) -> tuple[mi.Point3f, mi.Bool]:
        here = mi.Ray3f(ray)
        here.o = o
        si = instance_scene.intersect(scene, here, mi.RayFlags.Minimal, active=active)
        active &= si.is_valid() & (si.emitter(scene, active) != None)  # noqa: E711
        return dr.select(active, ray_from(si, ray.d, instance_scene.rounding(si)).o, o), active

    result, n = type(ray)(ray), dr.width(ray)
    state = mi.Point3f(ray.o) + dr.zeros(mi.Point3f, n), dr.full(mi.Bool, True, n)
    result.o = dr.while_loop(state, lambda _, active: active, step, label="emitters")[0]
    return result


def shows_sky(scene: mi.Scene, hide_emitters: bool) -> bool:
    """Whether a camera sees an environment where it sees nothing else, so that no pixel is transparent."""
    return not hide_emitters and scene.environment() is not None


def splat(
    film: mi.Film, rays: mi.Ray3f, L: mi.Spectrum, seen: mi.Bool, position: mi.Vector2f, spp: int,
    layers: Sequence[mi.Float] = (),
) -> None:  # fmt: skip
    """Add the light of rays to a film, and values of further channels."""
    block = film.create_block()
    block.set_coalesce(block.coalesce() and spp >= 4)
    alpha = dr.select(seen, mi.Float(1), mi.Float(0))
    dr.eval(L, alpha, position, rays.wavelengths, layers)  # what follows has the crop of the film in its kernel
    has_alpha = mi.has_flag(film.flags(), mi.FilmFlags.Alpha)
    if mi.has_flag(film.flags(), mi.FilmFlags.Special):
        values = film.prepare_sample(L, rays.wavelengths, block.channel_count(), weight=1.0, alpha=alpha)
    else:
        L = mi.spectrum_to_srgb(L, rays.wavelengths) if mi.is_spectral else L
        rgb = [L[0]] * 3 if len(L) == 1 and block.channel_count() >= 4 else list(L)
        values = [*rgb, *([alpha] if has_alpha else []), mi.Float(1), *layers]
    block.put(position, values)
    film.put_block(block)
    dr.eval(block.tensor())


def widened(ray: mi.Ray3f, n: int) -> mi.Ray3f:
    """n rays; those of a sensor that knows one ray only are one."""
    result = mi.Ray3f(ray)
    result.o, result.d = result.o + dr.zeros(mi.Point3f, n), result.d + dr.zeros(mi.Vector3f, n)
    if mi.is_spectral:
        result.wavelengths = result.wavelengths + dr.zeros(mi.Spectrum, n)
    return result


# --------------------------------------------------------------------------------------------------
# Random numbers of the paths of an image: of low discrepancy over the samples of each pixel, padded.
#
# A number, or a pair, is the sample i of the sequence of van der Corput, or of the first two dimensions of Sobol's: in
# the bits i = Σ_c i_c 2^c
#
#     x = Σ_c i_c 2^(-c-1),   y = Σ_r y_r 2^(-r-1),   y_r = Σ_c binom(c, r) i_c mod 2.
#
# For each number of a path the bits of i are shuffled, and of pairs the digits of x and y scrambled, by nested uniform
# scrambling (Owen 1995). So each is uniform, and numbers of a path are paired at random; but N = 2^m samples from a
# multiple of N on are stratified in each number and each pair. Single numbers have one distance from the ends of their
# strata: most of the light is smooth in them, and periodic. Scrambling is hashed as by Laine and Karras (2011), in the
# form of Burley (2020), where the sequences are padded so too: sums and products carry from low bits to high ones only.


STEP = 0x9E3779B9  # between the keys of two numbers of a path
PASCAL = (0x55555555, 0x33333333, 0x0F0F0F0F, 0x00FF00FF, 0x0000FFFF)  # binom(c, r) mod 2, by the bits of c and r


def path_numbers(seed: int, pixels: int, first: int, spp: int) -> mi.Sampler:
    """Numbers for the samples from `first` on of each pixel, beside each other.
    `seed`: images of different seeds are independent. `first`: number of the first sample of a pixel; those before it
    have been taken."""
    return _numbers_class()(seed, pixels, first, spp)


@per_variant
def _numbers_class() -> type:

    class PathNumbers(mi.Sampler):
        """A sampler with the number of what it gives next as state."""

        def __init__(self, seed: int, pixels: int, first: int, spp: int) -> None:
            mi.Sampler.__init__(self, mi.Properties())
            self.set_sample_count(spp)
            # sample i of a pixel in reversed bits, and the key of the pixel
            lane = dr.arange(mi.UInt32, pixels * spp)
            pixel = lane // dr.opaque(mi.UInt32, spp)
            self._reversed = dr.brev(lane - pixel * dr.opaque(mi.UInt32, spp) + dr.opaque(mi.UInt32, first))
            self._key = mi.sample_tea_32(pixel, dr.opaque(mi.UInt32, seed))[0]

        def next_1d(self, active: mi.Bool = True) -> mi.Float:
            return _unit_fraction(scrambled(self._reversed, self._next()))

        def next_2d(self, active: mi.Bool = True) -> mi.Point2f:
            # shuffle i, then scramble the digits of x and y
            key = self._next()
            i, key_x = dr.brev(scrambled(self._reversed, key)), hashed(key)
            digits = scrambled(i, key_x), scrambled(second(i), hashed(key_x))
            return mi.Point2f(*(_unit_fraction(dr.brev(v)) for v in digits))

        def _next(self) -> mi.UInt32:
            self._key = self._key + STEP
            return hashed(self._key)

        def to_string(self) -> str:
            return "PathNumbers[]"

    return PathNumbers


def hashed(x: mi.UInt32) -> mi.UInt32:
    """The bits of x mixed, as MurmurHash3 ends (Appleby 2011)."""
    x = (x ^ (x >> 16)) * 0x85EBCA6B
    x = (x ^ (x >> 13)) * 0xC2B2AE35
    return x ^ (x >> 16)


def scrambled(x: mi.UInt32, key: mi.UInt32) -> mi.UInt32:
    """Nested uniform scrambling of a fraction whose first digit is the lowest bit."""
    # each multiple of an even factor lets a digit flip all higher ones (Laine and Karras 2011)
    x = x + key
    for factor in (0x6C50B47C, 0xB82F1E52, 0xC7AFE638, 0x8D22F6E6):
        x = x ^ (x * factor)
    return x


def second(i: mi.UInt32) -> mi.UInt32:
    """y of sample i, its first digit the lowest bit."""
    for k, mask in enumerate(PASCAL):
        i = i ^ ((i >> 2**k) & mask)
    return i


def _unit_fraction(x: mi.UInt32) -> mi.Float:
    return mi.Float(x >> 8) * 2.0**-24
