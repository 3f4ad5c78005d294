"""Path-traced ground truth of a half-space: reflectance, moments, profiles and radiance curves, with their errors."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from halfspace_sss.backend import array_types
from halfspace_sss.checks import check_count, check_finite, check_interval, check_scalar_medium
from halfspace_sss.fresnel import F_t, mu_internal
from halfspace_sss.medium import Medium
from halfspace_sss.tallies import AngularTally, FluxTally, LineTally, MomentTally, RingTally
from halfspace_sss.walk import Tally, pass_seed, walk

__all__ = ["ORDERS", "CurveTrace", "Estimate", "Trace", "launch_shape", "trace", "trace_curve"]

ORDERS = ("single", "multiple", "total")
PATHS_PER_LANE, MAX_LANES = 64, 131072
Progress = Callable[[int, int], None]  # passes done, passes in all


class Estimate(NamedTuple):
    """A Monte Carlo number (or array) and its standard error."""

    value: Any
    standard_error: Any


def launch_shape(n_paths: int) -> tuple[int, int, int]:
    """Lanes, walks per lane and passes that together trace at least `n_paths` walks."""
    per_lane = int(np.clip(n_paths // 16384, 1, PATHS_PER_LANE))
    lanes = min(math.ceil(n_paths / per_lane), MAX_LANES)
    return lanes, per_lane, math.ceil(n_paths / (lanes * per_lane))


def _order_sum(order: str, single: np.ndarray, multiple: np.ndarray) -> np.ndarray:
    if order not in ORDERS:
        raise ValueError(f"order must be one of {', '.join(ORDERS)}, got {order!r}")
    return {"single": single, "multiple": multiple, "total": single + multiple}[order]


def _estimate(samples: np.ndarray) -> Estimate:
    """Mean over the first axis of independent samples, and its standard error."""
    n = len(samples)
    value, error = samples.mean(axis=0), samples.std(axis=0, ddof=1) / math.sqrt(n)
    return Estimate(float(value), float(error)) if samples.ndim == 1 else Estimate(value, error)


@dataclass(frozen=True)
class Trace:
    """What `trace` measured; every method returns an `Estimate` (value, standard_error) by scattering order.

    Attributes:
        medium, mu_i, seed, backend: what was asked.
        n_paths: walks traced, the asked number rounded up to whole lanes.
        n_events: scattering events.
        seconds: wall time, compilation included.
    """

    medium: Medium
    mu_i: float | str
    seed: int
    backend: str
    n_paths: int
    n_events: int
    seconds: float
    _lanes: np.ndarray  # (lanes, sums), T_12 included
    _rings: np.ndarray | None
    _n_directions: int
    _T_o: np.ndarray | None

    def _pair(self, single: int) -> tuple[np.ndarray, np.ndarray]:
        return self._lanes[:, single], self._lanes[:, single + 1]

    def reflectance(self, order: str = "total") -> Estimate:
        """Fraction of incident flux that leaves the medium after `order` scattering; surface reflection excluded."""
        return _estimate(_order_sum(order, *self._pair(0)))

    def _ratio(self, order: str, column: int, unit: float) -> Estimate:
        flux = _order_sum(order, *self._pair(0))
        moment = _order_sum(order, *self._pair(column))
        if not flux.mean() > 0:
            return Estimate(math.nan, math.nan)
        ratio = moment.mean() / flux.mean()
        error = (moment - ratio * flux).std(ddof=1) / (math.sqrt(len(flux)) * flux.mean())
        return Estimate(float(unit * ratio), float(unit * error))

    def mean_r2(self, order: str = "total") -> Estimate:
        """Mean squared distance between entry and exit, weighted by exitant flux, mm²."""
        return self._ratio(order, 2, self.medium.mfp**2)

    def mean_x(self, order: str = "total") -> Estimate:
        """Mean displacement in the forward direction of the plane of incidence, mm."""
        return self._ratio(order, 4, self.medium.mfp)

    def mean_path_length(self, order: str = "total") -> Estimate:
        """Mean path length inside the medium of the light that leaves, mm."""
        return self._ratio(order, 6, self.medium.mfp)

    def angular_reflectance(self, order: str = "total") -> Estimate:
        """∫ S dA towards each of `directions`, 1/sr: the BRDF of the uniformly lit half-space."""
        if self._T_o is None:
            raise ValueError("directions must be given to trace() for angular_reflectance, got None")
        pairs = self._lanes[:, 8:].reshape(len(self._lanes), self._n_directions, 2)
        return _estimate(_order_sum(order, pairs[..., 0], pairs[..., 1]) * self._T_o)

    def exitance(self, order: str = "total") -> Estimate:
        """Mean exitance over each ring between consecutive `radii`, 1/mm² per incident flux."""
        if self._rings is None:
            raise ValueError("radii must be given to trace() for exitance, got None")
        return _estimate(_order_sum(order, self._rings[:, 0], self._rings[:, 1]))


def _incidence(mu_i: float | str, eta: float, lanes: int, rng: np.random.Generator) -> np.ndarray:
    """Outside cosine of each lane; diffuse light is stratified over lanes by its cosine."""
    if mu_i == "diffuse":
        return np.sqrt((np.arange(lanes) + rng.random(lanes)) / lanes)
    return np.full(lanes, float(mu_i))


def trace(
    medium: Medium,
    mu_i: float | str = 1.0,
    n_paths: int = 1_000_000,
    seed: int = 0,
    *,
    directions: Sequence[tuple[float, float]] | None = None,
    radii: Sequence[float] | None = None,
    backend: str = "llvm",
    relative_error: float | None = None,
    progress: Progress | None = None,
) -> Trace:
    """Trace walks of a beam in a half-space and return what leaves it, by scattering order.

    Args:
        medium: scalar medium (take `medium.channel(k)` of a coloured one).
        mu_i: cosine of incidence outside, [0, 1], or "diffuse" for uniform radiance from above.
        n_paths: number of walks, at least 256; rounded up to whole lanes.
        seed: results repeat for the same seed, backend and version.
        directions: pairs (mu_o, delta_phi) for `angular_reflectance`; delta_phi = 0 is forward, the far
            side; not for diffuse light.
        radii: edges in mm of the rings for `exitance`, ascending.
        backend: "llvm" or "cuda".
        relative_error: stop early, at a pass of up to 8.4 million walks, once the standard error of the total
            reflectance has come down to this fraction of it.
        progress: called with (passes done, passes in all).

    Raises:
        ValueError: an argument is out of range; nothing has been traced then.
    """
    check_scalar_medium(medium)
    check_count("n_paths", n_paths, 256)
    check_count("seed", seed, 0)
    if mu_i != "diffuse":
        check_interval("mu_i", mu_i, 0.0, 1.0)
    if relative_error is not None:
        check_interval("relative_error", relative_error, 0.0, 1.0)
    edges = _checked_radii(radii, mu_i)
    pairs = _checked_directions(directions, mu_i)
    types, started = array_types(backend), time.perf_counter()
    lanes, per_lane, passes = launch_shape(n_paths)
    rows: list[np.ndarray] = []
    rings: list[np.ndarray] = []
    events = done = 0
    for done in range(1, passes + 1):
        tallies: list[Tally] = [FluxTally(types), MomentTally(types)]
        if pairs is not None:
            tallies.append(AngularTally(types, medium.g, medium.eta, *pairs.T))
        if edges is not None:
            tallies.append(RingTally(types, edges * medium.sigma_t))
        mu = _incidence(mu_i, medium.eta, lanes, np.random.default_rng([seed, done]))
        T_i = F_t(mu, medium.eta)
        mu_in = types.Float(np.maximum(mu_internal(mu, medium.eta), 1e-6))
        sums, n = walk(types, medium, mu_in, per_lane, pass_seed(seed, done), tallies)
        columns = [column.numpy() for tally_sums in sums for column in tally_sums]
        rows.append(np.stack(columns, axis=1).astype(np.float64) * (T_i / per_lane)[:, None])
        if edges is not None:
            cells = tallies[-1].cells.result().reshape(-1, 2, len(edges) - 1)
            rings.append(cells * T_i[0] * _batch_scale(cells, lanes, per_lane))
        events += int(n.numpy().astype(np.int64).sum())
        if progress:
            progress(done, passes)
        if relative_error and _estimate(np.concatenate(rows)[:, :2].sum(axis=1)).standard_error <= (
            relative_error * np.concatenate(rows)[:, :2].sum(axis=1).mean()
        ):
            break
    area = None if edges is None else np.pi * np.diff(edges**2)
    return Trace(
        medium, mu_i, seed, backend, done * lanes * per_lane, events, time.perf_counter() - started,
        np.concatenate(rows), None if edges is None else np.concatenate(rings) / area,
        0 if pairs is None else len(pairs), None if pairs is None else F_t(pairs[:, 0], medium.eta),
    )  # fmt: skip


def _batch_scale(cells: np.ndarray, lanes: int, per_lane: int) -> np.ndarray:
    """One over the walks of each batch (batches differ by a lane where their number does not divide the lanes)."""
    batches = len(cells)
    walks = per_lane * (lanes // batches + (np.arange(batches) < lanes % batches))
    return (1 / walks).reshape(-1, *[1] * (cells.ndim - 1))


def _checked_radii(radii: Sequence[float] | None, mu_i: float | str) -> np.ndarray | None:
    if radii is None:
        return None
    edges = np.asarray(radii, dtype=np.float64)
    if (
        edges.ndim != 1
        or len(edges) < 2
        or not np.all(np.isfinite(edges))
        or edges[0] < 0
        or np.any(np.diff(edges) <= 0)
    ):
        raise ValueError(f"radii must be two or more finite, ascending lengths >= 0 in mm, got {radii!r}")
    if mu_i == "diffuse":
        raise ValueError("radii must be None for diffuse light, which enters everywhere, got radii")
    return edges


def _checked_directions(directions: Sequence[tuple[float, float]] | None, mu_i: float | str) -> np.ndarray | None:
    if directions is None:
        return None
    if mu_i == "diffuse":
        raise ValueError("directions must be None for diffuse light, which has no forward direction, got directions")
    pairs = np.asarray(directions, dtype=np.float64)
    if pairs.ndim != 2 or pairs.shape[1] != 2 or len(pairs) == 0:
        raise ValueError(f"directions must be a list of pairs (mu_o, delta_phi), got shape {pairs.shape}")
    for mu_o, delta_phi in pairs:
        check_interval("mu_o", mu_o, 0.0, 1.0)
        check_finite("delta_phi", delta_phi)
    return pairs


@dataclass(frozen=True)
class CurveTrace:
    """Radiance along a line: r (mm, geometric middle of each cell), S of order >= 2 in 1/(mm² sr), its error."""

    r: np.ndarray
    r_edges: np.ndarray
    S: np.ndarray
    standard_error: np.ndarray
    n_paths: int
    n_events: int
    seconds: float


def trace_curve(
    medium: Medium,
    mu_i: float,
    mu_o: float,
    delta_phi: float,
    line_phi: float,
    r_edges: Sequence[float],
    half_width: float = 0.13,
    n_paths: int = 4_000_000,
    seed: int = 0,
    backend: str = "llvm",
    progress: Progress | None = None,
) -> CurveTrace:
    """Path-traced S of order >= 2 along a line through the entry point, for fixed directions.

    Each value is the mean over a cell: r between consecutive edges, azimuth within `half_width` of the line.
    In the terms of a query, phi_i = pi - line_phi and phi_o = delta_phi - line_phi. The single order is left
    out: for a pencil beam it is a distribution on the line where the two refracted rays meet.

    Args:
        medium: scalar medium.
        mu_i, mu_o: outside cosines, [0, 1].
        delta_phi: azimuth of w_o from the forward direction of the plane of incidence (0 = far side), radians.
        line_phi: azimuth of x_o - x_i from the forward direction (pi/2 = perpendicular), radians.
        r_edges: cell edges in mm, ascending.
        half_width: half the angle of the sector averaged over, radians, (0, pi].
        n_paths, seed, backend, progress: as in `trace`.

    Raises:
        ValueError: an argument is out of range.
    """
    check_scalar_medium(medium)
    check_interval("mu_i", mu_i, 0.0, 1.0)
    check_interval("mu_o", mu_o, 0.0, 1.0)
    check_finite("delta_phi", delta_phi)
    check_finite("line_phi", line_phi)
    check_interval("half_width", half_width, 1e-6, math.pi)
    check_count("n_paths", n_paths, 256)
    check_count("seed", seed, 0)
    edges = _checked_radii(r_edges, mu_i)
    types, started = array_types(backend), time.perf_counter()
    lanes, per_lane, passes = launch_shape(n_paths)
    mu_in = max(float(mu_internal(mu_i, medium.eta)), 1e-6)
    symmetry = _symmetry(mu_i, mu_o, delta_phi)
    samples, events = [], 0
    for done in range(1, passes + 1):
        angular = AngularTally(types, medium.g, medium.eta, np.array([mu_o]), np.array([delta_phi]))
        line = LineTally(types, angular, edges * medium.sigma_t, line_phi, half_width, symmetry)
        start = types.Float(np.full(lanes, mu_in))
        _, n = walk(types, medium, start, per_lane, pass_seed(seed, done), [line])
        cells = line.cells.result()
        samples.append(cells * _batch_scale(cells, lanes, per_lane) / line.areas)
        events += int(n.numpy().astype(np.int64).sum())
        if progress:
            progress(done, passes)
    scale = medium.sigma_t**2 * F_t(float(mu_i), medium.eta) * F_t(float(mu_o), medium.eta)
    S, error = _estimate(np.concatenate(samples) * scale)
    r = np.sqrt(np.maximum(edges[:-1], 1e-3 * edges[1:]) * edges[1:])
    return CurveTrace(r, edges, S, error, passes * lanes * per_lane, events, time.perf_counter() - started)


def _symmetry(mu_i: float, mu_o: float, delta_phi: float) -> str:
    """Which motions of the plane leave both directions as they are."""
    if mu_i == 1 and mu_o == 1:
        return "rotation"
    in_plane = abs(math.sin(delta_phi)) < 1e-9 or mu_o == 1
    return "mirror" if in_plane else "none"
