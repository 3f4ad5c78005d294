"""One spelling of array mathematics for NumPy, torch and Dr.Jit.

`library(*args)` returns the functions that belong to the arguments, so that a formula is written once:

    lib = library(r)
    return lib.exp(-r) / lib.maximum(r, 1e-9)

The functions are those of NumPy (`where`, `minimum`, `expm1`, ...); Python numbers may stand for any
array argument and never change its precision. Only what the models need is here.
"""

from __future__ import annotations

import functools
import operator
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, TypeAlias

import numpy as np

from halfspace_sss.backend import prepare_llvm
from halfspace_sss.lazy import once

if TYPE_CHECKING:
    import drjit
    import torch

Lanes: TypeAlias = "drjit.AnyArray"  # of Dr.Jit, one value a lane
Real: TypeAlias = "float | np.ndarray | torch.Tensor | drjit.AnyArray"  # a number, or an array of any library
PerChannel: TypeAlias = "Real | Sequence[float]"  # a number, or one for each channel


def _fold(
    f: Callable[..., tuple[Real, ...]], tables: tuple[np.ndarray, ...], state: tuple[Real, ...], x: Real
) -> tuple[Real, ...]:
    """state = f(*state, *row) for each row of the equally long 1-D `tables`, in order; x tells the array type.
    A loop of array operations, one symbolic loop for Dr.Jit: kernels stay small however many rows there are."""
    for row in zip(*(table.tolist() for table in tables)):
        state = f(*state, *row)
    return state


def _check_no_derivatives(value: Real) -> None:
    if getattr(value, "requires_grad", False):
        raise ValueError("a medium with derivatives is asked with torch tensors: use medium.detached() for its numbers")


class Library:
    """Functions of the arrays of one library, by the names of NumPy."""

    exp: Callable[[Real], Real]
    expm1: Callable[[Real], Real]
    log: Callable[[Real], Real]
    log1p: Callable[[Real], Real]
    sqrt: Callable[[Real], Real]
    sin: Callable[[Real], Real]
    cos: Callable[[Real], Real]
    abs: Callable[[Real], Real]
    floor: Callable[[Real], Real]
    isfinite: Callable[[Real], Real]
    minimum: Callable[[Real, Real], Real]
    maximum: Callable[[Real, Real], Real]
    arctan2: Callable[[Real, Real], Real]
    where: Callable[[Real, Real, Real], Real]
    stack: Callable[[list[Real]], Real]
    fold: Callable[..., tuple[Real, ...]]


class _NumpyLibrary(Library):
    """NumPy, and plain Python numbers."""

    exp, expm1, log, log1p, sqrt = (staticmethod(f) for f in (np.exp, np.expm1, np.log, np.log1p, np.sqrt))
    sin, cos, abs, where = (staticmethod(f) for f in (np.sin, np.cos, np.abs, np.where))
    minimum, maximum, isfinite = (staticmethod(f) for f in (np.minimum, np.maximum, np.isfinite))
    arctan2, floor = (staticmethod(f) for f in (np.arctan2, np.floor))

    @staticmethod
    def float64(x: Real) -> Real:
        return np.asarray(x, dtype=np.float64)

    @staticmethod
    def like(value: Real, x: Real) -> Real:
        return np.asarray(value, dtype=np.asarray(x).dtype)

    @staticmethod
    def largest(x: Real) -> float:
        return float(np.finfo(np.asarray(x).dtype).max)

    @staticmethod
    def constant(value: Real, x: Real) -> Real:
        _check_no_derivatives(value)
        return np.asarray(value, dtype=np.asarray(x).dtype) if np.ndim(value) else float(value)

    @staticmethod
    def interval(edges: np.ndarray, x: Real) -> Real:
        return np.searchsorted(edges, x, side="right") - 1

    @staticmethod
    def take(table: np.ndarray, index: Real, x: Real) -> Real:
        return np.asarray(table, dtype=np.asarray(x).dtype)[index]

    stack = staticmethod(functools.partial(np.stack, axis=-1))
    fold = staticmethod(_fold)


