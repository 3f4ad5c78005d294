"""The commands `train` and `errors`: which files they write, what they print, and what they refuse."""

from __future__ import annotations

import functools
import json
from pathlib import Path
from typing import Any

import pandas
import pytest
from typer.testing import CliRunner

from benchmarks import __main__ as benchmarks
from benchmarks import universal_training
from benchmarks.universal_training import UniversalRecipe
from figures import app as cli
from halfspace_sss import bssrdf, materials
from halfspace_sss.comparison import model_errors
from halfspace_sss.maps import noisy_maps
from halfspace_sss.maps.noisy_maps import CellGrid
from halfspace_sss.materials import catalogue as registry
from halfspace_sss.neural import material_model, paper_model, store
from halfspace_sss.neural.store import load_weights
from halfspace_sss.neural.training import train_material
from halfspace_sss.neural.training.fit import Fit
from halfspace_sss.neural.training.train_material import MaterialRecipe

FIG10 = materials.load("fig10").medium
HOW = Fit(steps=20, n_groups=4, n_queries=32, validate_every=10)
TINY = MaterialRecipe(n_groups=8, events=1e5, grid=CellGrid(8, 4), how=HOW)
TINY_UNIVERSAL = UniversalRecipe(
    8, 1e5, CellGrid(8, 4), HOW, rank=2, calibration_media=4, calibration_how=Fit(5, n_groups=4)
)


def _invoke(*arguments: str) -> Any:
    app = benchmarks.app if arguments[0] in benchmarks.COMMANDS else cli.app
    return CliRunner().invoke(app, list(arguments))


def _errors(*arguments: str) -> Any:
    return _invoke("errors", "materials", *arguments)


@pytest.fixture(autouse=True)
def _small(monkeypatch: Any, tmp_path: Path) -> None:
    """Recipes of a second and coarse maps, in an empty folder, where weights are looked up too."""
    monkeypatch.setattr(model_errors, "GRID", CellGrid(16, 8))
    monkeypatch.setattr(model_errors, "LAST_N_PSI", model_errors.FIRST_N_PSI)
    for name in ("STANDARD", "FAST"):
        monkeypatch.setattr(train_material, name, TINY)
    monkeypatch.setattr(universal_training, "UniversalRecipe", lambda: TINY_UNIVERSAL)
    for module in (material_model, paper_model):
        monkeypatch.setattr(module, "find_weights", store.find_weights)
    monkeypatch.setenv(store.ENVIRONMENT_VARIABLE, str(tmp_path / "weights"))
    monkeypatch.chdir(tmp_path)


def _record(path: Path) -> dict:
    return json.loads(path.with_suffix(".json").read_text())


def _weights(folder: str = "weights") -> list[Path]:
    return sorted(Path(folder).glob("*.safetensors"))


@pytest.mark.slow
def test_training_without_a_name_writes_weights_of_fig10_where_its_model_finds_them() -> None:
    """With the upper end of the error, and with its work in a folder of the material and channel."""
    result = _invoke("train", "material", "--fast", "--work", "unfinished")
    assert result.exit_code == 0, result.output
    (path,) = _weights()
    assert path.name == store.weights_name("neural_material", FIG10) and path.name in result.stdout
    assert bssrdf("neural_material", FIG10).eval(1.0, 1.0, 0.0, 1.0, 0.0) > 0
    record = _record(path)
    assert record["medium"] == {"albedo": 0.75, "g": 0.0, "eta": 1.3}
    assert record["history"][-1]["error"] == record["validation"]["bound"] > record["validation"]["error"] >= 0
    assert (Path("unfinished") / "fig10" / "channel-0" / "run.json").is_file()


@pytest.mark.slow
def test_every_channel_of_every_material_has_its_row_and_weights() -> None:
    result = _invoke("train", "material", "ketchup", "fig10", "--fast", "--out", "mine")
    assert result.exit_code == 0 and len(_weights("mine")) == 4 and not _weights()
    rows = [line.split() for line in result.stdout.splitlines() if line.strip().startswith(("ketchup", "fig10"))]
    assert [row[0] for row in rows] == ["ketchup"] * 3 + ["fig10"]
    assert all(row[4] == "<" or row[5] == "±" for row in rows)  # no error is told as if it were exact


