"""Everything the next step of a fit depends on, in a file with a checksum: a killed run goes on bit for bit."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import torch

from halfspace_sss.provenance import write_atomically

Tensors = dict[str, torch.Tensor]


def write(path: Path, tensors: Tensors, **more: torch.Tensor) -> None:
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
