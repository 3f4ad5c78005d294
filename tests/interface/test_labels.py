"""Queries with labels of pandas and xarray: the answer has them too."""

from __future__ import annotations

import numpy as np
import pandas
import pytest
import xarray

import halfspace_sss as sss

GREY, COLOURED = sss.Medium(1.0, 0.01, 0.0, 1.3), sss.Medium([1.0, 2.0, 3.0], [0.1, 0.2, 0.3], 0.0, 1.3)


@pytest.mark.parametrize("medium", [GREY, COLOURED])
def test_arrays_of_xarray_broadcast_by_dimension(medium: sss.Medium) -> None:
    model = sss.bssrdf("better_dipole", medium)
    r, mu = xarray.DataArray([0.5, 1, 2], {"r": [0.5, 1, 2]}), xarray.DataArray([0.2, 0.9], {"mu_i": [0.2, 0.9]})
    S = model.eval(r, mu, 0.0, 1.0, 0.0)
    assert S.dims == ("r", "mu_i", "channel")[: S.ndim] and S.name == "S" and S.sel(r=2, mu_i=0.9).shape == S.shape[2:]
    np.testing.assert_array_equal(S, model.eval(r.to_numpy()[:, None], mu.to_numpy(), 0.0, 1.0, 0.0))


def test_series_give_a_series_or_a_table_of_channels() -> None:
    r = pandas.Series([0.5, 1.0], ["near", "far"])
    for medium, kind in ((GREY, pandas.Series), (COLOURED, pandas.DataFrame)):
        S = sss.bssrdf("better_dipole", medium).eval(r, 0.5, 0.0, 1.0, 0.0)
        assert isinstance(S, kind) and S.index.equals(r.index)


@pytest.mark.parametrize(
    ("mu", "message"),
    [
        (pandas.Series([0.5, 1.0], [3, 4]), "series of a query must have one index"),
        (np.ma.masked_array([0.5, 1.0], [False, True]), "must be plain arrays, got a masked one"),
    ],
)
def test_labels_that_would_be_lost_are_refused(mu: object, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        sss.bssrdf("better_dipole", GREY).eval(pandas.Series([0.5, 1.0]), mu, 0.0, 1.0, 0.0)
