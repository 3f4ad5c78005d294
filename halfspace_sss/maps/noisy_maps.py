"""Training data: many noisy maps of order >= 2, each of its own directions and, if wanted, its own medium.

A group is a medium, a direction of incidence and 16 directions of observation that share the walks of 64 lanes or more;
its maps hold the integral of G over cells of the plane of x_o - x_i, uniform in u = log(exp(r/L) - 1) and azimuth.
Groups of different media run side by side in one kernel.
"""

from __future__ import annotations

import io
import math
from concurrent.futures import Executor
from dataclasses import dataclass, fields
from pathlib import Path
from types import ModuleType

import numpy as np

from halfspace_sss.arrays import Lanes, aligned, library
from halfspace_sss.backend import array_types
from halfspace_sss.checks import check_count
from halfspace_sss.executors import completed
from halfspace_sss.maps.map_tracing import GROUP, MapTally
from halfspace_sss.physics.backbone import U_MAX, backbone, length_scale, unwarp, warp
from halfspace_sss.physics.medium import eval_hg
from halfspace_sss.progress import NamedProgress
from halfspace_sss.provenance import write_atomically
from halfspace_sss.tracing.passes import CellSums
from halfspace_sss.tracing.walk import Scatter, WalkConstants, pass_seed, walk

LANES, PER_LAUNCH = 32768, 256  # lanes and groups of one launch, at most
FIRST_R = 0.02  # of min(L, mfp): smallest distance in the maps
LEAST_ALBEDO = 1e-4  # G/albedo² of darker media is that of this one to 1e-4
PILOT_LANES = 8  # of a group, one walk each
WALKS_PER_LANE = 8  # at least, where there are enough for it: lanes then end at about the same time


@dataclass(frozen=True)
class CellGrid:
    """Numbers of cells of a map in u, at least 2, and in azimuth, an even number."""

    n_u: int = 40
    n_psi: int = 16

    def __post_init__(self) -> None:
        check_count("n_u", self.n_u, 2)
        check_count("n_psi", self.n_psi, 2)
        if self.n_psi % 2:
            raise ValueError(f"n_psi must be even, got {self.n_psi}")


@dataclass(frozen=True, eq=False)
class Groups:
    """Media and directions: albedo, g, eta, mu_i of shape (n,), mu_o and delta_phi of shape (n, 16).

    Outside cosines; delta_phi = 0 is the far side of the plane of incidence.
    """

    albedo: np.ndarray
    g: np.ndarray
    eta: np.ndarray
    mu_i: np.ndarray
    mu_o: np.ndarray
    delta_phi: np.ndarray

    def __len__(self) -> int:
        return len(self.albedo)

    def __getitem__(self, index: np.ndarray | slice) -> Groups:
        return Groups(*(getattr(self, f.name)[index] for f in fields(self)))

    @property
    def L(self) -> np.ndarray:
        return np.asarray(length_scale(self.albedo, self.g))


def draw_directions(albedo: np.ndarray, g: np.ndarray, eta: np.ndarray, rng: np.random.Generator) -> Groups:
    """One group per entry: mu_i stratified over the entries, observations a Latin square of cosine and azimuth."""
    n = len(albedo)
    lowest = np.sqrt(np.maximum(1 - eta**2, 0.0))  # eta < 1: only these cosines refract
    mu_i = lowest + (1 - lowest) * (rng.permutation(n) + rng.random(n)) / n
    strata = np.argsort(rng.random((2, n, GROUP)), axis=-1)
    u = (strata + rng.random((2, n, GROUP))) / GROUP
    mu_o = lowest[:, None] + (1 - lowest[:, None]) * u[0]
    return Groups(albedo, g, eta, mu_i, mu_o, 2 * math.pi * u[1] - math.pi)


def radial_edges(groups: Groups, grid: CellGrid) -> np.ndarray:
    """Edges of the cells in u, shape (n, n_u + 1)."""
    lib, L = library(0.0), groups.L
    low = warp(lib, FIRST_R * np.minimum(L, 1.0) / L)
    return low[:, None] + (U_MAX - low[:, None]) * np.arange(grid.n_u + 1) / grid.n_u


