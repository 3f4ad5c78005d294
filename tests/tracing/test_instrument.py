"""Light in time, any absorption from one trace, fluence, fibres and beams of an instrument.

Fixed seeds; a z-test fails at 4 standard errors (two-sided 6e-5).
"""

from __future__ import annotations

import math

import numpy as np
import pytest
from traced import z

from benchmarks.truths import read_truths
from halfspace_sss import Fibre, Instrument, Layers, Medium, Ring, trace
from halfspace_sss.physics.fresnel import F_t
from halfspace_sss.tracing.instrument import LIGHT_SPEED
from halfspace_sss.tracing.passes import estimate

MEDIUM = Medium(1.0, 0.1, 0.5, 1.4)
RADII, DEPTHS = [0.0, 0.5, 1.0, 2.0, 5.0, 1e5], np.r_[np.linspace(0.0, 4.0, 9), 8.0, 100.0]
DETECTORS = [Ring(0.5, 1.0), Ring(0.5, 1.0, 0.5), Fibre(1.5, 0.3), Fibre(0.0, 0.5), Fibre(0.9, 0.3, y=1.2)]


@pytest.fixture(scope="module")
def run():
    asked = Instrument(times=[0.0, 10.0, 50.0, 1e7], depths=DEPTHS, white=True, detectors=DETECTORS)
    return trace(MEDIUM, 1.0, 60_000, 2, radii=RADII, instrument=asked)


def test_published_light_in_time_comes_out():
    """At 0.02/mm, where walks are short, each bin of 5 ps times exp(+ sigma_a L) is that without absorption."""
    rows = [t for t in read_truths()[0] if t.measure == "ring in time" and t.times[1] <= 200]
    radii, times, sigma_a = [0.0, 1.0, 2.0, 4.0, 8.0, 16.0], np.arange(0.0, 201.0, 5.0), 0.02
    medium = Medium(5.0, sigma_a, 0.8, 1.4)
    result = trace(medium, 1.0, 100_000, 3, radii=radii, instrument=Instrument(times=times))
    lengths = LIGHT_SPEED / medium.eta * (times[1:] + times[:-1]) / 2
    samples = result.readings._samples["times"] * np.exp(sigma_a * lengths)
    for row in rows:
        ring, first, last = radii.index(row.ring[0]), *np.searchsorted(times, row.times)
        area = math.pi * (row.ring[1] ** 2 - row.ring[0] ** 2)
        found = estimate(samples[:, ring, first:last].sum(axis=1) * row.factor / area / (row.times[1] - row.times[0]))
        assert found.standard_error < 0.1 * found.value
        assert abs(z(found, (row.value, row.uncertainty))) < 4, row.id
    assert len(rows) == 18


def test_light_in_time_adds_up_to_all_that_leaves(run):
    readings, whole = run.readings, run.reflectance().value
    seconds = np.diff(readings.instrument.times)
    assert (readings.reflectance_in_time().value * seconds).sum() == pytest.approx(whole, rel=1e-5)
    np.testing.assert_allclose((readings.exitance_in_time().value * seconds).sum(axis=1), run.exitance().value, 1e-5)
    at_once = readings.frequency_in_time([0.2]).value
    assert (at_once * seconds).sum() == pytest.approx(run.frequency_reflectance([0.2]).value[0], rel=1e-5)


def test_one_trace_has_the_reflectance_at_any_absorption():
    radii = [0.0, 0.5, 1.0, 3.0]
    white = trace(Medium(1.0, 0.0, 0.0, 1.4), 1.0, 4096, 4, radii=radii, instrument=Instrument(white=True))
    sigma_a = np.geomspace(0.01, 3.0, 20)
    R, M = white.readings.reflectance_at(sigma_a), white.readings.exitance_at(sigma_a)
    exact = [Medium(1.0, a, 0.0, 1.4).reflectance(1.0) for a in sigma_a]
    assert np.all(R.standard_error < 0.15 * R.value) and np.all(np.abs(z(R, (exact, 0.0))) < 4)
    for k in (3, 15):
        direct = trace(Medium(1.0, sigma_a[k], 0.0, 1.4), 1.0, 60_000, 40 + k, radii=radii).exitance()
        assert np.all(np.abs(z(direct, (M.value[:, k], M.standard_error[:, k]))) < 4)


