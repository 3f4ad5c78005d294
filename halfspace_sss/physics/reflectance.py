"""The exact reflectance of the half-space by discrete ordinates, and the albedo that has a wanted reflectance.

Radiance that is the same at all azimuths obeys, with I⁺ going down and I⁻ going up at the cosines mu_j of a quadrature,

    s' = -(A + B) d,  d' = -(A - B) s,   s = I⁺ + I⁻,  d = I⁺ - I⁻,
    A - B = (1 - a E W) / mu,  A + B = (1 - a O W) / mu,

E and O the even and odd terms of sum_l beta_l P_l(mu) P_l(mu'), beta_l = (2 l + 1) g^l, and W the weights. What decays
as e^(-k tau) has (A + B)(A - B) s = k² s and k d = (A - B) s. Inside, the boundary reflects by Fresnel. The forward
peak is cut off by delta-M (Wiscombe 1977).

The product is not symmetric, and near albedo 1 it loses 1 - a. Both factors are squares, though: with V = diag(W mu),
A - B = V^-½ F F^T V^½ and A + B = V^-½ G G^T V^½. Then k are the singular values of G^T F = X diag(k) Y^T,
s = V^-½ G X and d = V^-½ F Y: nothing is divided by k. What is the same in all directions is split off in F, where
1 - a stands as it is given; on the nodes all other orders are made orthogonal to it.

Source: Chandrasekhar 1960, chapter II; the reduction of the order is that of Stamnes et al. 1988.
"""

from __future__ import annotations

import functools
import math
import numbers
from typing import NamedTuple

import numpy as np

from halfspace_sss.backend import one_blas_thread
from halfspace_sss.physics.fresnel import F_r, F_t, mu_internal

DIFFUSE = "diffuse"
NODES = 96
DEGREE = 64  # of ln(R / albedo) as a polynomial of x, s = x / (c + (1 - c) x), s² = 1 - albedo'
DENSE = 8192  # values of it between which its inverse is looked up
STEPS = 2  # of Newton's method after that
LARGEST_G = 0.9999  # beyond it the peak, and that backwards, is narrower than the nodes are apart
LEAST = 1e-6  # albedo that stands for 0 in ln(R / albedo)


class _Basis(NamedTuple):
    """Nodes of an index with sqrt(w) P_l on them, P_l of even order without their mean over the nodes."""

    mu: np.ndarray
    w: np.ndarray
    even: np.ndarray  # of orders 2, 4, ...
    odd: np.ndarray
    mean: np.ndarray  # of those even orders
    alike: np.ndarray  # sqrt(w), of length 1: the same in all directions
    others: np.ndarray  # orthonormal, across it
    turned: np.ndarray  # the even orders in those


class _Modes(NamedTuple):
    """Solutions that decay downwards: s and d at the nodes, one a column, with k, and a beta_l of delta-M."""

    s: np.ndarray
    d: np.ndarray
    k: np.ndarray
    a_beta: np.ndarray


@one_blas_thread()
def half_space_reflectance(albedo: float, g: float, eta: float, mu_i: float | str = DIFFUSE) -> float:
    """The fraction of incident flux that comes back out of the medium, all orders, as R(mu_i) of the conventions.

    Args:
        albedo: of single scattering, [0, 1].
        g: mean cosine of the Henyey-Greenstein phase function, [-0.9999, 0.9999].
        eta: index inside over outside, > 0.
        mu_i: cosine of incidence, [0, 1], or "diffuse" for uniform radiance from above.

    Left out: what the boundary reflects from outside. Absolute error, against 256 nodes: at most 6e-8 for |g| <= 0.9,
    6e-5 for g in [-0.95, 0.98], and 6e-3 at -0.99, where the peak backwards leaves along the normal.
    """
    _check(g, mu_i)
    m, basis, T, share = _even_light(albedo, g, eta)
    if mu_i == DIFFUSE:
        up = (m.s - m.d) / 2
        R, entered = 2 * np.sum(basis.w * basis.mu * T * (up @ share)), 2 * np.sum(basis.w * basis.mu * T) * eta**2
    else:  # reciprocity: what comes out towards mu_i then is R(mu_i)
        entered = F_t(mu_i, eta)
        R = entered * _upwards(m, basis, share, mu_internal(mu_i, eta)) / eta**2
    return float(np.clip(R, 0, min(entered, 1.0)))  # but for rounding