def backbone_mass(groups: Groups, grid: CellGrid) -> np.ndarray:
    """Integral of the backbone over each cell, shape (n, n_u); Gauss quadrature of four points in u."""
    edges, lib = radial_edges(groups, grid), library(0.0)
    nodes, weights = np.polynomial.legendre.leggauss(4)
    half = 0.5 * np.diff(edges, axis=1)[..., None]
    u = 0.5 * (edges[:, 1:] + edges[:, :-1])[..., None] + half * nodes
    L, albedo, g, eta = (np.asarray(v)[:, None, None] for v in (groups.L, groups.albedo, groups.g, groups.eta))
    r, dr_du = L * unwarp(lib, u), L / (1 + np.exp(-u))
    B = backbone(r, np.maximum(albedo, LEAST_ALBEDO), g, eta)
    return (B * r * dr_du * half * weights).sum(axis=-1) * (2 * math.pi / grid.n_psi)


class _GroupCells(CellSums):
    """Fixed-point sums of the cells of each group in two independent halves; lanes of a group are neighbours."""

    def __init__(self, types: ModuleType, cells: int, groups: int, lanes_per_group: int) -> None:
        super().__init__(types, cells, 2 * groups)
        self.half = lanes_per_group // 2

    def add(self, value: Lanes, cell: Lanes, lane: Lanes, active: Lanes) -> None:
        super().add(value, cell, lane // self.half, active)


def _group_tally(types: ModuleType, groups: Groups, grid: CellGrid, lanes_per_group: int) -> MapTally:
    """The tally of media and observations of their own for each group of lanes, halved by reciprocity.

    A path that turns back early is found by walks from the other end: its score is weighted by p_1 / (p_1 + p_n), the
    balance of both ends with the phase functions of the first and the last angle, which takes the rare large scores
    of forward scattering away. The maps hold 2 H with G(i, o) = H(i, o) + H(o, i): fitting them with a reciprocal
    function gives G, and so does the mean of both directions.
    """
    import drjit as dr

    def lanes(values: np.ndarray) -> Lanes:
        return aligned(types.Float, np.repeat(values, lanes_per_group))

    def phase(cosine: Lanes, event: Scatter, g: Lanes) -> Lanes:
        last, first = eval_hg(cosine, g), eval_hg(event.first, g)
        return 2 * last * first / (first + last)

    g, eta = lanes(groups.g), groups.eta[:, None]
    mu = np.maximum(np.sqrt(np.maximum(1 - (1 - groups.mu_o**2) / eta**2, 0.0)), 1e-4)
    sine = np.sqrt(1 - mu**2)
    columns = (sine * np.cos(groups.delta_phi), sine * np.sin(groups.delta_phi), mu, 1 / mu, 1 / (eta**2 * mu))
    directions = [tuple(lanes(c[:, k]) for c in columns) for k in range(GROUP)]
    edges = radial_edges(groups, grid)
    scale = (lanes(1 / groups.L), lanes(edges[:, 0]), lanes(grid.n_u / (edges[:, -1] - edges[:, 0])))
    cells = _GroupCells(types, GROUP * grid.n_u * grid.n_psi, len(groups), lanes_per_group)
    dr.eval(g, directions, *scale)
    return MapTally(types, grid.n_u, grid.n_psi, phase, g, directions, *scale, cells)


def _launch(
    groups: Groups, grid: CellGrid, per_group: int, walks: int, seed: tuple[int, int], backend: str
) -> tuple[np.ndarray, int]:
    """Cell integrals of G of one launch, two independent estimates (n, 2, 16, n_u, n_psi), and events."""
    types = array_types(backend)
    albedo = np.maximum(groups.albedo, LEAST_ALBEDO)
    tally = _group_tally(types, groups, grid, per_group)
    constants = WalkConstants.per_lane(types, *(np.repeat(v, per_group) for v in (albedo, groups.g, groups.eta)))
    mu_in = np.maximum(np.sqrt(np.maximum(1 - (1 - groups.mu_i**2) / groups.eta**2, 0.0)), 1e-4)
    start = aligned(types.Float, np.repeat(mu_in, per_group))
    # order 1 is not recorded: walks start with weight albedo^-2 so that roulette spares them until order 2
    _, events = walk(
        types, constants, start, walks, seed, [tally], weight=aligned(types.Float, np.repeat(albedo**-2, per_group))
    )
    sums = tally.cells.result().reshape(len(groups), 2, GROUP, grid.n_u, grid.n_psi)
    sums *= (2 * albedo**2 / (walks * per_group))[:, None, None, None, None]
    return sums.astype(np.float32), int(events.numpy().astype(np.int64).sum())


@dataclass(frozen=True, eq=False)
class MapLaunch:
    """Groups that are traced side by side: `index` says which, `trace` does it.

    The number of walks follows from the events of a pilot, so that the result depends on the arguments alone.
    """

    index: np.ndarray
    groups: Groups
    grid: CellGrid
    events: float
    seed: tuple[int, ...]
    backend: str

    def trace(self) -> np.ndarray:
        """Two independent estimates of the cell integrals of G, (k, 2, 16, n_u, n_psi)."""
        n = len(self.groups)
        _, pilot = _launch(self.groups, self.grid, PILOT_LANES, 1, pass_seed(*self.seed, 0), self.backend)
        per_group_walks = self.events / pilot * PILOT_LANES
        per_group = 2 * int(np.clip(per_group_walks / (2 * WALKS_PER_LANE), PILOT_LANES // 2, LANES // (2 * n)))
        walks = max(int(per_group_walks / per_group), 1)
        return _launch(self.groups, self.grid, per_group, walks, pass_seed(*self.seed, 1), self.backend)[0]


def trace_groups(
    groups: Groups, grid: CellGrid, events: float, seed: tuple[int, ...], backend: str = "llvm"
) -> list[MapLaunch]:
    """Launches of `PER_LAUNCH` groups that together trace all of them, those of long walks side by side.

    Args:
        groups: media and directions.
        grid: cells of the maps.
        events: scattering events over all launches, about; each has its share.
        seed: seeds of the random numbers.
    """
    order = np.argsort((1 - groups.albedo) * (1 - groups.albedo * groups.g), kind="stable")
    parts = [order[at : at + PER_LAUNCH] for at in range(0, len(order), PER_LAUNCH)]
    return [
        MapLaunch(part, groups[part], grid, events * len(part) / len(groups), (*seed, k), backend)
        for k, part in enumerate(parts)
    ]


def load_maps(place: Path, shape: tuple[int, ...]) -> np.ndarray:
    """Maps of a launch as an earlier run left them."""
    try:
        maps = np.load(place, allow_pickle=False)
    except (ValueError, EOFError, OSError) as error:
        raise ValueError(f"{place}: maps cannot be used, remove the file to make them anew: {error}") from error
    if maps.shape != shape or maps.dtype != np.float32 or not np.isfinite(maps).all():
        raise ValueError(
            f"{place}: maps must be {shape} finite float32, got {maps.shape} {maps.dtype}; remove the file"
        )
    return maps


def make_pool(
    groups: Groups,
    grid: CellGrid,
    events: float,
    seed: tuple[int, ...],
    folder: Path | None = None,
    progress: NamedProgress | None = None,
    backend: str = "llvm",
    executor: Executor | None = None,
) -> np.ndarray:
    """Cell integrals of all groups, (n, 2, 16, n_u, n_psi), kept launch by launch in `folder` so that a run can go on.

    Args:
        groups, grid, events, seed, backend: as in `trace_groups`.
        folder: that of this run, see `neural.training.fit`.
        progress: called with ("data", launches done, launches in all).
        executor: where launches run (see `halfspace_sss.executors`); by default in this process.

    Raises:
        ValueError: a file of maps in the folder is damaged.
    """
    halves = np.zeros((len(groups), 2, 16, grid.n_u, grid.n_psi), np.float32)
    launches = trace_groups(groups, grid, events, seed, backend=backend)
    places = [folder / f"maps-{'-'.join(map(str, seed))}-{k:05d}.npy" if folder else None for k in range(len(launches))]
    parts = {f"launch {k}": (launch, place) for k, (launch, place) in enumerate(zip(launches, places))}
    for done, (name, maps) in enumerate(completed(executor, _traced, parts), 1):
        halves[parts[name][0].index] = maps
        if progress:
            progress("data", done, len(launches))
    return halves


def _traced(launch: MapLaunch, place: Path | None) -> np.ndarray:
    """Maps of a launch, from its file if there is one."""
    if place and place.exists():
        return load_maps(place, (len(launch.index), 2, GROUP, launch.grid.n_u, launch.grid.n_psi))
    maps = launch.trace()
    if place:
        file = io.BytesIO()
        np.save(file, maps)
        write_atomically(place, file.getvalue())
    return maps
