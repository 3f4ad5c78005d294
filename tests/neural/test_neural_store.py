"""Files of weights: what is refused, by which name, and that nothing is lost or half-written."""

from __future__ import annotations

import hashlib
import json
import os
import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from safetensors.numpy import save

from halfspace_sss import Medium
from halfspace_sss.neural import paper_model
from halfspace_sss.neural.material_model import load_network
from halfspace_sss.neural.network import N_FEATURES, N_MEDIUM, N_TERMS, layer_shapes
from halfspace_sss.neural.store import LARGEST, load_weights, save_weights
from halfspace_sss.neural.universal import load_hypernetwork

KIND = "neural_material"
WIDTH, DEPTH = 4, 2
MEDIUM = Medium(1.0, 1.0, 0.0, 1.3)
RECORD = {"width": WIDTH, "depth": DEPTH, "medium": {"albedo": 0.5, "g": 0.0, "eta": 1.3}}


def _numbers(*shape: int, kind: type = np.float32) -> np.ndarray:
    return np.random.default_rng(shape).standard_normal(shape).astype(kind)


def _layers(n_in: int) -> dict[str, np.ndarray]:
    shapes = layer_shapes(n_in, WIDTH, DEPTH)
    arrays = {f"W_{k}": _numbers(*shape) for k, shape in enumerate(shapes)}
    return arrays | {f"b_{k}": _numbers(j) for k, (_, j) in enumerate(shapes)}


def _universal() -> dict[str, np.ndarray]:
    size = sum(i * j + j for i, j in layer_shapes(N_FEATURES, WIDTH, DEPTH))
    medium = {"medium_0_W": _numbers(N_MEDIUM, 3), "medium_0_b": _numbers(3)}
    medium |= {"medium_1_W": _numbers(3, 2), "medium_1_b": _numbers(2)}
    medium |= {"balance_0_W": _numbers(N_MEDIUM, N_TERMS), "balance_0_b": _numbers(N_TERMS)}
    return {**medium, "base": _numbers(size), "basis": _numbers(2, size)}


@pytest.fixture
def saved(tmp_path: Path) -> Path:
    """A whole file of weights; its record lies beside it."""
    return save_weights(tmp_path / "w.safetensors", KIND, _layers(N_FEATURES), RECORD)


def _rewrite(path: Path, arrays: dict[str, np.ndarray] | None = None, **record: Any) -> None:
    """Other arrays under a checksum that fits, other entries in the record."""
    content = json.loads(path.with_suffix(".json").read_text())
    if arrays is not None:
        path.write_bytes(save(arrays))
        content["sha256"] = hashlib.sha256(path.read_bytes()).hexdigest()
    path.with_suffix(".json").write_text(json.dumps({**content, **record}))


def _refusal(path: Path, kind: str = KIND) -> str:
    with pytest.raises(ValueError) as error:
        load_weights(path, kind)
    return str(error.value)


@pytest.mark.parametrize("kind", [np.float16, np.float32, np.float64])
def test_a_round_trip_keeps_every_bit(tmp_path: Path, kind: type) -> None:
    arrays = {"a": _numbers(3, 5, kind=kind), "b": np.asfortranarray(_numbers(4, 2, kind=kind)).T}
    arrays["a"].flat[:3] = -0.0, np.finfo(kind).smallest_subnormal, min(LARGEST, np.finfo(kind).max)
    found, record = load_weights(save_weights(tmp_path / "w.safetensors", KIND, arrays, {"seed": 3}), KIND)
    assert record["seed"] == 3 and found.keys() == arrays.keys()
    for name, array in arrays.items():
        assert found[name].dtype == array.dtype and found[name].shape == array.shape
        assert found[name].tobytes() == np.ascontiguousarray(array).tobytes()


def test_a_loaded_record_can_be_saved_with_other_weights(saved: Path) -> None:
    arrays, record = load_weights(saved, KIND)
    save_weights(saved, KIND, {name: 2 * array for name, array in arrays.items()}, record)
    np.testing.assert_array_equal(load_weights(saved, KIND)[0]["W_0"], 2 * arrays["W_0"])


@pytest.mark.parametrize("length", [0, 7, 100, -1])
def test_a_truncated_file_is_refused(saved: Path, length: int) -> None:
    saved.write_bytes(saved.read_bytes()[:length])
    assert str(saved) in _refusal(saved) and "truncated or altered" in _refusal(saved)


@pytest.mark.parametrize("position", [3, 40, -1])
def test_a_file_of_which_one_bit_was_altered_is_refused(saved: Path, position: int) -> None:
    data = bytearray(saved.read_bytes())
    data[position] ^= 1
    saved.write_bytes(data)
    assert str(saved) in _refusal(saved) and "truncated or altered" in _refusal(saved)


@pytest.mark.parametrize("key", ["format", "kind", "sha256", "shapes"])
@pytest.mark.parametrize("value", [None, 99, "other"])
def test_a_wrong_entry_of_the_head_is_refused_by_its_key(saved: Path, key: str, value: Any) -> None:
    _rewrite(saved, **{key: value})
    message = _refusal(saved)
    assert saved.stem in message and (key in message or "truncated or altered" in message)