@pytest.mark.slow
def test_the_network_of_the_paper_is_trained_by_name(monkeypatch: pytest.MonkeyPatch) -> None:
    narrow = functools.partial(train_material.PaperLearner, width=32)
    monkeypatch.setattr(train_material, "PaperLearner", narrow)
    assert _invoke("train", "material", "--model", "neural_paper", "--steps", "2").exit_code == 0
    (path,) = _weights()
    assert load_weights(path, "neural_paper")[1]["recipe"]["how"]["steps"] == 2


def test_training_stops_at_the_target_error_that_is_given() -> None:
    assert _invoke("train", "material", "--target-error", "1", "--seed", "4").exit_code == 0
    record = _record(_weights()[0])
    assert [h["step"] for h in record["history"]] == [10] and record["seed"] == 4


def test_the_name_of_a_material_cannot_lead_out_of_the_work_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    entry = '[[material]]\nname = "../../x"\nsigma_s = 1.0\nsigma_a = 0.1\ng = 0.0\n'
    (tmp_path / "mine.toml").write_text(f'set = "mine"\nunit = "1/mm"\neta = 1.3\nsource = "mine"\n{entry}')
    monkeypatch.setenv(registry.ENVIRONMENT_VARIABLE, str(tmp_path / "mine.toml"))
    monkeypatch.setattr(registry, "_registry", registry.Registry())
    result = _invoke("train", "material", "../../x", "--work", "a/b/ww")
    assert result.exit_code == 2 and "name must be without '/', as folders are called by it" in result.stderr
    assert not (Path("a") / "x").exists() and not Path("x").exists()


@pytest.mark.slow
def test_the_universal_network_is_trained_into_a_folder() -> None:
    result = _invoke("train-universal", "--steps", "3", "--out", "all")
    assert result.exit_code == 0 and "neural.safetensors" in result.stdout
    assert load_weights(Path("all") / "neural.safetensors", "neural")[1]["recipe"]["how"]["steps"] == 3


REFUSED_BY_TRAIN = [
    (["no such material"], "material must be one of"),
    (["fig10", "--albedo", "0.5"], "albedo must be left out for a named material"),
    (["--albedo", "1.5"], "albedo must be in [0, 1], got 1.5"),
    (["--model", "neural"], "'neural' is not one of 'neural_material', 'neural_paper'"),
    (["--steps", "0"], "steps must be a whole number >= 1, got 0"),
    (["--seed", "-1"], "seed must be a whole number >= 0, got -1"),
    (["--target-error", "2"], "target_error must be a number in [0.0001, 1], got 2.0"),
    (["--backend", "opencl"], "'opencl' is not one of 'llvm', 'cuda'"),
    (["--out", "file"], "folder must be a folder or new, got 'file'"),
    (["--work", "file"], "folder must be a folder or new, got 'file"),
]
REFUSED_BY_UNIVERSAL = [
    (["--steps", "-1"], "steps must be a whole number >= 1, got -1"),
    (["--seed", "-1"], "seed must be a whole number >= 0, got -1"),
    (["--backend", "opencl"], "'opencl' is not one of 'llvm', 'cuda'"),
    (["--out", "file"], "folder must be a folder or new, got 'file'"),
]
REFUSED_BY_ERRORS = [
    (["no such material"], "material must be one of"),
    (["fig10", "--g", "0.5"], "g must be left out for a named material"),
    (["--model", "no_such_model"], "model must be one of"),
    (["--model", "neural_material", "--g", "0.01"], "medium must be trained for neural_material, got one that is not"),
    (["--model", "neural", "--g", "0.99"], "g must be in [-0.5, 0.98] for the neural model, got 0.99"),
    (["--events", "10"], "events must be a number in [10000, 1e+12], got 10.0"),
    (["--block", "3"], "'3' is not one of '1', '2', '4', '8'"),
    (["--seed", "-1"], "seed must be a whole number >= 0, got -1"),
    (["--backend", "opencl"], "'opencl' is not one of 'llvm', 'cuda'"),
    (["--out", "file"], "folder must be a folder or new, got 'file'"),
]
REFUSED = [
    *(("train material", *case) for case in REFUSED_BY_TRAIN),
    *(("train-universal", *case) for case in REFUSED_BY_UNIVERSAL),
    *(("errors materials", *case) for case in REFUSED_BY_ERRORS),
]


