"""One network for all media: it writes the small network of a medium."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from halfspace_sss.arrays import Real, library
from halfspace_sss.neural.features import N_FEATURES, medium_features
from halfspace_sss.neural.network import Network, layer_shapes
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

    def network(self, albedo: float, g: float, eta: float) -> Network:
        """The small network of a medium; takes numbers."""
        h = _layered(self.medium_layers, albedo, g, eta)
        return Network.from_vector(self.base + h @ self.basis.astype(np.float64), self.shapes)

    def calibration(self, albedo: float, g: float, eta: float) -> tuple[float, ...]:
        """The coefficients of log a of a medium, see `calibration`; takes numbers."""
        return tuple(_layered(self.calibration_layers, albedo, g, eta).tolist()) if self.calibration_layers else ()

    @property
    def shapes(self) -> list[tuple[int, int]]:
        return layer_shapes(N_FEATURES, self.width, self.depth)

    def parameters(self) -> dict[str, np.ndarray]:
        """Arrays by name, for the file of weights."""
        layers = {**named_layers("medium", self.medium_layers), **named_layers(CALIBRATION, self.calibration_layers)}
        return {**layers, "base": self.base, "basis": self.basis}


def named_layers(name: str, layers: Layers) -> dict[str, np.ndarray]:
    """Matrices and biases by name, for the file of weights."""
    return {f"{name}_{k}_{n}": v for k, pair in enumerate(layers) for n, v in zip("Wb", pair)}


def _layered(layers: Layers, albedo: float, g: float, eta: float) -> np.ndarray:
    h = np.array(medium_features(library(0.0), albedo, g, eta, length_scale(albedo, g)))
    for k, (W, b) in enumerate(layers):
        h = h @ W.astype(np.float64) + b
        if k < len(layers) - 1:
            h = h / (1 + np.exp(-h))
    return h


N_POLYNOMIALS = 4
GRAZING = (0.05, 0.25)  # inside cosines at which the other terms fall to a half
N_TERMS = N_POLYNOMIALS + len(GRAZING)
CALIBRATION = "balance"  # what files call the layers of the calibration


def log_calibration(c: Sequence[Real], mu: Real, mu_in: Real) -> Real:
    """log a = sum_k c_k T_k(2 mu - 1) + sum_j d_j s_j / (s_j + mu'); 0 for no terms.

    The polynomials, by Clenshaw's recurrence, are of the outside cosine. The others, s_j of `GRAZING`, are of that
    inside, mu': where the boundary is nearly matched the network is off for light that runs along it inside.

    Args:
        c: coefficients c_k and d_j of a medium, numbers or arrays of the library of mu.
        mu, mu_in: cosines outside and inside, [0, 1].
    """
    if not len(c):
        return 0.0 * mu
    twice, after, last = 4 * mu - 2, 0.0, 0.0 * mu
    for c_k in reversed(list(c)[1:N_POLYNOMIALS]):
        last, after = c_k + twice * last - after, last
    grazing = sum(d * (s / (s + mu_in)) for d, s in zip(list(c)[N_POLYNOMIALS:], GRAZING))
    return c[0] + 0.5 * twice * last - after + grazing


def calibration_terms(mu: np.ndarray, mu_in: np.ndarray) -> np.ndarray:
    """What `log_calibration` has for each coefficient, the last axis."""
    polynomials = np.polynomial.chebyshev.chebvander(2 * np.asarray(mu) - 1, N_POLYNOMIALS - 1)
    return np.concatenate([polynomials, *((s / (s + mu_in))[..., None] for s in GRAZING)], axis=-1)