def test_another_format_version_is_refused_with_both_versions(saved: Path) -> None:
    _rewrite(saved, format=2)
    assert _refusal(saved) == f"{saved.with_suffix('.json')}: format must be 1, got 2"


def test_weights_of_another_kind_are_refused_with_both_kinds(saved: Path) -> None:
    message = f"{saved.with_suffix('.json')}: kind must be 'neural_paper', got 'neural_material'"
    assert _refusal(saved, "neural_paper") == message


def test_shapes_other_than_those_of_the_record_are_refused(saved: Path) -> None:
    _rewrite(saved, {**_layers(N_FEATURES), "W_0": _numbers(N_FEATURES, WIDTH + 1)})
    assert _refusal(saved).startswith(f"{saved}: shapes must be")


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 1.01 * LARGEST, -1e30])
def test_numbers_that_are_not_finite_or_too_large_are_refused(saved: Path, value: float) -> None:
    arrays = _layers(N_FEATURES)
    arrays["b_1"][2] = value
    _rewrite(saved, arrays)
    assert str(saved) in _refusal(saved) and "b_1" in _refusal(saved)


def test_weights_that_could_not_be_loaded_are_not_saved(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="w.safetensors: a must be floating-point numbers"):
        save_weights(tmp_path / "w.safetensors", KIND, {"a": np.full(3, np.nan, np.float32)}, {})
    assert not list(tmp_path.iterdir())


def test_numbers_of_numpy_stand_in_a_record_as_numbers(tmp_path: Path) -> None:
    record = {"seed": np.int64(3), "recipe": {"events": np.float32(0.5)}}
    path = save_weights(tmp_path / "w.safetensors", KIND, _layers(N_FEATURES), record)
    assert load_weights(path, KIND)[1] | {"seed": 3, "recipe": {"events": 0.5}} == load_weights(path, KIND)[1]


def test_whole_numbers_are_refused(saved: Path) -> None:
    _rewrite(saved, {**_layers(N_FEATURES), "b_1": np.zeros(WIDTH, np.int32)})
    assert str(saved) in _refusal(saved) and "b_1" in _refusal(saved)


def test_bytes_that_are_no_safetensors_are_refused(saved: Path) -> None:
    saved.write_bytes(b"no such format" * 9)
    _rewrite(saved, sha256=hashlib.sha256(saved.read_bytes()).hexdigest())
    assert str(saved) in _refusal(saved) and "must be a safetensors file" in _refusal(saved)


@pytest.mark.parametrize("suffix", [".safetensors", ".json"])
def test_a_missing_file_is_refused_by_its_name(saved: Path, suffix: str) -> None:
    saved.with_suffix(suffix).unlink()
    assert str(saved.with_suffix(suffix)) in _refusal(saved) and "cannot be read" in _refusal(saved)


@pytest.mark.parametrize("text", ["", "{", "[1]", "3", "\x00", "[" * 100_000], ids=lambda text: text[:3])
def test_a_record_that_is_no_json_object_is_refused(saved: Path, text: str) -> None:
    saved.with_suffix(".json").write_text(text)
    assert str(saved.with_suffix(".json")) in _refusal(saved) and "must be" in _refusal(saved)


def test_a_record_that_is_no_text_is_refused(saved: Path) -> None:
    saved.with_suffix(".json").write_bytes(b"\xff\xfe\x80")
    assert str(saved.with_suffix(".json")) in _refusal(saved)


class _Harmful:
    def __init__(self, trace: Path) -> None:
        self.trace = trace

    def __reduce__(self) -> tuple:
        return Path.touch, (self.trace,)


@pytest.mark.parametrize("suffix", [".pt", ".pkl", ".pth", ".safetensors"])
def test_a_pickle_is_refused_and_not_run(saved: Path, tmp_path: Path, suffix: str) -> None:
    path = saved.with_suffix(suffix)
    path.write_bytes(pickle.dumps(_Harmful(tmp_path / "trace")))
    _rewrite(saved, sha256=hashlib.sha256(path.read_bytes()).hexdigest())
    assert str(path) in _refusal(path)
    assert not (tmp_path / "trace").exists()


def test_weights_are_saved_under_no_other_suffix(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="path must end in .safetensors, got .*w.pt"):
        save_weights(tmp_path / "w.pt", KIND, _layers(N_FEATURES), {})
    assert not list(tmp_path.iterdir())


def test_a_record_that_cannot_be_written_as_json_leaves_no_file(tmp_path: Path) -> None:
    with pytest.raises(TypeError):
        save_weights(tmp_path / "w.safetensors", KIND, _layers(N_FEATURES), {"path": tmp_path})
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("function", ["fsync", "replace"])
def test_writing_that_fails_keeps_the_old_weights_and_leaves_nothing_else(
    saved: Path, monkeypatch: pytest.MonkeyPatch, function: str
) -> None:
    before = {path.name: path.read_bytes() for path in saved.parent.iterdir()}

    def fail(*_: object) -> None:
        raise OSError("disk is full")

    with monkeypatch.context() as patch:
        patch.setattr(os, function, fail)
        with pytest.raises(OSError, match="disk is full"):
            save_weights(saved, KIND, {"a": _numbers(3)}, {})
    assert {path.name: path.read_bytes() for path in saved.parent.iterdir()} == before


