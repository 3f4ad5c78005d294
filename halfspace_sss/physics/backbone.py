"""The analytic backbone of the learnt models: right length scales and decay, roughly the right size.

All in mean free paths. The functions take Python numbers, or arrays for albedo, g and eta where a medium is to be
differentiated or differs from lane to lane.
"""

from __future__ import annotations

import math

import numpy as np

from halfspace_sss.arrays import Library, Real, library

LONGEST = 20.0  # transport mean free paths; caps the length scale where nothing absorbs
U_MAX = 12.0  # beyond this u the learnt factor stays as it is there
NEAR = 0.05  # mean free paths; bounds the near term at r = 0


def length_scale(albedo: Real, g: Real) -> Real:
    """L = 1 / sqrt(3 (1 - albedo) (1 - albedo g)), at most 20 transport mean free paths: the decay of diffusion."""
    lib = library(albedo, g)
    sigma_t_prime = 1 - albedo * g
    sigma_tr = lib.sqrt(lib.maximum(3 * (1 - albedo) * sigma_t_prime, 1e-12))
    L = lib.minimum(1 / sigma_tr, LONGEST / sigma_t_prime)
    return float(L) if isinstance(L, np.floating) else L  # a NumPy scalar would widen float32 queries


def warp(lib: Library, x: Real) -> Real:
    """u = log(exp(x) - 1) of x = r/L: logarithmic below one, linear above, without overflow."""
    small = lib.minimum(x, 30.0)
    return lib.where(x > 20, x, lib.log(lib.maximum(lib.expm1(small), 1e-30)))


def unwarp(lib: Library, u: Real) -> Real:
    """x = log(1 + exp(u)), the inverse of `warp`."""
    return lib.where(u > 20, u, lib.log(1 + lib.exp(lib.minimum(u, 30.0))))


def _boundary_A(eta: Real) -> Real:
    """A of the extrapolation distance to 1 % on [1, 2], smooth in eta; a fit of `fresnel.boundary_A`."""
    x = eta - 1
    return 1 + x * (3.12364741 + x * (4.56955441 - 0.60924973 * x))


def backbone(r: Real, albedo: Real, g: Real, eta: Real) -> Real:
    """B(r) = albedo² b(r), b = sum_{r,v} z (1 + s d) exp(-s d)/d³ / (4 pi²) + ((1 - g)/sigma_t')² e(r) / (16 pi²).

    A dipole with Grosjean's diffusion constant D, s = sqrt((1 - albedo)/D), d² = r² + z², z_r = 1/sigma_t',
    z_v = z_r + 4 A D, which falls off at the right rate also for low albedo, and a near term e(r) =
    exp(-r) / (r + 0.05) in the form of double scattering.

    Args:
        r: distance, mean free paths.
        albedo, g, eta: the medium.

    Source: Grosjean 1956, d'Eon and Irving 2011 for D and A; the sum is this project's.
    """
    return albedo * albedo * backbone_shape(r, albedo, g, eta)


def backbone_shape(r: Real, albedo: Real, g: Real, eta: Real) -> Real:
    """b(r) of `backbone`, without albedo²: a product with it may leave the range of float32 on the way."""
    lib = library(r, albedo, g, eta)
    sigma_t_prime = 1 - albedo * g
    D = (2 * (1 - albedo) + albedo * (1 - g)) / (3 * sigma_t_prime * sigma_t_prime)
    s = (lib.sqrt if hasattr(albedo, "shape") else math.sqrt)((1 - albedo) / D)
    z_r = 1 / sigma_t_prime
    z_v, near = z_r + 4 * _boundary_A(eta) * D, ((1 - g) / sigma_t_prime) ** 2 / (16 * math.pi**2)
    if isinstance(albedo, float):
        s, z_r, z_v, near = (lib.constant(v, r) for v in (s, z_r, z_v, near))
    far = _source(lib, r, z_r, s) + _source(lib, r, z_v, s)
    return far / (4 * math.pi**2) + near * lib.exp(-r) / (r + NEAR)


def _source(lib: Library, r: Real, z: Real, s: Real) -> Real:
    inverse = 1 / lib.sqrt(r * r + z * z)
    t = s / inverse
    return z * (1 + t) * lib.exp(-t) * inverse * inverse * inverse
