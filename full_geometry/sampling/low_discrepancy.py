"""Random numbers of the paths of an image: of low discrepancy over the samples of each pixel, padded.

A number, or a pair, is the sample i of the sequence of van der Corput, or of the first two dimensions of Sobol's: in
the bits i = Σ_c i_c 2^c

    x = Σ_c i_c 2^(-c-1),   y = Σ_r y_r 2^(-r-1),   y_r = Σ_c binom(c, r) i_c mod 2.

For each number of a path the bits of i are shuffled, and of pairs the digits of x and y scrambled, by nested uniform
scrambling (Owen 1995). So each is uniform, and numbers of a path are paired at random; but N = 2^m samples from a
multiple of N on are stratified in each number and each pair. Single numbers have one distance from the ends of their
strata: most of the light is smooth in them, and periodic. Scrambling is hashed as by Laine and Karras (2011), in the
form of Burley (2020), where the sequences are padded so too: sums and products carry from low bits to high ones only.
"""

from __future__ import annotations

import functools

import drjit as dr
import mitsuba as mi

STEP = 0x9E3779B9  # between the keys of two numbers of a path
PASCAL = (0x55555555, 0x33333333, 0x0F0F0F0F, 0x00FF00FF, 0x0000FFFF)  # binom(c, r) mod 2, by the bits of c and r


def path_numbers(seed: int, pixels: int, first: int, spp: int) -> mi.Sampler:
    """Numbers for the samples from `first` on of each pixel, beside each other.

    Args:
        seed: images of different seeds are independent.
        pixels: of the image.
        first: number of the first sample of a pixel; those before it have been taken.
        spp: samples of each pixel.
    """
    return _class(mi.variant())(seed, pixels, first, spp)


@functools.cache
def _class(variant: str) -> type:
    """The class of a variant, which must be the current one."""

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
            return _fraction(scrambled(self._reversed, self._next()))

        def next_2d(self, active: mi.Bool = True) -> mi.Point2f:
            # shuffle i, then scramble the digits of x and y
            key = self._next()
            i, key_x = dr.brev(scrambled(self._reversed, key)), hashed(key)
            digits = scrambled(i, key_x), scrambled(second(i), hashed(key_x))
            return mi.Point2f(*(_fraction(dr.brev(v)) for v in digits))

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


def _fraction(x: mi.UInt32) -> mi.Float:
    return mi.Float(x >> 8) * 2.0**-24
