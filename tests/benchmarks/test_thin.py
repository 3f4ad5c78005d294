"""Thin things lit from behind, in miniature."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
import pandas
import pytest

pytest.importorskip("mitsuba")
pytest.importorskip("igl")
pytest.importorskip("flip_evaluator")

import benchmarks.__main__  # noqa: E402, F401 - its figures
from benchmarks import thin_figure as thin  # noqa: E402
from figures.parts import runner  # noqa: E402
from full_geometry.transport import any_shape  # noqa: E402


@pytest.fixture()
def small(monkeypatch: pytest.MonkeyPatch, little_light: None) -> None:
    monkeypatch.setattr(thin, "THINGS", {"leaf": thin.THINGS["leaf"]})
    monkeypatch.setattr(thin, "MODELS", ("better_dipole", "neural_shape"))
    monkeypatch.setattr(any_shape, "WALKS", (2**13, 2**15))
    monkeypatch.setattr(any_shape, "PAIRS", (2**15, 2**16))
    for name, value in {"SIZES": 24, "RESOLUTION": 48, "MODEL_SPP": 64, "TRUTH_SPP": 64}.items():
        monkeypatch.setitem(getattr(thin, name), "draft", value)


@pytest.mark.slow
def test_light_comes_through_a_leaf_by_the_network_of_all_shapes_and_not_by_a_half_space(
    small: None, tmp_path: Path
) -> None:
    files = thin.draw(runner.compute("thin", "draft", tmp_path))
    rows = pandas.read_csv(io.StringIO(str(files["thin.csv"]))).set_index("model")
    ratio, flip = rows["mean over path traced"], rows["FLIP"]
    assert abs(np.log(ratio["Neural, any shape"])) < 0.25 * abs(np.log(ratio["Better dipole"]))
    assert flip["Neural, any shape"] < flip["Better dipole"]
    assert str(files["thin.html"]).startswith("<!DOCTYPE html>") and files["thin.png"].startswith(b"\x89PNG")


def test_parts_of_paper_quality_are_more_work_and_all_differ() -> None:
    draft, paper = thin.parts("draft"), thin.parts("paper")
    assert len({part.name for part in draft}) == len(draft) == 12
    assert sum(p.work for p in paper) > 10 * sum(p.work for p in draft)
