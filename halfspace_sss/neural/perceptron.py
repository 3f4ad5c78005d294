"""Perceptrons in Dr.Jit, evaluated inside of the kernel that asks.

As cooperative vectors: in single precision on LLVM, in half precision on CUDA, which has no other. In double precision,
which these lack, layers are loops over outputs. So they are on CUDA where a network says so: OptiX takes 5 to 10 s for
a product in the path tracer of a model that is large by itself. Loops are slower and have no derivatives; where these
are asked for it is cooperative vectors.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping, Sequence

import numpy as np

from halfspace_sss.arrays import Lanes

MOST_IN_HALF = 256.0  # of an input, which are of order one: a layer with weights of order one stays below 65504
PACKET = 4  # numbers of a row that loops read at once


def hard_swish(x: Lanes) -> Lanes:
    """x clip(x/6 + 1/2, 0, 1): a fifth of the time of `silu`."""
    import drjit as dr

    return x * dr.clip(x * (1 / 6) + 0.5, 0, 1)


def relu(x: Lanes) -> Lanes:
    """max(x, 0)."""
    import drjit as dr

    return dr.maximum(x, 0)


def silu(x: Lanes) -> Lanes:
    """x / (1 + exp(-x))."""
    import drjit as dr

    return x * (0.5 + 0.5 * dr.tanh(0.5 * x))


class Perceptron:
    """x_1 = W_0 x_0 + b_0, x_{k+1} = W_k a(x_k) + b_k.

    The first layer may be asked for in parts, W_0 = (U_0, U_1, ...), where some are known before the others or
    stand for several others:

        net.rest(net.activation(net.first(0, x, biased=True) + net.first(1, y)))

    Args:
        matrices: W_k (outputs, inputs).
        biases: b_k (outputs,).
        activation: a, of a vector.
        splits: columns of W_0 at which its parts begin, but for the first part.
        looped: layers are loops on CUDA.
    """

    def __init__(
        self,
        matrices: Sequence[np.ndarray],
        biases: Sequence[np.ndarray],
        activation: Callable[[Lanes], Lanes] = hard_swish,
        splits: Sequence[int] = (),
        looped: bool = False,
    ) -> None:
        self.looped = looped
        self.parts: list[np.ndarray] = np.split(np.asarray(matrices[0]), list(splits), axis=1)
        self.matrices: list[np.ndarray] = [*self.parts, *matrices[1:]]
        self.biases: list[np.ndarray] = list(biases)
        self.activation = activation
        self._packed: dict[type, tuple[list, list]] = {}  # by type of vector, so of each backend

    @classmethod
    def named(cls, weights: Mapping[str, np.ndarray], matrix: str, bias: str, **more: object) -> Perceptron:
        """The perceptron of the arrays `matrix`_k and `bias`_k, as many as there are."""
        n = sum(name.startswith(f"{matrix}_") for name in weights)
        return cls(*([weights[f"{name}_{k}"] for k in range(n)] for name in (matrix, bias)), **more)

    def __call__(self, x: Sequence[Lanes]) -> list[Lanes]:
        """The outputs, in single precision at least; the first layer has one part."""
        first = self.first(0, x, biased=True)
        return self.rest(self.activation(first)) if len(self.biases) > 1 else self.numbers(first)

    def first(self, part: int, x: Sequence[Lanes], biased: bool = False) -> Lanes:
        """U_part x, with b_0 if it is `biased`, as a vector."""
        x = self.vector(x)
        matrices, biases = self._views(x)
        return _product(matrices[part], x, biases[0] if biased else None)

    def rest(self, x: Lanes) -> list[Lanes]:
        """The outputs, of a(x_1) as a vector; one layer follows at least."""
        matrices, biases = self._views(x)
        layers = list(zip(matrices[len(self.parts) :], biases[1:]))
        for k, (W, b) in enumerate(layers):
            x = _product(W, self.activation(x) if k else x, b)
        return self.numbers(x)

    def vector(self, x: Sequence[Lanes]) -> Lanes:
        """Numbers as a vector that layers are asked with."""
        import drjit as dr

        kind = dr.expr_t(*map(type, x))
        by_loops = self.looped and dr.backend_v(kind) == dr.JitBackend.CUDA and not any(dr.grad_enabled(v) for v in x)
        return _listed(x) if by_loops or _is_double(kind) else cooperative(x)

    @staticmethod
    def numbers(x: Lanes) -> list[Lanes]:
        """A vector as numbers, in single precision at least."""
        import drjit as dr

        kind = _precise(x.type if _is_cooperative(x) else dr.value_t(type(x)))
        return [kind(v) for v in x]

    def _views(self, x: Lanes) -> tuple[list, list]:
        """Matrices and biases for products with a vector."""
        key, make = (x.type, _packed) if _is_cooperative(x) else (type(x), _rows)
        if key not in self._packed:
            self._packed[key] = make(key, self.matrices, self.biases)
        return self._packed[key]


def cooperative(x: Sequence[Lanes]) -> Lanes:
    """Numbers as a cooperative vector: in half precision on CUDA or where they have it, else in single precision."""
    import drjit as dr
    from drjit import nn

    kind = dr.expr_t(*map(type, x))
    half = dr.type_v(kind) == dr.VarType.Float16 or dr.backend_v(kind) == dr.JitBackend.CUDA
    if not half:
        return nn.CoopVec(*(dr.float32_array_t(kind)(v) for v in x))
    return nn.CoopVec(*(dr.float16_array_t(kind)(dr.clip(v, -MOST_IN_HALF, MOST_IN_HALF)) for v in x))


def _listed(x: Sequence[Lanes]) -> Lanes:
    """Numbers as a vector that loops take."""
    import drjit as dr

    kind = _precise(dr.expr_t(*map(type, x)))
    return _kin(kind, "X")([kind(v) for v in x])


def _is_cooperative(x: Lanes) -> bool:
    from drjit import nn

    return isinstance(x, nn.CoopVec)


def _is_double(kind: type) -> bool:
    import drjit as dr

    return dr.type_v(kind) == dr.VarType.Float64


def _precise(kind: type) -> type:
    """A kind of numbers in single precision at least."""
    import drjit as dr

    return kind if _is_double(kind) else dr.float32_array_t(kind)


def _kin(kind: type, size: int | str) -> type:
    """Arrays of so many lanes' numbers of a kind, X for any number of them."""
    bits = "64" if _is_double(kind) else ""
    return getattr(sys.modules[kind.__module__], f"Array{size}f{bits}")


