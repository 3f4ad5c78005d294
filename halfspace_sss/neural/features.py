"""What the learnt models are given: functions of a query that reciprocity and mirroring leave as they are.

Swapping the directions (with both reversed) and mirroring the plane at the line x_i -> x_o change no feature, so a
network of them is reciprocal and mirror-invariant exactly, without training.
"""

from __future__ import annotations

from halfspace_sss.arrays import Library, Real, library
from halfspace_sss.interface.query import Query
from halfspace_sss.physics.backbone import U_MAX, warp

N_FEATURES, N_MEDIUM = 13, 9
R_SMALLEST = 0.01  # of min(L, mfp): below it the learnt factor stays as it is there
DEPTHS = (0.25, 1.0, 4.0)  # mean free paths along the refracted rays; L is the fourth
RIDGE, ROUNDING = 1e-3, 1e-5
SOFT = 1e-4  # share of the squared depth that keeps the logarithm of a distance finite
Ray = tuple[Real, Real, Real]


def travel(q: Query) -> tuple[Ray, Ray]:
    """Directions of travel inside, in and out, as (x, y, mu'): x along x_i -> x_o, mu' the cosine with the normal."""
    lib = q.lib
    incoming = (-q.sin_i * lib.cos(q.phi_i), -q.sin_i * lib.sin(q.phi_i), q.mu_i_in)
    return incoming, (q.sin_o * lib.cos(q.phi_o), q.sin_o * lib.sin(q.phi_o), q.mu_o_in)


def symmetric_features(lib: Library, r: Real, incoming: Ray, outgoing: Ray, L: Real) -> list[Real]:
    """The features of a query, each of order one.

    With (x, y, mu') of both rays: u/4 where u = log(exp(r/L) - 1); x_i + x_o; mu_i' + mu_o' - 1; (x_i - x_o)²;
    (mu_i' - mu_o')²; (x_i - x_o)(mu_i' - mu_o'); y_i y_o; and for depths s of 0.25, 1 and 4 mean free paths and L the
    logarithm of the distance between the points s along both refracted rays over sqrt(r² + s²).

    Args:
        lib: array library of the query.
        r: distance in mean free paths.
        incoming, outgoing: from `travel`.
        L: length scale of the medium in mean free paths.
    """
    (x_i, y_i, mu_i), (x_o, y_o, mu_o) = incoming, outgoing
    x, y, mu = x_i + x_o, y_i + y_o, mu_i - mu_o
    d = x_i - x_o
    near = lib.maximum(r, R_SMALLEST * library(L).minimum(L, 1.0))
    u = lib.minimum(warp(lib, near / L), U_MAX)
    side = y * y + mu * mu
    gaps = []
    for s in (*DEPTHS, L):
        along = r - s * x
        s2 = s * s
        gaps.append(0.5 * lib.log((along * along + s2 * (side + SOFT)) / (r * r + s2)))
    return [
        0.25 * u,
        x,
        mu_i + mu_o - 1,
        d * d,
        mu * mu,
        d * mu,
        y_i * y_o,
        *gaps,
        *_meeting(lib, r, incoming, outgoing),
    ]


def _meeting(lib: Library, r: Real, incoming: Ray, outgoing: Ray) -> tuple[Real, Real]:
    """How closely the refracted rays pass each other, and how far light travels until there.

    At depth z they are |r - z v| apart, v = d_i/mu_i' + d_o/mu_o' in the plane; the least is at
    z = r v_x / (v² + 0.05). Returns log(|r - z v| / r) and p / (1 + p) of the path p = z (1/mu_i' + 1/mu_o').
    """
    (x_i, y_i, mu_i), (x_o, y_o, mu_o) = incoming, outgoing
    a, b = 1 / lib.maximum(mu_i, 1e-3), 1 / lib.maximum(mu_o, 1e-3)
    v_x, v_y = a * x_i + b * x_o, a * y_i + b * y_o
    forward = lib.maximum(v_x - ROUNDING * (a + b), 0.0)  # grazing rays that cancel leave no noise of rounding
    z = forward / (v_x * v_x + v_y * v_y + 0.05)  # over r
    across, along = z * v_y, 1 - z * v_x
    path = r * z * (a + b)
    return 0.5 * lib.log(along * along + across * across + RIDGE), path / (1 + path)


def medium_features(lib: Library, albedo: Real, g: Real, eta: Real, L: Real) -> list[Real]:
    """The features of a medium, each of order one and smooth over albedo [0, 1], g [-0.5, 0.98], eta [1, 2]."""
    albedo_prime = albedo * (1 - g) / (1 - albedo * g)
    log, x = lib.log, eta - 1
    return [
        2 * albedo - 1, log(1 - albedo + 1e-4) / 3 + 1, g, log(1 - g) / 1.5 + 0.5, 2 * x - 1, log(L) / 2 - 0.5,
        2 * albedo_prime - 1, log(1 - albedo_prime + 1e-4) / 3 + 1, log(x * x + 1e-3) / 2 + 1,
    ]  # fmt: skip
