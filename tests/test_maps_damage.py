"""Damage in a store of maps that would take the process down in the library that reads it."""

from __future__ import annotations

from pathlib import Path

import pytest

from halfspace_sss import Medium
from halfspace_sss.maps.grid import MapGrid
from halfspace_sss.maps.store import load_maps, make_maps


@pytest.mark.parametrize(("at", "what"), [(4, "bytes"), (8, "bytes of a block"), (12, "compressed bytes")])
def test_a_chunk_whose_head_tells_other_sizes_is_refused_by_name(at: int, what: str, tmp_path: Path) -> None:
    how = {"grid": MapGrid(2, 16, 4, 4), "target_error": None, "n_paths": 1024}
    path = make_maps({"m": Medium(1.0, 0.1)}, tmp_path, **how)["m"]
    load_maps(path)
    chunk = path / "mu_o" / "0.0"
    data = bytearray(chunk.read_bytes())
    data[at : at + 4] = b"\x08\x01\xf6\x31"
    chunk.write_bytes(data[:183] if at == 12 else data)
    with pytest.raises(ValueError, match=r"m.zarr is damaged or not a map store: chunk mu_o/0.0 must be of 256 bytes"):
        load_maps(path)
