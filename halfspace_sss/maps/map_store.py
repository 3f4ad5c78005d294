"""Training maps of half-spaces: made in units that can be killed, resumed and spread; stored as labelled Zarr.

Units, coordinates and attributes have checksums, and so have the chunks of Zstandard that hold them.
"""

from __future__ import annotations

import contextlib
import itertools
import json
import os
import shutil
import zlib
from collections.abc import Mapping
from concurrent.futures import Executor
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from halfspace_sss.backend import array_types
from halfspace_sss.checks import as_count, check_count, check_interval
from halfspace_sss.executors import completed
from halfspace_sss.maps.grid import MapGrid, cell_edges, map_directions
from halfspace_sss.maps.map_tracing import MapUnit, trace_unit
from halfspace_sss.physics.medium import Medium
from halfspace_sss.progress import ProgressText
from halfspace_sss.provenance import JsonDict, is_remote, naming, one_writer, path_of, provenance

if TYPE_CHECKING:
    import xarray as xr


ASKED = "halfspace_sss_maps"  # the attribute with medium, grid and numbers of walks
METADATA = ".zmetadata"  # of all arrays of a store
COORDINATES, ATTRIBUTE = "checksums_of_coordinates", "checksum_of_halfspace_sss_maps"


def unit_checksum(S: np.ndarray, variance: np.ndarray) -> int:
    """Checksum of the data of a unit; never 0, which marks a unit not done."""
    data = np.ascontiguousarray(S, np.float32).tobytes(), np.ascontiguousarray(variance, np.float32).tobytes()
    return (1 << 32) | zlib.crc32(data[1], zlib.crc32(data[0]))


def _coordinates(dataset: xr.Dataset) -> dict[str, int]:
    """Checksums of the coordinates, in float64."""
    return {str(name): zlib.crc32(np.asarray(c.values, "<f8").tobytes()) for name, c in dataset.coords.items()}


FORMAT = 1
MOST_PATHS = 2**33
DATA = ("S", "variance")
Unit = tuple[str, int, MapUnit]  # name of the medium, channel, and what is traced


def make_maps(
    media: Mapping[str, Medium],
    folder: str | os.PathLike[str],
    *,
    grid: MapGrid | None = None,
    target_error: float | None = 0.05,
    n_paths: int | None = None,
    seed: int = 0,
    backend: str = "llvm",
    progress: ProgressText | None = None,
    executor: Executor | None = None,
) -> dict[str, Path]:
    """Trace training maps of media into `folder/NAME.zarr`, one Zarr store each, continuing what is there.

    For each of n_theta directions of incidence and each of n_phi azimuths (which follow from the first by
    rotation, so the walks are shared) a map holds S of order >= 2 towards its own direction of observation,
    over cells of x_o - x_i. One direction of incidence of one channel is one unit of work: its result depends on
    the arguments alone, so a killed and resumed run equals an unbroken one bit for bit, wherever units are traced.

    Args:
        media: name -> medium; channels of a medium become a dimension of its store.
        folder: where the stores are, made if absent; or a URL of an object store (see `provenance.path_of`).
        grid: numbers of directions and cells.
        target_error: stop a unit at this mean cell error (see `trace_unit`); None to trace `n_paths` exactly.
        n_paths: walks per unit and group of 16 observations; with a target error, the most that are traced.
        seed, backend: as in `trace`.
        progress: called with (units done, units in all, what was just done), first with those that were done before.
        executor: where units are traced and written (see `halfspace_sss.executors`); by default in this process.

    Returns:
        name -> path of the store.

    Raises:
        ValueError: an argument is out of range, a store exists with other parameters, or another run writes it; nothing
            has been written then.
    """
    grid = grid or MapGrid()
    n_paths = n_paths if n_paths is None else as_count("n_paths", n_paths, 1024)
    _check(media, target_error, n_paths, seed)
    array_types(backend)
    paths = {name: path_of(folder) / f"{name}.zarr" for name in media}
    asked = {name: _parameters(m, grid, target_error, n_paths, seed, backend) for name, m in media.items()}
    units = _units(media, grid, target_error, n_paths or MOST_PATHS, seed, backend)
    with contextlib.ExitStack() as locks:
        for path in paths.values():
            locks.enter_context(one_writer(path))
        # make the stores that are not there, once those that are there are known to be of the same parameters
        for name in filter(lambda name: _exists(paths[name]), media):
            _open_same(paths[name], asked[name])
        for name, medium in media.items():
            if not _exists(paths[name]):
                _create(paths[name], medium, grid, seed, asked[name])
        # trace the units that are not whole
        stores = {name: _open_same(path, asked[name]) for name, path in paths.items()}
        left = [u for u in units if not _done(stores[u[0]], u[1], u[2].theta_index)]
        parts = {
            f"{name} channel {k} direction {unit.theta_index + 1}/{grid.n_theta}": (paths[name].absolute(), k, unit)
            for name, k, unit in left
        }
        before, steps = len(units) - len(left), completed(executor, _trace_and_write, parts)
        for done, (text, _) in enumerate(itertools.chain([("", None)], steps), before):
            if progress:
                progress(done, len(units), text)
    return paths


