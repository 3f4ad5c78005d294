"""The one way by which perceptrons are evaluated in Dr.Jit: cooperative vectors, inside of the kernel that asks.

CUDA has them in half precision only, so there the layers, and nothing else, are in half precision; LLVM keeps single.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

__all__ = ["Perceptron", "hard_swish", "relu", "silu"]

MOST_IN_HALF = 256.0  # of an input, which are of order one: a layer with weights of order one stays below 65504


def hard_swish(x: Any) -> Any:
    """x clip(x/6 + 1/2, 0, 1): a fifth of the time of `silu`."""
    import drjit as dr

    return x * dr.clip(x * (1 / 6) + 0.5, 0, 1)


def relu(x: Any) -> Any:
    """max(x, 0)."""
    import drjit as dr

    return dr.maximum(x, 0)


def silu(x: Any) -> Any:
    """x / (1 + exp(-x))."""
    import drjit as dr

    return x * (0.5 + 0.5 * dr.tanh(0.5 * x))


class Perceptron:
    """x_1 = W_0 x_0 + b_0, x_{k+1} = W_k a(x_k) + b_k.

    The first layer may be asked for in parts, W_0 = (U_0, U_1, ...), of which some are known before the others or
    stand for several others:

        net.rest(net.activation(net.first(0, x, biased=True) + net.first(1, y)))

    Args:
        matrices: W_k (outputs, inputs).
        biases: b_k (outputs,).
        activation: a, of a cooperative vector.
        splits: columns of W_0 at which its parts begin, but for the first part.
    """

    def __init__(
        self,
        matrices: Sequence[np.ndarray],
        biases: Sequence[np.ndarray],
        activation: Callable[[Any], Any] = hard_swish,
        splits: Sequence[int] = (),
    ) -> None:
        self.parts = np.split(np.asarray(matrices[0]), list(splits), axis=1)
        self.matrices, self.biases, self.activation = [*self.parts, *matrices[1:]], list(biases), activation
        self._packed: dict[type, tuple[list, list]] = {}  # by type of array, so that of each backend

    @classmethod
    def named(cls, weights: Mapping[str, np.ndarray], matrix: str, bias: str, **more: Any) -> Perceptron:
        """That of the arrays `matrix`_k and `bias`_k, as many as there are."""
        n = sum(name.startswith(f"{matrix}_") for name in weights)
        return cls(*([weights[f"{name}_{k}"] for k in range(n)] for name in (matrix, bias)), **more)

    def __call__(self, x: Sequence[Any]) -> list[Any]:
        """The outputs in single precision; the first layer has one part."""
        first = self.first(0, x, biased=True)
        return self.rest(self.activation(first)) if len(self.biases) > 1 else self.numbers(first)

    def first(self, part: int, x: Sequence[Any], biased: bool = False) -> Any:
        """U_part x, with b_0 if it is `biased`, as a cooperative vector."""
        from drjit import nn

        x = self.vector(x)
        matrices, biases = self._views(x.type)
        return nn.matvec(matrices[part], x, biases[0]) if biased else nn.matvec(matrices[part], x)

    def rest(self, x: Any) -> list[Any]:
        """The outputs in single precision, of a(x_1) as a cooperative vector; one layer follows at least."""
        from drjit import nn

        matrices, biases = self._views(x.type)
        layers = list(zip(matrices[len(self.parts) :], biases[1:]))
        for k, (W, b) in enumerate(layers):
            x = nn.matvec(W, self.activation(x) if k else x, b)
        return self.numbers(x)

    @staticmethod
    def vector(x: Sequence[Any]) -> Any:
        """Numbers as a cooperative vector in the precision of the layers: half on CUDA, or where numbers have it."""
        import drjit as dr
        from drjit import nn

        kind = dr.expr_t(*x)
        half = dr.type_v(kind) == dr.VarType.Float16 or dr.backend_v(kind) == dr.JitBackend.CUDA
        if not half:
            return nn.CoopVec(*(dr.float32_array_t(kind)(v) for v in x))
        return nn.CoopVec(*(dr.float16_array_t(kind)(dr.clip(v, -MOST_IN_HALF, MOST_IN_HALF)) for v in x))

    @staticmethod
    def numbers(x: Any) -> list[Any]:
        """A cooperative vector as numbers in single precision."""
        import drjit as dr

        single = dr.float32_array_t(x.type)
        return [single(v) for v in x]

    def _views(self, inner: type) -> tuple[list, list]:
        """Matrices and biases as Dr.Jit wants them, in the precision and on the backend of a type of array."""
        import drjit as dr
        from drjit import nn

        if inner not in self._packed:
            half, tensor = dr.type_v(inner) == dr.VarType.Float16, dr.tensor_t(inner)
            precision, n = np.float16 if half else np.float32, len(self.matrices)
            parts = [tensor(np.ascontiguousarray(W, dtype=precision)) for W in self.matrices]
            parts += [inner(np.ascontiguousarray(b, dtype=precision)) for b in self.biases]
            views = nn.pack(*parts)[-len(parts) :]
            self._packed[inner] = list(views[:n]), list(views[n:])
        return self._packed[inner]
