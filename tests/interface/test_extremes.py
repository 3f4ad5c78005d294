"""Every model at the ends of every parameter: no NaN, no Inf, nothing negative, float32 as good as float64."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

import halfspace_sss
from halfspace_sss import Medium
from halfspace_sss.backend import array_types

ALBEDO = (0.0, 1e-6, 1e-3, 0.5, 0.9, 0.999, 1 - 1e-7, 1.0)
G = (-0.99, -0.5, 0.0, 0.5, 0.9, 0.999)
ETA = (0.66, 1.0, 1.0001, 1.5, 3.0)
SIGMA_T = (1e-4, 1.0, 1e4)
N_RANDOM = 120
SMALLEST = 1e-36  # 1/mm² and 1/mfp²: above, float32 has all its digits
EVERY = {"neural_paper": 13}  # medium, as each has a large file; all values of all parameters are among them


def media() -> list[Medium]:
    """Every combination of albedo, g and eta; the three extinctions take turns."""
    cases = enumerate(itertools.product(ALBEDO, G, ETA))
    return [Medium.from_albedo(albedo, SIGMA_T[k % 3], g, eta) for k, (albedo, g, eta) in cases]


def query(medium: Medium, seed: int) -> list[np.ndarray]:
    """Corners and random points, in float32; r from 0 to 1e6 mean free paths."""
    r, mu_i, mu_o = (0.0, 1e-8, 1e-3, 1.0, 30.0, 1e6), (0.0, 1e-6, 1e-3, 0.7, 1.0), (0.0, 1e-3, 1.0)
    corners = np.array(list(itertools.product(r, mu_i, (0.0, np.pi), mu_o, (0.0,))))
    rng = np.random.default_rng(seed)
    uniform = rng.random((4, N_RANDOM))
    cosines = np.where(uniform[:2] < 0.5, (2 * uniform[:2]) ** 6, uniform[:2])  # half of them towards grazing
    azimuths = 2 * np.pi * uniform[2:] - np.pi
    scattered = [10 ** rng.uniform(-8, 6, N_RANDOM), cosines[0], azimuths[0], cosines[1], azimuths[1]]
    points = np.concatenate([corners.T, scattered], axis=1)
    points[0] /= medium.sigma_t
    return list(points.astype(np.float32))


def make(name: str, medium: Medium):
    """The model, or None if it refuses the medium with a ValueError that names parameter, bound and value."""
    try:
        return halfspace_sss.bssrdf(name, medium)
    except ValueError as error:
        assert any(f"{p} must be" in str(error) for p in ("albedo", "g", "eta", "sigma_s", "sigma_a")), error
        assert "got " in str(error)
        return None


def test_values_stay_finite_and_not_negative_in_both_precisions(name):
    """300 queries of each of 240 media; models may refuse a medium, but not most."""
    answered, asked = 0, 0
    for seed, medium in list(enumerate(media()))[:: EVERY.get(name, 1)]:
        single = query(medium, seed)
        asked += 2 * single[0].size
        model = make(name, medium)
        if model is None:
            continue
        S32, S64 = model.eval(*single), model.eval(*(x.astype(np.float64) for x in single))
        where = f"{medium}"
        for S in (S32, S64):
            assert np.isfinite(S).all(), (where, [x[~np.isfinite(S)][0] for x in single])
            assert (S >= 0).all(), (where, [x[S < 0][0] for x in single])
        if medium.sigma_s == 0:
            assert not S64.any(), where
        # of a size that float32 can hold, in 1/mm² and in 1/mfp²
        normal = S64 * min(1, medium.sigma_t**-2) > SMALLEST
        compared = normal & (S64 > 1e-30 * S64.max())
        error = np.abs(S32 / np.where(compared, S64, 1) - 1)[compared]
        worst = error.argmax() if error.size else 0
        assert (error <= 1e-3).all(), (where, error.max(), [x[compared][worst] for x in single], S64[compared][worst])
        answered += S32.size + S64.size
    assert answered >= 0.15 * asked


@pytest.mark.parametrize("eta", [1.0, 1.3])
def test_almost_no_absorption_tends_to_none(name, eta):
    """albedo 1 - 1e-12 and 1 agree: nothing divides by the absorption."""
    points = (np.array([0.1, 1.0, 5.0]), 0.8, 0.3, 0.9, 0.0)
    values = [halfspace_sss.bssrdf(name, Medium.from_albedo(a, 1.0, 0.5, eta)).eval(*points) for a in (1 - 1e-12, 1.0)]
    np.testing.assert_allclose(*values, rtol=1e-4)


@pytest.mark.parametrize("g", [0.0, 0.8])
def test_an_index_close_to_matched_tends_to_matched(name, g):
    points = (np.array([0.1, 1.0, 5.0]), 0.8, 0.3, 0.9, 0.0)
    values = [halfspace_sss.bssrdf(name, Medium.from_albedo(0.9, 1.0, g, eta)).eval(*points) for eta in (1 + 1e-6, 1.0)]
    np.testing.assert_allclose(*values, rtol=5e-3)  # the published fit of F_dr jumps by 0.0016 at eta = 1


@pytest.mark.parametrize("library", ["torch", "drjit"])
def test_other_array_libraries_stay_finite_too(name, library):
    """Every 13th medium in float32, against NumPy in float64."""
    torch = pytest.importorskip("torch") if library == "torch" else None
    convert = torch.as_tensor if torch else array_types("llvm").Float
    for seed, medium in list(enumerate(media()))[::13]:
        model = make(name, medium)
        if model is None:
            continue
        single = query(medium, seed)
        S, expected = model.eval(*map(convert, single)).numpy(), model.eval(*(x.astype(np.float64) for x in single))
        assert np.isfinite(S).all() and (S >= 0).all(), medium
        compared = (expected * min(1, medium.sigma_t**-2) > SMALLEST) & (expected > 1e-30 * expected.max())
        np.testing.assert_allclose(S[compared], expected[compared], rtol=1e-3, err_msg=str(medium))
