"""The learnt BSSRDF of every homogeneous medium, with weights that come with the package."""

from __future__ import annotations

from importlib import resources
from pathlib import Path

import numpy as np

from halfspace_sss.neural.features import N_FEATURES, N_MEDIUM
from halfspace_sss.neural.hypernetwork import Hypernetwork, check_range
from halfspace_sss.neural.network import layer_shapes
from halfspace_sss.neural.store import load_weights, record_count
from halfspace_sss.neural.symmetric import SymmetricModel, channels
from halfspace_sss.once import once
from halfspace_sss.physics.medium import Medium

__all__ = ["Neural", "load_hypernetwork", "shipped_weights"]

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
    sizes = [N_MEDIUM]
    while f"medium_{len(sizes) - 1}_b" in arrays:
        sizes.append(arrays[f"medium_{len(sizes) - 1}_b"].size)
    layers = range(len(sizes) - 1)
    wanted = {"base": (size,), "basis": (sizes[-1], size), **{f"medium_{k}_b": (sizes[k + 1],) for k in layers}}
    wanted |= {f"medium_{k}_W": (sizes[k], sizes[k + 1]) for k in layers}
    found = {name: array.shape for name, array in arrays.items()}
    if found != wanted or not layers:
        raise ValueError(f"{path}: shapes must be {wanted}, got {found}")
    pairs = tuple((arrays[f"medium_{k}_W"], arrays[f"medium_{k}_b"]) for k in layers)
    return Hypernetwork(pairs, arrays["base"], arrays["basis"], width, depth)


class Neural(SymmetricModel):
    """One network for all media: S = T_12 T_21 B(r) exp(MLP(features; theta(albedo, g, eta))), order >= 2.

    A second network maps the medium to the numbers theta of a small one, once; evaluation costs that of the small
    one. Positive, reciprocal and mirror-invariant by construction. Trained on path tracing over albedo [0, 1],
    g [-0.5, 0.98], eta [1, 2]; other media are refused. Single scattering is left out.
    """

    name = "neural"
    source = "this project; training data by path tracing as in TG, Tran, Jensen, Ramamoorthi and Frisvad 2024"

    def __init__(self, medium: Medium, weights: Path | None = None) -> None:
        super().__init__(medium)
        check_range(medium)
        hyper = load_hypernetwork(weights or shipped_weights())
        self.networks = [hyper.network(float(m.albedo), float(np.float64(m.g)), m.eta) for m in channels(medium)]
