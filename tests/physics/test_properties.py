"""Properties of media and directions over their whole space, searched by Hypothesis."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from halfspace_sss import Medium
from halfspace_sss.physics.backbone import unwarp, warp
from halfspace_sss.physics.fresnel import F_r, F_t, mu_internal
from halfspace_sss.physics.medium import eval_hg, sample_hg

ALBEDO = st.one_of(st.floats(0, 1), st.floats(0, 7).map(lambda x: 1 - 10**-x))
G = st.floats(-0.99, 0.999)
ETA = st.one_of(st.just(1.0), st.floats(0.4, 3.0))
LENGTH = st.floats(1e-6, 1e6)
MU = st.one_of(st.floats(0, 1), st.floats(0, 12).map(lambda x: 10**-x))
MEDIA = st.builds(Medium.from_albedo, ALBEDO, LENGTH, G, ETA)
search = settings(max_examples=200, deadline=None, derandomize=True)


@search
@given(MEDIA, LENGTH)
def test_scaling_keeps_the_ratios_and_scales_the_lengths(medium: Medium, c: float) -> None:
    scaled = medium.scaled(c)
    assert scaled.sigma_t == pytest.approx(c * medium.sigma_t)
    assert scaled.albedo == pytest.approx(medium.albedo, rel=1e-12, abs=1e-15)
    assert (scaled.g, scaled.eta) == (medium.g, medium.eta)


@search
@given(MEDIA)
def test_similarity_keeps_the_reduced_medium(medium: Medium) -> None:
    reduced = Medium.from_reduced(medium.sigma_s_prime, medium.sigma_a, 0.0, medium.eta)
    assert reduced.sigma_s == pytest.approx(medium.sigma_s_prime)
    assert reduced.sigma_t_prime == pytest.approx(medium.sigma_t_prime)


@search
@given(MU, ETA)
def test_what_is_not_reflected_is_transmitted_and_both_ways_alike(mu: float, eta: float) -> None:
    assert 0 <= F_r(mu, eta) <= 1
    assert F_r(mu, eta) + F_t(mu, eta) == pytest.approx(1, abs=1e-12)
    if 1 - mu**2 < eta**2:
        inside = float(mu_internal(mu, eta))
        assert F_t(inside, 1 / eta) == pytest.approx(F_t(mu, eta), rel=1e-6, abs=1e-6)  # the square root of rounding
        assert math.sqrt(1 - inside**2) * eta == pytest.approx(math.sqrt(1 - mu**2), abs=1e-7)


@search
@given(G)
def test_the_phase_function_is_positive_and_integrates_to_one(g: float) -> None:
    # cosines at equal steps of the distribution function, so that the peak is met whatever g
    t, weights = np.polynomial.legendre.leggauss(64)
    u = 0.5 * (t + 1)
    cosine = np.asarray(sample_hg(u, g))
    assert np.all(np.abs(cosine) <= 1 + 1e-12) and np.all(np.asarray(eval_hg(cosine, g)) > 0)
    slope = np.gradient(np.asarray(sample_hg(np.linspace(0, 1, 20001), g)), 1 / 20000)[1:-1]
    middle = np.asarray(sample_hg(np.linspace(0, 1, 20001), g))[1:-1]
    assert np.median(np.abs(2 * math.pi * np.asarray(eval_hg(middle, g)) * np.abs(slope) - 1)) < 1e-4


@search
@given(st.floats(1e-6, 1e4))
def test_unwarp_takes_warp_back(x: float) -> None:
    from halfspace_sss.arrays import library

    lib = library(0.0)
    assert float(unwarp(lib, warp(lib, np.float64(x)))) == pytest.approx(x, rel=1e-9)
