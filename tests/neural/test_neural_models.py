"""What is special to the learnt models: range, size, accuracy of what is shipped."""

from __future__ import annotations

import numpy as np
import pytest

import halfspace_sss
from halfspace_sss import Medium
from halfspace_sss.comparison.model_errors import ReferenceSize, model_error, reference_maps
from halfspace_sss.comparison.sampled_exits import sampled_reflectance
from halfspace_sss.maps.noisy_maps import CellGrid
from halfspace_sss.neural.universal import shipped_weights

FIG10 = Medium.from_albedo(0.75, 1.0, 0.0, 1.3)
QUERY = (np.array([0.3, 1.0, 2.0]), 0.7, 0.4, 0.9, 0.2)


@pytest.mark.parametrize(
    ("medium", "bound"),
    [
        (Medium.from_albedo(0.5, 1.0, 0.985, 1.3), "g must be in [-0.5, 0.98]"),
        (Medium.from_albedo(0.5, 1.0, -0.6, 1.3), "g must be in [-0.5, 0.98]"),
        (
            Medium.from_albedo(0.5, 1.0, 0.81, 1.09),
            "g must be in [-0.5, 0.8] for the neural",
        ),
        (Medium.from_albedo(0.5, 1.0, 0.0, 0.9), "eta must be in [1, 2]"),
        (Medium.from_albedo(0.5, 1.0, 0.0, 2.1), "eta must be in [1, 2]"),
    ],
)
def test_media_out_of_range_are_refused_by_name_bound_and_value(medium, bound):
    with pytest.raises(ValueError) as refused:
        halfspace_sss.bssrdf("neural", medium)
    assert bound in str(refused.value) and "got" in str(refused.value)


def test_the_shipped_weights_are_small():
    size = sum(path.stat().st_size for path in (shipped_weights(), shipped_weights().with_suffix(".json")))
    assert size <= 300_000


@pytest.mark.slow
@pytest.mark.parametrize("medium", [FIG10, Medium.from_albedo(0.99, 1.0, 0.5, 1.5)])
def test_unseen_maps_are_met_better_than_by_any_dipole(medium):
    (reference,) = reference_maps([medium], ReferenceSize(1, CellGrid(40, 16), 4), 5e6, (31,))
    error = model_error(halfspace_sss.bssrdf("neural", medium), reference).error
    dipoles = ("standard_dipole", "better_dipole", "photon_beam_diffusion", "normalized_diffusion")
    others = [model_error(halfspace_sss.bssrdf(name, medium), reference).error for name in dipoles]
    assert error < 0.10 and error < 0.4 * min(others)


def test_a_dilution_changes_lengths_only():
    m = Medium.from_albedo(0.9, 3.0, 0.5, 1.3)
    r, *directions = QUERY
    thin = halfspace_sss.bssrdf("neural", m.scaled(0.1)).eval(10 * r, *directions)
    np.testing.assert_allclose(100 * thin, halfspace_sss.bssrdf("neural", m).eval(r, *directions), rtol=1e-9)


def test_sampled_reflectance_agrees_with_quadrature_for_a_smooth_model():
    model = halfspace_sss.bssrdf("better_dipole", FIG10)
    R, error = sampled_reflectance(model, 1.0)
    assert R == pytest.approx(halfspace_sss.measure.reflectance(model, 1.0), rel=1e-4) and error < 1e-5
