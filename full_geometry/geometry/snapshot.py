"""Snapshots of objects of Mitsuba and their parameters, by which a later edit is seen.

Values count, by checksums of their bytes. The numbers that Dr.Jit gives to its variables tell nothing: they are given
again once a variable is freed. Neither would values that are kept: NumPy's views of them write into them.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np


class Snapshot:
    """Objects of Mitsuba, which are kept, and checksums of their parameters; equal to another where nothing differs."""

    __hash__ = None

    def __init__(self, nodes: list[mi.Object], checksums: dict[str, bytes]) -> None:
        self._nodes, self._checksums = nodes, checksums

    @classmethod
    def of(
        cls, root: mi.Object, wanted: Callable[[str], bool] | None = None, without: tuple[type, ...] = ()
    ) -> Snapshot:
        """Take the snapshot of an object and all that it holds.

        Args:
            root: of Mitsuba.
            wanted: whether a parameter of this name counts; by default all do.
            without: classes of objects that do not count.
        """
        parameters, checksums = mi.traverse(root), {}
        for key, value in parameters.items():
            if not isinstance(parameters.properties[key][2], without) and (wanted is None or wanted(key)):
                checksums[key] = _checksum(value)
        return cls([node for node in parameters.hierarchy if not isinstance(node, without)], checksums)

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Snapshot):
            return NotImplemented
        return same_objects(self._nodes, other._nodes) and self._checksums == other._checksums


def same_objects(a: list[mi.Object], b: list[mi.Object]) -> bool:
    """Whether two lists hold the same objects of Mitsuba."""
    return len(a) == len(b) and all(x is y for x, y in zip(a, b))


def plain(value: object) -> Any:
    """A parameter without gradients, of a transformation its matrix."""
    if value is None:
        return value
    value = dr.detach(value)
    return value if dr.is_array_v(value) else getattr(value, "matrix", value)  # arrays take any name for components


def _checksum(value: object) -> bytes:
    result = hashlib.sha256()
    for numbers in _numbers(plain(value)):
        result.update(f"{numbers.dtype}{numbers.shape}".encode())
        result.update(np.ascontiguousarray(numbers))
    return result.digest()


def _numbers(value: dr.ArrayBase | object) -> Iterator[np.ndarray]:
    """The numbers of a parameter, array by array: to join arrays Dr.Jit would run a kernel."""
    if dr.is_tensor_v(value):
        yield np.array(value.shape)
        yield value.array.numpy()
    elif dr.depth_v(value) > 1:
        for part in value:
            yield from _numbers(part)
    else:
        numbers = value.numpy() if dr.is_jit_v(value) else np.array(value)
        yield np.frombuffer(repr(value).encode(), np.uint8) if numbers.dtype == object else numbers
