"""Damage in a store of maps that the libraries that read it do not see, or that takes the process down there."""

from __future__ import annotations

import json
import zlib
from pathlib import Path

import numpy as np
import pytest

from halfspace_sss import Medium
from halfspace_sss.maps.grid import MapGrid
from halfspace_sss.maps.map_store import load_maps, make_maps

MEDIA = {"m": Medium([1.0, 2.0], 0.1)}
HOW = {"grid": MapGrid(2, 16, 4, 4), "target_error": None, "n_paths": 1024}
COORDINATES = ("theta_i", "mu_i", "phi_i", "mu_o", "delta_phi", "r_edges", "psi_edges", "mfp")


@pytest.mark.parametrize("at", [4, 8, 12])
def test_a_chunk_with_other_bytes_is_refused_with_the_name_of_the_store(at: int, tmp_path: Path) -> None:
    path = make_maps(MEDIA, tmp_path, **HOW)["m"]
    load_maps(path)
    chunk = path / "mu_o" / "0.0"
    data = bytearray(chunk.read_bytes())
    data[at : at + 4] = b"\x08\x01\xf6\x31"
    chunk.write_bytes(data)
    with pytest.raises(ValueError, match=r"m.zarr is damaged or not a map store"):
        load_maps(path)


def _change(path: Path, name: str) -> None:
    """Another last bit in the first number of a coordinate, in a chunk that is whole."""
    import zarr

    array = zarr.open_group(path, mode="r+")[name]
    values = array[...]
    values.flat[0] = np.nextafter(values.flat[0], np.inf)
    array[...] = values


@pytest.mark.parametrize("coordinate", COORDINATES)
def test_a_coordinate_with_another_last_bit_is_refused_by_name(coordinate: str, tmp_path: Path) -> None:
    path = make_maps(MEDIA, tmp_path, **HOW)["m"]
    assert set(load_maps(path).coords) == set(COORDINATES)
    _change(path, coordinate)
    said = rf"m.zarr is damaged or .*: coordinate {coordinate} does not match its checksum"
    for read in (lambda: load_maps(path), lambda: make_maps(MEDIA, tmp_path, **HOW)):
        with pytest.raises(ValueError, match=said):
            read()


def test_checksums_of_coordinates_are_those_of_their_numbers(tmp_path: Path) -> None:
    maps = load_maps(make_maps(MEDIA, tmp_path, **HOW)["m"])
    written = json.loads(maps.attrs["checksums_of_coordinates"])
    assert written == {name: zlib.crc32(maps[name].values.tobytes()) for name in COORDINATES}


@pytest.mark.parametrize("kept", [0, 7, 40])
@pytest.mark.parametrize("array", ["S", "checksum"])
def test_a_chunk_that_was_cut_off_is_made_again(array: str, kept: int, tmp_path: Path) -> None:
    path = make_maps(MEDIA, tmp_path, **HOW)["m"]
    whole = load_maps(path)
    (chunk,) = (file for file in (path / array).iterdir() if file.name.startswith("1.0"))
    chunk.write_bytes(chunk.read_bytes()[:kept] if kept < chunk.stat().st_size else b"")
    with pytest.raises(ValueError, match="m.zarr is damaged"):
        load_maps(path)
    done = []
    make_maps(MEDIA, tmp_path, **HOW, progress=lambda *step: done.append(step[0]))
    again = load_maps(path)
    assert len(done) == 2  # of the four units one was left
    np.testing.assert_array_equal(again.S, whole.S)


def test_an_edited_medium_is_refused(tmp_path: Path) -> None:
    path = make_maps(MEDIA, tmp_path, **HOW)["m"]
    for name in (".zattrs", ".zmetadata"):
        text = (path / name).read_text()
        assert "sigma_a" in text
        (path / name).write_text(text.replace('\\"sigma_a\\": [0.1, 0.1]', '\\"sigma_a\\": [0.2, 0.1]'))
    for read in (lambda: load_maps(path), lambda: make_maps(MEDIA, tmp_path, **HOW)):
        with pytest.raises(ValueError, match="attribute halfspace_sss_maps does not match its checksum"):
            read()