def _units(
    media: Mapping[str, Medium], grid: MapGrid, target_error: float | None, n_paths: int, seed: int, backend: str
) -> list[Unit]:
    """Name, channel and work of every unit."""
    stop = {"target_error": target_error, "n_paths": n_paths, "backend": backend}
    return [
        (name, channel, MapUnit(mfp, grid, a, seed, stream=channel, **stop))
        for name, medium in media.items()
        for channel, mfp in enumerate(medium.in_mfp().channels())
        for a in range(grid.n_theta)
    ]


def _check(media: object, target_error: object, n_paths: object, seed: object) -> None:
    if not isinstance(media, Mapping) or not media:
        raise ValueError(f"media must map at least one name to a Medium, got {media!r}")
    for name, medium in media.items():
        if not isinstance(medium, Medium):
            raise ValueError(f"media[{name!r}] must be a Medium, got {type(medium).__name__}")
        if not isinstance(name, str) or not name or name != Path(name).name or name.startswith("."):
            raise ValueError(f"a name in media must be usable as a file name, got {name!r}")
    if target_error is None and n_paths is None:
        raise ValueError("target_error or n_paths must be given, got None for both")
    if target_error is not None:
        check_interval("target_error", target_error, 1e-4, 1.0)
    check_count("seed", seed, 0)


def _parameters(
    medium: Medium, grid: MapGrid, target_error: float | None, n_paths: int | None, seed: int, backend: str
) -> JsonDict:
    """What defines the contents of a store; a resumed run must agree in all of it."""
    numbers = {k: np.asarray(getattr(medium, k)).tolist() for k in ("sigma_s", "sigma_a", "g", "eta")}
    stop = {"target_error": target_error, "n_paths": n_paths}
    return {"format": FORMAT, "medium": numbers, "grid": asdict(grid), **stop, "seed": seed, "backend": backend}


