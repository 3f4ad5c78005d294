"""One network for all media: it writes the small network of a medium."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from halfspace_sss.arrays import library
from halfspace_sss.maps.media import RANGES
from halfspace_sss.neural.features import N_FEATURES, medium_features
from halfspace_sss.neural.network import Network, layer_shapes
from halfspace_sss.physics.backbone import length_scale
from halfspace_sss.physics.medium import Medium

__all__ = ["Hypernetwork", "check_range", "in_range"]


def check_range(medium: Medium) -> None:
    """Refuse media that no training medium was near to.

    Raises:
        ValueError: albedo, g or eta is outside `RANGES`.
    """
    for name, (low, high) in RANGES.items():
        for value in np.atleast_1d(getattr(medium, name)):
            if not low <= value <= high + 1e-9:
                raise ValueError(f"{name} must be in [{low:g}, {high:g}] for the neural model, got {float(value):g}")


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
    """

    medium_layers: tuple[tuple[np.ndarray, np.ndarray], ...]
    base: np.ndarray
    basis: np.ndarray
    width: int
    depth: int

    def network(self, albedo: float, g: float, eta: float) -> Network:
        """The small network of a medium; takes numbers."""
        lib = library(0.0)
        h = np.array(medium_features(lib, albedo, g, eta, length_scale(albedo, g)))
        for k, (W, b) in enumerate(self.medium_layers):
            h = h @ W.astype(np.float64) + b
            if k < len(self.medium_layers) - 1:
                h = h / (1 + np.exp(-h))
        vector = self.base + h @ self.basis.astype(np.float64)
        return Network.from_vector(vector, self.shapes)

    @property
    def shapes(self) -> list[tuple[int, int]]:
        return layer_shapes(N_FEATURES, self.width, self.depth)

    def parameters(self) -> dict[str, Any]:
        """Arrays by name, for the file of weights."""
        layers = {f"medium_{k}_{n}": v for k, pair in enumerate(self.medium_layers) for n, v in zip("Wb", pair)}
        return {**layers, "base": self.base, "basis": self.basis}
