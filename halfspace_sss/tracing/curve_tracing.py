"""Path-traced radiance along a line of the plane, for fixed directions of entry and exit."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from halfspace_sss.backend import array_types
from halfspace_sss.checks import check_cosine, check_count, check_edges, check_finite, check_interval
from halfspace_sss.physics.fresnel import F_t
from halfspace_sss.physics.medium import Medium, check_scalar_medium
from halfspace_sss.progress import Progress
from halfspace_sss.tracing.passes import estimate, walk_passes
from halfspace_sss.tracing.tallies import AngularTally, LineTally
from halfspace_sss.tracing.walk import Tally

__all__ = ["CurveTrace", "trace_curve"]


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
    mu_i, mu_o = check_cosine("mu_i", mu_i), check_cosine("mu_o", mu_o)
    check_finite("delta_phi", delta_phi)
    check_finite("line_phi", line_phi)
    check_interval("half_width", half_width, 1e-6, math.pi)
    check_count("n_paths", n_paths, 256)
    check_count("seed", seed, 0)
    edges = check_edges("r_edges", r_edges)
    types, started = array_types(backend), time.perf_counter()
    symmetry = _symmetry(mu_i, mu_o, delta_phi)

    def tallies() -> list[Tally]:
        angular = AngularTally(types, medium.g, medium.eta, np.array([mu_o]), np.array([delta_phi]))
        return [LineTally(types, angular, edges * medium.sigma_t, line_phi, half_width, symmetry)]

    samples, events, paths = [], 0, 0
    for done in walk_passes(types, medium, mu_i, n_paths, (seed,), tallies, progress):
        line = done.tallies[0]
        samples.append(done.cells(line.cells) / line.areas)
        events, paths = events + done.n_events, paths + done.n_paths
    S, error = estimate(np.concatenate(samples) * (medium.sigma_t**2 * F_t(float(mu_o), medium.eta)))
    r = np.sqrt(np.maximum(edges[:-1], 1e-3 * edges[1:]) * edges[1:])
    return CurveTrace(r, edges, S, error, paths, events, time.perf_counter() - started)


def _symmetry(mu_i: float, mu_o: float, delta_phi: float) -> str:
    """Which motions of the plane leave both directions as they are."""
    if mu_i == 1 and mu_o == 1:
        return "rotation"
    in_plane = abs(math.sin(delta_phi)) < 1e-9 or mu_o == 1
    return "mirror" if in_plane else "none"
