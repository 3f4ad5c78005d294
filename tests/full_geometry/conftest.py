"""Fixtures of what learns objects."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from halfspace_sss.neural import store


@pytest.fixture(scope="module", autouse=True)
def fewer_walks() -> Iterator[None]:
    """Noisier errors of trainings than by default: a quarter of the walks and of the entries."""
    pytest.importorskip("mitsuba")
    pytest.importorskip("torch")
    from full_geometry.learning import training

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(training, "WALKS", 512)
        patch.setattr(training, "SAMPLES", 128)
        yield


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """Where weights are kept and looked for."""
    found = tmp_path_factory.mktemp("weights")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv(store.ENVIRONMENT_VARIABLE, str(found))
        yield found
