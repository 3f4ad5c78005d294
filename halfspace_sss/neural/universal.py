"""The learnt BSSRDF of every homogeneous medium, with weights that come with the package."""

from __future__ import annotations

from collections.abc import Mapping
from importlib import resources
from pathlib import Path

import numpy as np

from halfspace_sss.lazy import once
from halfspace_sss.neural.features import N_FEATURES, N_MEDIUM
from halfspace_sss.neural.hypernetwork import CALIBRATION, N_TERMS, Hypernetwork, check_range
from halfspace_sss.neural.network import layer_shapes
from halfspace_sss.neural.store import checksum_of, load_weights, record_count
from halfspace_sss.neural.symmetric import SymmetricModel, channels
from halfspace_sss.physics.medium import Medium

KIND = "neural"


def shipped_weights() -> Path:
    """The file of weights that comes with the package."""
    return Path(str(resources.files("halfspace_sss.neural").joinpath("data", "neural.safetensors")))


@once
def load_hypernetwork(path: Path) -> Hypernetwork:
    """The network of a file of weights; ValueError names the file if it cannot be used."""
    arrays, record = load_weights(path, KIND)
    width, depth = record_count(path, record, "width"), record_count(path, record, "depth", 64)
    size = sum(i * o + o for i, o in layer_shapes(N_FEATURES, width, depth))
    medium, calibration = _sizes(arrays, "medium"), _sizes(arrays, CALIBRATION)
    wanted = {"base": (size,), "basis": (medium[-1], size)}
    wanted |= _layer_shapes("medium", medium) | _layer_shapes(CALIBRATION, [*calibration[:-1], N_TERMS])
    results = {name: array.shape for name, array in arrays.items()}
    if results != wanted:
        raise ValueError(f"{path}: shapes must be {wanted}, got {results}")
    return hypernetwork_of(arrays, width, depth)


def hypernetwork_of(arrays: Mapping[str, np.ndarray], width: int, depth: int) -> Hypernetwork:
    """The network of arrays by name, as they stand in a file of weights."""
    medium, calibration = (
        tuple((arrays[f"{name}_{k}_W"], arrays[f"{name}_{k}_b"]) for k in range(_count(arrays, name)))
        for name in ("medium", CALIBRATION)
    )
    return Hypernetwork(medium, arrays["base"], arrays["basis"], width, depth, calibration)


def _count(arrays: Mapping[str, np.ndarray], name: str) -> int:
    return sum(key.startswith(f"{name}_") and key.endswith("_b") for key in arrays)


def _sizes(arrays: Mapping[str, np.ndarray], name: str) -> list[int]:
    """Inputs of the layers of a name, and outputs of the last; of one layer if there is none."""
    sizes = [N_MEDIUM]
    while f"{name}_{len(sizes) - 1}_b" in arrays:
        sizes.append(arrays[f"{name}_{len(sizes) - 1}_b"].size)
    return sizes if len(sizes) > 1 else [N_MEDIUM, 1]


def _layer_shapes(name: str, sizes: list[int]) -> dict[str, tuple[int, ...]]:
    pairs = list(enumerate(zip(sizes, sizes[1:])))
    return {f"{name}_{k}_W": pair for k, pair in pairs} | {f"{name}_{k}_b": (pair[1],) for k, pair in pairs}


class Neural(SymmetricModel):
    """One network for all media: S = T_12 T_21 B(r) exp(MLP(features; theta)) a(mu_i) a(mu_o), order >= 2.

    A second network maps albedo, g and eta to the numbers theta of the small one, a third to those of a, which holds S
    to the exact reflectance (`calibration`): both once, so that evaluation costs that of the small one. Positive,
    reciprocal and mirror-invariant by construction. Trained on path tracing over albedo [0, 1], g [-0.5, 0.98],
    eta [1, 2]; other media are refused, and g above 0.8 for eta below 1.1. Single scattering is left out.
    """

    name = "neural"
    source = "this project; training data by path tracing as in TG, Tran, Jensen, Ramamoorthi and Frisvad 2024"

    def __init__(self, medium: Medium, weights: Path | None = None) -> None:
        super().__init__(medium)
        check_range(medium)
        self.weights = weights or shipped_weights()
        hyper = load_hypernetwork(self.weights)
        ratios = [(float(m.albedo), float(np.float64(m.g)), m.eta) for m in channels(medium)]
        self.networks = [hyper.network(*one) for one in ratios]
        self.calibrations = [hyper.calibration(*one) for one in ratios]

    @property
    def trained(self) -> str:
        """SHA-256 of the weights that the networks of all media are made of."""
        return checksum_of(self.weights, KIND)
