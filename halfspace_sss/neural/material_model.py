"""The small learnt BSSRDF of one medium."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from halfspace_sss.neural.network import N_FEATURES, SILU, Activation, Network, SymmetricModel, layer_shapes
from halfspace_sss.neural.store import check_medium, find_weights, load_weights, record_count
from halfspace_sss.physics.medium import Medium

KIND = "neural_material"


def network_arrays(network: Network) -> dict[str, np.ndarray]:
    """Arrays of a network by name, for a file of weights."""
    pairs = enumerate(zip(network.matrices, network.biases))
    return {f"{name}_{k}": array for k, pair in pairs for name, array in zip("Wb", pair)}


def load_network(path: Path, kind: str, medium: Medium, n_in: int, activation: Activation = SILU) -> Network:
    """The network of a file of weights; ValueError names the file if it cannot be used, or not for this medium."""
    arrays, record = load_weights(path, kind)
    check_medium(path, record, medium)
    shapes = layer_shapes(n_in, record_count(path, record, "width"), record_count(path, record, "depth", 64))
    wanted = {f"{name}_{k}": s for k, pair in enumerate(shapes) for name, s in zip("Wb", (pair, pair[1:]))}
    results = {name: array.shape for name, array in arrays.items()}
    if results != wanted:
        raise ValueError(f"{path}: layers must be {wanted}, got {results}")
    matrices = tuple(arrays[f"W_{k}"].astype(np.float32) for k in range(len(shapes)))
    return Network(matrices, tuple(arrays[f"b_{k}"].astype(np.float32) for k in range(len(shapes))), activation)


class NeuralMaterial(SymmetricModel):
    """A small network per medium: S = T_12 T_21 B(r) exp(MLP(features)), 3 x 32 SiLU, order >= 2.

    Positive, reciprocal and mirror-invariant by construction; B is the analytic backbone. The weights are those that
    `halfspace_sss.neural.train` or `halfspace-sss train material` made for each channel of the medium; media that were
    not trained are refused. Single scattering is left out.
    """

    name = KIND
    source = "this project; training data by path tracing as in TG, Tran, Jensen, Ramamoorthi and Frisvad 2024"

    def __init__(self, medium: Medium) -> None:
        super().__init__(medium)
        self.networks: list[Network] = [
            load_network(find_weights(KIND, m), KIND, m, N_FEATURES) for m in medium.channels()
        ]
