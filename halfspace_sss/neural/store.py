"""Weights on disk: a safetensors file of arrays and, beside it, a JSON record of what they are and how they were made.

Weights of single media are found again by the medium that they were trained for.

Loading runs no code of the file. The record names the checksum of the arrays, and both must agree with the format
version, kind and shapes that are asked for.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from importlib import resources
from pathlib import Path

import numpy as np

from halfspace_sss.checks import check_interval
from halfspace_sss.physics.medium import Medium, check_numbers
from halfspace_sss.provenance import JsonDict, check_folder, path_of, read_bytes, read_text, write_together

FORMAT = 1
LARGEST = 1e4  # no weight of a network that works is as large


def to_json(content: JsonDict) -> str:
    """The text of a JSON file with one line for each key; NumPy's numbers become Python's.
    TypeError if something in it has no form in JSON."""

    def plain(value: object) -> object:
        if isinstance(value, np.generic):
            return value.item()
        raise TypeError(f"content must be ready for JSON, got {value!r}")

    lines = (f" {json.dumps(key)}: {json.dumps(value, default=plain)}" for key, value in content.items())
    return "{\n" + ",\n".join(lines) + "\n}\n"


def _record_path(path: Path) -> Path:
    return path.with_suffix(".json")


def record_count(path: Path, record: JsonDict, key: str, most: int = 4096) -> int:
    """A whole number in [1, most] of the record of `path`; ValueError names file, key, bound and value."""
    value = record.get(key)
    if isinstance(value, bool) or not isinstance(value, int) or not 1 <= value <= most:
        raise ValueError(f"{_record_path(path)}: {key} must be a whole number in [1, {most}], got {value!r}")
    return value


def record_number(path: Path, record: JsonDict, key: str, low: float, high: float) -> float:
    """A number in [low, high] of the record of `path`; ValueError names file, key, bound and value."""
    check_interval(f"{_record_path(path)}: {key}", record.get(key), low, high)
    return float(record[key])


def save_weights(path: str | os.PathLike[str], kind: str, arrays: Mapping[str, np.ndarray], record: JsonDict) -> Path:
    """Write `path` (.safetensors) and its record (.json); together or not at all.
    `kind`: which network it is, e.g. "neural_material". `arrays`: name -> float array. `record`: what else is known:
    medium, architecture, data, error, time, versions; ready for JSON. ValueError if the name does not end in
    .safetensors, or a number is such that loading would refuse it, which is what a training that diverged gives."""
    from safetensors.numpy import save

    path = path_of(path)
    if path.suffix != ".safetensors":
        raise ValueError(f"path must end in .safetensors, got {str(path)!r}")
    _check_numbers(path, arrays)
    data = save({name: np.ascontiguousarray(array) for name, array in arrays.items()})
    shapes = {name: list(array.shape) for name, array in arrays.items()}
    head = {"format": FORMAT, "kind": kind, "sha256": hashlib.sha256(data).hexdigest(), "shapes": shapes}
    text = to_json(head | record | head)  # the head of a record that was loaded is of other weights
    write_together({path: data, _record_path(path): text})
    return path


def load_weights(path: str | os.PathLike[str], kind: str) -> tuple[dict[str, np.ndarray], JsonDict]:
    """Arrays and record of a file of weights.
    ValueError if it is no such file, is truncated or altered, of another kind, version or shape, or holds numbers that
    are not finite; the message names the file."""
    path = path_of(path)
    record = _read_record(path, kind)
    try:
        data = read_bytes(path)
    except OSError as error:
        raise ValueError(f"{path}: weights cannot be read: {error.strerror}") from error
    if hashlib.sha256(data).hexdigest() != record["sha256"]:
        raise ValueError(f"{path}: sha256 must be {record['sha256'][:12]}..., got another: truncated or altered")
    return _arrays(path, data, record), record


def checksum_of(path: str | os.PathLike[str], kind: str) -> str:
    """SHA-256 of the arrays of a file of weights, as its record names it; errors as in `load_weights`."""
    return _read_record(path_of(path), kind)["sha256"]


def _read_record(path: Path, kind: str) -> JsonDict:
    if path.suffix != ".safetensors":
        raise ValueError(f"{path}: weights must be a .safetensors file (a pickle could run code), got {path.suffix!r}")
    where = _record_path(path)
    try:
        record = json.loads(read_text(where))
    except OSError as error:
        raise ValueError(f"{where}: record of the weights cannot be read: {error.strerror}") from error
    except (UnicodeDecodeError, json.JSONDecodeError, RecursionError) as error:
        raise ValueError(f"{where}: record of the weights must be JSON: {error}") from error
    if not isinstance(record, dict):
        raise ValueError(f"{where}: record of the weights must be a JSON object, got {type(record).__name__}")
    for key, wanted in (("format", FORMAT), ("kind", kind)):
        if record.get(key) != wanted:
            raise ValueError(f"{where}: {key} must be {wanted!r}, got {record.get(key)!r}")
    for key, sort in (("sha256", str), ("shapes", dict)):
        if not isinstance(record.get(key), sort):
            raise ValueError(f"{where}: {key} must be a {sort.__name__}, got {record.get(key)!r}")
    return record


def _arrays(path: Path, data: bytes, record: JsonDict) -> dict[str, np.ndarray]:
    from safetensors import SafetensorError
    from safetensors.numpy import load

    try:
        arrays = load(data)
    except SafetensorError as error:
        raise ValueError(f"{path}: must be a safetensors file: {error}") from error
    shapes = {name: list(array.shape) for name, array in arrays.items()}
    if shapes != record["shapes"]:
        raise ValueError(f"{path}: shapes must be {record['shapes']}, got {shapes}")
    _check_numbers(path, arrays)
    return arrays


def _check_numbers(path: Path, arrays: Mapping[str, np.ndarray]) -> None:
    for name, array in arrays.items():
        if array.dtype.kind != "f" or not np.all(np.abs(array) <= LARGEST):
            raise ValueError(f"{path}: {name} must be floating-point numbers of size <= {LARGEST:g}, got others")


ENVIRONMENT_VARIABLE = "HALFSPACE_SSS_WEIGHTS"
RATIOS = ("albedo", "g", "eta")


def weights_folder() -> Path:
    """Folder for trained weights: HALFSPACE_SSS_WEIGHTS, also a URL, or the user's data folder."""
    if os.environ.get(ENVIRONMENT_VARIABLE):
        return path_of(os.environ[ENVIRONMENT_VARIABLE])
    variable, default = ("LOCALAPPDATA", "AppData/Local") if os.name == "nt" else ("XDG_DATA_HOME", ".local/share")
    return Path(os.environ.get(variable) or Path.home() / default) / "halfspace-sss" / "weights"


