"""Unfinished work: a folder that says to which run it belongs, and what the next step of a fit depends on.

Another run is refused; from a checkpoint, a file with a checksum, a killed run goes on bit for bit.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import torch

import halfspace_sss
from halfspace_sss.neural.store import to_json
from halfspace_sss.provenance import JsonDict, read_text, write_atomically

Tensors = dict[str, torch.Tensor]
RUN, CHECKPOINT = "run.json", "checkpoint.safetensors"
WORK = ("maps-*.npy", "reflectances-*.npy", CHECKPOINT)


def claim(folder: Path, **run: object) -> None:
    """Write in `folder` which run it belongs to; where that is written already, check that it is the same.

    Args:
        folder: for maps and checkpoint; made if it is not there.
        run: all that the result follows from (medium, recipe, seed, ...), ready for JSON; the version is added.

    Raises:
        ValueError: the folder holds the work of another run, or work of an unknown one.
    """
    run = {"version": halfspace_sss.__version__, **run}
    place = folder / RUN
    if not place.exists():
        left = sorted(path.name for pattern in WORK for path in folder.glob(pattern))
        if left:
            raise ValueError(f"{folder}: work must come from a known run, got {left[0]} without {RUN}; remove it")
        write_atomically(place, to_json(run))
        return
    wanted, result = _flat(json.loads(to_json(run))), _flat(_read(place))
    for key in sorted(wanted.keys() | result.keys()):
        if wanted.get(key) != result.get(key):
            asked, stands = wanted.get(key), result.get(key)
            raise ValueError(
                f"{place}: {key} must be {asked!r} to go on with this work, got {stands!r}; name another folder"
            )


def _read(place: Path) -> JsonDict:
    try:
        run = json.loads(read_text(place))
    except (OSError, UnicodeDecodeError, json.JSONDecodeError) as error:
        raise ValueError(f"{place}: must be a readable JSON file, remove the folder to start anew: {error}") from error
    if not isinstance(run, dict):
        raise ValueError(f"{place}: must be a JSON object, remove the folder to start anew, got {type(run).__name__}")
    return run


def _flat(tree: JsonDict) -> JsonDict:
    """Leaves by their path, {"recipe.how.steps": 100}."""
    leaves = {}
    for key, value in tree.items():
        inner = _flat(value) if isinstance(value, dict) else None
        leaves |= {f"{key}.{k}": v for k, v in inner.items()} if inner else {key: value}
    return leaves


def write_checkpoint(path: Path, tensors: Tensors, **more: torch.Tensor) -> None:
    """A checkpoint of tensors on any device, and of others that are read back by name."""
    from safetensors.torch import save

    state = {name: tensor.to("cpu", copy=True) for name, tensor in {**tensors, **more}.items()}
    write_atomically(path, save({**state, "checksum": _checksum(state)}))


@contextmanager
def gone_on_with(path: Path, tensors: Tensors) -> Iterator[Tensors]:
    """Fill tensors from a checkpoint; yields all that it holds, for the reading of the others.

    Raises:
        ValueError: it is damaged or of another run, also where that shows in the reading of the others.
    """
    from safetensors import SafetensorError
    from safetensors.torch import load

    try:
        stored = load(path.read_bytes())
        if not torch.equal(stored.pop("checksum"), _checksum(stored)):
            raise RuntimeError("it was altered")
        for name, tensor in tensors.items():
            if stored[name].shape != tensor.shape:
                raise RuntimeError(f"{name} must have shape {tuple(tensor.shape)}")
            tensor.copy_(stored[name])
        yield stored
    except (SafetensorError, KeyError, RuntimeError, OSError) as error:
        raise ValueError(f"{path}: checkpoint cannot be used, remove it to start anew: {error}") from error


def _checksum(tensors: Tensors) -> torch.Tensor:
    """SHA-256 of names and contents, as 32 bytes."""
    digest = hashlib.sha256()
    for name in sorted(tensors):
        digest.update(name.encode())
        digest.update(tensors[name].numpy().tobytes())
    return torch.tensor(list(digest.digest()), dtype=torch.uint8)