@pytest.mark.parametrize(
    ("command", "arguments", "message"), REFUSED, ids=[f"{c} {' '.join(a)}" for c, a, _ in REFUSED]
)
def test_bad_input_is_refused_before_any_work(
    command: str, arguments: list[str], message: str, tmp_path: Path, monkeypatch: Any
) -> None:
    monkeypatch.setattr(noisy_maps, "_launch", None)
    (tmp_path / "file").touch()
    result = _invoke(*command.split(), *arguments)
    assert result.exit_code == 2, result.output
    assert result.stderr.startswith("error: ") and message in result.stderr and len(result.stderr.splitlines()) == 1
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


@pytest.mark.slow
def test_errors_are_written_for_every_model_that_takes_the_medium() -> None:
    result = _errors("--events", "2e4", "--out", "deep/found")
    assert result.exit_code == 0, result.output
    table = pandas.read_csv("deep/found/errors.csv")
    assert {"standard_dipole", "directional_dipole", "neural", "neural_material"} <= set(table["model"])
    assert "neural_paper" not in set(table["model"])  # not trained
    assert (table["error"] >= 0).all() and (table["noise"] > 0).all() and table["bias"].notna().all()
    for name in ("errors.csv", "errors.json"):
        assert f"deep/found/{name}" in result.stdout


def test_errors_of_a_material_are_those_of_its_channels() -> None:
    assert _errors("ketchup", "--events", "2e4", "--model", "standard_dipole").exit_code == 0
    table = pandas.read_csv("errors/errors.csv")
    assert list(table["medium"]) == ["ketchup R", "ketchup G", "ketchup B"]
    assert list(table["albedo"]) == pytest.approx(materials.load("ketchup").medium.albedo)


def test_the_json_says_what_an_error_is_and_where_the_numbers_come_from() -> None:
    assert (
        _invoke(
            "errors", "materials", "--events", "2e4", "--model", "better_dipole", "--block", "8", "--seed", "3"
        ).exit_code
        == 0
    )
    content = json.loads(Path("errors/errors.json").read_text())
    assert content["provenance"]["parameters"] == {"events": 2e4, "block": 8, "seed": 3}
    assert "blocks of 8 x 8 cells" in content["definition"]
    assert [row["model"] for row in content["summary"]] == ["better_dipole"]


def test_errors_are_repeated_by_their_seed() -> None:
    for out in ("a", "b"):
        assert _errors("--events", "2e4", "--model", "better_dipole", "--out", out).exit_code == 0
    assert Path("a/errors.csv").read_bytes() == Path("b/errors.csv").read_bytes()


@pytest.mark.slow
def test_given_coefficients_are_trained_and_among_the_errors() -> None:
    medium = ("--albedo", "0.6", "--g", "0.2", "--eta", "1.1", "--sigma-t", "3")
    assert _invoke("train", "material", *medium).exit_code == 0
    assert _record(_weights()[0])["medium"] == {"albedo": pytest.approx(0.6), "g": 0.2, "eta": 1.1}
    result = _errors(*medium, "--events", "2e4", "--model", "neural_material")
    assert result.exit_code == 0 and "neural_material" in result.stdout


@pytest.mark.slow
def test_held_out_media_are_summed_up_by_percentiles_ranges_and_losses() -> None:
    chosen = ("--model", "neural", "--model", "standard_dipole")
    result = _invoke("media-errors", "--held-out", "4", "--events", "2e4", *chosen)
    assert result.exit_code == 0, result.output
    assert len(pandas.read_csv("errors/errors.csv")) == 8
    for words in ("errors over the media", "neural over ranges of media", "has a smaller error than neural"):
        assert words in result.stdout


def test_held_out_media_can_be_asked_of_one_model_alone() -> None:
    assert _invoke("media-errors", "--held-out", "1", "--events", "2e4", "--model", "neural").exit_code == 0
