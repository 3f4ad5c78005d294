"""What `neural.train` refuses, and where trained weights are found: by their medium, and by no other."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import halfspace_sss
from benchmarks.universal_training import UniversalRecipe, train_universal
from halfspace_sss import Medium, materials
from halfspace_sss.maps import noisy_maps
from halfspace_sss.maps.noisy_maps import CellGrid
from halfspace_sss.neural import material_model, paper_model, store
from halfspace_sss.neural.store import load_weights
from halfspace_sss.neural.training.fit import Fit
from halfspace_sss.neural.training.train_material import MaterialRecipe, TrainedChannel, train

FIG10 = materials.load("fig10").medium
HOW = Fit(steps=20, n_groups=4, n_queries=32, validate_every=5)
TINY = MaterialRecipe(n_groups=8, events=1e5, grid=CellGrid(8, 4), how=HOW)
MEDIUM = Medium.from_albedo([0.75, 0.9], 1.0, [0.0, 0.3], 1.3)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: Any) -> Path:
    return tmp_path_factory.mktemp("weights")


@pytest.fixture(scope="module")
def fig10(folder: Path) -> TrainedChannel:
    (result,) = train("Fig10", recipe=TINY, seed=np.int64(5), folder=folder, target_error=1.0)
    return result


@pytest.fixture
def look_in(monkeypatch: Any) -> Callable[[Path], None]:
    """Weights are looked up in a folder, as without the stand-ins of the other tests."""
    for module in (material_model, paper_model):
        monkeypatch.setattr(module, "find_weights", store.find_weights)
    return lambda folder: monkeypatch.setenv(store.ENVIRONMENT_VARIABLE, str(folder))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"material": "no such material"}, "material must be one of"),
        ({"material": 3}, "material must be a name, got 3"),
        ({"model": "neural"}, "model must be one of neural_material, neural_paper, got 'neural'"),
        ({"recipe": None}, "recipe must be a MaterialRecipe, got None"),
        ({"recipe": UniversalRecipe()}, "recipe must be a MaterialRecipe, got UniversalRecipe"),
        ({"seed": -1}, "seed must be a whole number >= 0, got -1"),
        ({"seed": True}, "seed must be a whole number >= 0, got True"),
        ({"target_error": 0.0}, r"target_error must be a number in \[0.0001, 1\], got 0.0"),
        ({"target_error": float("nan")}, r"target_error must be a number in \[0.0001, 1\], got nan"),
        ({"backend": "opencl"}, "backend must be one of llvm, cuda, got 'opencl'"),
        ({"folder": "a file"}, "folder must be a folder or new, got '.*a file'"),
        ({"work": "a file"}, "folder must be a folder or new, got '.*a file'"),
    ],
    ids=lambda v: str(v)[:30],
)
def test_a_bad_argument_is_refused_before_any_work(arguments: dict, message: str, tmp_path: Path, monkeypatch: Any):
    monkeypatch.setattr(noisy_maps, "_launch", None)
    monkeypatch.chdir(tmp_path)
    Path("a file").touch()
    asked = {"material": "fig10", "recipe": TINY, "folder": "weights", "work": "work", **arguments}
    with pytest.raises(ValueError, match=message):
        train(**asked)
    assert [path.name for path in tmp_path.iterdir()] == ["a file"]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"seed": 1.5}, "seed must be a whole number >= 0, got 1.5"),
        ({"backend": "opencl"}, "backend must be one of llvm, cuda, got 'opencl'"),
        ({"folder": "a file"}, "folder must be a folder or new, got 'a file'"),
    ],
    ids=str,
)
def test_a_bad_argument_of_the_universal_training_is_refused(
    arguments: dict, message: str, tmp_path: Path, monkeypatch: Any
) -> None:
    monkeypatch.setattr(noisy_maps, "_launch", None)
    monkeypatch.chdir(tmp_path)
    Path("a file").touch()
    with pytest.raises(ValueError, match=message):
        train_universal(**{"folder": "universal", **arguments})
    assert [path.name for path in tmp_path.iterdir()] == ["a file"]


@pytest.mark.parametrize(
    ("make", "arguments", "message"),
    [
        (Fit, {"steps": 0}, "steps must be a whole number >= 1, got 0"),
        (Fit, {"steps": 1, "n_groups": 2.0}, "n_groups must be a whole number >= 1, got 2.0"),
        (Fit, {"steps": 1, "n_queries": 0}, "n_queries must be a whole number >= 1, got 0"),
        (Fit, {"steps": 1, "rate": 0.0}, "rate must be a number in .*, got 0.0"),
        (Fit, {"steps": 1, "checkpoint_every": -1.0}, "checkpoint_every must be a number in .*, got -1.0"),
        (Fit, {"steps": 1, "validate_every": 0}, "validate_every must be a whole number >= 1, got 0"),
        (CellGrid, {"n_u": 1}, "n_u must be a whole number >= 2, got 1"),
        (CellGrid, {"n_psi": 7}, "n_psi must be even, got 7"),
        (MaterialRecipe, {"n_groups": 0}, "n_groups must be a whole number >= 1, got 0"),
        (MaterialRecipe, {"events": 10.0}, r"events must be a number in \[10000, 1e\+15\], got 10.0"),
        (UniversalRecipe, {"n_media": 0}, "n_media must be a whole number >= 1, got 0"),
        (UniversalRecipe, {"rank": 0}, "rank must be a whole number >= 1, got 0"),
        (UniversalRecipe, {"events": float("inf")}, "events must be a number in .*, got inf"),
    ],
    ids=str,
)
def test_a_recipe_that_cannot_be_followed_is_refused(make: Any, arguments: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make(**arguments)


def test_training_that_diverges_writes_no_weights(tmp_path: Path, monkeypatch: Any) -> None:
    monkeypatch.setattr(material_model.Network, "from_vector", _not_finite(material_model.Network.from_vector))
    with pytest.raises(ValueError, match="must be floating-point numbers"):
        train(FIG10, recipe=TINY, folder=tmp_path)
    assert not list(tmp_path.iterdir())


def _not_finite(from_vector: Callable) -> Callable:
    return lambda vector, *shapes: from_vector(np.nan * vector, *shapes)


def test_the_record_says_how_weights_were_made(fig10: TrainedChannel) -> None:
    record = json.loads(fig10.path.with_suffix(".json").read_text())
    assert record["medium"] == {"albedo": 0.75, "g": 0.0, "eta": 1.3} and record["seed"] == 5
    assert record["recipe"]["how"]["steps"] == 20 and record["recipe"]["grid"] == {"n_u": 8, "n_psi": 4}
    assert record["validation"]["error"] == fig10.error.error and record["orders"] == "multiple"
    assert record["provenance"]["versions"]["torch"] and record["fit_seconds"] > 0


def test_training_stops_early_at_a_target_error(fig10: TrainedChannel) -> None:
    history = json.loads(fig10.path.with_suffix(".json").read_text())["history"]
    assert [h["step"] for h in history] == [5]  # of 20: the target was 100 %


def test_weights_are_found_by_their_medium(fig10: TrainedChannel, folder: Path, look_in: Any) -> None:
    look_in(folder)
    (network,) = halfspace_sss.bssrdf("neural_material", FIG10).networks
    np.testing.assert_array_equal(network.matrices[0], load_weights(fig10.path, "neural_material")[0]["W_0"])


@pytest.mark.parametrize("factor", [1e-3, 1.0, 77.0])
def test_weights_are_found_at_every_extinction(
    fig10: TrainedChannel, folder: Path, look_in: Any, factor: float
) -> None:
    look_in(folder)
    assert halfspace_sss.bssrdf("neural_material", FIG10.scaled(factor)).eval(1 / factor, 1.0, 0.0, 1.0, 0.0) > 0


@pytest.mark.parametrize("other", [(0.7501, 0.0, 1.3), (0.75, 0.001, 1.3), (0.75, 0.0, 1.31)])
def test_weights_are_not_taken_for_another_medium(
    fig10: TrainedChannel, folder: Path, look_in: Any, other: Any
) -> None:
    look_in(folder)
    albedo, g, eta = other
    with pytest.raises(ValueError, match="medium must be trained for neural_material, got one that is not"):
        halfspace_sss.bssrdf("neural_material", Medium.from_albedo(albedo, 1.0, g, eta))


def test_weights_are_not_taken_for_another_model(fig10: TrainedChannel, folder: Path, look_in: Any) -> None:
    look_in(folder)
    with pytest.raises(ValueError, match="medium must be trained for neural_paper, got one that is not"):
        halfspace_sss.bssrdf("neural_paper", FIG10)


def test_a_material_lists_the_model_if_it_is_trained(look_in: Any, tmp_path: Path) -> None:
    look_in(tmp_path)
    assert "neural_material" in materials.load("marble").models()
    assert "neural_material" not in materials.load("cream").models()


def test_every_channel_must_be_trained(fig10: TrainedChannel, folder: Path, look_in: Any) -> None:
    look_in(folder)
    with pytest.raises(ValueError, match=r"medium must be trained for neural_material, got .* \(albedo 0.9, g 0.3"):
        halfspace_sss.bssrdf("neural_material", MEDIUM)


def test_weights_lie_in_the_folder_of_the_user_unless_another_is_named(tmp_path: Path, monkeypatch: Any) -> None:
    monkeypatch.delenv(store.ENVIRONMENT_VARIABLE, raising=False)
    for variable in ("XDG_DATA_HOME", "LOCALAPPDATA"):
        monkeypatch.setenv(variable, str(tmp_path))
    assert store.weights_folder() == tmp_path / "halfspace-sss" / "weights"
