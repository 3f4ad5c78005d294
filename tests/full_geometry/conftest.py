"""Fixtures of what learns objects."""

from __future__ import annotations

from collections.abc import Iterator

import pytest


@pytest.fixture(scope="module", autouse=True)
def fewer_walks() -> Iterator[None]:
    """A noisier truth of trainings than by default: a quarter of the walks."""
    pytest.importorskip("mitsuba")
    pytest.importorskip("torch")
    from full_geometry.learning import training

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(training, "WALKS", 512)
        yield