def test_new_weights_without_their_record_are_not_taken_for_whole(saved: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    replace = os.replace

    def fail_at_the_record(source: str, target: Path) -> None:
        if Path(target).suffix == ".json":
            raise OSError("disk is full")
        replace(source, target)

    with monkeypatch.context() as patch:
        patch.setattr(os, "replace", fail_at_the_record)
        with pytest.raises(OSError, match="disk is full"):
            save_weights(saved, KIND, {"a": _numbers(3)}, {})
    assert [path.name for path in saved.parent.iterdir()] == [saved.name]
    assert str(saved.with_suffix(".json")) in _refusal(saved)


WRONG = [("width", None), ("width", "4"), ("width", 4.0), ("width", True), ("width", 0), ("width", 10**9),
         ("depth", None), ("depth", [2]), ("depth", -1), ("depth", 10**9)]  # fmt: skip


@pytest.mark.parametrize(("key", "value"), WRONG)
def test_an_entry_that_a_network_needs_is_refused_by_file_and_key(saved: Path, key: str, value: Any) -> None:
    _rewrite(saved, **{key: value})
    with pytest.raises(ValueError) as error:
        load_network(saved, KIND, MEDIUM, N_FEATURES)
    assert f"{saved.with_suffix('.json')}: {key} must be" in str(error.value) and repr(value) in str(error.value)


@pytest.mark.parametrize(
    "change", [{"width": 5}, {"depth": 3}, {"W_1": (WIDTH, 3)}, {"b_0": (3,)}, {"b_2": None}, {"c": (2,)}], ids=str
)
def test_layers_that_do_not_fit_the_architecture_are_refused(saved: Path, change: dict) -> None:
    _replaced(saved, _layers(N_FEATURES), change)
    with pytest.raises(ValueError, match=f"{saved}: layers must be"):
        load_network(saved, KIND, MEDIUM, N_FEATURES)


def _replaced(path: Path, arrays: dict[str, np.ndarray], change: dict) -> None:
    """Arrays of other shapes (None: left out), and the record's other entries."""
    record = {key: value for key, value in change.items() if isinstance(value, int)}
    arrays |= {name: _numbers(*shape) for name, shape in change.items() if isinstance(shape, tuple)}
    arrays = {name: array for name, array in arrays.items() if change.get(name, 0) is not None}
    _rewrite(path, arrays, **record, shapes={name: list(array.shape) for name, array in arrays.items()})


@pytest.fixture
def universal(tmp_path: Path) -> Path:
    return save_weights(tmp_path / "u.safetensors", "neural", _universal(), {"width": WIDTH, "depth": DEPTH})


def test_whole_weights_of_the_universal_network_are_taken(universal: Path) -> None:
    assert load_hypernetwork(universal).network(0.5, 0.1, 1.3).matrices[0].shape == (N_FEATURES, WIDTH)


@pytest.mark.parametrize(("key", "value"), WRONG)
def test_an_entry_that_the_universal_network_needs_is_refused(universal: Path, key: str, value: Any) -> None:
    _rewrite(universal, **{key: value})
    with pytest.raises(ValueError) as error:
        load_hypernetwork(universal)
    assert f"{universal.with_suffix('.json')}: {key} must be" in str(error.value) and repr(value) in str(error.value)


@pytest.mark.parametrize(
    "change", [{"width": 5}, {"base": None}, {"basis": None}, {"basis": (3, 9)}, {"medium_0_b": None},
               {"medium_1_W": (4, 2)}, {"medium_0_W": (N_MEDIUM + 1, 3)}, {"medium_2_b": (2,)}, {"c": (2,)},
               {"balance_0_W": None}, {"balance_0_W": None, "balance_0_b": None}, {"balance_0_b": (3,)}], ids=str,
)  # fmt: skip
def test_arrays_that_do_not_fit_the_universal_network_are_refused(universal: Path, change: dict) -> None:
    _replaced(universal, _universal(), change)
    with pytest.raises(ValueError, match=f"{universal}: shapes must be"):
        load_hypernetwork(universal)


@pytest.mark.parametrize("value", [None, "1", -1.0, float("inf"), float("nan"), True])
def test_a_scale_that_is_no_number_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, value: Any) -> None:
    record = {**RECORD, "scale": value}
    path = save_weights(tmp_path / "p.safetensors", paper_model.KIND, _layers(paper_model.N_INPUTS), record)
    monkeypatch.setattr(paper_model, "find_weights", lambda kind, medium: path)
    with pytest.raises(ValueError) as error:
        paper_model.NeuralPaper(MEDIUM)
    message = str(error.value)
    assert f"{path.with_suffix('.json')}: scale must be a number in" in message and repr(value) in message