def _packed(inner: type, matrices: list[np.ndarray], biases: list[np.ndarray]) -> tuple[list, list]:
    """As cooperative vectors of a kind of numbers want them."""
    import drjit as dr
    from drjit import nn

    tensor, n = dr.tensor_t(inner), len(matrices)
    precision = np.float16 if dr.type_v(inner) == dr.VarType.Float16 else np.float32
    parts = [tensor(np.ascontiguousarray(W, dtype=precision)) for W in matrices]
    parts += [inner(np.ascontiguousarray(b, dtype=precision)) for b in biases]
    views = nn.pack(*parts)[-len(parts) :]
    return list(views[:n]), list(views[n:])


def _rows(vector: type, matrices: list[np.ndarray], biases: list[np.ndarray]) -> tuple[list, list]:
    """As loops want them: rows filled up to packets."""
    import drjit as dr

    kind, results = dr.value_t(vector), []
    precision = np.float64 if _is_double(kind) else np.float32
    for W in matrices:
        W = np.pad(W, ((0, 0), (0, -W.shape[1] % PACKET)))
        results.append((len(W), kind(W.ravel().astype(precision).tolist())))
    # lists, not NumPy arrays: memory in any alignment would need kernels of its own
    return results, [kind(np.asarray(b, dtype=precision).tolist()) for b in biases]


def _product(W: Lanes, x: Lanes, bias: Lanes) -> Lanes:
    """W x, with a bias if there is one."""
    import drjit as dr
    from drjit import nn

    if _is_cooperative(x):
        return nn.matvec(W, x) if bias is None else nn.matvec(W, x, bias)
    n, rows = W
    kind = dr.value_t(type(x))
    UInt32, Packet = dr.uint32_array_t(kind), _kin(kind, PACKET)
    x = [*x, *[kind(0)] * (-len(x) % PACKET)]

    def output(j: Lanes, out: Lanes) -> tuple:
        total = kind(0) if bias is None else dr.gather(kind, bias, j)
        for k in range(0, len(x), PACKET):
            row = dr.gather(Packet, rows, j * (len(x) // PACKET) + k // PACKET)
            for a, b in zip(row, x[k : k + PACKET]):
                total = dr.fma(a, b, total)
        out[j] = total
        return j + 1, out

    state = (UInt32(0), dr.alloc_local(kind, n))
    _, out = dr.while_loop(state, lambda j, _: j < n, output, label="layer")
    return _listed([out[UInt32(j)] for j in range(n)])