def _even_light(albedo: float, g: float, eta: float) -> tuple[_Modes, _Basis, np.ndarray, np.ndarray]:
    """Modes, nodes, transmittance at the nodes, and the shares of the modes under radiance 1 from everywhere."""
    m, basis = _modes(albedo, g, eta), _basis(eta)
    down, up = (m.s + m.d) / 2, (m.s - m.d) / 2
    T = F_t(basis.mu, 1 / eta)
    return m, basis, T, np.linalg.solve(down - F_r(basis.mu, 1 / eta)[:, None] * up, T * eta**2)


def _upwards(m: _Modes, basis: _Basis, share: np.ndarray, inside: float) -> float:
    """Radiance that arrives at the boundary from within at the cosine `inside`."""
    return _sources(m, basis, inside)[0] / (m.k * inside + 1) @ share


def _sources(m: _Modes, basis: _Basis, inside: float) -> tuple[np.ndarray, np.ndarray]:
    """What each mode scatters upwards and downwards at the cosine `inside`, per optical thickness, at depth 0."""
    P = np.polynomial.legendre.legvander(np.array([inside]), len(m.a_beta) - 1)[0] * m.a_beta
    root = np.sqrt(basis.w)
    even = P[0] * basis.w + ((P[2::2] - basis.mean * m.a_beta[2::2]) @ basis.even.T) * root
    odd = (P[1::2] @ basis.odd.T) * root
    s, d = even @ m.s, odd @ m.d
    return (s - d) / 2, (s + d) / 2


class SlabFluxes(NamedTuple):
    """Fractions of incident flux of a slab between slides, for light along the normal."""

    reflectance: float
    transmittance: float
    unscattered: float  # part of the transmittance


LARGEST_SLAB_ALBEDO = 1 - 1e-9  # beyond it light that decays from both sides cannot be told apart


@one_blas_thread()
def slab_fluxes(
    albedo: float, g: float, tau: float, eta: float, eta_slide: float = 1.0, nodes: int = NODES
) -> SlabFluxes:
    """Reflectance and transmittance of a slab in air, with or without slides of glass on both sides.

    Radiance is sum_j a_j s_j exp(-k_j t) + b_j s_j exp(-k_j (tau - t)); by the symmetry of the slab a + b and a - b are
    solved for apart. What is asked of one direction is integrated along it.

    Args:
        albedo, g: of single scattering, as in `half_space_reflectance`; albedos beyond 1 - 1e-9 count as that.
        tau: optical thickness, > 0.
        eta, eta_slide: index of the medium, >= 1, and of slides that do not absorb, 1 for none; light adds up
            incoherently.
        nodes: quadrature points.
    """
    albedo = min(albedo, LARGEST_SLAB_ALBEDO)
    m, basis = _modes(albedo, g, eta, nodes), _basis(eta, nodes)
    thick = tau * (1 - albedo * g**nodes)  # of delta-M
    F = _slide_reflectance(basis.mu, eta, eta_slide)
    down, up, far = (m.s + m.d) / 2, (m.s - m.d) / 2, np.exp(-m.k * thick)
    lit, dark = down - F[:, None] * up, (up - F[:, None] * down) * far
    entering = (1 - F) * eta**2
    both, odd = np.linalg.solve(lit + dark, entering), np.linalg.solve(lit - dark, entering)
    a, b = (both + odd) / 2, (both - odd) / 2
    # along the normal: what modes scatter on the way through, I⁻(0) = E F I⁺(tau) + SU, I⁺(tau) = E (F I⁻(0) + T) + SD
    u, v = _sources(m, basis, 1.0)
    E, near = math.exp(-thick), -np.expm1(-(m.k + 1) * thick) / (m.k + 1)
    with np.errstate(divide="ignore", invalid="ignore"):
        across = np.where(abs(m.k - 1) < 1e-7, thick * E, (far - E) / (1 - m.k))
    SU, SD = a @ (u * near) + b @ (v * across), a @ (v * across) + b @ (u * near)
    F = float(_slide_reflectance(np.ones(1), eta, eta_slide)[0])
    T = (1 - F) * eta**2
    upwards = (E * F * (E * T + SD) + SU) / (1 - (E * F) ** 2)
    downwards = E * (F * upwards + T) + SD
    straight = math.exp(-tau)
    return SlabFluxes(
        reflectance=F + (1 - F) * upwards / eta**2, transmittance=(1 - F) * downwards / eta**2,
        unscattered=(1 - F) ** 2 * straight / (1 - (F * straight) ** 2),
    )  # fmt: skip