class _TorchLibrary(Library):
    """torch tensors on any device."""

    def __init__(self) -> None:
        import torch

        self.torch = torch
        for name in ("exp", "expm1", "log", "log1p", "sqrt", "sin", "cos", "abs", "where", "isfinite", "floor"):
            setattr(self, name, getattr(torch, name))

    def _pair(self, a: Real, b: Real) -> tuple[torch.Tensor, torch.Tensor]:
        like = a if isinstance(a, self.torch.Tensor) else b
        return tuple(v if isinstance(v, self.torch.Tensor) else self.like(v, like) for v in (a, b))

    def minimum(self, a: Real, b: Real) -> torch.Tensor:
        return self.torch.minimum(*self._pair(a, b))

    def maximum(self, a: Real, b: Real) -> torch.Tensor:
        return self.torch.maximum(*self._pair(a, b))

    def arctan2(self, a: Real, b: Real) -> torch.Tensor:
        return self.torch.arctan2(*self._pair(a, b))

    def float64(self, x: torch.Tensor) -> torch.Tensor:
        return x.to(self.torch.float64)

    def like(self, value: Real, x: torch.Tensor) -> torch.Tensor:
        if isinstance(value, self.torch.Tensor):
            return value.to(device=x.device, dtype=x.dtype)
        return self.torch.as_tensor(value, dtype=x.dtype, device=x.device)

    def largest(self, x: torch.Tensor) -> float:
        return self.torch.finfo(x.dtype).max

    def constant(self, value: Real, x: torch.Tensor) -> torch.Tensor:
        return self.like(value, x) if np.ndim(value) or isinstance(value, self.torch.Tensor) else float(value)

    fold = staticmethod(_fold)

    def interval(self, edges: np.ndarray, x: torch.Tensor) -> torch.Tensor:
        edges = self.torch.as_tensor(edges, device=x.device)
        return self.torch.searchsorted(edges, x.to(edges.dtype).contiguous(), right=True) - 1

    def take(self, table: np.ndarray, index: torch.Tensor, x: torch.Tensor) -> torch.Tensor:
        return self.like(table, x)[index]

    def stack(self, values: list[torch.Tensor]) -> torch.Tensor:
        return self.torch.stack(values, dim=-1)


class _DrJitLibrary(Library):
    """Dr.Jit arrays of any backend; one lane per query."""

    def __init__(self) -> None:
        import drjit as dr

        self.dr = dr
        for name in ("exp", "log", "sqrt", "sin", "cos", "abs", "minimum", "maximum", "isfinite", "floor"):
            setattr(self, name, getattr(dr, name))
        self.where, self.arctan2 = dr.select, dr.atan2

    def expm1(self, x: Lanes) -> Lanes:
        half = 0.5 * self.dr.maximum(x, -60.0)  # sinh overflows in float32 below
        return 2 * self.dr.exp(half) * self.dr.sinh(half)

    def float64(self, x: Lanes) -> Lanes:
        return self.dr.float64_array_t(type(x))(x)

    def like(self, value: Real, x: Lanes) -> Lanes:
        return type(x)(value)

    def largest(self, x: Lanes) -> float:
        return self.dr.largest(type(x))

    def constant(self, value: Real, x: Lanes) -> Lanes:
        _check_no_derivatives(value)
        if np.ndim(value):
            raise ValueError("a Dr.Jit query is answered by a medium of one channel: use medium.channel(k)")
        return self.dr.opaque(type(x), float(value))  # kernels then differ in their data, and are compiled once

    def interval(self, edges: np.ndarray, x: Lanes) -> Lanes:
        dr = self.dr
        table = dr.float64_array_t(type(x))(edges)
        x = self.float64(x)
        upper = dr.binary_search(0, len(edges), lambda i: dr.gather(type(table), table, i) <= x)
        return dr.int32_array_t(type(x))(upper) - 1

    def take(self, table: np.ndarray, index: Lanes, x: Lanes) -> Lanes:
        return self.dr.gather(type(x), type(x)(table), self.dr.uint32_array_t(type(x))(index))

    def fold(
        self, f: Callable[..., tuple[Lanes, ...]], tables: tuple[np.ndarray, ...], state: tuple[Lanes, ...], x: Lanes
    ) -> tuple[Lanes, ...]:
        dr, kind = self.dr, type(x)
        n, columns = len(tables[0]), [kind(table) for table in tables]
        zero = dr.uint32_array_t(kind)(0)

        def body(k: Lanes, *state: Lanes) -> tuple:
            return k + 1, *f(*state, *(dr.gather(kind, column, k) for column in columns))

        # derivatives backwards store the states of n rounds
        return dr.while_loop((zero, *state), lambda k, *_: k < n, body, label="fold", max_iterations=n)[1:]

    def stack(self, values: list[Lanes]) -> Lanes:
        raise ValueError("a Dr.Jit query is answered by a medium of one channel: use medium.channel(k)")


