"""Where trained weights of single media lie, found again by the medium they were trained for."""

from __future__ import annotations

import os
from collections.abc import Mapping
from importlib import resources
from pathlib import Path
from typing import Any

from halfspace_sss.physics.medium import Medium
from halfspace_sss.provenance import check_folder

__all__ = [
    "ENVIRONMENT_VARIABLE",
    "check_medium",
    "check_weights_folder",
    "find_weights",
    "weights_folder",
    "weights_name",
]

ENVIRONMENT_VARIABLE = "HALFSPACE_SSS_WEIGHTS"
RATIOS = ("albedo", "g", "eta")


def weights_folder() -> Path:
    """Folder for trained weights: HALFSPACE_SSS_WEIGHTS, or the user's data folder."""
    if os.environ.get(ENVIRONMENT_VARIABLE):
        return Path(os.environ[ENVIRONMENT_VARIABLE])
    variable, default = ("LOCALAPPDATA", "AppData/Local") if os.name == "nt" else ("XDG_DATA_HOME", ".local/share")
    return Path(os.environ.get(variable) or Path.home() / default) / "halfspace-sss" / "weights"


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
    numbers = (f"{name}{value}" for name, value in _digits(medium).items())
    return "-".join((kind, *numbers)) + ".safetensors"


def _digits(medium: Medium) -> dict[str, str]:
    """What counts of a scalar medium, to the digits that count."""
    return {name: f"{float(getattr(medium, name)):.8g}" for name in RATIOS}


def check_medium(path: Path, record: Mapping[str, Any], medium: Medium) -> None:
    """ValueError if the weights of `path` were trained for another medium, whatever the file is called."""
    found = record.get("medium")
    if not isinstance(found, dict) or any(type(found.get(name)) not in (int, float) for name in RATIOS):
        raise ValueError(f"{path.with_suffix('.json')}: medium must have {', '.join(RATIOS)} as numbers, got {found!r}")
    for name, wanted in _digits(medium).items():
        if f"{found[name]:.8g}" != wanted:
            raise ValueError(
                f"{path.with_suffix('.json')}: {name} of medium must be {wanted} for this medium, got {found[name]!r}: "
                "the weights are those of another one, renamed"
            )


def find_weights(kind: str, medium: Medium) -> Path:
    """The file of weights of a scalar medium, the user's before the shipped one.

    Raises:
        ValueError: there is none; says how to train it.
    """
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