@contextmanager
def weights_in(folder: Path) -> Iterator[None]:
    """Weights are kept and looked for in a folder, and nowhere else."""
    before = os.environ.get(ENVIRONMENT_VARIABLE)
    os.environ[ENVIRONMENT_VARIABLE] = str(folder)
    try:
        yield
    finally:
        os.environ.pop(ENVIRONMENT_VARIABLE)
        if before is not None:
            os.environ[ENVIRONMENT_VARIABLE] = before


def check_weights_folder(folder: str | Path | None = None) -> Path:
    """A folder for trained weights, by default `weights_folder`; ValueError if it cannot be written to."""
    if folder is not None:
        return check_folder(folder)
    try:
        return check_folder(weights_folder())
    except ValueError as error:
        raise ValueError(f"{error}; {ENVIRONMENT_VARIABLE} names another folder") from None


def weights_name(kind: str, medium: Medium) -> str:
    """File name of the weights of a scalar medium: all that counts is albedo, g and eta, to eight digits."""
    check_numbers(f"medium of {kind}", medium)
    numbers = (f"{name}{value}" for name, value in _digits(medium).items())
    return "-".join((kind, *numbers)) + ".safetensors"


def _digits(medium: Medium) -> dict[str, str]:
    """What counts of a scalar medium, to the digits that count."""
    return {name: f"{float(getattr(medium, name)):.8g}" for name in RATIOS}


def check_medium(path: Path, record: JsonDict, medium: Medium) -> None:
    """ValueError if the weights of `path` were trained for another medium, whatever the file is called."""
    result = record.get("medium")
    if not isinstance(result, dict) or any(type(result.get(name)) not in (int, float) for name in RATIOS):
        raise ValueError(
            f"{path.with_suffix('.json')}: medium must have {', '.join(RATIOS)} as numbers, got {result!r}"
        )
    for name, wanted in _digits(medium).items():
        if f"{result[name]:.8g}" != wanted:
            raise ValueError(
                f"{path.with_suffix('.json')}: {name} of medium must be {wanted} for this medium, "
                f"got {result[name]!r}: "
                "the weights are those of another one, renamed"
            )


def find_weights(kind: str, medium: Medium) -> Path:
    """The file of weights of a scalar medium, the user's before the shipped one.
    ValueError if there is none, which says how to train it."""
    name = weights_name(kind, medium)
    shipped = Path(str(resources.files("halfspace_sss.neural").joinpath("data")))
    for folder in (weights_folder(), shipped):
        if (folder / name).exists():
            return folder / name
    ratios = ", ".join(f"{n} {float(getattr(medium, n)):.4g}" for n in RATIOS)
    raise ValueError(
        f"medium must be trained for {kind}, got one that is not ({ratios}); "
        f"`halfspace-sss train material` does it, the model `neural` needs no training"
    )
