"""Weights of objects on disk, found again by the object they belong to."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np

from full_geometry.half_space import HalfSpace
from full_geometry.identity import Identity, frame_of, identify
from full_geometry.model import FullGeometry
from full_geometry.subject import Subject
from halfspace_sss.neural.store import load_weights, save_weights
from halfspace_sss.neural.trained import weights_folder

__all__ = ["KIND", "find_weights", "load", "save", "weights_name"]

KIND = "full_geometry"
LAYER = ("W_", "b_")


def weights_name(identity: Identity) -> str:
    """File name of the weights of an object: its digest, and its size in mean free paths of the first channel."""
    return f"{KIND}-{identity.digest()}-{identity.medium['size_in_mfp'][0]:.5g}.safetensors"


def save(folder: str | os.PathLike, identity: Identity, arrays: dict[str, np.ndarray], record: dict[str, Any]) -> Path:
    """Write the weights of an object and their record; returns the path."""
    whole = {"orders": "multiple", **identity.record(), **record}
    return save_weights(
        Path(folder) / weights_name(identity), KIND, {**arrays, "anchors": identity.anchors.astype(np.float32)}, whole
    )


def find_weights(subject: Subject, folder: str | os.PathLike | None = None) -> Path:
    """The file of weights of an object.

    Raises:
        ValueError: there is none; says what tells the object from the nearest one that was trained.
    """
    here = identify(subject)
    place = Path(folder) if folder is not None else weights_folder()
    reasons = []
    for path in sorted(place.glob(f"{KIND}-{here.digest()}-*.safetensors")):
        try:
            _trained(path)[0].pose(here)
            return path
        except ValueError as error:
            reasons.append(f"{path.name}: {error}")
    why = f" ({'; '.join(reasons)})" if reasons else ""
    raise ValueError(
        f"object {subject.found.shape.id()!r} must be trained for {KIND}, got one that is not in {place}{why}; "
        "`halfspace-sss train --scene` does it"
    )


def _trained(path: Path) -> tuple[Identity, dict[str, np.ndarray], dict[str, Any]]:
    arrays, record = load_weights(path, KIND)
    try:
        anchors = arrays.pop("anchors")
        identity = Identity(record["kind_of_shape"], record["topology"], anchors, dict(record["medium"]))
        if {"albedo", "g", "eta", "size_in_mfp"} - set(identity.medium):
            raise KeyError("medium")
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(f"{path.with_suffix('.json')}: record must be that of an object, {error} is wrong") from error
    return identity, arrays, record


def load(path: str | os.PathLike, subject: Subject) -> FullGeometry:
    """The model of an object from its weights.

    Raises:
        ValueError: the file is damaged, of another kind or version, or of another object.
    """
    path = Path(path)
    identity, arrays, record = _trained(path)
    try:
        frame = frame_of(subject, identity)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error
    layers = {name: value for name, value in arrays.items() if name.startswith(LAYER)}
    return FullGeometry(subject, frame, HalfSpace(subject, record["recipe"]["backbone"]), layers)