class SlabKernels(NamedTuple):
    """How light of each direction is scattered by a slab, as kernels between internal cosines.

    The radiance outside along mu_o under irradiance E along mu_i is F_t(mu_i) F_t(mu_o) / eta² times E times a kernel.
    """

    mu: np.ndarray  # rising, inside
    reflected: np.ndarray  # of two events or more, or with reflections inside, 1/sr, by azimuth, exit and entry
    transmitted: np.ndarray
    reflectance: np.ndarray  # fraction of entered flux that leaves upwards scattered, by entry, all orders
    transmittance: np.ndarray
    straight: float  # optical thickness for light that passes unscattered; of delta-M


@one_blas_thread()
def slab_kernels(
    albedo: float, g: float, tau: float, eta: float, azimuths: np.ndarray, orders: int, nodes: int = NODES
) -> SlabKernels:
    """How a slab in air scatters, without light scattered once that no boundary reflects inside, which has formulas.

        K_r = a p (1 - exp(-t (1/mu_i + 1/mu_o))) / (mu_i + mu_o),
        K_t = a p (exp(-t / mu_o) - exp(-t / mu_i)) / (mu_o - mu_i),   cosines inside, p of the phase function, 1/sr

    is what is left out. All of it enters `reflectance` and `transmittance`.

    Args:
        albedo, g, tau, eta, nodes: as of `slab_fluxes`.
        azimuths: between the directions of travel.
        orders: of the Fourier series over azimuth.
    """
    albedo = min(albedo, LARGEST_SLAB_ALBEDO)
    first, basis = _modes(albedo, g, eta, nodes), _basis(eta, nodes)
    t, mu = tau * (1 - albedo * g**nodes), basis.mu
    F = F_r(mu, 1 / eta)
    i, o, E = mu[None], mu[:, None], np.exp(-t / mu)
    entering = np.diag(1 / (2 * np.pi * mu * basis.w))  # each node alone is lit by flux 1
    straight = np.diag(entering) * E / (1 - (F * E) ** 2)
    leaving, reflected, transmitted = 2 * np.pi * basis.w * mu * (1 - F), 0.0, 0.0
    with np.errstate(divide="ignore", invalid="ignore"):
        back = -np.expm1(-t * (1 / i + 1 / o)) / (i + o)
        across = np.where(i == o, t * E / (i * o), (np.exp(-t / o) - np.exp(-t / i)) / (o - i))
    for order in range(orders):
        P = _associated_legendre(mu, order, nodes)
        m = first if order == 0 else _azimuthal_modes(P, order, first.a_beta, basis)
        down, up, far = (m.s + m.d) / 2, (m.s - m.d) / 2, np.exp(-m.k * t)
        lit, dark = down - F[:, None] * up, (up - F[:, None] * down) * far
        both, odd = np.linalg.solve(lit + dark, entering), np.linalg.solve(lit - dark, entering)
        a, b = (both + odd) / 2, far[:, None] * (both - odd) / 2
        # without what passes unscattered
        upwards = up @ a + down @ b - np.diag(F * E * straight)
        downwards = down @ (far[:, None] * a) + up @ (both - odd) / 2 - np.diag(straight)
        if order == 0:
            R, T = leaving @ upwards, leaving @ downwards
        # without light scattered once
        signs = (-1.0) ** (np.arange(nodes) + order)
        ahead, behind = ((P * (m.a_beta * sign)) @ P.T / (4 * np.pi) for sign in (1, signs))
        wave = (1 if order == 0 else 2) * np.cos(order * np.asarray(azimuths))[:, None, None]
        reflected, transmitted = (
            reflected + wave * (upwards - behind * back),
            transmitted + wave * (downwards - ahead * across),
        )
    some = np.flatnonzero(F < 1)
    reflected, transmitted = (each[:, some][:, :, some] for each in (reflected, transmitted))
    return SlabKernels(mu[some], reflected, transmitted, R[some], T[some], t)


def _associated_legendre(mu: np.ndarray, m: int, n: int) -> np.ndarray:
    """sqrt((l - m)! / (l + m)!) P_l^m for l < n, one a column; 0 for l < m."""
    result = np.zeros((len(mu), n))
    result[:, m] = np.prod([math.sqrt((2 * k - 1) / (2 * k)) for k in range(1, m + 1)]) * (1 - mu * mu) ** (m / 2)
    for k in range(m, n - 1):
        before = math.sqrt(k * k - m * m) * result[:, k - 1] if k > m else 0.0
        result[:, k + 1] = ((2 * k + 1) * mu * result[:, k] - before) / math.sqrt((k + 1) ** 2 - m * m)
    return result