def _template(medium: Medium, grid: MapGrid, seed: int) -> xr.Dataset:
    """All coordinates, and data that say nothing yet: NaN, count 0, no checksum."""
    import xarray as xr

    channels = medium.in_mfp().channels()
    mu_i, mu_o, delta_phi = map_directions(medium.channel(0), grid, seed)
    edges = np.stack([cell_edges(m, grid)[0] for m in channels])
    psi = cell_edges(channels[0], grid)[1]
    shape = (len(channels), grid.n_theta, grid.n_phi, grid.n_r, grid.n_psi)
    dims = ("channel", "theta", "phi", "r", "psi")
    unit = "1/(mfp2 sr)"
    data = {name: (dims, np.full(shape, np.nan, np.float32), {"units": unit}) for name in DATA}
    data["variance"][2].update(units="1/(mfp4 sr2)", long_name="variance of the mean of S in the cell")
    data["S"][2].update(long_name="BSSRDF of order >= 2, mean over the cell, Fresnel transmittances included")
    for name in ("n_paths", "n_events", "checksum"):
        data[name] = (dims[:2], np.zeros(shape[:2], np.uint64))
    for name in ("mean_cell_error", "seconds"):
        data[name] = (dims[:2], np.full(shape[:2], np.nan))
    coords = {
        "theta_i": ("theta", np.degrees(np.arccos(mu_i)), {"units": "degree"}),
        "mu_i": ("theta", mu_i),
        "phi_i": ("phi", 2 * np.pi * np.arange(grid.n_phi) / grid.n_phi, {"units": "radian"}),
        "mu_o": (("theta", "phi"), mu_o),
        "delta_phi": (("theta", "phi"), delta_phi, {"units": "radian", "long_name": "azimuth of w_o from forward"}),
        "r_edges": (("channel", "r_edge"), edges, {"units": "mfp"}),
        "psi_edges": ("psi_edge", psi, {"units": "radian", "long_name": "azimuth of x_o - x_i from forward"}),
        "mfp": ("channel", np.atleast_1d(medium.mfp), {"units": "mm"}),
    }
    return xr.Dataset(data, coords)


def _create(path: Path, medium: Medium, grid: MapGrid, seed: int, asked: JsonDict) -> None:
    """A store of the right shape, made under another name and renamed; in an object store, with its metadata last.
    Encoded in memory: zarr's threads, which an interrupt does not end, would write on into a folder just removed."""
    import zarr
    from numcodecs import Zstd

    dataset, memory = _template(medium, grid, seed), {}
    dataset.attrs |= {ASKED: json.dumps(asked, sort_keys=True), "provenance": json.dumps(provenance())}
    dataset.attrs[COORDINATES] = json.dumps(_coordinates(dataset), sort_keys=True)
    dataset.attrs[ATTRIBUTE] = zlib.crc32(dataset.attrs[ASKED].encode())
    key = "compressor" if zarr.__version__ < "3" else "compressors"  # version 2 is the last one for Python 3.10
    kinds = {name: {key: Zstd(checksum=True)} for name in dataset.variables}
    for name in dataset.data_vars:
        kinds[name]["chunks"] = (1, 1, *dataset[name].shape[2:])
    dataset.to_zarr(memory, mode="w", zarr_format=2, encoding=kinds)
    # bytes in version 2 of zarr
    content = {key: data if isinstance(data, bytes) else data.to_bytes() for key, data in memory.items()}
    if is_remote(path):
        for key in sorted(content, key=METADATA.__eq__):
            (path / key).write_bytes(content[key])
        return
    temporary = path.with_name(f".{path.name}.{os.getpid()}")
    shutil.rmtree(temporary, ignore_errors=True)
    try:
        with naming(path):
            for key, data in content.items():
                (temporary / key).parent.mkdir(parents=True, exist_ok=True)
                (temporary / key).write_bytes(data)
            os.replace(temporary, path)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def _exists(path: Path) -> bool:
    return (path / METADATA).exists() if is_remote(path) else path.exists()


def _at(path: Path) -> JsonDict:
    """A store in the words of xarray."""
    return {"store": str(path), "storage_options": dict(path.storage_options)} if is_remote(path) else {"store": path}


