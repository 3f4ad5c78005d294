"""The weights that come with the package."""

from __future__ import annotations

import os
from importlib import resources
from pathlib import Path

import numpy as np

from full_geometry.neural_shape.backbone import MODEL
from full_geometry.neural_shape.balance import held
from full_geometry.neural_shape.descriptors import CURVED_OWN, CURVED_SHARED, N_MEDIUM, N_OWN, N_SHARED
from full_geometry.neural_shape.model import NeuralShape
from full_geometry.subject import Subject
from halfspace_sss.interface.model import bssrdf
from halfspace_sss.neural.store import checksum_of, load_weights
from halfspace_sss.once import once

__all__ = ["KIND", "WEIGHTS", "checksums", "load", "shipped_weights", "transport"]

KIND = "neural_shape"
WEIGHTS = f"{KIND}.safetensors"


def shipped_weights() -> Path:
    """The file of weights that comes with the package."""
    return Path(str(resources.files("full_geometry.neural_shape").joinpath("data", WEIGHTS)))


@once
def load(path: Path) -> dict[str, np.ndarray]:
    """The arrays of a file of weights.

    Raises:
        ValueError: it is damaged, of another kind, or of a network of other descriptors; the message names the file.
    """
    arrays, _ = load_weights(path, KIND)
    depth, inputs = len(arrays) // 2, N_OWN + N_SHARED + N_MEDIUM
    outputs = len(range(N_OWN)[CURVED_OWN]) + len(range(N_SHARED)[CURVED_SHARED])
    names = {f"{letter}_{k}" for letter in "Wb" for k in range(depth)}
    if set(arrays) != names or depth < 2:
        raise ValueError(f"{path}: arrays must be W_k and b_k of two layers or more, got {sorted(arrays)}")
    widths = [inputs, *(arrays[f"b_{k}"].size for k in range(depth))]
    for k in range(depth):
        found, wanted = (arrays[f"W_{k}"].shape, arrays[f"b_{k}"].shape), (widths[k + 1], widths[k])
        if found != (wanted, wanted[:1]) or widths[-1] != outputs:
            raise ValueError(f"{path}: layer {k} must go from {widths[k]} to {widths[k + 1]} numbers, got {found}")
    return {name: value.astype(np.float32) for name, value in arrays.items()}


def checksums(subject: Subject, path: str | os.PathLike | None = None) -> tuple[str, ...]:
    """Of the shipped weights or others, and of those of the half-space models that they correct."""
    models = [bssrdf(MODEL, m) for m in subject.media]
    own = checksum_of(Path(path) if path is not None else shipped_weights(), KIND)
    return (own, *(checksum for m in models for checksum in m.checksums))


def transport(subject: Subject, path: str | os.PathLike | None = None) -> NeuralShape:
    """The model of an object, by the shipped weights or others, held to the light that leaves by walks.

    Raises:
        ValueError: the file cannot be used, or the medium varies or is out of the range of `neural`.
    """
    if subject.varying is not None:
        name = subject.found.shape.id()
        raise ValueError(f"the medium of {name!r} must be the same everywhere for {KIND}, got one that varies")
    return held(NeuralShape.of(subject, load(Path(path) if path is not None else shipped_weights())))