def _azimuthal_modes(P: np.ndarray, order: int, a_beta: np.ndarray, basis: _Basis) -> _Modes:
    """Modes of radiance that goes as cos(order phi), order > 0, from `_associated_legendre` of the order."""
    root, n = np.sqrt(basis.w)[:, None] * P, len(basis.mu)
    even, odd = root[:, order % 2 :: 2], root[:, 1 - order % 2 :: 2]
    # A - B = V^-½ F F^T V^½ and A + B = V^-½ G G^T V^½
    of_even, of_odd = a_beta[order % 2 :: 2], a_beta[1 - order % 2 :: 2]
    F, G = (
        np.linalg.cholesky(np.eye(n) - (part * of) @ part.T) / np.sqrt(basis.mu)[:, None]
        for part, of in ((even, of_even), (odd, of_odd))
    )
    X, k, Y = np.linalg.svd(G.T @ F)
    scale = 1 / np.sqrt(basis.w * basis.mu)[:, None]
    return _Modes(scale * (G @ X), scale * (F @ Y.T), k, a_beta)


def _slide_reflectance(mu: np.ndarray, eta: float, eta_slide: float) -> np.ndarray:
    """Of a boundary with a slide, for light from within the medium at the cosines mu."""
    inner = F_r(mu, eta_slide / eta)
    sine2 = np.minimum((1 - mu * mu) * (eta / eta_slide) ** 2, 1.0)
    outer = F_r(np.sqrt(1 - sine2), 1 / eta_slide)
    turned = inner >= 1
    return np.where(turned, 1.0, inner + (1 - inner) ** 2 * outer / np.where(turned, 1.0, 1 - inner * outer))


@one_blas_thread()
def directional_table(g: float, eta: float, x: np.ndarray, mu_in: np.ndarray) -> np.ndarray:
    """ln(R(mu) / (albedo F_t(mu))), shape (x, mu_in), which is smooth in both.
    `g`, `eta`: as in `half_space_reflectance`. `x`: in [0, 1], of the albedos 1 - albedo' = s², s = x / (c + (1 - c)
    x), c = (1 - max(g, 0))^(1/3). `mu_in`: cosines inside, in [0, 1], of the directions mu outside."""
    result = []
    for albedo in np.maximum(_albedo(np.asarray(x, dtype=float), g)[0], LEAST).tolist():
        m, basis, _, share = _even_light(albedo, g, eta)
        result.append([_upwards(m, basis, share, each) / (albedo * eta**2) for each in mu_in])
    return np.log(result)


def _check(g: float, mu_i: float | str) -> None:
    if not abs(g) <= LARGEST_G:
        raise ValueError(f"g must be in [-{LARGEST_G}, {LARGEST_G}] for the exact reflectance, got {float(g)!r}")
    if mu_i != DIFFUSE and not (isinstance(mu_i, numbers.Real) and 0 <= mu_i <= 1):
        raise ValueError(f"mu_i must be a number in [0, 1] or {DIFFUSE!r}, got {mu_i!r}")


def _modes(albedo: float, g: float, eta: float, nodes: int = NODES) -> _Modes:
    basis = _basis(eta, nodes)
    n = len(basis.mu)
    # delta-M: the share g^n of the peak counts as unscattered
    peak = g**n
    lost = (1 - albedo) / (1 - albedo * peak)  # 1 - a
    order = np.arange(n)
    a_beta = (1 - lost) * (2 * order + 1) * (float(g) ** order - peak) / (1 - peak)
    # factors of A - B = V^-½ F F^T V^½ and A + B = V^-½ G G^T V^½
    root = 1 / np.sqrt(basis.mu)[:, None]
    C = np.linalg.cholesky(np.eye(n - 1) - (basis.turned * a_beta[2::2]) @ basis.turned.T)
    F = root * np.column_stack([math.sqrt(lost) * basis.alike, basis.others @ C])
    G = root * np.linalg.cholesky(np.eye(n) - (basis.odd * a_beta[1::2]) @ basis.odd.T)
    # modes: G^T F = X diag(k) Y^T, s = V^-½ G X, d = V^-½ F Y
    X, k, Y = np.linalg.svd(G.T @ F)
    scale = 1 / np.sqrt(basis.w * basis.mu)[:, None]
    return _Modes(scale * (G @ X), scale * (F @ Y.T), k, a_beta)


