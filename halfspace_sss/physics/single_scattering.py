"""The exact first order of scattering in a half-space with a smooth boundary: light that scatters exactly once.

For a pencil beam this order is a distribution (the two refracted rays must meet), so that it is never a value of
S; it is given integrated over the plane (`brdf`, `reflectance`) or over exit directions (`exitance`).

mu' is the cosine inside, mu' = sqrt(1 - (1 - mu²)/eta²); c the cosine between the two directions of travel inside,
c = -mu_i' mu_o' + sin_i' sin_o' cos(delta_phi), and delta_phi the azimuth of the light that leaves from that of the
light that enters, both as directions of travel: 0 means that light leaves on the far side.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence

import numpy as np

from halfspace_sss.arrays import Library, Real, broadcast_query, library
from halfspace_sss.checks import check_query
from halfspace_sss.physics.fresnel import F_t, mu_external, mu_internal, sine
from halfspace_sss.physics.medium import Medium, eval_hg

TINY = 1e-30
_NUMPY = library(0.0)


def _arguments(medium: Medium, **args: Real) -> tuple[Library, Sequence[Real]]:
    """Broadcast arguments in one library, with a channel axis last if the medium has channels; refuses bad ranges."""
    lib, values = broadcast_query(*args.values())
    values = check_query(lib, values, tuple(args.values()), tuple(args))
    if medium.n_channels is not None:
        lib.constant(medium.sigma_t, values[0])
        values = [v[..., None] for v in values]
    return lib, values


def _sine(lib: Library, mu: Real, eta: float) -> Real:
    """Sine of the refracted angle, sqrt(1 - mu²)/eta, at most 1."""
    return lib.minimum(sine(mu) / eta, 1.0)


def brdf(medium: Medium, mu_i: Real, mu_o: Real, delta_phi: Real) -> Real:
    """Single scattering under uniform irradiation of the plane, the BRDF in 1/sr.

    f = albedo T_12(mu_i) T_21(mu_o) p(c) / (eta² (mu_i' + mu_o')), reciprocal.

    Args:
        medium: the medium, scalar or with channels (channel axis last in the result).
        mu_i, mu_o: external cosines, [0, 1]; delta_phi: azimuth in radians, 0 where light leaves on the far side.
            They broadcast and may be NumPy, torch or Dr.Jit arrays.
    Raises ValueError if an argument is out of range or libraries are mixed.
    Valid for every albedo, g and eta; unbounded where both directions graze at eta = 1.
    Source: Chandrasekhar 1960 for the matched boundary; the 1/eta² turns inside into outside solid angle.
    """
    lib, (mu_i, mu_o, delta_phi) = _arguments(medium, mu_i=mu_i, mu_o=mu_o, delta_phi=delta_phi)
    eta = medium.eta
    a, b, sines = mu_internal(mu_i, eta), mu_internal(mu_o, eta), _sine(lib, mu_i, eta) * _sine(lib, mu_o, eta)
    c = lib.maximum(lib.minimum(sines * lib.cos(delta_phi) - a * b, 1.0), -1.0)
    throughput = F_t(mu_i, eta) * F_t(mu_o, eta) * eval_hg(c, lib.constant(medium.g, mu_i)) / eta**2
    return lib.constant(medium.albedo, mu_i) * throughput / lib.maximum(a + b, TINY)


@functools.cache
def _graded(n_low: int, n_high: int, n_nodes: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Gauss nodes x, 1 - x and weights on [0, 1] in panels that halve n_low times towards 0, n_high times towards 1."""
    nodes, weights = np.polynomial.legendre.leggauss(n_nodes)
    edges = (np.concatenate([[0.0], 0.5 ** np.arange(n, 0, -1)]) for n in (n_low, n_high))
    (x, w), (y, v) = (
        ((e[:-1, None] + np.diff(e)[:, None] * 0.5 * (nodes + 1)).ravel(), np.outer(np.diff(e), 0.5 * weights).ravel())
        for e in edges
    )
    return np.concatenate([x, 1 - y]), np.concatenate([1 - x, y]), np.concatenate([w, v])


def _mean_hg(g: Real, mu: Real, sine: Real, nu: Real, nu_sine: Real) -> tuple[Real, Real]:
    """Means over azimuth of p(c) and p(c) cos(delta_phi) for c = -mu nu + sine nu_sine cos(delta_phi).
    1 + g² - 2 g c = A - B cos(delta_phi): with the complete elliptic integrals and m = 2B/(A + B), the integral of (A -
    B cos)^(-3/2) is 4 E(m) / ((A - B) sqrt(A + B)), that of (A - B cos)^(-1/2) is 4 K(m) / sqrt(A + B)."""
    from scipy.special import ellipe, ellipkm1

    size, sign = np.abs(g), np.where(np.asarray(g) < 0, -1.0, 1.0)
    gap = 0.5 * ((mu + sign * nu) ** 2 + (sine - nu_sine) ** 2)
    below = (1 - size) ** 2 + 2 * size * gap  # A - B
    B = 2 * size * sine * nu_sine
    A, above = below + B, below + 2 * B
    three_halves = 4 * ellipe(2 * B / above) / (below * np.sqrt(above))
    x = B / A
    series = np.pi * x * (1.5 + x * x * (1.640625 + x * x * 1.6918945)) / A**1.5
    with np.errstate(divide="ignore", invalid="ignore"):
        exact = (A * three_halves - 4 * ellipkm1(below / above) / np.sqrt(above)) / B
    cosine = np.where(x < 3e-3, series, exact)
    scale = (1 - size) * (1 + size) / (8 * np.pi**2)
    return scale * three_halves, sign * scale * cosine


