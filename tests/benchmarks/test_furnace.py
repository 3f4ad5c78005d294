"""The white furnace: what conserves energy has the radiance of the light."""

from __future__ import annotations

import pytest

from benchmarks.furnace import mean_radiance

pytest.importorskip("mitsuba")
pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("rgb")]


def test_walks_in_a_white_furnace_have_its_radiance() -> None:
    mean, error = mean_radiance("path_traced", 8, 4)
    assert abs(mean - 1) < 4 * error + 1e-3


def test_a_normalised_model_makes_no_light() -> None:
    mean, error = mean_radiance("normalized_diffusion", 16, 64)
    assert 0.98 - 4 * error < mean < 1 + 4 * error
