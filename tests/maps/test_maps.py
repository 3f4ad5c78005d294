"""Training maps: right numbers, labelled, resumable, refused when damaged."""

import math
import os
import signal
import subprocess
import sys
import time
import warnings

import numpy as np
import pytest

from halfspace_sss import Medium, make_maps, trace
from halfspace_sss.maps import map_store
from halfspace_sss.maps.grid import MapGrid, cell_edges, map_directions, radial_scale
from halfspace_sss.maps.map_store import load_maps
from halfspace_sss.maps.map_tracing import MapUnit, trace_unit
from halfspace_sss.tracing.tracer import Line, trace_curve

FIG10 = Medium.from_albedo(0.75, 1.0, 0.0, 1.3)
FORWARD = Medium.from_albedo(0.99, 1.0, 0.8, 1.5)
SMALL = MapGrid(n_theta=3, n_phi=16, n_r=10, n_psi=8)


@pytest.mark.slow
@pytest.mark.parametrize(
    "medium", [FIG10, FORWARD, Medium.from_albedo(0.6, 1.0, -0.5, 0.8)], ids=["fig10", "g0.8", "eta0.8"]
)
def test_a_map_summed_over_the_plane_is_the_angular_reflectance(medium):
    unit = MapUnit(medium, SMALL, 1, 3, 0, None, 200_000)
    result = trace_unit(unit)
    mu_i, mu_o, delta_phi = map_directions(medium, SMALL, 3)
    r, psi = cell_edges(medium, SMALL)
    area = 0.5 * np.diff(r**2)[:, None] * np.diff(psi)
    total = (result.S * area).sum(axis=(1, 2))
    error = np.sqrt((result.variance * area**2).sum(axis=(1, 2)))
    directions = np.stack([mu_o[1], delta_phi[1]], axis=1)
    truth = trace(medium, float(mu_i[1]), 500_000, seed=9, directions=directions).angular_reflectance("multiple")
    outside = 0.01 * truth.value  # light beyond the last edge and inside the first
    z = (total - truth.value) / np.hypot(np.hypot(error, truth.standard_error), outside)
    assert np.all(np.abs(z) < 4), z  # 48 numbers, significance 3e-3 with Bonferroni


def test_a_cell_agrees_with_a_curve_traced_through_it():
    grid = MapGrid(n_theta=1, n_phi=16, n_r=6, n_psi=12)
    result = trace_unit(MapUnit(FIG10, grid, 0, 4, 0, None, 2_000_000))
    mu_i, mu_o, delta_phi = map_directions(FIG10, grid, 4)
    r, psi = cell_edges(FIG10, grid)
    k, j = 5, 8
    middle, half = 0.5 * (psi[j] + psi[j + 1]), 0.5 * (psi[j + 1] - psi[j])
    line = Line(r, float(mu_o[0, k]), float(delta_phi[0, k]), middle, half)
    curve = trace_curve(FIG10, float(mu_i[0]), line, 4_000_000, 5)
    error = np.hypot(np.sqrt(result.variance[k, :, j]), curve.standard_error)
    assert np.all(np.abs(result.S[k, :, j] - curve.S) < 4.5 * error)


def test_the_stated_variance_is_that_of_repeated_runs():
    runs = [trace_unit(MapUnit(FIG10, SMALL, 2, 3, stream, None, 40_000)) for stream in range(16)]
    order = np.argsort(-runs[0].S.reshape(-1))[:200]  # the cells that carry the light
    values = np.stack([run.S.reshape(-1)[order] for run in runs])
    stated = np.stack([run.variance.reshape(-1)[order] for run in runs]).mean(axis=0)
    ratio = (values.var(axis=0, ddof=1) / stated).mean()
    assert abs(ratio - 1) < 0.15  # 200 variances of 15 degrees of freedom: standard error 0.026


def test_the_target_error_is_reached():
    result = trace_unit(MapUnit(FIG10, SMALL, 1, 0, 0, 0.02, 2**30))
    assert 0.015 < result.mean_cell_error <= 0.021


def test_a_unit_repeats_bit_for_bit():
    a, b = (trace_unit(MapUnit(FORWARD, SMALL, 0, 1, 0, None, 30_000)) for _ in range(2))
    assert a.S.tobytes() == b.S.tobytes()
    assert a.variance.tobytes() == b.variance.tobytes()


def test_no_scattering_makes_black_maps():
    result = trace_unit(MapUnit(Medium(0.0, 1.0), SMALL, 0, 0, 0, 0.05, 100_000))
    assert not result.S.any()


@pytest.mark.parametrize("albedo", [0.0, 0.5, 1.0])
def test_the_radial_scale_is_finite_for_every_albedo(albedo):
    assert 0 < radial_scale(Medium.from_albedo(albedo, 1.0, 0.9, 1.3)) < math.inf


def test_observations_of_one_incidence_are_stratified():
    _, mu_o, delta_phi = map_directions(FIG10, MapGrid(), 0)
    assert np.array_equal(np.sort((mu_o * 64).astype(int), axis=1), np.tile(np.arange(64), (16, 1)))
    assert np.all(np.abs(delta_phi) <= math.pi)


def test_a_store_has_a_channel_for_each_of_a_medium(tmp_path):
    medium = Medium([0.75, 0.5], [0.25, 0.5])
    paths = make_maps({"two": medium}, tmp_path, grid=SMALL, target_error=None, n_paths=2048)
    maps = load_maps(paths["two"])
    assert maps.S.dims == ("channel", "theta", "phi", "r", "psi")
    assert maps.sizes["channel"] == 2
    assert np.isfinite(maps.S).all()