def _exit_moments(medium: Medium, mu_i: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """R, R ⟨x⟩ and R ⟨r²⟩ (per mean free path) for mu_i of shape (n, 1), scalar or channel medium; shape (n, channels).
    Over u, the cosine on the thinner side (external for eta >= 1), which has no kink at the critical angle; the panels
    halve towards u = 0, 1 and the backward peak of the phase function."""
    eta = medium.eta
    g, albedo = np.atleast_1d(medium.g), np.atleast_1d(medium.albedo)
    x, _, w = _graded(20, 20, 10)
    peak = mu_i if eta >= 1 else mu_internal(mu_i, eta)
    u = np.concatenate([peak * x, peak + (1 - peak) * x], axis=1)[:, None, :]
    weight = np.concatenate([peak * w, (1 - peak) * w], axis=1)[:, None, :] * u / max(eta, 1.0) ** 2
    mu_o = u if eta >= 1 else mu_external(u, eta)
    nu, nu_sine = (mu_internal(u, eta), np.sqrt(1 - u * u) / eta) if eta >= 1 else (u, np.sqrt(1 - u * u))
    a = mu_internal(mu_i, eta)[:, None]
    sine = _sine(_NUMPY, mu_i, eta)[:, None]
    p, p_cos = _mean_hg(g[:, None], a, sine, nu, nu_sine)
    k = np.maximum(a + nu, TINY)
    common = 2 * np.pi * weight * F_t(mu_o, eta) / k
    enter = albedo * F_t(mu_i, eta)
    mean_x = (nu * sine * p + a * nu_sine * p_cos) / k
    mean_r2 = 2 * ((nu**2 * sine**2 + a**2 * nu_sine**2) * p + 2 * a * nu * sine * nu_sine * p_cos) / k**2
    return tuple(enter * np.sum(common * v, axis=2) for v in (p, mean_x, mean_r2))


def _cosines(medium: Medium, mu_i: Real) -> tuple[np.ndarray, np.ndarray | None]:
    """Cosines of incidence as an array, and for "diffuse" the weights 2 mu dmu of uniform radiance, else None."""
    if isinstance(mu_i, str):
        if mu_i != "diffuse":
            raise ValueError(f'mu_i must be cosines in [0, 1] or "diffuse", got {mu_i!r}')
        x, _, w = _graded(12, 12, 10)
        return mu_external(x, min(medium.eta, 1.0)), 2 * min(medium.eta, 1.0) ** 2 * x * w
    return check_query(_NUMPY, (np.asarray(mu_i, dtype=np.float64),), (mu_i,), ("mu_i",))[0], None


def reflectance(medium: Medium, mu_i: Real = 1.0) -> Real:
    """Fraction of incident flux that leaves the medium after exactly one scattering event.

    R = albedo T_12 ∫_{mu_c}^1 mu / (mu + mu_i') T_21(mu) 2 pi p_mean(mu, mu_i') dmu over cosines inside; light that is
    reflected back inside scatters again and belongs to the higher orders. To 1e-10.

    Args:
        mu_i: external cosine of incidence, number or NumPy array in [0, 1], or "diffuse": uniform radiance from above.
    The shape is that of mu_i, channel axis last; a number for a number. ValueError if mu_i is not in [0, 1].
    Source: matched and isotropic (albedo/2) (1 - mu_i ln(1 + 1/mu_i)), Chandrasekhar 1960.
    """
    mu, weights = _cosines(medium, mu_i)
    R = _exit_moments(medium, mu.reshape(-1, 1))[0]
    R = weights @ R if weights is not None else R.reshape(*mu.shape, -1)
    return R if medium.n_channels is not None else R[..., 0][()]


def moments(medium: Medium, mu_i: Real = 1.0) -> tuple[Real, Real]:
    """⟨r²⟩ (mm²) and ⟨x⟩ (mm) of the flux that leaves after one scattering event, x along the light that enters.

    In mean free paths ⟨x⟩ = ⟨(nu sin_i + a sin_o cos)/(a + nu)⟩ and ⟨r²⟩ = 2 ⟨(nu² sin_i² + 2 a nu sin_i sin_o cos +
    a² sin_o²)/(a + nu)²⟩, a and nu the cosines inside of entry and exit: distances along both rays are exponential.
    Arguments, shapes and errors as `reflectance`, without "diffuse"; NaN where nothing enters or scatters.
    """
    if isinstance(mu_i, str):
        raise ValueError(f"mu_i must be cosines in [0, 1], got {mu_i!r}")
    mu, mfp = _cosines(medium, mu_i)[0], np.atleast_1d(medium.mfp)
    R, x, r2 = _exit_moments(medium, mu.reshape(-1, 1))
    with np.errstate(invalid="ignore"):
        result = [(v / R).reshape(*mu.shape, -1) for v in (r2 * mfp**2, x * mfp)]
    return tuple(v if medium.n_channels is not None else v[..., 0][()] for v in result)


def exitance(medium: Medium, r: Real, mu_i: Real = 1.0, phi: Real = 0.0) -> Real:
    """Exitance of the single order per flux of a pencil beam, 1/mm², at distance r and azimuth phi.

    M = T_12 ∫ sigma_s exp(-sigma_t (t + d)) p T_21 cos(theta) / d² dt over the refracted beam, d the distance from the
    vertex to the point of exit; with the angle e between beam and exit ray as variable, b the distance of the point
    from the line of the beam: M = T_12 sigma_s/b ∫_0^e_max p(-cos e) T_21 cos(theta) exp(-sigma_t (t + d)) de, e_max
    where total reflection starts. Goes as 1/r for r -> 0, inf at r = 0. To 1e-7 (r >= 1e-5 mfp).

    Args:
        medium: the medium, scalar or with channels (channel axis last in the result).
        r: distance from the point of entry, mm, >= 0.
        mu_i: external cosine of incidence, [0, 1].
        phi: azimuth of the point about the point of entry, radians, 0 on the far side of the plane of incidence.
            The three broadcast: NumPy or torch (a Dr.Jit kernel of it takes ten seconds to compile); float64 inside.
    Raises ValueError if an argument is out of range or libraries are mixed.
    Source: Habel, Christensen and Jarosz 2013 (normal incidence), here for any incidence.
    """
    lib, (r_in, mu_i, phi) = _arguments(medium, r=r, mu_i=mu_i, phi=phi)
    r, mu_i, phi = lib.float64(r_in), lib.float64(mu_i), lib.float64(phi)
    eta = medium.eta
    tau = lib.constant(medium.sigma_t, r) * r
    a, sine, cos_phi = mu_internal(mu_i, eta), _sine(lib, mu_i, eta), lib.cos(phi)
    # the line of the refracted beam: distance b = r h of the point of exit from it, and the foot of its perpendicular
    foot = sine * cos_phi  # of the perpendicular from the point to the beam, in units of r
    h = lib.maximum(lib.sqrt(a * a + (sine * lib.sin(phi)) * (sine * lib.sin(phi))), TINY)
    # the beam is seen from where total reflection ends, at the largest angle e_max between beam and exit ray
    start = _critical_length(lib, eta, mu_i, foot)
    d_start = lib.sqrt((start - foot) * (start - foot) + h * h)
    e_max = lib.arctan2(h, start - foot)
    g = lib.constant(medium.g, r)
    total = 0.0 * tau
    for x, rest, w in zip(*(v.tolist() for v in _graded(20, 26, 8))):
        # at the angle e: distance d to the point of exit, length t of the beam, cosine theta of the exit ray
        sin_e = lib.maximum(lib.sin(e_max * rest), TINY)
        d = h / sin_e
        t = start + d_start * lib.sin(e_max * x) / sin_e
        cosine = lib.minimum(a * t / d, 1.0)
        flux = eval_hg(-lib.cos(e_max * rest), g) * F_t(mu_external(cosine, eta), eta) * cosine
        total = total + w * flux * lib.exp(-tau * (t + d))
    M = lib.constant(medium.sigma_s, r) * F_t(mu_i, eta) * e_max * total / lib.maximum(r * h, TINY)
    M = lib.where(r > 0, M, lib.where(M > 0, M + math.inf, 0.0 * M))
    return lib.like(M, r_in)[()] if lib is _NUMPY else lib.like(M, r_in)


def _critical_length(lib: Library, eta: float, mu_i: Real, foot: Real) -> Real:
    """Beam length over r with total reflection, root of (mu_i/eta)² t² + 2 foot mu_c² t - mu_c² = 0; 0 if eta <= 1."""
    if eta <= 1:
        return 0.0 * mu_i * foot
    mu_c2 = (eta - 1) * (eta + 1) / eta**2
    b, k = foot * mu_c2, lib.maximum(mu_i / eta, 1e-8)
    root = lib.sqrt(b * b + k * k * mu_c2)
    return lib.where(b > 0, mu_c2 / (root + lib.abs(b)), (root + lib.abs(b)) / (k * k))
