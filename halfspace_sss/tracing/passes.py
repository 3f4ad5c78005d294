"""A beam on a half-space, walked pass by pass: the loop behind every traced quantity, and its estimates."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from types import ModuleType
from typing import NamedTuple

import numpy as np

from halfspace_sss.checks import check_choice, check_edges
from halfspace_sss.physics.fresnel import F_t, mu_internal
from halfspace_sss.physics.layers import Layers
from halfspace_sss.physics.medium import Medium
from halfspace_sss.progress import Progress
from halfspace_sss.tracing.tallies import BATCHES, CellSums
from halfspace_sss.tracing.walk import Tally, pass_seed, walk

ORDERS = ("single", "multiple", "total")
PATHS_PER_LANE, MAX_LANES = 64, 131072


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

    __radd__, __rmul__, __array_ufunc__ = __add__, __mul__, None  # arrays of NumPy leave the operation to it


def _parts(other: Estimate | float | np.ndarray) -> tuple[float | np.ndarray, float | np.ndarray]:
    return other if isinstance(other, Estimate) else (other, 0.0)


def estimate(samples: np.ndarray) -> Estimate:
    """Mean over the first axis of independent samples, and its standard error."""
    n = len(samples)
    value, error = samples.mean(axis=0), samples.std(axis=0, ddof=1) / math.sqrt(n)
    return Estimate(float(value), float(error)) if samples.ndim == 1 else Estimate(value, error)


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


def launch_shape(n_paths: int) -> tuple[int, int, int]:
    """Lanes (whole batches), walks per lane and passes that together trace at least `n_paths` walks."""
    per_lane = int(np.clip(n_paths // 16384, 1, PATHS_PER_LANE))
    lanes = min(BATCHES * math.ceil(n_paths / (per_lane * BATCHES)), MAX_LANES)
    return lanes, per_lane, math.ceil(n_paths / (lanes * per_lane))


@dataclass(frozen=True)
class Pass:
    """What one launch of the walk recorded, per incident flux: what enters is T_12 of it.

    Attributes:
        tallies, sums: the tallies of this pass and their per-lane sums.
        T_i: transmittance T_12 of the beam of each lane.
        per_lane, n_events: walks of each lane, scattering events of all.
    """

    tallies: list[Tally]
    sums: tuple
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


def _incidence(mu_i: float | str, lanes: int, rng: np.random.Generator) -> np.ndarray:
    """Outside cosine of each lane; diffuse light is stratified over lanes by its cosine."""
    if mu_i == "diffuse":
        return np.sqrt((np.arange(lanes) + rng.random(lanes)) / lanes)
    return np.full(lanes, float(mu_i))


def walk_passes(
    types: ModuleType,
    medium: Medium | Layers,
    mu_i: float | str,
    n_paths: int,
    seed: Sequence[int],
    tallies: Callable[[], list[Tally]],
    progress: Progress | None = None,
    trace: Callable[..., tuple] = walk,
) -> Iterator[Pass]:
    """Trace at least `n_paths` walks, one pass after another for as long as passes are asked for.

    Args:
        types: Dr.Jit array module, from `backend.array_types`.
        medium: scalar medium, or what `trace` walks in.
        mu_i: cosine of incidence outside, [0, 1], or "diffuse".
        seed: whole numbers that name this run; each pass has a stream of its own.
        tallies: makes the tallies of a pass.
        progress: called with (passes done, passes in all).
        trace: the walk in the medium, with the arguments of `walk`.
    """
    lanes, per_lane, passes = launch_shape(n_paths)
    for done in range(1, passes + 1):
        mu, recorded = _incidence(mu_i, lanes, np.random.default_rng([*seed, done])), tallies()
        mu_in = types.Float(mu_internal(mu, medium.eta))
        sums, events = trace(types, medium, mu_in, per_lane, pass_seed(*seed, done), recorded)
        if progress:
            progress(done, passes)
        yield Pass(recorded, sums, F_t(mu, medium.eta), per_lane, int(events.numpy().astype(np.int64).sum()))