SCRIPT = """
from halfspace_sss import Medium, make_maps
from halfspace_sss.maps.grid import MapGrid
make_maps({"m": Medium.from_albedo(0.75, 1.0)}, %r, grid=MapGrid(6, 16, 10, 8), target_error=None, n_paths=300_000,
          progress=lambda *a: print(*a, flush=True))
"""


@pytest.mark.slow
def test_a_killed_run_resumes_to_the_same_bits(tmp_path):
    def start(folder):
        return subprocess.Popen([sys.executable, "-c", SCRIPT % str(folder)], stdout=subprocess.PIPE, text=True)

    unbroken = start(tmp_path / "a")
    assert unbroken.wait(120) == 0
    broken = start(tmp_path / "b")
    assert broken.stdout.readline() == "0 6 \n"
    broken.stdout.readline()  # one unit done; the next is under way
    time.sleep(0.15)
    os.kill(broken.pid, signal.SIGKILL)
    broken.wait()
    with pytest.raises(ValueError, match="unfinished"):
        load_maps(tmp_path / "b" / "m.zarr")
    assert start(tmp_path / "b").wait(120) == 0
    a, b = (load_maps(tmp_path / name / "m.zarr") for name in "ab")
    for name in ("S", "variance", "n_paths", "n_events", "checksum"):
        assert a[name].values.tobytes() == b[name].values.tobytes(), name


def test_progress_begins_with_the_units_that_were_done_before(tmp_path, monkeypatch):
    arguments = {"grid": SMALL, "target_error": None, "n_paths": 1024}
    calls, found = [], map_store.trace_unit

    def interrupted(unit):
        if unit.theta_index == 1:
            raise KeyboardInterrupt
        return found(unit)

    monkeypatch.setattr(map_store, "trace_unit", interrupted)
    with pytest.raises(KeyboardInterrupt):
        make_maps({"m": FIG10}, tmp_path, **arguments)
    monkeypatch.undo()
    make_maps({"m": FIG10}, tmp_path, progress=lambda *call: calls.append(call), **arguments)
    assert calls == [(1, 3, ""), (2, 3, "m channel 0 direction 2/3"), (3, 3, "m channel 0 direction 3/3")]


@pytest.fixture
def store(tmp_path):
    return make_maps({"m": FIG10}, tmp_path, grid=SMALL, target_error=None, n_paths=1024)["m"]


@pytest.mark.parametrize("zarr_format", [2, 3])
def test_loaded_maps_can_be_written_elsewhere(store, tmp_path, zarr_format):
    maps = load_maps(store)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # on metadata of format 3
        maps.to_zarr(tmp_path / "copy.zarr", zarr_format=zarr_format)
        assert load_maps(tmp_path / "copy.zarr").identical(maps)


def test_an_altered_chunk_is_refused_by_store_and_direction(store):
    import xarray as xr

    region = {"channel": slice(0, 1), "theta": slice(1, 2)}
    part = xr.open_zarr(store, chunks=None).isel(region)[["S"]].load().drop_vars(["mu_i", "theta_i", "mfp"])
    part = part.drop_vars([name for name in part.coords])
    (part * 1.5).to_zarr(store, region=region, mode="r+")
    with pytest.raises(ValueError, match=r"m\.zarr is damaged at channel 0, direction 1"):
        load_maps(store)


def test_a_truncated_chunk_is_refused_by_name(store):
    chunk = next(path for path in (store / "S").iterdir() if path.name[0] != ".")
    chunk.write_bytes(chunk.read_bytes()[:-40])
    with pytest.raises(ValueError, match=r"m\.zarr is damaged"):
        load_maps(store)


def test_a_store_without_its_metadata_is_refused_by_name(store):
    for name in (".zattrs", ".zmetadata"):
        (store / name).unlink()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)
        with pytest.raises(ValueError, match=r"m\.zarr is damaged or not a map store"):
            load_maps(store)


def test_a_store_of_another_run_is_refused_by_parameter(store):
    with pytest.raises(ValueError, match=r"m\.zarr was made with seed = 0, got 1"):
        make_maps({"m": FIG10}, store.parent, grid=SMALL, target_error=None, n_paths=1024, seed=1)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"media": {}}, "media must map at least one name"),
        ({"media": {"a/b": FIG10}}, "usable as a file name, got 'a/b'"),
        ({"media": {"a": 3}}, r"media\['a'\] must be a Medium, got int"),
        ({"target_error": 2.0}, r"target_error must be a number in \[0.0001, 1\], got 2.0"),
        ({"target_error": None}, "target_error or n_paths must be given"),
        ({"n_paths": 10}, "n_paths must be a whole number >= 1024, got 10"),
        ({"seed": -1}, "seed must be a whole number >= 0, got -1"),
        ({"backend": "metal"}, "backend must be one of llvm, cuda, got 'metal'"),
    ],
)
def test_a_wrong_argument_is_refused_and_nothing_written(tmp_path, changes, message):
    arguments = {"media": {"m": FIG10}, "folder": tmp_path / "maps"} | changes
    with pytest.raises(ValueError, match=message):
        make_maps(**arguments)
    assert not (tmp_path / "maps").exists()


@pytest.mark.parametrize("numbers", [(2, 16, 99999, 999), (1, 16, 2**17, 3), (4097, 16, 2, 2), (1, 2**22, 2, 2)])
def test_a_grid_must_fit_into_memory(numbers):
    with pytest.raises(ValueError, match="n_theta must be at most 4096|n_phi n_r n_psi must be at most 4194304, .*got"):
        MapGrid(*numbers)


def test_a_grid_must_hold_whole_groups_of_observations():
    with pytest.raises(ValueError, match="n_phi must be a multiple of 16, got 20"):
        MapGrid(n_phi=20)