_NUMPY = _NumpyLibrary()


_torch_library, _drjit_library = once(_TorchLibrary), once(_DrJitLibrary)


def asks_nothing(lib: Library, args: tuple[Real, ...]) -> bool:
    """Whether a Dr.Jit array of a query is empty, beside which Dr.Jit refuses numbers; arrays of others may be."""
    return isinstance(lib, _DrJitLibrary) and any(lib.dr.width(a) == 0 for a in args)


def is_torch(lib: Library) -> bool:
    """Whether functions of `library` are those for torch tensors."""
    return isinstance(lib, _TorchLibrary)


def library(*args: Real) -> Library:
    """The functions for the arguments: Dr.Jit if any is a Dr.Jit array, then torch, else NumPy.
    ValueError if torch and Dr.Jit arrays are mixed. BackendError if the LLVM that Dr.Jit found would abort the
    process."""
    parts = [type(a).__module__.split(".") for a in args]
    modules = {part[0] for part in parts}
    if "torch" in modules and "drjit" in modules:
        raise ValueError("torch and Dr.Jit arrays cannot be mixed in one query")
    if "drjit" in modules:
        if any(part[:2] == ["drjit", "llvm"] for part in parts):
            prepare_llvm()
        return _drjit_library()
    return _torch_library() if "torch" in modules else _NUMPY


def _common_float(lib: Library, args: tuple, names: Sequence[str] = ()) -> tuple:
    """Arguments as floating-point arrays of one library and the widest precision among the arrays."""
    names = names or ("a query",) * len(args)
    if lib is _NUMPY:
        arrays = [_converted(name, np.asarray, a) for name, a in zip(names, args)]
        for name, array, raw in zip(names, arrays, args):
            if array.dtype.kind not in "biufO":  # objects are None, or numbers of another kind, such as fractions
                raise ValueError(f"{name} must be real numbers, got {raw!r}")
        # Python numbers and integers are weak: they take the precision of the floating arrays around them
        strong = [a.dtype for a, raw in zip(arrays, args) if not isinstance(raw, (int, float)) and a.dtype.kind == "f"]
        dtype = np.result_type(np.float32, *strong) if strong else np.float64
        return tuple(_converted(n, functools.partial(np.asarray, dtype=dtype), a) for n, a in zip(names, arrays))
    if isinstance(lib, _TorchLibrary):
        torch = lib.torch
        tensors = [a for a in args if isinstance(a, torch.Tensor)]
        for name, a in zip(names, args):
            if isinstance(a, torch.Tensor) and a.is_complex():  # torch would leave out the imaginary part
                raise ValueError(f"{name} must be real numbers, got {a!r}")
        floats = [a.dtype for a in tensors if a.dtype.is_floating_point] or [torch.get_default_dtype()]
        dtype = functools.reduce(torch.promote_types, floats)
        convert = functools.partial(torch.as_tensor, dtype=dtype, device=tensors[0].device)
        return tuple(_converted(name, convert, a) for name, a in zip(names, args))
    dr = lib.dr
    arrays = [a for a in args if dr.is_array_v(a)]
    total = functools.reduce(operator.add, (dr.zeros(type(a)) for a in arrays))  # of their common type
    kind = type(total) if dr.is_float_v(total) else dr.float32_array_t(type(total))
    return tuple(_converted(name, kind, a) for name, a in zip(names, args))