def test_without_further_absorption_the_histogram_is_the_trace(run):
    assert run.readings.reflectance_at(MEDIUM.sigma_a).value == pytest.approx(run.reflectance().value, rel=1e-6)
    np.testing.assert_allclose(run.readings.exitance_at(MEDIUM.sigma_a).value, run.exitance().value, rtol=1e-5)
    found = run.readings.frequency_at([0.0, 0.2], [0.1, 0.4])
    np.testing.assert_allclose(found.value[:, 0], run.frequency_reflectance([0.0, 0.2]).value, rtol=1e-5)
    assert found.value.shape == (2, 2) and np.all(found.value[:, 1] < found.value[:, 0])


def test_fluence_is_absorbed_where_light_does_not_come_back(run):
    volumes = np.pi * np.diff(np.square(RADII))[:, None] * np.diff(DEPTHS)
    absorbed = MEDIUM.sigma_a * np.sum(run.readings.fluence().value * volumes)
    assert absorbed + run.reflectance().value == pytest.approx(F_t(1.0, MEDIUM.eta), abs=0.01)


def test_fluence_of_a_medium_that_hardly_scatters_is_the_beam():
    medium, depths = Medium.from_albedo(1e-4, 2.0, 0.0, 1.0), np.linspace(0.0, 2.0, 6)
    found = trace(medium, 0.5, 60_000, 5, instrument=Instrument(depths=depths)).readings.fluence()
    beam = -np.diff(np.exp(-2.0 * depths / 0.5)) / (2.0 * np.diff(depths))  # the path is twice the depth
    assert np.all(np.abs(z(found, (beam, 1e-3 * beam))) < 4)


def test_fluence_is_that_of_discrete_ordinates():
    nanodisort = pytest.importorskip("nanodisort")
    state, depths = nanodisort.DisortState(), np.linspace(0.0, 8.0, 161)
    state.nstr, state.nlyr, state.nmom, state.ntau = 64, 1, 200, len(depths)
    state.usrtau = state.lamber = state.quiet = state.onlyfl = True
    state.usrang = state.planck = state.intensity_correction = state.old_intensity_correction = False
    state.fbeam, state.umu0, state.phi0, state.fisot, state.albedo = 1.0, 1.0, 0.0, 0.0, 0.0
    state.allocate()
    state.pmom = 0.5 ** np.arange(state.nmom + 1)[:, None]
    state.dtauc, state.ssalb, state.utau = np.array([60.0]), np.array([0.9]), depths
    state.solve()
    phi = 4 * np.pi * np.asarray(state.uavg)
    means = np.array([np.trapezoid(phi[k : k + 21], dx=0.05) for k in range(0, 160, 20)])
    asked = Instrument(depths=depths[::20])
    found = trace(Medium.from_albedo(0.9, 1.0, 0.5, 1.0), 1.0, 60_000, 10, instrument=asked).readings.fluence()
    assert np.all(found.standard_error < 0.05 * found.value) and np.all(np.abs(z(found, (means, 2e-3 * means))) < 4)


def test_mean_depth_of_one_scattering_event_is_exact():
    """Of e^-z E_2(z): the mean depth of isotropic single scattering, matched, is (∫ z e^-z E_2) / (∫ e^-z E_2)."""
    from scipy.special import expn

    depth = np.linspace(0.0, 40.0, 400_001)
    weight = np.exp(-depth) * expn(2, depth)
    exact = np.trapezoid(depth * weight, depth) / np.trapezoid(weight, depth)
    medium = Medium.from_albedo(0.01, 2.0, 0.0, 1.0)  # of what leaves 0.6 % has scattered again
    result = trace(medium, 1.0, 200_000, 6, instrument=Instrument(depths=[0.0, 1.0])).readings.mean_depth()
    assert abs(z(result, (exact / 2.0, 0.006 * exact))) < 4 and result.standard_error < 0.05 * exact


