"""The learnt BSSRDF of every homogeneous medium, with weights that come with the package.

One network for all media writes the small network of a medium.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from importlib import resources
from pathlib import Path

import numpy as np

from halfspace_sss.arrays import Real, is_torch, library
from halfspace_sss.lazy import once
from halfspace_sss.neural.network import (
    N_FEATURES,
    N_MEDIUM,
    N_TERMS,
    Network,
    SymmetricModel,
    layer_shapes,
    medium_features,
)
from halfspace_sss.neural.store import checksum_of, load_weights, record_count
from halfspace_sss.physics.backbone import length_scale
from halfspace_sss.physics.medium import Medium

RANGES = {"albedo": (0.0, 1.0), "g": (-0.5, 0.98), "eta": (1.0, 2.0)}  # what the shipped weights were trained on
# where the boundary is nearly matched, light along it is beyond the factor for larger g: R of g 0.85 to 0.98 was off by
# 2 to 13 % at cosines below 0.1, and at albedo 1 up to 1.005; within these bounds it is within 1.5 %
NEARLY_MATCHED, MOST_G_THERE = 1.1, 0.8
Layers = tuple[tuple[np.ndarray, np.ndarray], ...]  # matrix (inputs, outputs) and bias of each


def check_range(medium: Medium) -> None:
    """Refuse media that no training medium was near to, or whose reflectance is not met.

    Raises:
        ValueError: albedo, g or eta is outside `RANGES`, or g above `MOST_G_THERE` at an eta below `NEARLY_MATCHED`.
    """
    medium = medium.detached()
    for name, (low, high) in RANGES.items():
        for value in np.atleast_1d(getattr(medium, name)):
            if not low <= value <= high + 1e-9:
                raise ValueError(f"{name} must be in [{low:g}, {high:g}] for the neural model, got {float(value):g}")
    steepest = float(np.max(medium.g))
    if np.min(medium.eta) < NEARLY_MATCHED - 1e-9 and steepest > MOST_G_THERE + 1e-9:
        raise ValueError(
            f"g must be in [{RANGES['g'][0]:g}, {MOST_G_THERE:g}] for the neural model where eta is below "
            f"{NEARLY_MATCHED:g}, got g {steepest:g} and eta {float(np.min(medium.eta)):g}"
        )


def in_range(medium: Medium) -> bool:
    """Whether `check_range` accepts the medium."""
    try:
        check_range(medium)
    except ValueError:
        return False
    return True


@dataclass(frozen=True, eq=False)
class Hypernetwork:
    """theta = theta_0 + sum_k c_k(medium) Theta_k: numbers of the small network, of low rank over media.

    Args:
        medium_network: matrices and biases that map medium features to the coefficients c.
        base: theta_0, shape (P,).
        basis: Theta, shape (rank, P).
        width, depth: hidden layers of the small network.
        calibration_layers: matrices and biases that map medium features to `calibration`; none while they
            are not fitted yet.
    """

    medium_layers: Layers
    base: np.ndarray
    basis: np.ndarray
    width: int
    depth: int
    calibration_layers: Layers = ()

    def network(self, albedo: Real, g: Real, eta: float) -> Network:
        """The small network of a medium; albedo and g are numbers, or tensors of float64."""
        h = _layered(self.medium_layers, albedo, g, eta)
        base, basis = (library(h).like(v, h) for v in (self.base, self.basis))
        return Network.from_vector(base + h @ basis, self.shapes)

    def calibration(self, albedo: Real, g: Real, eta: float) -> tuple[Real, ...]:
        """The coefficients of log a of a medium, see `network.log_calibration`; takes what `network` does."""
        if not self.calibration_layers:
            return ()
        c = _layered(self.calibration_layers, albedo, g, eta)
        return tuple(c if is_torch(library(c)) else c.tolist())

    @property
    def shapes(self) -> list[tuple[int, int]]:
        return layer_shapes(N_FEATURES, self.width, self.depth)


def _layered(layers: Layers, albedo: Real, g: Real, eta: float) -> Real:
    lib = library(albedo)
    albedo, g, eta, L = (lib.like(v, albedo) for v in (albedo, g, eta, length_scale(albedo, g)))
    h = lib.stack(medium_features(lib, albedo, g, eta, L))
    for k, (W, b) in enumerate(layers):
        h = h @ lib.like(W, h) + lib.like(b, h)
        if k < len(layers) - 1:
            h = h / (1 + lib.exp(-h))
    return h


KIND, CALIBRATION = "neural", "balance"  # what files call the weights, and the layers of the calibration


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
    layers: dict[str, list[tuple[np.ndarray, np.ndarray]]] = {"medium": [], CALIBRATION: []}
    for name, pairs in layers.items():
        while f"{name}_{len(pairs)}_b" in arrays:
            pairs.append((arrays[f"{name}_{len(pairs)}_W"], arrays[f"{name}_{len(pairs)}_b"]))
    medium, calibration = map(tuple, layers.values())
    return Hypernetwork(medium, arrays["base"], arrays["basis"], width, depth, calibration)


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
        self.weights: Path = weights or shipped_weights()
        hyper = load_hypernetwork(self.weights)
        ratios = [(m.albedo, m.g, m.eta) for m in medium.channels()]
        self.networks: list[Network] = [hyper.network(*one) for one in ratios]
        self.calibrations: list[tuple[float, ...]] = [hyper.calibration(*one) for one in ratios]

    @property
    def trained(self) -> str:
        """SHA-256 of the weights that the networks of all media are made of."""
        return checksum_of(self.weights, KIND)
