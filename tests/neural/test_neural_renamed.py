"""Weights of one medium are refused for another, and what has no end is not read, whatever their file is called."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from halfspace_sss import Medium, bssrdf
from halfspace_sss.neural import material_model, paper_model, store
from halfspace_sss.neural.material_model import load_network
from halfspace_sss.neural.network import N_FEATURES, layer_shapes
from halfspace_sss.neural.store import save_weights

KIND = material_model.KIND
MEDIUM = Medium(1.0, 1.0, 0.0, 1.3)
RECORD = {"width": 4, "depth": 2, "scale": 1.0, "medium": {"albedo": 0.5, "g": 0.0, "eta": 1.3}}


def _layers(n_in: int) -> dict[str, np.ndarray]:
    shapes = enumerate(layer_shapes(n_in, RECORD["width"], RECORD["depth"]))
    return {f"{name}_{k}": np.ones(s, np.float32) for k, shape in shapes for name, s in zip("Wb", (shape, shape[1:]))}


@pytest.fixture
def saved(tmp_path: Path) -> Path:
    return save_weights(tmp_path / "w.safetensors", KIND, _layers(N_FEATURES), RECORD)


@pytest.mark.parametrize(("key", "value"), [("albedo", 0.4), ("g", 0.1), ("eta", 1.3000001)])
def test_weights_renamed_to_another_medium_are_refused(saved: Path, key: str, value: float) -> None:
    ratios = {**RECORD["medium"], key: value}
    other = Medium.from_albedo(ratios["albedo"], 2.0, ratios["g"], ratios["eta"])
    load_network(saved, KIND, MEDIUM, N_FEATURES)
    with pytest.raises(ValueError) as error:
        load_network(saved, KIND, other, N_FEATURES)
    wrong = f"{saved.with_suffix('.json')}: {key} of medium must be {value:.8g} for this medium"
    assert f"{wrong}, got {RECORD['medium'][key]!r}" in str(error.value)


@pytest.mark.parametrize("medium", [None, {}, "marble", {"albedo": "0.5", "g": 0, "eta": 1.3}], ids=str)
def test_weights_that_name_no_medium_are_refused(saved: Path, medium: Any) -> None:
    record = saved.with_suffix(".json")
    record.write_text(json.dumps(json.loads(record.read_text()) | {"medium": medium}))
    with pytest.raises(ValueError, match="json: medium must have albedo, g, eta as numbers, got"):
        load_network(saved, KIND, MEDIUM, N_FEATURES)


@pytest.mark.parametrize("ending", [".json", ".safetensors"])
def test_weights_without_end_are_not_read(saved: Path, ending: str) -> None:
    path = saved.with_suffix(ending)
    path.unlink()
    path.symlink_to("/dev/zero")
    with pytest.raises(ValueError, match=f"{path}: .*cannot be read: it must be a regular file"):
        load_network(saved, KIND, MEDIUM, N_FEATURES)


@pytest.mark.parametrize("model", [material_model, paper_model])
def test_a_model_refuses_weights_renamed_to_its_medium(tmp_path: Path, monkeypatch: Any, model: Any) -> None:
    monkeypatch.setenv(store.ENVIRONMENT_VARIABLE, str(tmp_path))
    monkeypatch.setattr(model, "find_weights", store.find_weights)
    n_in = {material_model.KIND: N_FEATURES, paper_model.KIND: paper_model.N_INPUTS}[model.KIND]
    other = Medium.from_albedo(0.625, 1.0, 0.0, 1.3)
    save_weights(tmp_path / store.weights_name(model.KIND, other), model.KIND, _layers(n_in), RECORD)
    with pytest.raises(ValueError, match="albedo of medium must be 0.625 for this medium, got 0.5"):
        bssrdf(model.KIND, other)
