"""Measures of any half-space model through the shared interface alone: flux, profile, moments, reciprocity, energy.

Everything is an integral of S by a quadrature whose numbers are open (`Quadrature`): a trapezoid in ln r over the
distances that carry flux, periodic trapezoids in both azimuths with the mirror symmetry, Gauss-Legendre in mu_o.
Where S depends on both azimuths, the reflectance is summed on a shifted lattice instead, which tells its error.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from halfspace_sss.checks import check_cosine, check_count, rounding
from halfspace_sss.interface.model import BSSRDF, bssrdf, models
from halfspace_sss.measure.lattice import lattice_reflectance
from halfspace_sss.measure.quadrature import Angles, Quadrature, cosine_nodes, distances, flux, log_sum
from halfspace_sss.physics import single_scattering
from halfspace_sss.physics.fresnel import C_1, F_t, mu_external
from halfspace_sss.physics.medium import Medium

if TYPE_CHECKING:
    import pandas

__all__ = [
    "Estimate", "Moments", "Quadrature", "ReciprocityGap", "clamped_energy", "energy_table", "moments", "profile",
    "reciprocity_gap", "reflectance", "reflectance_estimate", "weight_variance",
]  # fmt: skip

DEFAULT = Quadrature()
DIFFUSE_COSINES = 10  # of incidence, on the lattice


class Estimate(NamedTuple):
    """A value and its error."""

    value: Any
    error: Any


class Moments(NamedTuple):
    """Mean square distance (mm²) and mean displacement along the incident light's travel (mm) of the exitant flux."""

    mean_r2: Any
    mean_x: Any


class ReciprocityGap(NamedTuple):
    """|S - S'| / (S + S'), S' with entry and exit exchanged: mean and largest over the queries, and share of energy."""

    mean: Any
    max: Any
    energy: Any


def _over_incidence(angles: Angles, mu_i: Any, q: Quadrature) -> np.ndarray:
    """`flux` for a number, an array or "diffuse", with the channel axis last if the medium has one."""
    _check_diffuse(mu_i)
    if isinstance(mu_i, str):
        mu, w = cosine_nodes(angles.medium.eta, q.n_mu)
        R = 2 * w @ np.stack([flux(angles, m, q) for m in mu])
    else:
        mu = _cosines(mu_i)
        R = np.stack([flux(angles, m, q) for m in mu.ravel()]).reshape(*mu.shape, -1)
    return R if angles.medium.n_channels is not None else R[..., 0][()]


def _cosines(mu_i: Any) -> np.ndarray:
    """Cosines in [0, 1] in float64, those that exceed 1 by rounding as 1; ValueError otherwise."""
    mu = np.asarray(mu_i, dtype=np.float64)
    mu = np.where((mu > 1) & (mu <= 1 + rounding(mu_i)), 1.0, mu)
    if not mu.size or not np.all((mu >= 0) & (mu <= 1)):
        bad = mu[~((mu >= 0) & (mu <= 1))]
        raise ValueError(
            f"mu_i must be in [0, 1], got {float(bad.flat[0])!r}" if bad.size else "mu_i must not be empty"
        )
    return mu


def reflectance(model: BSSRDF, mu_i: Any = 1.0, order: str | None = None, quadrature: Quadrature | None = None) -> Any:
    """Fraction of incident flux that comes back out of the medium, R(mu_i) = ∫∫ S mu_o dw_o dA_o.

    Args:
        model: any model of the interface.
        mu_i: external cosine of incidence, number or NumPy array in [0, 1], or "diffuse" for uniform radiance from
            above, 2 ∫ R(mu_i) mu_i dmu_i.
        order: None for the orders the model contains, or "multiple", or "total", which adds the exact single order to
            a model of "multiple".
        quadrature: see `Quadrature`. None: its defaults where S does not depend on both azimuths (1e-6 relative for
            smooth models), else a lattice; `reflectance_estimate` tells the error.

    Returns:
        Array of the shape of mu_i, with the channel axis last if the medium has channels; a number for numbers.

    Raises:
        ValueError: mu_i is out of range, or the model cannot form the order.
    """
    _check_order(model, order)
    angles = Angles(model.eval, model.medium, quadrature or DEFAULT)
    on_lattice = quadrature is None and angles.both_azimuths
    R = _lattice(model, mu_i).value if on_lattice else _over_incidence(angles, mu_i, quadrature or DEFAULT)
    return R + _single(model, mu_i, order)


