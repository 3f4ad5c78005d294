"""Photographs that are disturbed: exposure of all, noise and number of those that are fitted."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("mitsuba")

from benchmarks.disturbed import Disturbance  # noqa: E402
from full_geometry.inverse.views import GivenView  # noqa: E402


@pytest.mark.usefixtures("quiet_rgb")
def test_fitted_views_are_every_other_one_with_noise_and_those_held_out_have_the_exposure_alone() -> None:
    image = np.full((40, 40, 3), 0.5, np.float32)
    views = [GivenView.of(str(k), 0, image, held_out=k > 3) for k in range(6)]
    found = Disturbance(exposure=1.1, every=2, noise=0.02).of(views, 0)
    assert [view.name for view in found] == ["0", "2", "4", "5"]
    assert all((view.image == np.float32(1.1 * 0.5)).all() for view in found[2:])
    for view in found[:2]:  # the error of a deviation of 4800 numbers is 1 %
        assert view.image.std() == pytest.approx(0.02 * 0.55, rel=0.04)
        assert view.image.mean() == pytest.approx(0.55, rel=0.002)
