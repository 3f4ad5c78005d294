"""Reflectance over spatial frequency, by models and by traces, and the coefficients that it tells."""

from __future__ import annotations

import numpy as np
import pytest
from traced import z

from halfspace_sss import Instrument, Medium, bssrdf, measure, trace

MEDIUM = Medium(1.0, 0.05, 0.0, 1.4)
FREQUENCIES = [0.0, 0.02, 0.1, 0.3, 1.0]  # 1/mm
RADII = np.r_[0.0, np.geomspace(0.02, 1e5, 60)]


@pytest.fixture(scope="module")
def white():
    how = {"radii": RADII, "instrument": Instrument(white=True)}
    return trace(Medium(1.0, 0.0, 0.0, 1.4), 1.0, 4096, 8, **how).readings


def test_the_transform_of_a_dipole_is_that_by_many_points():
    """Against a trapezoid in r of a thousand times as many points."""
    model = bssrdf("standard_dipole", MEDIUM)
    found = measure.frequency_reflectance(model, FREQUENCIES)
    r = np.geomspace(1e-4, 400.0, 400_001)
    M = measure.profile(model, r)
    from scipy.special import j0

    for f, value in zip(FREQUENCIES[:4], found):
        assert value == pytest.approx(np.trapezoid(2 * np.pi * r * M * j0(2 * np.pi * f * r), r), rel=1e-4)


@pytest.mark.parametrize("which", ["better_dipole", "photon_beam_diffusion", "directional_dipole"])
def test_at_frequency_zero_it_is_the_reflectance(which):
    model = bssrdf(which, MEDIUM)
    order = "total" if model.orders == "multiple" else None
    found = measure.frequency_reflectance(model, FREQUENCIES, order)
    assert found[0] == pytest.approx(measure.reflectance(model, 1.0, order), rel=1e-5)
    assert np.all(np.diff(found) < 0)


def test_a_white_trace_has_the_transform_of_a_direct_one(white):
    direct = trace(MEDIUM, 1.0, 30_000, 9, radii=RADII).frequency_reflectance(FREQUENCIES)
    found = white.frequency_at(FREQUENCIES, MEDIUM.sigma_a)
    assert np.all(np.abs(z(direct, found)) < 4) and np.all(direct.standard_error[:3] < 0.02 * direct.value[:3])
    assert abs(z((found.value[0], found.standard_error[0]), (MEDIUM.reflectance(1.0), 0.0))) < 4


@pytest.mark.parametrize("sigma_s_prime", [0.5, 4.0])
def test_coefficients_come_back_from_the_reflectance_at_two_frequencies(white, sigma_s_prime):
    medium = Medium(sigma_s_prime, 0.02 * sigma_s_prime, 0.0, 1.4)
    f = [0.0, 0.1 * sigma_s_prime]
    R = white.frequency_at(np.array(f) / sigma_s_prime, 0.02).value
    found = measure.coefficients_of_frequencies(f, R, 0.001, white)
    assert found.sigma_a.value == pytest.approx(medium.sigma_a, rel=1e-4)
    assert found.sigma_s_prime.value == pytest.approx(sigma_s_prime, rel=1e-4)
    moved = [measure.coefficients_of_frequencies(f, R + step, 0.001, white) for step in ([0.001, 0.0], [0.0, 0.001])]
    spread = np.hypot(*(m.sigma_a.value - found.sigma_a.value for m in moved))
    assert found.sigma_a.error == pytest.approx(spread, rel=0.05)


def test_coefficients_come_back_from_the_reflectance_of_a_model():
    f = [0.0, 0.1]
    R = measure.frequency_reflectance(bssrdf("directional_dipole", MEDIUM), f)
    found = measure.coefficients_of_frequencies(f, R, 0.001, "directional_dipole", eta=1.4)
    assert found.sigma_a.value == pytest.approx(MEDIUM.sigma_a, rel=1e-4)
    assert found.sigma_s_prime.value == pytest.approx(1.0, rel=1e-4)


@pytest.mark.parametrize(
    ("frequencies", "R", "error", "message"),
    [
        ([0.1], [0.3], 0.01, "frequencies must be two or more"),
        ([0.0, -0.1], [0.3, 0.2], 0.01, "frequencies must be finite and >= 0"),
        ([0.0, 0.1], [0.3, 1.2], 0.01, "reflectance must be in"),
        ([0.0, 0.1], [0.3, 0.2], 0.0, "error must be > 0"),
    ],
)
def test_reflectances_that_tell_nothing_are_refused(frequencies, R, error, message):
    with pytest.raises(ValueError, match=message):
        measure.coefficients_of_frequencies(frequencies, R, error, "standard_dipole", eta=1.4)


def test_a_reflectance_that_no_medium_has_is_refused(white):
    with pytest.raises(ValueError, match="reflectance must be that of a medium"):
        measure.coefficients_of_frequencies([0.0, 0.1], [0.1, 0.9], 0.001, white)
