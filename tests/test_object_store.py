"""Maps and weights in an object store: the bits of a folder, resumed where a run ended, errors in a sentence."""

from __future__ import annotations

import sys
import uuid
from pathlib import Path

import numpy as np
import pytest

from halfspace_sss import Medium
from halfspace_sss.maps import map_store as store
from halfspace_sss.maps.grid import MapGrid
from halfspace_sss.maps.map_store import load_maps, make_maps
from halfspace_sss.neural.store import find_weights, load_weights, save_weights, weights_in, weights_name
from halfspace_sss.provenance import check_folder, path_of

pytest.importorskip("upath")
MEDIA = {"m": Medium([1.0, 2.0], 0.1)}
HOW = {"grid": MapGrid(2, 16, 4, 4), "target_error": None, "n_paths": 1024}


@pytest.fixture
def bucket() -> str:
    """A bucket of its own in the memory of this process."""
    return f"memory://{uuid.uuid4().hex}"


def test_maps_in_a_bucket_have_the_bits_of_those_in_a_folder(bucket: str, tmp_path: Path) -> None:
    there = make_maps(MEDIA, f"{bucket}/maps", **HOW)["m"]
    assert str(there) == f"{bucket}/maps/m.zarr"
    here = load_maps(make_maps(MEDIA, tmp_path, **HOW)["m"])
    assert load_maps(there).drop_vars("seconds").equals(here.drop_vars("seconds"))
    assert load_maps(str(there)).attrs[store.ASKED] == here.attrs[store.ASKED]


def test_units_that_are_missing_in_a_bucket_are_made_and_others_are_not(
    bucket: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = make_maps(MEDIA, bucket, **HOW)["m"]
    bits = load_maps(whole)
    (whole / "S" / "1.0.0.0.0").unlink()
    (whole / "checksum" / "1.0").unlink()
    (whole / "S" / "0.1.0.0.0").write_bytes((whole / "S" / "0.1.0.0.0").read_bytes()[:-9])
    made, trace = [], store.trace_unit
    monkeypatch.setattr(store, "trace_unit", lambda unit: made.append(unit.theta_index) or trace(unit))
    assert load_maps(make_maps(MEDIA, bucket, **HOW)["m"]).drop_vars("seconds").equals(bits.drop_vars("seconds"))
    assert made == [1, 0]


def test_a_store_whose_creation_was_cut_off_is_created_again(bucket: str) -> None:
    whole = make_maps(MEDIA, bucket, **HOW)["m"]
    bits = load_maps(whole)
    (whole / store.METADATA).unlink()  # it is written last
    with pytest.raises(ValueError, match="map store must exist, got memory://"):
        load_maps(whole)
    assert load_maps(make_maps(MEDIA, bucket, **HOW)["m"]).drop_vars("seconds").equals(bits.drop_vars("seconds"))


def test_weights_are_kept_and_found_in_a_bucket(bucket: str) -> None:
    medium, arrays = Medium.from_albedo(0.9, 1.0, 0.1, 1.3), {"w": np.arange(4, dtype=np.float32)}
    path = save_weights(f"{bucket}/{weights_name('neural_material', medium)}", "neural_material", arrays, {})
    with weights_in(bucket):
        assert str(find_weights("neural_material", medium)) == str(path)
    (loaded, _) = load_weights(str(path), "neural_material")
    assert np.array_equal(loaded["w"], arrays["w"])
    path.write_bytes(path.read_bytes()[:-1])
    with pytest.raises(ValueError, match="sha256 must be .* truncated or altered"):
        load_weights(path, "neural_material")


def test_a_url_without_its_package_and_a_bucket_that_cannot_be_written_to_are_told(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    place = path_of("memory://b")
    with pytest.raises(ValueError, match="nonsense"):
        path_of("nonsense://b")
    with monkeypatch.context() as patch, pytest.raises(ValueError, match=r"memory://b needs more .*sss\[cluster\]"):
        patch.setitem(sys.modules, "upath", None)
        path_of("memory://b")
    monkeypatch.setattr(type(place), "write_bytes", lambda *_: (_ for _ in ()).throw(PermissionError("read-only")))
    with pytest.raises(ValueError, match=r"folder must be one that can be written to, got 'memory://b/?': read-only"):
        check_folder(place)
