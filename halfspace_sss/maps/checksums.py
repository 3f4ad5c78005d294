"""Checksums of a store of maps: of its units, its coordinates and of what it says that it was made with."""

from __future__ import annotations

import json
import zlib
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    import xarray as xr

__all__ = ["ASKED", "check_written", "unit_checksum", "written_checksums"]

ASKED = "halfspace_sss_maps"  # the attribute with medium, grid and numbers of walks
COORDINATES, ATTRIBUTE = "checksums_of_coordinates", "checksum_of_halfspace_sss_maps"


def unit_checksum(S: np.ndarray, variance: np.ndarray) -> int:
    """Of the data of a unit; never 0, which marks a unit not done."""
    data = np.ascontiguousarray(S, np.float32).tobytes(), np.ascontiguousarray(variance, np.float32).tobytes()
    return (1 << 32) | zlib.crc32(data[1], zlib.crc32(data[0]))


def written_checksums(dataset: xr.Dataset) -> dict[str, str | int]:
    """Attributes: of every coordinate, in float64, and of the attribute `ASKED`."""
    coordinates = json.dumps(_coordinates(dataset), sort_keys=True)
    return {COORDINATES: coordinates, ATTRIBUTE: zlib.crc32(dataset.attrs[ASKED].encode())}


def check_written(dataset: xr.Dataset) -> None:
    """ValueError names what is not as it was written; stores of before have no checksums, or fewer."""
    if ATTRIBUTE in dataset.attrs and dataset.attrs[ATTRIBUTE] != zlib.crc32(dataset.attrs[ASKED].encode()):
        raise ValueError(f"attribute {ASKED} does not match its checksum")
    if COORDINATES not in dataset.attrs:
        return
    written, found = json.loads(dataset.attrs[COORDINATES]), _coordinates(dataset)
    for name in sorted(written.keys() | found.keys()):
        if written.get(name) != found.get(name):
            raise ValueError(f"coordinate {name} does not match its checksum")


def _coordinates(dataset: xr.Dataset) -> dict[str, int]:
    return {str(name): zlib.crc32(np.asarray(c.values, "<f8").tobytes()) for name, c in dataset.coords.items()}