def _open(path: Path) -> xr.Dataset:
    import xarray as xr

    try:
        dataset = xr.open_zarr(**_at(path), chunks=None)
        asked = json.loads(dataset.attrs[ASKED])
        missing = {*DATA, "checksum", "n_paths", "n_events"} - set(dataset.data_vars)
        if missing:
            raise KeyError(f"arrays {', '.join(sorted(missing))}")
        if dataset.attrs[ATTRIBUTE] != zlib.crc32(dataset.attrs[ASKED].encode()):
            raise ValueError(f"attribute {ASKED} does not match its checksum")
        written, result = json.loads(dataset.attrs[COORDINATES]), _coordinates(dataset)
        for name in sorted(written.keys() | result.keys()):
            if written.get(name) != result.get(name):
                raise ValueError(f"coordinate {name} does not match its checksum")
    except Exception as error:  # zarr, JSON and xarray each raise their own kinds
        raise ValueError(f"map store {path} is damaged or not a map store: {error}") from error
    if asked.get("format") != FORMAT:
        raise ValueError(f"map store {path} must have format {FORMAT}, got {asked.get('format')!r}")
    return dataset


def _open_same(path: Path, asked: JsonDict) -> xr.Dataset:
    """The store at a path, which must have been made with the same parameters."""
    dataset = _open(path)
    result = json.loads(dataset.attrs[ASKED])
    wanted = json.loads(json.dumps(asked))
    for key, value in wanted.items():
        if result.get(key) != value:
            was = f"map store {path} was made with {key} = {result.get(key)!r}"
            raise ValueError(f"{was}, got {value!r}: ask for the same, or take another folder")
    return dataset


def _done(dataset: xr.Dataset, channel: int, theta: int) -> bool:
    """Whether a unit is whole; one that cannot be read, or does not fit its checksum, was cut off and is made again."""
    at = {"channel": channel, "theta": theta}
    try:
        stored = int(dataset["checksum"].isel(at).values)
        return stored != 0 and stored == unit_checksum(*(dataset[name].isel(at).values for name in DATA))
    except (RuntimeError, ValueError):  # of codecs, and of arrays that are too short
        return False


def _trace_and_write(path: Path, channel: int, unit: MapUnit) -> None:
    """Write the data of a unit in chunks of its own, then the checksum that says it is whole."""
    import xarray as xr

    result, theta = trace_unit(unit), unit.theta_index
    dims = ("channel", "theta", "phi", "r", "psi")
    data: dict[str, tuple] = {name: (dims, getattr(result, name)[None, None]) for name in DATA}
    for name, kind in (("n_paths", np.uint64), ("n_events", np.uint64), ("mean_cell_error", float), ("seconds", float)):
        data[name] = (dims[:2], np.full((1, 1), getattr(result, name), kind))
    region = {"channel": slice(channel, channel + 1), "theta": slice(theta, theta + 1)}
    with naming(path):
        xr.Dataset(data).to_zarr(**_at(path), region=region, mode="r+")
    checksum = np.full((1, 1), unit_checksum(result.S, result.variance), np.uint64)
    with naming(path):
        xr.Dataset({"checksum": (dims[:2], checksum)}).to_zarr(**_at(path), region=region, mode="r+")


def load_maps(path: str | os.PathLike[str]) -> xr.Dataset:
    """Load a finished store of `make_maps` and check every unit of it.

    Returns:
        Dataset over (channel, theta, phi, r, psi) with S and variance per mean free path squared, directions,
        cell edges, counts and provenance.

    Raises:
        ValueError: the store is absent, damaged or unfinished; the message names store, channel and direction.
    """
    path = path_of(path)
    if not _exists(path):
        raise ValueError(f"map store must exist, got {path}")
    dataset = _open(path)
    try:
        dataset = dataset.load()
    except Exception as error:
        raise ValueError(f"map store {path} is damaged: {error}") from error
    for channel in range(dataset.sizes["channel"]):
        for theta in range(dataset.sizes["theta"]):
            part = dataset.isel(channel=channel, theta=theta)
            where = f"channel {channel}, direction {theta}"
            if int(part["checksum"]) == 0:
                raise ValueError(f"map store {path} is unfinished at {where}: run the same command again to resume")
            if int(part["checksum"]) != unit_checksum(part["S"].values, part["variance"].values):
                raise ValueError(f"map store {path} is damaged at {where}: the checksum does not match")
    return dataset.drop_encoding()  # codecs of the store, which another format does not take
