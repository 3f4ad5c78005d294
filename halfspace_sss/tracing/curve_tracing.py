"""Path-traced radiance along a line of the plane, for fixed directions of entry and exit."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass

import numpy as np

from halfspace_sss.backend import array_types
from halfspace_sss.checks import check_cosine, check_edges, check_finite, check_interval
from halfspace_sss.physics.fresnel import F_t
from halfspace_sss.physics.medium import Medium, check_scalar_medium
from halfspace_sss.progress import Progress
from halfspace_sss.tracing.passes import Estimate, estimate, order_sum, walk_passes
from halfspace_sss.tracing.tallies import AngularTally, FluxTally, LineTally
from halfspace_sss.tracing.walk import Tally

__all__ = ["CurveTrace", "Line", "trace_curve"]


@dataclass(frozen=True, eq=False)
class Line:
    """Cells along a line through the entry point, and the direction in which they are seen.

    In the terms of a query, phi_i = pi - phi and phi_o = delta_phi - phi.

    Args:
        r_edges: cell edges in mm, ascending.
        mu_o: outside cosine of observation, [0, 1].
        delta_phi: azimuth of w_o from the forward direction of the plane of incidence (0 = far side), radians.
        phi: azimuth of x_o - x_i from the forward direction (pi/2 = perpendicular), radians.
        half_width: half the angle of the sector that a cell spans, radians, (0, pi].

    Raises:
        ValueError: an argument is out of range.
    """

    r_edges: np.ndarray
    mu_o: float = 1.0
    delta_phi: float = 0.0
    phi: float = math.pi / 2
    half_width: float = 0.13

    def __post_init__(self) -> None:
        check_finite("delta_phi", self.delta_phi)
        check_finite("phi", self.phi)
        check_interval("half_width", self.half_width, 1e-6, math.pi)
        object.__setattr__(self, "mu_o", check_cosine("mu_o", self.mu_o))
        object.__setattr__(self, "r_edges", check_edges("r_edges", self.r_edges))


@dataclass(frozen=True)
class CurveTrace:
    """Radiance along a line: S of order >= 2 in 1/(mm² sr) and its standard error, and the flux of the same walks."""

    S: np.ndarray
    standard_error: np.ndarray
    n_paths: int
    n_events: int
    seconds: float
    _lanes: np.ndarray  # flux of the single order and the others, T_12 included

    def reflectance(self, order: str = "total") -> Estimate:
        """As `Trace.reflectance`."""
        return estimate(order_sum(order, *self._lanes.T))


def trace_curve(
    medium: Medium,
    mu_i: float,
    line: Line,
    n_paths: int = 4_000_000,
    seed: int = 0,
    backend: str = "llvm",
    progress: Progress | None = None,
) -> CurveTrace:
    """Path-traced S of order >= 2 along a line through the entry point, for fixed directions.

    Each value is the mean over a cell: r between consecutive edges, azimuth within `half_width` of the line. The single
    order is left out: for a pencil beam it is a distribution on the line where the two refracted rays meet.

    Args:
        medium: scalar medium.
        mu_i: outside cosine, [0, 1].
        line: cells and direction of observation.
        n_paths, seed, backend, progress: as in `trace`.

    Raises:
        ValueError: an argument is out of range.
    """
    check_scalar_medium(medium)
    mu_i = check_cosine("mu_i", mu_i)
    types, started = array_types(backend), time.perf_counter()
    symmetry = _symmetry(mu_i, line.mu_o, line.delta_phi)

    def tallies() -> list[Tally]:
        angular = AngularTally(types, medium.g, medium.eta, np.array([line.mu_o]), np.array([line.delta_phi]))
        edges = line.r_edges * medium.sigma_t
        return [FluxTally(types), LineTally(types, angular, edges, line.phi, line.half_width, symmetry)]

    samples, lanes, events, paths = [], [], 0, 0
    for done in walk_passes(types, medium, mu_i, n_paths, (seed,), tallies, progress):
        cells = done.tallies[1]
        samples.append(done.cells(cells.cells) / cells.areas)
        lanes.append(done.lanes())
        events, paths = events + done.n_events, paths + done.n_paths
    S, error = estimate(np.concatenate(samples) * (medium.sigma_t**2 * F_t(line.mu_o, medium.eta)))
    return CurveTrace(S, error, paths, events, time.perf_counter() - started, np.concatenate(lanes))


def _symmetry(mu_i: float, mu_o: float, delta_phi: float) -> str:
    """Which motions of the plane leave both directions as they are."""
    if mu_i == 1 and mu_o == 1:
        return "rotation"
    in_plane = abs(math.sin(delta_phi)) < 1e-9 or mu_o == 1
    return "mirror" if in_plane else "none"
