"""The noise that `study speeds` compares: light that few samples meet counts by its variance."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("mitsuba")

from figures.beyond.speeds import PASSES, _noise  # noqa: E402
from figures.computing.timed import TimedRender  # noqa: E402


def test_noise_holds_light_that_most_pixels_have_not_met() -> None:
    spp, chance, size = 16, 0.003, 64
    met = np.random.default_rng(1).binomial(spp, chance, (PASSES, size, size, 3))
    timed = TimedRender((met / (spp * chance)).astype(np.float32), PASSES * spp, (1.0,) * PASSES, (1.0,) * PASSES)
    assert np.median(met.sum(axis=0)) == 0
    variance, error = _noise(timed, np.ones((size, size), dtype=bool))
    assert variance == pytest.approx(1 / chance - 1, rel=0.1)
    assert 0 < error < 0.1
