"""A multilayer perceptron, evaluated in NumPy, torch or Dr.Jit from the same numbers."""

from __future__ import annotations

import functools
import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from halfspace_sss.arrays import Lanes, Real
from halfspace_sss.neural.perceptron import Perceptron, relu, silu

if TYPE_CHECKING:
    import torch

NUMPY_BLOCK = 4096  # queries whose activations stay in the cache


def layer_shapes(n_in: int, width: int, depth: int) -> list[tuple[int, int]]:
    """Shapes (inputs, outputs) of the layers of a network with `depth` hidden layers and one output."""
    return [(n_in, width), *[(width, width)] * (depth - 1), (width, 1)]


class Activation(NamedTuple):
    """A function of each number in the three libraries; NumPy's changes its argument."""

    numpy: Callable[[np.ndarray], object]
    torch: Callable[[torch.Tensor], torch.Tensor]
    drjit: Callable[[Lanes], Lanes]


def _silu_numpy(h: np.ndarray) -> None:
    h /= 1 + np.exp(-np.maximum(h, -80.0))


def _silu_torch(h: torch.Tensor) -> torch.Tensor:
    import torch

    return torch.nn.functional.silu(h)


SILU = Activation(_silu_numpy, _silu_torch, silu)  # x / (1 + exp(-x))
RELU = Activation(lambda h: np.maximum(h, 0, out=h), lambda h: h.clamp_min(0), relu)


@dataclass(frozen=True, eq=False)
class Network:
    """h_{k+1} = a(h_k W_k + b_k), the last layer without a.

    Args:
        matrices: W_k of shape (inputs, outputs), NumPy float32.
        biases: b_k of shape (outputs,).
        activation: a, SILU or RELU.
    """

    matrices: tuple[np.ndarray, ...]
    biases: tuple[np.ndarray, ...]
    activation: Activation = SILU

    @classmethod
    def from_vector(
        cls, vector: np.ndarray, shapes: Sequence[tuple[int, int]], activation: Activation = SILU
    ) -> Network:
        """The network whose numbers stand in `vector` layer after layer, each matrix before its bias."""
        matrices, biases, at = [], [], 0
        for n_in, n_out in shapes:
            matrices.append(np.ascontiguousarray(vector[at : at + n_in * n_out].reshape(n_in, n_out), np.float32))
            at += n_in * n_out
            biases.append(np.ascontiguousarray(vector[at : at + n_out], np.float32))
            at += n_out
        return cls(tuple(matrices), tuple(biases), activation)

    @property
    def checksum(self) -> str:
        """SHA-256 of all numbers."""
        digest = hashlib.sha256(repr([W.shape for W in self.matrices]).encode())
        for array in (*self.matrices, *self.biases):
            digest.update(np.ascontiguousarray(array, np.float32).tobytes())
        return digest.hexdigest()

    def __call__(self, features: Sequence[Real]) -> Real:
        """The output for features that are arrays of one shape, in their library and precision."""
        kind = type(features[0]).__module__.split(".")[0]
        evaluate = {"torch": self._torch, "drjit": self._drjit, "mitsuba": self._drjit}.get(kind, self._numpy)
        return evaluate(features)

    def _numpy(self, features: Sequence[np.ndarray]) -> np.ndarray:
        shape = np.broadcast_shapes(*(np.shape(f) for f in features))
        dtype = np.result_type(*features)
        columns = np.stack([np.broadcast_to(f, shape).ravel() for f in features], axis=-1).astype(dtype, copy=False)
        layers = [(W.astype(dtype), b.astype(dtype)) for W, b in zip(self.matrices, self.biases)]
        out = np.empty(len(columns), dtype)
        for at in range(0, len(columns), NUMPY_BLOCK):
            h = columns[at : at + NUMPY_BLOCK]
            for W, b in layers[:-1]:
                h = h @ W
                h += b
                self.activation.numpy(h)
            W, b = layers[-1]
            out[at : at + NUMPY_BLOCK] = (h @ W)[:, 0] + b[0]
        return out.reshape(shape)

    @functools.cached_property
    def _tensors(self) -> dict:
        return {}

    def _torch(self, features: Sequence[torch.Tensor]) -> torch.Tensor:
        import torch

        x = torch.stack(torch.broadcast_tensors(*features), dim=-1)
        tensors, key = self._tensors, (x.dtype, x.device)
        if key not in tensors:
            pairs = [(np.ascontiguousarray(W.T), b) for W, b in zip(self.matrices, self.biases)]
            tensors[key] = [tuple(torch.from_numpy(v).to(x) for v in pair) for pair in pairs]
        *hidden, (W, b) = tensors[key]
        for V, c in hidden:
            x = self.activation.torch(torch.nn.functional.linear(x, V, c))
        return torch.nn.functional.linear(x, W, b)[..., 0]

    @functools.cached_property
    def _perceptron(self) -> Perceptron:
        return Perceptron([W.T for W in self.matrices], self.biases, self.activation.drjit)

    def _drjit(self, features: Sequence[Lanes]) -> Lanes:
        return self._perceptron(features)[0]
