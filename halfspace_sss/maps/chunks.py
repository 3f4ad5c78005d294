"""Blosc's own heads of the chunks of a store: it trusts them, and a damaged one takes the process down."""

from __future__ import annotations

import json
import math
import struct
from pathlib import Path

import numpy as np

__all__ = ["check_chunks", "drop_cut_off"]

HEAD = struct.Struct("<4B3I")  # versions, flags, size of a number; bytes, bytes of a block, compressed bytes


def check_chunks(path: Path) -> None:
    """ValueError if a chunk of a Zarr store that Blosc compressed has not the sizes that its head tells."""
    for array in sorted(path.glob("*/.zarray")):
        about = json.loads(array.read_text(encoding="utf-8"))
        if (about.get("compressor") or {}).get("id") != "blosc":
            continue
        size = math.prod(about["chunks"]) * np.dtype(about["dtype"]).itemsize
        for chunk in array.parent.iterdir():
            if not chunk.name.startswith("."):
                _check_chunk(chunk, size)


def drop_cut_off(path: Path, units: set[tuple[int, int]]) -> None:
    """Remove chunks of units, by (channel, direction), shorter than their heads tell: they then are missing."""
    for array in sorted(path.glob("*/.zarray")):
        about = json.loads(array.read_text(encoding="utf-8"))
        if (about.get("compressor") or {}).get("id") != "blosc":
            continue
        for chunk in array.parent.iterdir():
            place = chunk.name.split(".")
            if len(place) < 2 or not all(part.isdecimal() for part in place[:2]):
                continue
            if about["chunks"][:2] == [1, 1] and (int(place[0]), int(place[1])) in units and _is_cut_off(chunk):
                chunk.unlink()


def _is_cut_off(chunk: Path) -> bool:
    told, length = _told(chunk)
    return length < max(told[2], HEAD.size)


def _told(chunk: Path) -> tuple[tuple[int, int, int], int]:
    """What the head of a chunk tells, 0 if there is none, and the length of the file."""
    with chunk.open("rb") as file:
        head = file.read(HEAD.size)
    return HEAD.unpack(head)[4:] if len(head) == HEAD.size else (0, 0, 0), chunk.stat().st_size


def _check_chunk(chunk: Path, size: int) -> None:
    told, length = _told(chunk)
    if told[0] != size or not 0 < told[1] <= size or told[2] != length:
        raise ValueError(
            f"chunk {chunk.parent.name}/{chunk.name} must be of {size} bytes, {length} compressed, got {told}"
        )