def _converted(name: str, convert: Callable[[object], Real], value: object) -> Real:
    """An argument as a library makes it its own; ValueError where it cannot."""
    try:
        if isinstance(value, (str, bytes, dict)):  # Dr.Jit would take an empty one for no lanes
            raise TypeError
        return convert(value)
    except (TypeError, ValueError, OverflowError) as error:
        raise ValueError(f"{name} must be real numbers, got {value!r}") from error


def broadcast_query(*args: Real, names: Sequence[str] = ()) -> tuple[Library, tuple[Real, ...]]:
    """The library of a query and its arguments as broadcast floating-point arrays of that library.
    The precision is the widest among the array arguments; Python numbers follow it, and a query of Python numbers only
    is answered in float64. `args`: of the query. `names`: of these, for messages. ValueError if the shapes do not
    broadcast, libraries are mixed, or NumPy has no real numbers, as of text."""
    lib = library(*args)
    args = _common_float(lib, args, names)
    if isinstance(lib, _DrJitLibrary):
        widths = [lib.dr.width(a) for a in args]
        if len({*widths} - {0, 1}) > 1:
            raise ValueError(f"query shapes do not broadcast: {widths} lanes")
        return lib, args
    try:
        return lib, tuple(np.broadcast_arrays(*args) if lib is _NUMPY else lib.torch.broadcast_tensors(*args))
    except (ValueError, RuntimeError) as error:
        raise ValueError(f"query shapes do not broadcast: {error}") from error


def labelled(function: Callable[..., Real], args: Sequence[Real], name: str, channels: bool) -> Real:
    """function(*args) with the labels of its arguments: series of pandas with one index give a series, or a table with
    a column for each channel; arrays of xarray are broadcast by their dimensions and give an array, channels last.
    ValueError if series have several indices, or values are masked, whose mask would be lost."""
    kinds = {f"{type(a).__module__.partition('.')[0]}.{type(a).__name__}" for a in args}
    if "numpy.MaskedArray" in kinds:
        raise ValueError("arguments of a query must be plain arrays, got a masked one: fill or drop masked values")
    if "xarray.DataArray" in kinds:
        import xarray

        found = xarray.apply_ufunc(function, *args, output_core_dims=[["channel"] if channels else []])
        return found.rename(name)
    if "pandas.Series" in kinds:
        import pandas

        indices = [a.index for a in args if isinstance(a, pandas.Series)]
        if not all(index.equals(indices[0]) for index in indices):
            raise ValueError("series of a query must have one index, got several")
        values = function(*(a.to_numpy() if isinstance(a, pandas.Series) else a for a in args))
        return pandas.DataFrame(values, indices[0]) if channels else pandas.Series(values, indices[0], name=name)
    return function(*args)


def aligned(kind: type, values: np.ndarray) -> Lanes:
    """Numbers of any shape as one array of Dr.Jit, 32 bits each, at an address that is a multiple of 64.
    Dr.Jit takes over the memory of NumPy, and whether its address is one is in the code of kernels: where chance
    decides, they are compiled twice for each such array."""
    import drjit as dr

    dtype = {dr.VarType.UInt32: np.uint32, dr.VarType.Int32: np.int32}.get(dr.type_v(kind), np.float32)
    size = np.size(values)
    room = np.empty(size + 16, dtype)
    first = (-room.ctypes.data % 64) // 4
    room[first : first + size] = np.ravel(values)
    return kind(room[first : first + size])
