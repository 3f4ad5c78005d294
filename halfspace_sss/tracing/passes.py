"""A beam on a half-space, walked pass by pass: the loop behind every traced quantity, what it records, its estimates.

Flux, moments, rings, angular reflectance and curves are recorded, in units of mean free paths. Sums over memory cells
are kept as 64-bit fixed-point integers: integer addition is associative, so the result does not depend on the order in
which threads add, and a run gives the same bits every time.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from types import ModuleType
from typing import NamedTuple

import numpy as np

from halfspace_sss.arrays import Lanes, aligned
from halfspace_sss.checks import check_choice, check_edges
from halfspace_sss.lazy import LazyModule
from halfspace_sss.physics.fresnel import F_t, mu_internal
from halfspace_sss.physics.medium import Layers, Medium, eval_hg
from halfspace_sss.progress import Progress
from halfspace_sss.tracing.walk import Boundary, Scatter, Tally, pass_seed, walk

dr = LazyModule("drjit")

FIXED_POINT = 2.0**32  # quantum 2.3e-10 of a unit weight; a cell holds up to 4e9 unit weights
BATCHES = 64  # independent groups of lanes, from whose spread the variance of a cell is taken


def _split(order: Lanes, value: Lanes) -> tuple[Lanes, Lanes]:
    """A value as (single, multiple) according to the scattering order."""
    return dr.select(order == 1, value, 0.0), dr.select(order > 1, value, 0.0)


class FluxTally(Tally):
    """Flux through the boundary per entered flux: sums (single, multiple)."""

    def __init__(self, types: ModuleType) -> None:
        self.types = types

    def start(self, lanes: int) -> tuple[Lanes, ...]:
        return (dr.zeros(self.types.Float, lanes), dr.zeros(self.types.Float, lanes))

    def boundary(self, sums: tuple[Lanes, ...], event: Boundary) -> tuple[Lanes, ...]:
        return tuple(s + v for s, v in zip(sums, _split(event.order, event.weight)))


class MomentTally(Tally):
    """Flux times r², x and path length: sums (r² single, r² multiple, x single, ..., length multiple)."""

    def __init__(self, types: ModuleType) -> None:
        self.types = types

    def start(self, lanes: int) -> tuple[Lanes, ...]:
        return tuple(dr.zeros(self.types.Float, lanes) for _ in range(6))

    def boundary(self, sums: tuple[Lanes, ...], event: Boundary) -> tuple[Lanes, ...]:
        leaves = event.weight > 0
        moments = (event.x * event.x + event.y * event.y, event.x, event.length)
        values = [dr.select(leaves, event.weight * m, 0.0) for m in moments]
        parts = [part for value in values for part in _split(event.order, value)]
        return tuple(s + v for s, v in zip(sums, parts))


class AngularTally(Tally):
    """Radiance towards given outside directions integrated over the plane, without Fresnel factors.
    At each event: weight p(d.d_o) exp(-z/mu_o') / (eta² mu_o'), for each direction (single, multiple)."""

    def __init__(self, types: ModuleType, g: float, eta: float, mu_o: np.ndarray, delta_phi: np.ndarray) -> None:
        self.types = types
        self.g: float | Lanes = g if g == 0 else dr.opaque(types.Float, g)
        self.mu: np.ndarray = np.array([max(float(mu_internal(m, eta)), 1e-9) for m in mu_o])
        sine = np.sqrt(np.maximum(1 - self.mu**2, 0))
        self.constants: list[tuple[Lanes, ...]] = [
            tuple(dr.opaque(types.Float, v) for v in (s * math.cos(p), s * math.sin(p), m, 1 / m, 1 / (eta**2 * m)))
            for s, p, m in zip(sine, delta_phi, self.mu)
        ]

    def start(self, lanes: int) -> tuple[Lanes, ...]:
        return tuple(dr.zeros(self.types.Float, lanes) for _ in range(2 * len(self.mu)))

    def scatter(self, sums: tuple[Lanes, ...], event: Scatter) -> tuple[Lanes, ...]:
        out = []
        for k, (ox, oy, mu, inverse_mu, scale) in enumerate(self.constants):
            cosine = event.dx * ox + event.dy * oy - event.dz * mu
            score = event.weight * scale * eval_hg(cosine, self.g) * dr.exp(-event.z * inverse_mu)
            single, multiple = _split(event.order, score)
            out += [sums[2 * k] + single, sums[2 * k + 1] + multiple]
        return tuple(out)


class CellSums:
    """Fixed-point sums over cells, separately for each batch of lanes."""

    def __init__(self, types: ModuleType, cells: int, batches: int = BATCHES) -> None:
        self.cells = cells
        self.batches = batches
        self.UInt64: type[Lanes] = types.UInt64
        self.sums: Lanes = dr.zeros(types.UInt64, cells * batches)
        dr.eval(self.sums)

    def add(self, value: Lanes, cell: Lanes, lane: Lanes, active: Lanes) -> None:
        """Add value >= 0 to a cell of the batch of this lane."""
        index = (lane % self.batches) * self.cells + cell
        dr.scatter_add(self.sums, self.UInt64(value * FIXED_POINT + 0.5), index, active)

    def result(self) -> np.ndarray:
        """Sums as float64, shape (batches, cells)."""
        return self.sums.numpy().reshape(self.batches, self.cells).astype(np.float64) / FIXED_POINT


class RingTally(Tally):
    """Flux through rings of the plane between consecutive radii; cells (order, ring)."""

    def __init__(self, types: ModuleType, edges: np.ndarray) -> None:
        self.n: int = len(edges) - 1
        self.edges2: Lanes = aligned(types.Float, np.asarray(edges, dtype=np.float64) ** 2)
        self.cells: CellSums = CellSums(types, 2 * self.n)

    def boundary(self, sums: tuple[Lanes, ...], event: Boundary) -> tuple[Lanes, ...]:
        ring, inside = find_cell(self.edges2, event.x * event.x + event.y * event.y)
        cell = ring + (event.order > 1) * type(ring)(self.n)
        self.cells.add(event.weight, cell, event.lane, inside & (event.weight > 0))
        return sums


class LineTally(Tally):
    """Radiance of order >= 2 towards one outside direction, over cells of a sector about a line from the origin.
    Cells are ring segments between consecutive radii within `half_width` radians of the azimuth `line_phi`. Where the
    mirror y -> -y changes nothing (w_o in the plane of incidence) the mirrored sector counts too, where rotation
    changes nothing (both directions normal) the whole ring."""

    def __init__(
        self, types: ModuleType, angular: AngularTally, edges: np.ndarray, line_phi: float, half_width: float,
        symmetry: str,
    ) -> None:  # fmt: skip
        self.angular = angular
        self.symmetry = symmetry
        line = abs(math.remainder(line_phi, 2 * math.pi)) if symmetry == "mirror" else line_phi
        self.line: Lanes = dr.opaque(types.Float, line)
        self.half_width: Lanes = dr.opaque(types.Float, half_width)
        self.edges2: Lanes = aligned(types.Float, np.asarray(edges, dtype=np.float64) ** 2)
        self.cells: CellSums = CellSums(types, len(edges) - 1)
        low, high = max(line - half_width, 0.0), min(line + half_width, math.pi)
        self.angle: float = {"rotation": 2 * math.pi, "mirror": 2 * (high - low), "none": 2 * half_width}[symmetry]
        self.areas: np.ndarray = 0.5 * self.angle * np.diff(np.asarray(edges, dtype=np.float64) ** 2)

    def scatter(self, sums: tuple[Lanes, ...], event: Scatter) -> tuple[Lanes, ...]:
        ox, oy, mu, inverse_mu, scale = self.angular.constants[0]
        # connect the event with the surface along the refracted w_o: t = z / mu_o'
        t = event.z * inverse_mu
        x, y = event.x + t * ox, event.y + t * oy
        cell, active = find_cell(self.edges2, x * x + y * y)
        active &= event.order > 1
        # keep what lies in the sector |psi - line| < half width
        if self.symmetry != "rotation":
            psi = dr.atan2(dr.abs(y) if self.symmetry == "mirror" else y, x)
            off = psi - self.line
            off = dr.abs(off - 2 * math.pi * dr.round(off / (2 * math.pi)))
            active &= off < self.half_width
        cosine = event.dx * ox + event.dy * oy - event.dz * mu
        # score w p(d . d_o) exp(-t) / (eta² mu_o')
        score = event.weight * scale * eval_hg(cosine, self.angular.g) * dr.exp(-t)
        self.cells.add(score, cell, event.lane, active)
        return sums


def find_cell(edges: Lanes, value: Lanes) -> tuple[Lanes, Lanes]:
    """Index of the interval of an ascending Dr.Jit table that holds the value, and whether one does."""
    n = dr.width(edges)
    upper = dr.binary_search(0, n, lambda i: dr.gather(type(edges), edges, i) <= value)
    return dr.maximum(upper, 1) - 1, (upper > 0) & (upper < n)


ORDERS = ("single", "multiple", "total")
PATHS_PER_LANE, FEWEST_LANES, MAX_LANES = 64, 16384, 131072
# a GPU has events of 30 ps, so that what Python does for a pass wants passes of 2e9 walks
CUDA_PATHS_PER_LANE, CUDA_LANES = 8192, 2**18


class Estimate(NamedTuple):
    """A Monte Carlo number (or array) and its standard error.

    Sums, differences, products and ratios carry the error to first order, as of independent estimates:

        σ²(a ± b) = σ_a² + σ_b²,    σ²(a b) = (b σ_a)² + (a σ_b)²,    σ²(a / b) = (σ_a / b)² + (a σ_b / b²)².

    Those of one trace, as its orders, are not independent: ask for the total instead.
    """

    value: float | np.ndarray
    standard_error: float | np.ndarray

    def __add__(self, other: Estimate | float | np.ndarray) -> Estimate:
        b, error = _parts(other)
        return Estimate(self.value + b, np.hypot(self.standard_error, error))

    def __mul__(self, other: Estimate | float | np.ndarray) -> Estimate:
        b, error = _parts(other)
        return Estimate(self.value * b, np.hypot(b * self.standard_error, self.value * error))

    def __neg__(self) -> Estimate:
        return Estimate(-self.value, self.standard_error)

    def __sub__(self, other: Estimate | float | np.ndarray) -> Estimate:
        b, error = _parts(other)
        return self + Estimate(-b, error)

    def __rsub__(self, other: float | np.ndarray) -> Estimate:
        return -self + other

    def __truediv__(self, other: Estimate | float | np.ndarray) -> Estimate:
        b, error = _parts(other)
        return self * Estimate(1 / b, error / np.square(b))

    def __rtruediv__(self, other: float | np.ndarray) -> Estimate:
        return Estimate(other, 0.0) / self

    def __radd__(self, other: float | np.ndarray) -> Estimate:
        return self + other

    def __rmul__(self, other: float | np.ndarray) -> Estimate:
        return self * other

    __array_ufunc__ = None  # arrays of NumPy leave the operation to it


def _parts(other: Estimate | float | np.ndarray) -> tuple[float | np.ndarray, float | np.ndarray]:
    return other if isinstance(other, Estimate) else (other, 0.0)


def estimate(samples: np.ndarray) -> Estimate:
    """Mean over the first axis of independent samples, and its standard error."""
    n = len(samples)
    value, error = samples.mean(axis=0), samples.std(axis=0, ddof=1) / math.sqrt(n)
    return Estimate(float(value), float(error)) if samples.ndim == 1 else Estimate(value, error)


def is_certain(parts: np.ndarray, relative_error: float) -> bool:
    """Whether the sum of parts (samples, parts) is known to a relative standard error."""
    total = estimate(parts.sum(axis=1))
    return total.standard_error <= relative_error * total.value


def ratio_estimate(moment: np.ndarray, flux: np.ndarray, unit: float) -> Estimate:
    """The mean of a moment over that of the flux, of independent samples, times a unit; NaN without flux."""
    if not flux.mean() > 0:
        return Estimate(math.nan, math.nan)
    ratio = moment.mean() / flux.mean()
    error = (moment - ratio * flux).std(ddof=1) / (math.sqrt(len(flux)) * flux.mean())
    return Estimate(float(unit * ratio), float(unit * error))


def order_sum(order: str, single: np.ndarray, multiple: np.ndarray) -> np.ndarray:
    """What was recorded of an order, "single", "multiple" or their "total"."""
    check_choice("order", order, ORDERS)
    return {"single": single, "multiple": multiple, "total": single + multiple}[order]


def checked_radii(radii: Sequence[float] | None, mu_i: float | str) -> np.ndarray | None:
    """The edges of the rings as an array; ValueError if they are none or light is diffuse."""
    if radii is None:
        return None
    edges = check_edges("radii", radii)
    if mu_i == "diffuse":
        raise ValueError("radii must be None for diffuse light, which enters everywhere, got radii")
    return edges


def launch_shape(n_paths: int, cuda: bool = False) -> tuple[int, int, int]:
    """Lanes (whole batches), walks per lane and passes that together trace at least `n_paths` walks."""
    fewest, per_lane, most = (
        (CUDA_LANES, CUDA_PATHS_PER_LANE, CUDA_LANES) if cuda else (16384, PATHS_PER_LANE, MAX_LANES)
    )
    per_lane = int(np.clip(n_paths // fewest, 1, per_lane))
    lanes = min(BATCHES * math.ceil(n_paths / (per_lane * BATCHES)), most)
    return lanes, per_lane, math.ceil(n_paths / (lanes * per_lane))


@dataclass(frozen=True)
class Pass:
    """What one launch of the walk recorded, per incident flux: what enters is T_12 of it.
    `tallies`, `sums`: the tallies of this pass and their per-lane sums. `T_i`: transmittance T_12 of the beam of each
    lane. `per_lane`, `n_events`: walks of each lane, scattering events of all."""

    tallies: list[Tally]
    sums: tuple[tuple[Lanes, ...], ...]
    T_i: np.ndarray
    per_lane: int
    n_events: int

    @property
    def n_paths(self) -> int:
        """Walks of all lanes."""
        return len(self.T_i) * self.per_lane

    def lanes(self) -> np.ndarray:
        """Means of each lane, independent samples, for all per-lane sums in turn; shape (lanes, sums)."""
        columns = [column.numpy() for tally_sums in self.sums for column in tally_sums]
        return np.stack(columns, axis=1).astype(np.float64) * (self.T_i / self.per_lane)[:, None]

    def cells(self, sums: CellSums) -> np.ndarray:
        """Means of each batch of lanes, independent samples, of cells lit by one beam; shape (batches, cells)."""
        return sums.result() * (self.T_i[0] * sums.batches / self.n_paths)


def walk_passes(
    types: ModuleType,
    medium: Medium | Layers,
    mu_i: float | str,
    n_paths: int,
    seed: Sequence[int],
    tallies: Callable[[], list[Tally]],
    progress: Progress | None = None,
    trace: Callable[..., tuple[tuple[tuple[Lanes, ...], ...], Lanes]] = walk,
) -> Iterator[Pass]:
    """Trace at least `n_paths` walks, one pass after another for as long as passes are asked for.

    Args:
        types: Dr.Jit array module, from `backend.array_types`.
        medium: scalar medium, or what `trace` walks in.
        mu_i: cosine of incidence outside, [0, 1], or "diffuse".
        seed: whole numbers that name this run; each pass has a stream of its own.
        progress: called with (passes done, passes in all).
        trace: the walk in the medium, with the arguments of `walk`.
    """
    lanes, per_lane, passes = launch_shape(n_paths, dr.backend_v(types.Float) == dr.JitBackend.CUDA)
    for done in range(1, passes + 1):
        # outside cosine of each lane; diffuse light is stratified over lanes by its cosine
        u, recorded = np.random.default_rng([*seed, done]).random(lanes), tallies()
        mu = np.sqrt((np.arange(lanes) + u) / lanes) if mu_i == "diffuse" else np.full(lanes, float(mu_i))
        mu_in = aligned(types.Float, mu_internal(mu, medium.eta))
        sums, events = trace(types, medium, mu_in, per_lane, pass_seed(*seed, done), recorded)
        if progress:
            progress(done, passes)
        yield Pass(recorded, sums, F_t(mu, medium.eta), per_lane, int(events.numpy().astype(np.int64).sum()))
