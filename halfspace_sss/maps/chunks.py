"""Blosc's own heads of the chunks of a store: it trusts them, and a damaged one takes the process down."""

from __future__ import annotations

import json
import math
import struct
from pathlib import Path

import numpy as np

__all__ = ["check_chunks"]

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


def _check_chunk(chunk: Path, size: int) -> None:
    length = chunk.stat().st_size
    with chunk.open("rb") as file:
        head = file.read(HEAD.size)
    told = HEAD.unpack(head)[4:] if len(head) == HEAD.size else (0, 0, 0)
    if told[0] != size or not 0 < told[1] <= size or told[2] != length:
        raise ValueError(
            f"chunk {chunk.parent.name}/{chunk.name} must be of {size} bytes, {length} compressed, got {told}"
        )
