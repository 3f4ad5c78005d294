"""Fig. 10 in parts is the figure of `halfspace_sss.curves`."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas
import pytest

import halfspace_sss
from figures import fig10
from figures.computing.learnt import accepting, weight_files
from figures.parts.part import Result, Task

WALKS, MODELS = 8192, ["better_dipole", "neural"]


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Result]:
    """All parts of two models, with few walks."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(fig10, "accepting", lambda medium: MODELS)
        patch.setitem(fig10.WALKS, "draft", WALKS)
        parts = fig10.parts("draft")
    folder = tmp_path_factory.mktemp("work")
    return {part.name: Result({}, part.function(Task(part.params, folder)), 1.0, part.work) for part in parts}


def test_parts_together_are_one_set_of_curves(results: dict[str, Result]) -> None:
    whole = halfspace_sss.curves(n_paths=WALKS, models=["better_dipole"])
    together = fig10.curve_set(results)
    assert together.series == ("path_traced", *MODELS)
    np.testing.assert_array_equal(together.r_edges, whole.r_edges)
    for theta in whole.theta_i_deg:
        for series in whole.series:
            np.testing.assert_allclose(together.curve(series, theta).S, whole.curve(series, theta).S, rtol=1e-6)
    assert together.n_paths == whole.n_paths


@pytest.mark.slow
def test_the_figure_and_its_tables_are_drawn(results: dict[str, Result], tmp_path: Path) -> None:
    files = fig10.draw(results)
    assert files["fig10.pdf"].startswith(b"%PDF") and files["fig10.png"].startswith(b"\x89PNG")
    (tmp_path / "errors.csv").write_text(files["fig10_errors.csv"])
    assert set(pandas.read_csv(tmp_path / "errors.csv")["series"]) == set(fig10.curve_set(results).series)


def test_the_paper_quality_walks_farther() -> None:
    assert fig10.parts("paper")[0].work > 10 * fig10.parts("draft")[0].work


def test_learnt_models_depend_on_their_weights() -> None:
    medium = halfspace_sss.materials.load("marble").medium
    assert weight_files("better_dipole", medium) == ()
    assert all(path.is_file() for path in weight_files("neural", medium))
    assert len(weight_files("neural_material", medium)) == 3


def test_every_model_that_accepts_the_medium_is_in_the_figure() -> None:
    medium = halfspace_sss.materials.load("fig10").medium
    assert [part.name for part in fig10.parts("draft")][4:] == accepting(medium)
    assert "better_dipole" in accepting(medium)
