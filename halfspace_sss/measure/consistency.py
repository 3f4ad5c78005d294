"""What a half-space model keeps: reciprocity, positive values, energy; and the variance of its own samples."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from halfspace_sss.checks import check_cosine, check_count
from halfspace_sss.interface.model import BSSRDF
from halfspace_sss.measure.quadrature import Angles, Quadrature
from halfspace_sss.measure.reflected_flux import DEFAULT, Incidence, Values, over_incidence, reflectance
from halfspace_sss.physics import single_scattering
from halfspace_sss.physics.fresnel import C_1, F_t, mu_external
from halfspace_sss.physics.medium import Medium
from halfspace_sss.registry import bssrdf, models

if TYPE_CHECKING:
    import pandas


class ReciprocityGap(NamedTuple):
    """|S - S'| / (S + S'), S' with entry and exit exchanged: mean and largest over the queries, and share of energy."""

    mean: Values
    max: Values
    energy: Values


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


def clamped_energy(model: BSSRDF, mu_i: Incidence = 1.0, quadrature: Quadrature = DEFAULT) -> Values:
    """Flux per incident flux that clamping negative values adds, ∫∫ (S - S_unclamped) mu_o dw_o dA_o, >= 0.

    0 for a model that does not clamp. Arguments, shapes and errors as `reflectance`.
    """
    if type(model).G_unclamped is BSSRDF.G_unclamped:
        coarse = Quadrature(4, 4, 2)
        return 0.0 * over_incidence(Angles(model.eval, model.medium, coarse), mu_i, coarse)

    def added(*query: np.ndarray) -> np.ndarray:
        return model.eval(*query) - model.eval_unclamped(*query)

    return over_incidence(Angles(added, model.medium, quadrature, model.eval), mu_i, quadrature)


def energy_table(
    media: Mapping[str, Medium], names: Iterable[str] | None = None, mu_i: Iterable[Incidence] = (1.0, 0.3, "diffuse"),
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


def _energy_rows(
    medium_name: str, medium: Medium, name: str, mu_i: Incidence, quadrature: Quadrature | None
) -> list[dict[str, object]]:
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


def weight_variance(model: BSSRDF, mu_o: float = 0.8, n: int = 1 << 14, seed: int = 0) -> Values:
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
