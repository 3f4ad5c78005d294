"""Where trained weights of single media lie, found again by the medium they were trained for."""

from __future__ import annotations

import os
from importlib import resources
from pathlib import Path

from halfspace_sss.physics.medium import Medium

__all__ = ["ENVIRONMENT_VARIABLE", "find_weights", "weights_folder", "weights_name"]

ENVIRONMENT_VARIABLE = "HALFSPACE_SSS_WEIGHTS"


def weights_folder() -> Path:
    """Folder for trained weights: HALFSPACE_SSS_WEIGHTS, or the user's data folder."""
    if os.environ.get(ENVIRONMENT_VARIABLE):
        return Path(os.environ[ENVIRONMENT_VARIABLE])
    variable, default = ("LOCALAPPDATA", "AppData/Local") if os.name == "nt" else ("XDG_DATA_HOME", ".local/share")
    return Path(os.environ.get(variable) or Path.home() / default) / "halfspace-sss" / "weights"


def weights_name(kind: str, medium: Medium) -> str:
    """File name of the weights of a scalar medium: all that counts is albedo, g and eta, to eight digits."""
    numbers = (f"{name}{float(getattr(medium, name)):.8g}" for name in ("albedo", "g", "eta"))
    return "-".join((kind, *numbers)) + ".safetensors"


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
    ratios = ", ".join(f"{n} {float(getattr(medium, n)):.4g}" for n in ("albedo", "g", "eta"))
    raise ValueError(
        f"medium must be trained for {kind}, got one that is not ({ratios}); "
        f"`halfspace-sss train` does it, the model `neural` needs no training"
    )