def test_detectors_collect_what_leaves_where_they_are(run):
    ring, narrow, fibre, core, aside = run.readings.collected().value
    area = np.pi * np.diff(np.square(RADII))
    assert ring == pytest.approx(area[1] * run.exitance().value[1], rel=1e-5)
    assert core == pytest.approx(area[0] * run.exitance().value[0], rel=1e-5)
    assert 0.2 < narrow / ring < 0.28  # Lambert's cosine would have NA² = 0.25
    assert aside == pytest.approx(fibre, rel=1e-4)  # 1.5 mm away, to another side
    assert fibre == pytest.approx(math.pi * 0.09 * run.exitance().value[2], rel=0.1)


def test_oblique_light_reaches_fibres_ahead_and_both_sides_alike():
    asked = Instrument(detectors=[Fibre(1.0, 0.5), Fibre(-1.0, 0.5), Fibre(0.0, 0.5, y=1.0), Fibre(0.0, 0.5, y=-1.0)])
    ahead, behind, left, right = trace(MEDIUM, 0.5, 60_000, 7, instrument=asked).readings.collected().value
    assert ahead > 2 * left > 2 * behind and left == right


@pytest.mark.parametrize("mu_i", [1.0, 0.5])
def test_a_gaussian_beam_adds_its_width_to_the_moments(mu_i):
    """<r²> grows by w²/4 across the beam and w²/(4 mu_i²) along its footprint; fractions stay."""
    wide = trace(MEDIUM, mu_i, 120_000, 8, instrument=Instrument(beam_radius=3.0))
    thin = trace(MEDIUM, mu_i, 120_000, 9)
    added = 9 / 4 * (1 + 1 / mu_i**2)
    assert abs(z(wide.mean_r2(), (thin.mean_r2().value + added, thin.mean_r2().standard_error))) < 4
    assert abs(z(wide.mean_x(), thin.mean_x())) < 4 and abs(z(wide.reflectance(), thin.reflectance())) < 4


def test_an_instrument_leaves_the_walks_as_they_are(run):
    assert trace(MEDIUM, 1.0, 60_000, 2, radii=RADII).reflectance() == run.reflectance()


BAD = [
    (lambda: Instrument(times=[1.0, 0.5]), "times must be two or more finite, ascending times >= 0 in ps"),
    (lambda: Instrument(detectors=[3]), "detectors must be Ring or Fibre, got 3"),
    (lambda: Instrument(beam_radius=-1.0), "beam_radius must be .* got -1"),
    (lambda: Ring(2.0, 1.0), "outer must be .* got 1"),
    (lambda: Fibre(0.0, 0.0), "radius must be .* got 0"),
    (lambda: Fibre(0.0, 1.0, 1.5), "numerical_aperture must be .* got 1.5"),
    (lambda: trace(MEDIUM, "diffuse", 256, instrument=Instrument()), "instrument must be None for diffuse light"),
    (lambda: trace(Medium(0.0, 1.0), 1.0, 256, instrument=Instrument(depths=[0, 1])), "depths must be left out"),
    (lambda: trace(Layers([MEDIUM]), 1.0, 256, instrument=Instrument()), "instrument must be left out for layers"),
]


@pytest.mark.parametrize(("make", "message"), BAD)
def test_bad_instruments_are_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_readings_that_were_not_asked_for_are_refused(run):
    readings = trace(MEDIUM, 1.0, 256, instrument=Instrument()).readings
    for name, option in (("fluence", "depths"), ("collected", "detectors"), ("reflectance_in_time", "times")):
        with pytest.raises(ValueError, match=f"{option} must be given"):
            getattr(readings, name)()
    with pytest.raises(ValueError, match="sigma_a must be finite and >= 0.1"):
        run.readings.reflectance_at(0.05)
    with pytest.raises(ValueError, match="radii must hold all but 0.001"):
        trace(MEDIUM, 1.0, 256, radii=[0.0, 1.0]).frequency_reflectance([0.1])
