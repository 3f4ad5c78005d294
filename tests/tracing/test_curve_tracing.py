"""Traced curves: their integral, symmetry, errors and repeatability. Seeds and significance as in test_tracer.py."""

from __future__ import annotations

import math

import numpy as np
import pytest
from traced import MEDIA, check_spread, z

from halfspace_sss import Medium, trace
from halfspace_sss.tracing.passes import Estimate
from halfspace_sss.tracing.tracer import CurveTrace, Line, trace_curve


def curve_of(medium, mu_i, mu_o, delta_phi, phi, edges, half_width, n_paths, seed) -> CurveTrace:
    return trace_curve(medium, mu_i, Line(edges, mu_o, delta_phi, phi, half_width), n_paths, seed)


@pytest.fixture(scope="module", params=MEDIA)
def medium(request) -> Medium:
    return MEDIA[request.param]


@pytest.mark.parametrize(("mu_i", "mu_o", "delta_phi"), [(1.0, 1.0, 0.0), (0.8, 0.9, math.pi), (0.8, 0.9, 1.1)])
def test_curves_integrate_to_the_angular_reflectance_of_the_multiple_order(medium, mu_i, mu_o, delta_phi):
    edges = np.concatenate([[0.0], np.geomspace(1e-2, 200, 12)]) * medium.mfp
    curve = curve_of(medium, mu_i, mu_o, delta_phi, 0.0, edges, math.pi, 200_000, 81)
    area = np.pi * np.diff(edges**2)
    whole = Estimate(np.sum(curve.S * area), np.sum(curve.standard_error * area))  # the cells share their walks
    angular = trace(medium, mu_i, 200_000, 82, directions=[(mu_o, delta_phi)]).angular_reflectance("multiple")
    assert abs(z(angular, whole)[0]) < 4 and whole.standard_error < 0.05 * whole.value


def test_curves_on_both_sides_of_the_plane_of_incidence_agree(medium):
    edges = np.array([0.2, 0.5, 1.0, 2.0]) * medium.mfp
    a = curve_of(medium, 0.8, 0.9, 1.0, 0.7, edges, 0.4, 200_000, 83)
    b = curve_of(medium, 0.8, 0.9, -1.0, -0.7, edges, 0.4, 200_000, 84)
    assert np.all(np.abs(z((a.S, a.standard_error), (b.S, b.standard_error))) < 4)


PI = math.pi
SECTORS = {  # azimuth, half width and angle; where w_o is in the plane of incidence what lies beyond that counts too
    PI: [(0.0, 0.5, 1.0), (-1.25, 0.75, 3.0), (PI, PI - 2.0, 2 * (PI - 2.0))],
    1.1: [(-0.1, 0.7, 1.4), (1.6, 1.0, 2.0), (PI + 0.9, PI - 1.7, 2 * (PI - 1.7))],
}


@pytest.mark.parametrize("delta_phi", SECTORS)
def test_sectors_of_a_ring_add_up_to_it(delta_phi):
    """Of the same walks."""

    def curve(line_phi, half_width):
        return curve_of(MEDIA["denser"], 0.7, 0.6, delta_phi, line_phi, [0.05, 0.3, 1.0], half_width, 50_000, 5).S

    parts = sum(angle * curve(line_phi, half_width) for line_phi, half_width, angle in SECTORS[delta_phi])
    np.testing.assert_allclose(parts, 2 * PI * curve(0.0, PI), rtol=1e-5)


def test_one_oblique_direction_tells_forward_from_backward_whichever_it_is():
    """Light goes on along the one that enters; by reciprocity it is the same for the one that leaves."""
    edges = np.array([0.2, 0.6]) * MEDIA["denser"].mfp

    def curve(mu_i, mu_o, line_phi, seed):
        found = curve_of(MEDIA["denser"], mu_i, mu_o, 0.0, line_phi, edges, 0.4, 200_000, seed)
        return found.S, found.standard_error

    for line_phi in (0.0, math.pi):
        assert abs(z(curve(0.4, 1.0, line_phi, 85), curve(1.0, 0.4, line_phi, 86))[0]) < 4
    assert z(curve(0.4, 1.0, 0.0, 85), curve(0.4, 1.0, math.pi, 85))[0] > 20


def test_the_same_seed_gives_the_same_curve_and_another_seed_another_one():
    a, b, c = (curve_of(MEDIA["denser"], 0.6, 0.5, 0.3, 1.0, [0.1, 1.0, 2.0], 0.3, 30_000, s) for s in (1, 1, 2))
    assert a.S.tobytes() == b.S.tobytes() and a.S.tobytes() != c.S.tobytes()


def test_standard_errors_of_curves_are_the_spread_of_independent_runs():
    edges = [0.05, 0.2, 1.0]
    runs = [curve_of(MEDIA["denser"], 0.7, 0.6, 1.0, 2.0, edges, 0.5, 32_768, k) for k in range(20)]
    check_spread(tuple(r.S for r in runs), tuple(r.standard_error for r in runs))


@pytest.mark.parametrize(
    ("arguments", "parameter", "bound", "value"),
    [
        ({"half_width": 4.0}, "half_width", "3.14", "4.0"),
        ({"mu_o": -0.1}, "mu_o", r"\[0, 1\]", "-0.1"),
        ({"phi": math.inf}, "phi", "finite", "inf"),
        ({"delta_phi": math.nan}, "delta_phi", "finite", "nan"),
        ({"mu_i": "diffuse"}, "mu_i", r"\[0, 1\]", "diffuse"),
    ],
)
def test_bad_input_to_a_curve_is_refused_with_name_bound_and_value(arguments, parameter, bound, value):
    given = {"mu_o": 0.5, "delta_phi": 0.0, "phi": 0.0, "r_edges": [0.1, 1.0]}
    with pytest.raises(ValueError, match=f"{parameter} must be.*({bound}).*{value}"):
        mu_i = arguments.pop("mu_i", 0.5)
        trace_curve(MEDIA["matched"], mu_i, Line(**(given | arguments)), 1024)