def reflectance_estimate(model: BSSRDF, mu_i: Any = 1.0, order: str | None = None) -> Estimate:
    """`reflectance` with its error: on a lattice the standard error, else the difference from a rule of half as many.

    Arguments, shapes and errors as `reflectance`.
    """
    _check_order(model, order)
    angles = Angles(model.eval, model.medium, DEFAULT)
    if angles.both_azimuths:
        R = _lattice(model, mu_i)
    else:
        half = Quadrature(DEFAULT.per_decade // 2, DEFAULT.n_azimuth // 2, DEFAULT.n_mu // 2)
        value = _over_incidence(angles, mu_i, DEFAULT)
        R = Estimate(value, abs(value - _over_incidence(Angles(model.eval, model.medium, half), mu_i, half)))
    return Estimate(R.value + _single(model, mu_i, order), R.error)


def _check_order(model: BSSRDF, order: str | None) -> None:
    if order not in (None, model.orders) and (order, model.orders) != ("total", "multiple"):
        raise ValueError(
            f'order must be {model.orders!r} or None for {model.name!r}, or "total" if "multiple", got {order!r}'
        )


def _single(model: BSSRDF, mu_i: Any, order: str | None) -> Any:
    added = order == "total" and model.orders == "multiple"
    return single_scattering.reflectance(model.medium, mu_i) if added else 0.0


def _lattice(model: BSSRDF, mu_i: Any) -> Estimate:
    """By the lattice, for a number, an array or "diffuse", with the channel axis last if the medium has one."""
    _check_diffuse(mu_i)
    m = model.medium
    parts = [model] if m.n_channels is None else [model.for_medium(m.channel(k)) for k in range(m.n_channels)]
    diffuse = isinstance(mu_i, str)
    mu, w = cosine_nodes(m.eta, DIFFUSE_COSINES) if diffuse else (_cosines(mu_i), None)
    found = np.array([[lattice_reflectance(part, one) for part in parts] for one in mu.ravel().tolist()])
    found = 2 * np.tensordot(w, found, 1) if diffuse else found.reshape(*mu.shape, len(parts), 2)
    return Estimate(*(v if m.n_channels is not None else v[..., 0][()] for v in (found[..., 0], found[..., 1])))


def _check_diffuse(mu_i: Any) -> None:
    if isinstance(mu_i, str) and mu_i != "diffuse":
        raise ValueError(f'mu_i must be cosines in [0, 1] or "diffuse", got {mu_i!r}')


def profile(model: BSSRDF, r: Any, mu_i: float = 1.0, quadrature: Quadrature = DEFAULT) -> np.ndarray:
    """Exitance per incident flux at distance r, averaged over azimuth, M(r) = (1/2pi) ∫∫ S mu_o dw_o dphi, 1/mm².

    Args:
        r: distances in mm, >= 0, any shape; the result adds the channel axis last if the medium has channels.
        mu_i: external cosine of incidence, one number in [0, 1].

    Raises:
        ValueError: r or mu_i is out of range.
    """
    r = np.asarray(r, dtype=np.float64)
    mu_i = float(_cosines(mu_i))
    M = Angles(model.eval, model.medium, quadrature).exitance(r.ravel(), mu_i)[0].reshape(*r.shape, -1)
    return M if model.medium.n_channels is not None else M[..., 0][()]


def moments(model: BSSRDF, mu_i: float = 1.0, quadrature: Quadrature = DEFAULT) -> Moments:
    """Where the exitant flux leaves on average: ⟨r²⟩ = ∫ r² M dA / ∫ M dA in mm², ⟨x⟩ likewise in mm.

    x runs along the horizontal direction of travel of the incident light. A moment that diverges (no absorption: the
    profile falls as r^-3) is inf; NaN where nothing comes out. mu_i: one number in [0, 1]; ValueError otherwise.
    """
    mu_i = float(_cosines(mu_i))
    angles = Angles(model.eval, model.medium, quadrature)
    r = distances(angles, mu_i, quadrature, (2, 4))
    M, M_x = angles.exitance(r, mu_i)
    h, r = math.log(r[1] / r[0]), r[:, None]
    with np.errstate(invalid="ignore", divide="ignore"):
        R = log_sum(M * r**2, h)
        result = log_sum(M * r**4, h) / R, log_sum(M_x * r**3, h) / R
    return Moments(*(v if model.medium.n_channels is not None else v[0] for v in result))


def reciprocity_gap(model: BSSRDF, n: int = 4096, seed: int = 0) -> ReciprocityGap:
    """How far S(x_i, w_i; x_o, w_o) is from S' = S(x_o, w_o; x_i, w_i), by |S - S'| / (S + S') at random queries.

    r is uniform in ln r from 0.01 mean free paths to 10 transport mean free paths, both directions follow the cosine
    over those that refract, azimuths are uniform. `mean` and `max` are over queries (0 where both vanish); `energy`
    is sum r² |S - S'| / sum r² |S + S'|, the share of the transported flux. One value per channel where there are any.

    Raises:
        ValueError: n < 1.
    """
    if n < 1:
        raise ValueError(f"n must be >= 1, got {n!r}")
    m = model.medium
    mfp, transport = np.atleast_1d(m.mfp), 1 / np.maximum(np.atleast_1d(m.sigma_t_prime), 1e-300)
    gaps = []
    for k in range(len(mfp)):
        rng = np.random.default_rng(seed)
        r = np.exp(rng.uniform(math.log(0.01 * mfp[k]), math.log(10 * transport[k]), n))
        mu_i, mu_o = (mu_external(np.sqrt(rng.uniform(0, 1, n)), min(m.eta, 1.0)) for _ in range(2))
        phi_i, phi_o = rng.uniform(-math.pi, math.pi, (2, n))
        S = np.reshape(model.eval(r, mu_i, phi_i, mu_o, phi_o), (n, -1))[:, k].astype(np.float64)
        back = np.reshape(model.eval(r, mu_o, phi_o + math.pi, mu_i, phi_i + math.pi), (n, -1))[:, k].astype(np.float64)
        gap, size = np.abs(S - back), np.abs(S + back)
        ratio = gap / np.where(size > 0, size, 1.0)
        gaps.append((ratio.mean(), ratio.max(), np.sum(r**2 * gap) / max(np.sum(r**2 * size), 1e-300)))
    return ReciprocityGap(*(np.array(v) if m.n_channels is not None else v[0] for v in zip(*gaps)))


def clamped_energy(model: BSSRDF, mu_i: Any = 1.0, quadrature: Quadrature = DEFAULT) -> Any:
    """Flux per incident flux that clamping negative values adds, ∫∫ (S - S_unclamped) mu_o dw_o dA_o, >= 0.

    0 for a model that does not clamp. Arguments, shapes and errors as `reflectance`.
    """
    if type(model).G_unclamped is BSSRDF.G_unclamped:
        coarse = Quadrature(4, 4, 2)
        return 0.0 * _over_incidence(Angles(model.eval, model.medium, coarse), mu_i, coarse)

    def added(*query: Any) -> Any:
        return model.eval(*query) - model.eval_unclamped(*query)

    return _over_incidence(Angles(added, model.medium, quadrature, model.eval), mu_i, quadrature)


def energy_table(
    media: Mapping[str, Medium], names: Iterable[str] | None = None, mu_i: Iterable[Any] = (1.0, 0.3, "diffuse"),
    quadrature: Quadrature | None = None,
) -> pandas.DataFrame:  # fmt: skip
    """Reflectance of models over media against what can enter, where models leave [0, 1].

    Args:
        media: media by name.
        names: registered models, by default all.
        mu_i: incidences as in `reflectance`.

    Returns:
        One row per medium, channel, model and incidence: `reflectance` at the model's own orders, `total` with the
        single order added to models of "multiple", `limit` = T_12(mu_i) (diffuse: 1 - 2 C_1(1/eta)), `inside`, whether
        total lies in [0, limit] to 1e-6, and `note`, why a model refuses the medium (NaN, and None for `inside`).
    """
    import pandas

    rows = []
    for medium_name, medium in media.items():
        for name in models() if names is None else names:
            for incidence in mu_i:
                rows += _energy_rows(medium_name, medium, name, incidence, quadrature)
    return pandas.DataFrame(rows)


def _energy_rows(medium_name: str, medium: Medium, name: str, mu_i: Any, quadrature: Quadrature | None) -> list[dict]:
    n = medium.n_channels or 1
    try:
        model = bssrdf(name, medium)
        orders, note = model.orders, ""
        R = np.broadcast_to(reflectance(model, mu_i, quadrature=quadrature), n)
    except ValueError as error:
        if name not in models():
            raise
        orders, note, R = "", str(error), np.full(n, np.nan)
    total = R + (single_scattering.reflectance(medium, mu_i) if orders == "multiple" else 0.0)
    limit = 1 - 2 * C_1(1 / medium.eta) if isinstance(mu_i, str) else float(F_t(np.float64(mu_i), medium.eta))
    inside = [None if note else bool(-1e-6 <= t <= limit + 1e-6) for t in total]
    return [
        {"medium": medium_name, "channel": k, "model": name, "orders": orders, "mu_i": mu_i, "reflectance": R[k],
         "total": total[k], "limit": limit, "inside": inside[k], "note": note}
        for k in range(n)
    ]  # fmt: skip


def weight_variance(model: BSSRDF, mu_o: float = 0.8, n: int = 1 << 14, seed: int = 0) -> Any:
    """Relative variance of the weight S mu_i / (pdf_position pdf_direction) of the model's own samples.

    Var(w) / E(w)², E(w) the radiance that leaves under uniform light: the smaller, the fewer samples a render needs.

    Args:
        model: any model; a medium with channels gives one value for each.
        mu_o: cosine of exit, (0, 1].
        n: samples, at least 2; seed: of the uniform numbers.

    Raises:
        ValueError: an argument is out of range.
    """
    mu_o = check_cosine("mu_o", mu_o, 1e-6)
    check_count("n", n, 2)
    check_count("seed", seed, 0)
    if model.medium.n_channels is not None:
        parts = [model.for_medium(model.medium.channel(k)) for k in range(model.medium.n_channels)]
        return np.array([weight_variance(part, mu_o, n, seed) for part in parts])
    u = np.random.default_rng(seed).random((4, n))
    at = model.sample_position(mu_o, (u[0], u[1]))
    phi_o = np.pi - at.phi
    w_i = model.sample_direction(at.r, mu_o, phi_o, (u[2], u[3]))
    w = model.eval(at.r, w_i.mu_i, w_i.phi_i, mu_o, phi_o) * w_i.mu_i / (at.pdf * w_i.pdf)
    return float(np.var(w, ddof=1) / np.mean(w) ** 2)
