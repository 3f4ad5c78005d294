"""Weights of objects on disk, found again by the object they belong to."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from full_geometry.models import neural_shape as shapes
from full_geometry.models.half_space import HalfSpace
from full_geometry.models.object_model import DirectionalAlbedo, FullGeometry
from full_geometry.object.features import BaseModel, ObjectFrame, n_pair, n_side
from full_geometry.object.first_event import REFLECTIONS
from full_geometry.object.identity import Identity, frame_of, identify
from full_geometry.object.patches import Patches, PatchSampler
from full_geometry.object.subject import Subject
from halfspace_sss.interface.model import bssrdf
from halfspace_sss.neural.store import load_weights, save_weights, weights_folder

KIND = "full_geometry"
CHECKSUMS = "start_checksums"  # of a record
CENTRES, EVEN, TURNS, ENDS = "centres", "even", "turns", "Q"
S_LAYERS, ALPHA_LAYERS, PATCH_LAYERS = ("W_", "b_", ENDS), ("A_", "a_"), ("V_", "c_")
NEEDED = (
    (EVEN, "even light must be learnt"), (TURNS, "turns of what surrounds a point must be known"),
    (ENDS, "functions of ends must be solved for"),
)  # fmt: skip


class Learnt(NamedTuple):
    """What weights give: the model, and the sampler of its entries, None for a shape without faces."""

    model: FullGeometry
    sampler: PatchSampler | None


def weights_name(identity: Identity) -> str:
    """File name of the weights of an object: its digest, and its size in mean free paths of the first channel."""
    return f"{KIND}-{identity.digest()}-{identity.medium['size_in_mfp'][0]:.5g}.safetensors"


def save(folder: str | os.PathLike, identity: Identity, arrays: dict[str, np.ndarray], record: dict[str, Any]) -> Path:
    """Write the weights of an object and their record; returns the path."""
    whole = {"orders": "multiple", "reflections": REFLECTIONS, **identity.record(), **record}
    bound = {"anchors": identity.anchors.astype(np.float32)}
    if identity.grids:
        bound["probes"] = identity.probes
    return save_weights(Path(folder) / weights_name(identity), KIND, {**arrays, **bound}, whole)


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
            identity, _, record = _trained(path)
            identity.pose(here)
            _checked_base(path, record, subject.as_trained(identity.medium))
            return path
        except ValueError as error:
            reasons.append(f"{path.name}: {error}")
    why = f" ({'; '.join(reasons)})" if reasons else ""
    raise ValueError(
        f"object {subject.object.name} must be trained for {KIND}, got one that is not in {place}{why}; "
        "`halfspace-sss train object --scene` does it"
    )


def trained(subject: Subject) -> bool:
    """Whether there are weights of an object."""
    try:
        find_weights(subject)
    except ValueError:
        return False
    return True


def _trained(path: Path) -> tuple[Identity, dict[str, np.ndarray], dict[str, Any]]:
    arrays, record = load_weights(path, KIND)
    if record.get("reflections") != REFLECTIONS:
        known = f"reflections must be {REFLECTIONS}, got {record.get('reflections')}"
        raise ValueError(f"{path.with_suffix('.json')}: {known}: of another version, to be trained again")
    for name, what in NEEDED:
        if name not in arrays:
            raise ValueError(f"{path}: {what}, got none: of another version, to be trained again")
    try:
        anchors, grids = arrays.pop("anchors"), record.get("grids", "")
        probes = arrays.pop("probes") if grids else None
        identity = Identity(record["kind_of_shape"], record["topology"], anchors, dict(record["medium"]), grids, probes)
        if {"albedo", "g", "eta", "size_in_mfp"} - set(identity.medium):
            raise KeyError("medium")
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(f"{path.with_suffix('.json')}: record must be that of an object, {error} is wrong") from error
    return identity, arrays, record


def _checked_base(path: Path, record: dict[str, Any], subject: Subject) -> str:
    """Name of the model that weights multiply; ValueError if they were fitted to others of it than are here now."""
    place = path.with_suffix(".json")
    try:
        name, fitted = record["recipe"]["start"], tuple(record[CHECKSUMS])
    except (KeyError, TypeError) as error:
        raise ValueError(f"{place}: start must be recorded: of another version, to be trained again") from error
    if fitted != base_checksums(subject, name):
        raise ValueError(
            f"{place}: weights of the start {name} must be those of training, got others: to be trained again"
        )
    return name


def load(path: str | os.PathLike, subject: Subject) -> Learnt:
    """The model of an object and its sampler from its weights.

    Raises:
        ValueError: the file is damaged, of another kind or version, or of another object.
    """
    path = Path(path)
    identity, arrays, record = _trained(path)
    try:
        subject = subject.as_trained(identity.medium)
        frame = frame_of(subject, identity, arrays[TURNS])
        first, bias = ALPHA_LAYERS
        units = arrays[f"{first}{max(sum(name.startswith(bias) for name in arrays) - 1, 0)}"].shape[1]
        channels, known = len(subject.media), arrays["W_0"].shape[1]
        n = 2 * (n_side(channels, subject.n_local) + units) + n_pair(channels)
        if n != known:
            raise ValueError(f"W_0 must have {n} inputs, got {known}: of another version, to be trained again")
        base = base_model(subject, _checked_base(path, record, subject))
    except KeyError as error:
        raise ValueError(f"{path}: layers must be those of {KIND}, {error} is missing") from error
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error
    return assemble(subject, frame, base, arrays)


def base_model(subject: Subject, name: str) -> BaseModel:
    """What the network of an object begins with: the network of all shapes, or a half-space model.

    Raises:
        ValueError: there is no such model, or it does not take the medium.
    """
    return shapes.transport(subject) if name == shapes.KIND else HalfSpace(subject, name)


def base_checksums(subject: Subject, name: str) -> tuple[str, ...]:
    """Of the weights that a start has."""
    if name == shapes.KIND:
        return shapes.checksums(subject)
    return tuple(checksum for m in subject.media for checksum in bssrdf(name, m).checksums)


def assemble(
    subject: Subject, frame: ObjectFrame, base: BaseModel, arrays: Mapping[str, np.ndarray], patches: Any = None
) -> Learnt:
    """Model and sampler from the arrays of a file; `patches` are made from their centres if they are not given."""

    def layers(names: tuple[str, ...]) -> dict[str, np.ndarray]:
        return {name: value for name, value in arrays.items() if name.startswith(names)}

    alpha = DirectionalAlbedo(subject, frame, layers(ALPHA_LAYERS), arrays[EVEN])
    model = FullGeometry(subject, frame, base, layers(S_LAYERS), alpha)
    if CENTRES not in arrays:
        return Learnt(model, None)
    patches = patches or Patches(subject, frame, arrays[CENTRES].astype(np.float32))
    return Learnt(model, PatchSampler(frame, patches, layers(PATCH_LAYERS)))
