"""The command `maps`: which stores it makes, how it goes on, and how it ends."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from figures import app as cli
from halfspace_sss import materials
from halfspace_sss.maps.map_store import load_maps

SMALL = ("--grid", "2,16,6,4", "--paths", "2048")


def _invoke(*arguments: str) -> Any:
    return CliRunner().invoke(cli.app, ["maps", *arguments])


def test_a_material_has_one_store_with_all_its_channels(tmp_path: Path) -> None:
    result = _invoke("Ketchup", *SMALL, "--out", str(tmp_path / "deep" / "maps"))
    assert result.exit_code == 0
    (store,) = (tmp_path / "deep" / "maps").iterdir()
    assert store.name == "ketchup.zarr"
    assert str(store) in result.stdout
    maps = load_maps(store)
    assert dict(maps.sizes) | {"channel": 3, "theta": 2, "phi": 16, "r": 6, "psi": 4} == dict(maps.sizes)
    assert maps.mfp.values == pytest.approx(materials.load("ketchup").medium.mfp)


def test_chosen_channels_of_many_materials_have_a_store_each(tmp_path: Path) -> None:
    result = _invoke("ketchup", "strawberry shampoo", "--channel", "B,0", *SMALL, "--out", str(tmp_path))
    assert result.exit_code == 0
    names = ["ketchup_B.zarr", "ketchup_R.zarr", "strawberry_shampoo_B.zarr", "strawberry_shampoo_R.zarr"]
    assert sorted(path.name for path in tmp_path.iterdir()) == names
    assert load_maps(tmp_path / "ketchup_B.zarr").mfp.item() == pytest.approx(1 / 1.48)


def test_given_coefficients_make_a_store_under_the_given_name(tmp_path: Path) -> None:
    assert _invoke("--sigma-t", "2", "--g", "0.5", "--name", "soap", *SMALL, "--out", str(tmp_path)).exit_code == 0
    assert load_maps(tmp_path / "soap.zarr").mfp.item() == pytest.approx(0.5)


def test_a_store_has_a_name_that_a_shell_takes_as_it_is(tmp_path: Path) -> None:
    assert _invoke("head & shoulders shampoo", "--channel", "B", *SMALL, "--out", str(tmp_path)).exit_code == 0
    assert [path.name for path in tmp_path.iterdir()] == ["head_shoulders_shampoo_B.zarr"]


def test_without_arguments_the_medium_is_that_of_fig_10(tmp_path: Path) -> None:
    assert _invoke(*SMALL, "--out", str(tmp_path)).exit_code == 0
    assert load_maps(tmp_path / "fig10.zarr").mfp.item() == pytest.approx(1 / 0.241)


def test_progress_goes_to_stderr(tmp_path: Path) -> None:
    result = _invoke(*SMALL, "--out", str(tmp_path))
    assert "tracing" in result.stderr and "tracing" not in result.stdout


def test_a_store_that_is_whole_is_only_checked(tmp_path: Path, monkeypatch: Any) -> None:
    assert _invoke(*SMALL, "--out", str(tmp_path)).exit_code == 0
    monkeypatch.setattr("halfspace_sss.maps.map_store.trace_unit", None)
    result = _invoke(*SMALL, "--out", str(tmp_path))
    assert result.exit_code == 0
    assert "100 %" in result.stderr


def test_a_store_of_other_parameters_is_refused_and_nothing_added(tmp_path: Path) -> None:
    _invoke("marble", "--channel", "G", *SMALL, "--out", str(tmp_path))
    result = _invoke("ketchup", "marble", "--channel", "G", *SMALL, "--seed", "1", "--out", str(tmp_path))
    assert result.exit_code == 2
    assert "marble_G.zarr was made with seed = 0, got 1: ask for the same, or take another folder" in result.stderr
    assert [path.name for path in tmp_path.iterdir()] == ["marble_G.zarr"]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["marbel"], "did you mean 'marble'?"),
        (["marble", "kechup"], "did you mean 'ketchup'?"),
        (["marble", "Marble"], "materials and channels must be different, got marble, marble"),
        (["marble", "--channel", "R,r"], "materials and channels must be different, got marble R, marble R"),
        (["marble", "--channel", "X"], "channel must be one of R, G, B"),
        (["--channel", "R"], "channel must be left out unless materials are named, got 'R'"),
        (["marble", "--albedo", "0.5"], "albedo must be left out for a named material, got 0.5"),
        (["marble", "--name", "a"], "name must be left out unless coefficients are given, got 'a'"),
        (["--g", "0", "--name", "a/b"], "usable as a file name, got 'a/b'"),
        (["--sigma-t", "two"], "Invalid value for '--sigma-t': must be a number, such as 0.02"),
        (["--sigma-t", "-2"], "sigma_t must be finite and > 0 (1/mm), got -2"),
        (["--grid", "16,64"], "grid must be four whole numbers separated by commas, got '16,64'"),
        (["--grid", "16,64,inf,8"], "grid must be four whole numbers separated by commas, got '16,64,inf,8'"),
        (["--grid", "16,20,8,8"], "n_phi must be a multiple of 16, got 20"),
        (["--target-error", "0"], "target_error must be a number in [0.0001, 1], got 0.0"),
        (["--paths", "5"], "n_paths must be a whole number >= 1024, got 5"),
        (["--seed", "-1"], "seed must be a whole number >= 0, got -1"),
        (["--backend", "metal"], "'metal' is not one of 'llvm', 'cuda'"),
        (["--out", "/dev/null/maps"], "folder must be a folder or new, got '/dev/null/maps'"),
    ],
)
def test_bad_input_ends_with_2_and_writes_nothing(
    arguments: list[str], message: str, tmp_path: Path, monkeypatch: Any
) -> None:
    monkeypatch.chdir(tmp_path)
    result = _invoke(*arguments)
    assert result.exit_code == 2
    assert message in result.stderr
    assert result.stderr.startswith("error: ") and result.stderr.count("\n") == 1
    assert not list(tmp_path.iterdir())
