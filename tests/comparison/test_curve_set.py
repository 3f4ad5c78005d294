"""A set of curves: the error table, the files and the figure."""

from __future__ import annotations

import dataclasses
import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pandas
import pytest

import halfspace_sss
from halfspace_sss import Medium
from halfspace_sss.comparison.curve_set import TRACED, Curve, CurveSet, range_edges

FIG10 = Medium.from_albedo(0.75, 0.241)
PATHS = 8192


@pytest.fixture(scope="module")
def small() -> CurveSet:
    names = ["better_dipole", "directional_dipole"]
    return halfspace_sss.curves(theta_i_deg=[60], models=names, n_r=8, n_paths=PATHS)


@pytest.fixture(scope="module")
def folder(small: CurveSet, tmp_path_factory: Any) -> Path:
    path = tmp_path_factory.mktemp("curves") / "new"
    assert sorted(small.save(path)) == sorted(path.iterdir())
    return path


def _set(S_traced: list[float], error: list[float], S_model: list[float]) -> CurveSet:
    """Two cells, 1 to 2 and 2 to 20 mm, with given values."""
    R = {"multiple": (0.2, 0.001), "total": (0.3, 0.002)}
    arrays = [np.array(v, dtype=float) for v in (S_traced, error, S_model)]
    traced = Curve(TRACED, "multiple", 0.0, arrays[0], arrays[0], arrays[1], R)
    model = Curve("m", "multiple", 0.0, arrays[2], arrays[2], np.zeros(2), {"multiple": (0.25, 0.0)})
    edges = np.array([1.0, 2.0, 20.0])
    return CurveSet("", FIG10, 0, 0, 90, 0.13, "multiple", edges, (traced, model), {"m": 1e6}, 1, 0, "llvm", 1.0)


def test_ranges_split_at_powers_of_ten() -> None:
    assert range_edges(np.array([0.05, 1.0, 25.0])) == [0.05, 0.1, 1.0, 10.0, 25.0]
    assert range_edges(np.array([0.1, 1.0])) == [0.1, 1.0]


def test_errors_are_weighted_by_the_area_of_cells() -> None:
    every = _set([4, 1], [0, 0], [2, 2]).errors().query("series == 'm' and r_from_mm == 1 and r_to_mm == 20").iloc[0]
    near, far = 4 - 1, 400 - 4
    assert every["L1"] == pytest.approx((2 * near + far) / (4 * near + far))
    assert every["bias"] == pytest.approx((-2 * near + far) / (4 * near + far))


def test_a_dataset_of_xarray_holds_the_curves() -> None:
    data = _set([4, 1], [0.4, 0.1], [2, 2]).to_xarray().sel(theta_i_deg=0.0)
    np.testing.assert_array_equal(data.S.sel(series=TRACED), [4, 1])
    np.testing.assert_array_equal(data.standard_error.sel(series="m"), [0, 0])


def test_errors_state_the_noise_of_the_tracer() -> None:
    errors = _set([4, 1], [0.4, 0.1], [4, 1]).errors().query("r_to_mm == 20 and r_from_mm == 1").set_index("series")
    assert errors.loc["m", "L1"] == 0
    assert errors.loc["m", "noise"] == pytest.approx(0.1 * math.sqrt(2 / math.pi))
    assert errors.loc[TRACED, "L1"] == errors.loc["m", "noise"]
    assert errors.loc["m", "bias_standard_error"] == pytest.approx(math.hypot(0.4 * 3, 0.1 * 396) / (4 * 3 + 396))


def test_errors_are_not_a_number_where_no_light_was_traced() -> None:
    errors = _set([0, 0], [0, 0], [1, 1]).errors()
    assert errors["L1"].isna().all()


def test_the_table_of_values_is_tidy(small: CurveSet) -> None:
    frame = small.to_dataframe()
    assert len(frame) == len(small.series) * 8
    assert not frame.isna().any().any()
    assert (frame.query("series != 'path_traced'")["standard_error"] == 0).all()
    assert (frame.query("series == 'path_traced'")["standard_error"] > 0).all()


