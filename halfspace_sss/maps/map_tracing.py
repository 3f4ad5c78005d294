"""One unit of map tracing: all maps of one direction of incidence of one medium, to a count or an error."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from types import ModuleType

import numpy as np

from halfspace_sss.arrays import Lanes, library
from halfspace_sss.backend import array_types
from halfspace_sss.lazy import LazyModule
from halfspace_sss.maps.grid import MapGrid, cell_edges, map_directions, radial_scale
from halfspace_sss.physics.backbone import warp
from halfspace_sss.physics.fresnel import F_t, mu_internal
from halfspace_sss.physics.medium import Medium, eval_hg
from halfspace_sss.tracing.passes import PATHS_PER_LANE, CellSums
from halfspace_sss.tracing.walk import Scatter, Tally, at_lanes, pass_seed, walk

dr = LazyModule("drjit")

GROUP = 16  # observations that share a walk
HITS = 2  # scores per event, one in each half of the summed contributions
MAP_BATCHES = 16
PILOT_LANES, PILOT_PATHS, PASS_LANES = 8192, 16, 65536


@dataclass(frozen=True)
class MapUnit:
    """What one unit traces: a scalar medium, its grid, which direction of incidence, seeds, and when to stop.
    `target_error`: mean cell error to reach, see `trace_unit`; None to trace `n_paths` exactly. `n_paths`: walks for
    each group of 16 observations, or the most that are traced for `target_error`."""

    medium: Medium
    grid: MapGrid
    theta_index: int
    seed: int
    stream: int
    target_error: float | None
    n_paths: int
    backend: str = "llvm"


@dataclass(frozen=True)
class UnitResult:
    """S and variance of the mean in 1/(mfp² sr), (phi, r, psi); counts; mean cell error; seconds."""

    S: np.ndarray
    variance: np.ndarray
    n_paths: int
    n_events: int
    mean_cell_error: float
    seconds: float


@dataclass(eq=False)
class MapTally(Tally):
    """Order >= 2 radiance towards 16 observations over cells of the plane, without Fresnel factors.

    At each event one observation is drawn in proportion to its contribution q_k = p(d.d_k) exp(-z/mu_k) / (eta² mu_k)
    and scored with the sum of all, twice, stratified: all scores of an event are equal, which for forward
    scattering cuts the variance x time of a cell by 2.7 against scoring one observation drawn uniformly.

    Args:
        types: Dr.Jit's array types.
        n_r, n_psi: cells of a map.
        phase: phase function towards an observation, of its cosine, the event and g.
        g: of the medium, as lanes or a constant.
        directions: of each observation d_x, d_y, mu, 1/mu and 1/(eta² mu), as lanes or constants.
        inverse_scale, low, rate: of the cells (inverse_scale is 1/L), uniform in u: row = (u(r/L) - low) rate.
        cells: the sums.
    """

    types: ModuleType
    n_r: int
    n_psi: int
    phase: Callable[[Lanes, Scatter, Lanes], Lanes]
    g: Lanes
    directions: list[tuple[Lanes, ...]]
    inverse_scale: Lanes
    low: Lanes
    rate: Lanes
    cells: CellSums

    def at(self, lanes: Lanes) -> MapTally:
        names = ("g", "directions", "inverse_scale", "low", "rate")
        return replace(self, **{name: at_lanes(getattr(self, name), lanes) for name in names})

    def scatter(self, sums: tuple[Lanes, ...], event: Scatter) -> tuple[Lanes, ...]:
        # contributions towards all observations, q_k = p(d . d_k) exp(-z / mu_k) / (eta² mu_k)
        q = []
        for ox, oy, mu, inverse_mu, scale in self.directions:
            cosine = event.dx * ox + event.dy * oy - event.dz * mu
            q.append(scale * self.phase(cosine, event, self.g) * dr.exp(-event.z * inverse_mu))
        total = sum(q[1:], q[0])
        for hit in range(HITS):
            # draw one of them by q_k / sum q, and score the sum in the cell where it leaves
            target = (event.random() + hit) / HITS * total
            k, (ox, oy, inverse_mu) = self._choose(q, target)
            t = event.z * inverse_mu
            cell, inside = self._cell(event.x + t * ox, event.y + t * oy)
            index = k * (self.n_r * self.n_psi) + cell
            self.cells.add(event.weight * total / HITS, index, event.lane, inside & (event.order > 1))
        return sums

    def _choose(self, q: list, target: Lanes) -> tuple[Lanes, tuple]:
        """The observation in whose share of the running sum the target lies."""
        UInt32, Float = self.types.UInt32, self.types.Float
        running, k = Float(0), UInt32(0)
        chosen = tuple(Float(self.directions[0][c]) for c in (0, 1, 3))
        for i in range(1, GROUP):
            running = running + q[i - 1]
            beyond = target >= running
            k = dr.select(beyond, UInt32(i), k)
            chosen = tuple(dr.select(beyond, self.directions[i][c], v) for c, v in zip((0, 1, 3), chosen))
        return k, chosen

    def _cell(self, x: Lanes, y: Lanes) -> tuple[Lanes, Lanes]:
        Int32, UInt32 = self.types.Int32, self.types.UInt32
        ratio = dr.sqrt(x * x + y * y) * self.inverse_scale
        u = dr.select(ratio > 15, ratio, dr.log(dr.maximum(dr.exp(dr.minimum(ratio, 16)) - 1, 1e-12)))
        u = dr.select(ratio < 0.01, dr.log(dr.maximum(ratio, 1e-30)) + 0.5 * ratio, u)  # exp(x) - 1 has lost its digits
        i = Int32(dr.floor((u - self.low) * self.rate))
        j = Int32(dr.floor((dr.atan2(y, x) / (2 * math.pi) + 0.5) * self.n_psi))
        j = dr.clip(j, 0, self.n_psi - 1)
        return UInt32(i) * self.n_psi + UInt32(j), (i >= 0) & (i < self.n_r)


def _unit_tally(types: ModuleType, unit: MapUnit, mu_o: np.ndarray, delta_phi: np.ndarray) -> MapTally:
    """The tally of one medium and its observations."""
    m, grid = unit.medium, unit.grid
    g = m.g if m.g == 0 else dr.opaque(types.Float, m.g)
    mu = np.maximum(mu_internal(mu_o, m.eta), 1e-6)
    sine = np.sqrt(1 - mu**2)
    columns = (sine * np.cos(delta_phi), sine * np.sin(delta_phi), mu, 1 / mu, 1 / (m.eta**2 * mu))
    directions = [tuple(dr.opaque(types.Float, v) for v in row) for row in np.stack(columns, axis=1)]
    L = radial_scale(m)
    low, high = warp(library(0.0), cell_edges(m, grid)[0][[0, -1]] / L)
    cells = CellSums(types, GROUP * grid.n_r * grid.n_psi, MAP_BATCHES)
    scale = [dr.opaque(types.Float, v) for v in (1 / L, low, grid.n_r / (high - low))]

    def phase(cosine: Lanes, _: Scatter, g: Lanes) -> Lanes:
        return eval_hg(cosine, g)

    return MapTally(types, grid.n_r, grid.n_psi, phase, g, directions, *scale, cells)


def _trace_group(unit: MapUnit, group: int, launch: int, lanes: int, per_lane: int) -> tuple[np.ndarray, int]:
    """Fixed-point cell sums (batch, observation x cell) and events of one launch for one group of observations."""
    types = array_types(unit.backend)
    mu_i, mu_o, delta_phi = map_directions(unit.medium, unit.grid, unit.seed)
    members = slice(group * GROUP, (group + 1) * GROUP)
    tally = _unit_tally(types, unit, mu_o[unit.theta_index, members], delta_phi[unit.theta_index, members])
    mu_in = max(float(mu_internal(float(mu_i[unit.theta_index]), unit.medium.eta)), 1e-6)
    seed = pass_seed(unit.seed, unit.stream, unit.theta_index, group, launch)
    _, events = walk(types, unit.medium, types.Float(np.full(lanes, mu_in)), per_lane, seed, [tally])
    return tally.cells.result(), int(events.numpy().astype(np.int64).sum())


def _launches(paths: int) -> list[tuple[int, int]]:
    """Launches (lanes, walks per lane) that make up at least this many walks."""
    per_lane = int(np.clip(paths // PILOT_LANES, 1, PATHS_PER_LANE))
    lanes = MAP_BATCHES * math.ceil(paths / (per_lane * MAP_BATCHES))
    full, rest = divmod(lanes, PASS_LANES)
    return [(PASS_LANES, per_lane)] * full + ([(rest, per_lane)] if rest else [])


def trace_unit(unit: MapUnit) -> UnitResult:
    """Trace the maps of one direction of incidence. With a target error a pilot of 131072 walks a group tells how many
    more are needed. The mean cell error is the standard error of a cell weighted by the flux it should carry:
    sum(standard error mu_o area) / sum(S mu_o area) over all cells of all observations. The result depends on the unit
    alone, not on what ran before: units can be traced anywhere, in any order."""
    started = time.perf_counter()
    pilot = unit.n_paths if unit.target_error is None else min(unit.n_paths, PILOT_LANES * PILOT_PATHS)
    groups = unit.grid.n_phi // GROUP
    sums, events, paths, launch = 0.0, 0, 0, 0
    goal = pilot
    while True:
        for lanes, per_lane in _launches(goal - paths):
            parts = [_trace_group(unit, group, launch, lanes, per_lane) for group in range(groups)]
            sums = sums + np.concatenate([part.reshape(MAP_BATCHES, GROUP, -1) for part, _ in parts], axis=1)
            events += sum(n for _, n in parts)
            paths += lanes * per_lane
            launch += 1
        S, variance, error = _finish(unit, sums, paths)
        if unit.target_error is None or error <= unit.target_error or paths >= unit.n_paths:
            break
        needed = paths * (error / unit.target_error) ** 2 * 1.02
        goal = int(min(max(needed, paths + PILOT_LANES), unit.n_paths))
    return UnitResult(S, variance, groups * paths, events, error, time.perf_counter() - started)


def _finish(unit: MapUnit, sums: np.ndarray, paths: int) -> tuple[np.ndarray, np.ndarray, float]:
    """Cell means of S, variances of the means, mean cell error."""
    m, grid = unit.medium, unit.grid
    mu_i, mu_o, _ = map_directions(m, grid, unit.seed)
    r, psi = cell_edges(m, grid)
    area = 0.5 * np.diff(r**2)[:, None] * np.diff(psi)
    T = F_t(float(mu_i[unit.theta_index]), m.eta) * F_t(mu_o[unit.theta_index], m.eta)
    shape = (MAP_BATCHES, grid.n_phi, grid.n_r, grid.n_psi)
    samples = sums.reshape(shape) * (MAP_BATCHES / paths) * T[:, None, None] / area
    S, variance = samples.mean(axis=0), samples.var(axis=0, ddof=1) / MAP_BATCHES
    weight = mu_o[unit.theta_index][:, None, None] * area
    flux = float((S * weight).sum())
    error = float((np.sqrt(variance) * weight).sum()) / flux if flux > 0 else 0.0
    return S.astype(np.float32), variance.astype(np.float32), error
