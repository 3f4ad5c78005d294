"""Rounding is no mistake: cosines that exceed 1 by it are 1, and distances whose squares overflow have S = 0."""

from __future__ import annotations

import warnings

import numpy as np
import pytest

import halfspace_sss
from benchmarks.truths import trace_order
from halfspace_sss import Medium, measure, trace
from halfspace_sss.physics import single_scattering
from halfspace_sss.tracing.tracer import Line, trace_curve

MEDIUM = Medium(1.8075, 0.6025, 0.0, 1.3)
LOSSLESS = Medium(2.0, 0.0, 0.0, 1.3)  # S falls as r⁻³ only
ABOVE = np.nextafter(np.float32(1), np.float32(2))
FAR = [1e17, 1e20, 1e25, 3e38]
FARTHER = [*FAR, 1e100, 1e160, 1e300]


@pytest.mark.parametrize("position", [1, 3])
@pytest.mark.parametrize("ulps", [1, 4])
def test_a_cosine_that_exceeds_1_by_rounding_is_1(name, position, ulps):
    model, query = halfspace_sss.bssrdf(name, MEDIUM), [1.0, 1.0, 0.2, 1.0, 0.5]
    wanted = model.eval(*query)
    for kind in (np.float32, np.float64):
        query[position] = kind(1 + ulps * np.finfo(kind).eps)
        np.testing.assert_allclose(model.eval(*query), wanted, rtol=1e-5)


def test_so_it_is_in_torch(name):
    torch = pytest.importorskip("torch")
    model, above = halfspace_sss.bssrdf(name, MEDIUM), torch.tensor([float(ABOVE)], dtype=torch.float32)
    np.testing.assert_allclose(model.eval(1.0, above, 0.2, above, 0.5), model.eval(1.0, 1.0, 0.2, 1.0, 0.5), rtol=1e-4)


@pytest.mark.parametrize("mu", [np.float32(1 + 1e-6), 1.0000001, np.float64(ABOVE), np.float32(2.0), float("nan")])
def test_a_cosine_that_exceeds_1_by_more_is_refused(mu):
    model = halfspace_sss.bssrdf("standard_dipole", MEDIUM)
    with pytest.raises(ValueError, match="mu_i must be finite and in"):
        model.eval(np.float32(1.0), mu, 0.2, 1.0, 0.5)


ASKED = {
    "reflectance": lambda mu: measure.reflectance(halfspace_sss.bssrdf("standard_dipole", MEDIUM), mu),
    "profile": lambda mu: measure.profile(halfspace_sss.bssrdf("standard_dipole", MEDIUM), 1.0, mu),
    "moments": lambda mu: measure.moments(halfspace_sss.bssrdf("standard_dipole", MEDIUM), mu).mean_r2,
    "weight_variance": lambda mu: measure.weight_variance(halfspace_sss.bssrdf("standard_dipole", MEDIUM), mu, 64),
    "single reflectance": lambda mu: single_scattering.reflectance(MEDIUM, mu),
    "single radiance": lambda mu: single_scattering.brdf(MEDIUM, mu, mu, 0.3),
    "trace": lambda mu: trace(MEDIUM, mu, 256).reflectance().value,
    "trace, directions": lambda mu: trace(MEDIUM, 1.0, 256, directions=[(mu, 0.0)]).angular_reflectance().value,
    "curve": lambda mu: trace_curve(MEDIUM, mu, Line(np.array([0.1, 1.0]), mu, 0.0, 0.0), n_paths=256).S,
    "orders": lambda mu: trace_order(MEDIUM, mu, 1, 256)[0].value,
}


@pytest.mark.parametrize("what", ASKED)
def test_every_function_of_a_cosine_takes_its_rounding(what):
    np.testing.assert_allclose(ASKED[what](ABOVE), ASKED[what](1.0), rtol=1e-6)


@pytest.mark.parametrize("what", ASKED)
def test_no_function_of_a_cosine_takes_more(what):
    with pytest.raises(ValueError, match=r"mu_[io] must be .*1\], got"):
        ASKED[what](1.0001)


@pytest.mark.parametrize("medium", [MEDIUM, LOSSLESS])
@pytest.mark.parametrize("kind", [np.float32, np.float64])
def test_S_vanishes_where_the_square_of_a_distance_overflows(name, medium, kind):
    try:
        model = halfspace_sss.bssrdf(name, medium)
    except ValueError as error:
        pytest.skip(str(error))
    r = np.array(FAR if kind is np.float32 else FARTHER, kind)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # overflow on the way
        S = model.eval(r, kind(0.9), kind(0.2), kind(0.8), kind(0.5))
    assert S.dtype == kind and np.all(np.isfinite(S)) and np.all(S[r > 1e120 if kind is np.float64 else r > 0] == 0)
    assert np.all(np.diff(S) <= 0)


def test_so_it_does_in_other_libraries(name):
    torch = pytest.importorskip("torch")
    from halfspace_sss.backend import array_types

    model, types = halfspace_sss.bssrdf(name, MEDIUM), array_types()
    for r in (torch.tensor(FAR), torch.tensor(FARTHER, dtype=torch.float64), types.Float(FAR), types.Float64(FARTHER)):
        assert np.all(model.eval(r, 0.9, 0.2, 0.8, 0.5).numpy() == 0)