def test_saved_files_hold_what_was_measured(small: CurveSet, folder: Path) -> None:
    names = ["curves.csv", "curves.json", "curves.pdf", "curves.png", "curves_errors.csv"]
    assert sorted(path.name for path in folder.iterdir()) == names
    pandas.testing.assert_frame_equal(pandas.read_csv(folder / "curves.csv"), small.to_dataframe())
    assert len(pandas.read_csv(folder / "curves_errors.csv")) == len(small.errors())


def test_the_json_file_says_how_the_curves_were_made(small: CurveSet, folder: Path) -> None:
    about = json.loads((folder / "curves.json").read_text())
    assert about["parameters"]["seed"] == 0
    assert about["parameters"]["n_paths"] >= PATHS
    assert about["parameters"]["medium"]["sigma_t"] == pytest.approx(0.241)
    assert {"numpy", "drjit", "halfspace-sss", "python"} <= set(about["versions"])
    assert "command" in about and "commit" in about
    assert set(about["units"]) <= {*small.to_dataframe(), *small.errors()}


def test_the_pdf_is_vector_graphics_with_embedded_truetype_fonts(folder: Path) -> None:
    pdf = (folder / "curves.pdf").read_bytes()
    assert b"/FontFile2" in pdf and b"/Subtype /Image" not in pdf


def test_the_same_curves_give_the_same_files(small: CurveSet, folder: Path, tmp_path: Path) -> None:
    assert all(path.read_bytes() == (folder / path.name).read_bytes() for path in small.save(tmp_path))


def test_a_folder_that_is_a_file_is_refused(small: CurveSet, tmp_path: Any) -> None:
    (tmp_path / "file").write_text("x")
    with pytest.raises(ValueError, match="folder must be a folder or new"):
        small.save(tmp_path / "file" / "deeper")
    assert (tmp_path / "file").read_text() == "x"


DATA = ["curves.csv", "curves.json", "curves_errors.csv"]


@pytest.mark.parametrize("error", [RuntimeError("no ink"), KeyboardInterrupt()])
def test_a_failure_while_drawing_loses_no_result(
    small: CurveSet, tmp_path: Any, monkeypatch: Any, error: BaseException
) -> None:
    def fail(_: CurveSet) -> dict[str, bytes]:
        raise error

    monkeypatch.setattr("halfspace_sss.comparison.curve_set.render", fail)
    if isinstance(error, KeyboardInterrupt):
        with pytest.raises(KeyboardInterrupt):
            small.save(tmp_path / "new")
    else:
        with pytest.warns(UserWarning, match="^the figure could not be drawn: RuntimeError: no ink$"):
            assert sorted(path.name for path in small.save(tmp_path / "new")) == DATA
    assert json.loads((tmp_path / "new" / "curves.json").read_text())["files"] == ["curves.csv", "curves_errors.csv"]


def test_curves_without_light_can_be_drawn_and_saved(tmp_path: Any) -> None:
    s = halfspace_sss.curves(Medium(0.0, 1.0), theta_i_deg=[0], models=["standard_dipole"], n_paths=256)
    assert len(s.save(tmp_path)) == 5


def test_every_model_has_its_own_look_in_all_figures() -> None:
    from halfspace_sss.comparison.style import look

    looks = [look(series) for series in (TRACED, *halfspace_sss.models())]
    assert len({style.color for style in looks}) == len(looks)
    assert len({style.label for style in looks}) == len(looks)


def test_an_unknown_series_keeps_its_look_between_calls() -> None:
    from halfspace_sss.comparison.style import look

    assert look("my_model") == look("my_model")
    assert look("my_model").label == "My model"


def test_a_curve_that_is_not_there_is_refused(small: CurveSet) -> None:
    with pytest.raises(ValueError, match="series, theta_i_deg must be of"):
        small.curve("better_dipole", 45.0)


def test_results_cannot_be_changed(small: CurveSet) -> None:
    with pytest.raises(dataclasses.FrozenInstanceError):
        small.seed = 3