@functools.lru_cache(maxsize=16)
def _basis(eta: float, nodes: int = NODES) -> _Basis:
    mu, w = _nodes(nodes, eta)
    P = np.polynomial.legendre.legvander(mu, len(mu) - 1)
    root, mean = np.sqrt(w)[:, None], w @ P[:, 2::2]
    turn = np.linalg.qr(np.column_stack([root, np.eye(len(mu))[:, 1:]]))[0]
    even, others = root * (P[:, 2::2] - mean), turn[:, 1:]
    return _Basis(
        mu=mu, w=w, even=even, odd=root * P[:, 1::2], mean=mean, alike=turn[:, 0], others=others, turned=others.T @ even
    )


def _nodes(n: int, eta: float) -> tuple[np.ndarray, np.ndarray]:
    """Gauss points of [0, 1], close together on both sides of the critical cosine c, where radiance has a kink.
    Below a small c there are few: all others would be too few for the polynomials of highest order, which are then not
    orthogonal on the nodes."""
    if eta <= 1:
        return unit_gauss(n)
    c = math.sqrt((eta - 1) * (eta + 1)) / eta
    below = max(n // 8, round(n * min(c, 0.5)))
    (t, w), (T, W) = unit_gauss(below), unit_gauss(n - below)
    return np.concatenate([c * (1 - t * t), c + (1 - c) * T * T]), np.concatenate([c * 2 * t * w, (1 - c) * 2 * T * W])


@functools.cache
def unit_gauss(n: int) -> tuple[np.ndarray, np.ndarray]:
    """Points and weights of the Gauss-Legendre rule on [0, 1]."""
    x, w = np.polynomial.legendre.leggauss(n)
    return 0.5 * (x + 1), 0.5 * w


def albedo_of_reflectance(reflectance: np.ndarray, g: float, eta: float, mu_i: float | str = DIFFUSE) -> np.ndarray:
    """The albedo of single scattering of the half-space with the given reflectance.
    `reflectance`: array of any shape, from 0 to that of albedo 1. `g`, `eta`, `mu_i`: as in `half_space_reflectance`.
    ValueError if a reflectance is out of reach; bound and value are named."""
    _check(g, mu_i)
    R = np.asarray(reflectance, dtype=np.float64)
    x, values, polynomial = _inverse(float(g), float(eta), mu_i if mu_i == DIFFUSE else float(mu_i))
    most = half_space_reflectance(1.0, g, eta, mu_i)
    reached = (R >= 0) & (R <= most * (1 + 1e-9))
    if not reached.all():
        wrong = R[~reached].flat[0]
        raise ValueError(
            f"reflectance must be in [0, {most:.4g}], the most without absorption at eta {eta:g}, got {float(wrong)!r}"
        )
    result, slope = np.interp(R, values, x), polynomial.deriv()
    for _ in range(STEPS):
        albedo, growth = _albedo(result, g)
        value = albedo * np.exp(polynomial(result))
        change = (growth + albedo * slope(result)) * np.exp(polynomial(result))
        result = np.clip(result - (value - R) / np.minimum(change, -1e-12), 0, 1)
    return np.minimum(_albedo(result, g)[0], 1.0)  # rounding gives 1 + 2e-16 too


@functools.lru_cache(maxsize=64)
def _inverse(g: float, eta: float, mu_i: float | str) -> tuple[np.ndarray, np.ndarray, np.polynomial.Chebyshev]:
    """x falling from 1 to 0, the reflectance there, and ln(R / albedo) as a polynomial of x."""

    def log_ratio(x: np.ndarray) -> np.ndarray:
        albedo = _albedo(x, g)[0]
        return np.log([half_space_reflectance(a, g, eta, mu_i) / a for a in albedo])

    polynomial = np.polynomial.Chebyshev.interpolate(log_ratio, DEGREE, domain=[0, 1])
    x = np.linspace(1, 0, DENSE)
    return x, np.maximum.accumulate(_albedo(x, g)[0] * np.exp(polynomial(x))), polynomial


def _albedo(x: np.ndarray, g: float) -> tuple[np.ndarray, np.ndarray]:
    """The albedo whose reduced one is 1 - s², and its derivative by x.
    The albedo (1 - s²)/(1 - g s²) has its pole close to s = 1 for g near 1; c = (1 - g)^(1/3) moves it away in x."""
    c = (1 - max(g, 0.0)) ** (1 / 3)
    below = c + (1 - c) * x
    s = x / below
    rest = 1 - g * s * s
    # 1 - s = c (1 - x) / below
    return c * (1 - x) / below * (1 + s) / rest, -2 * s * (1 - g) / rest**2 * c / below**2
