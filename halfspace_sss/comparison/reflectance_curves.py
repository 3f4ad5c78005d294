"""S along a line through the entry point, path traced and by every model: the comparison of the paper's Fig. 10."""

from __future__ import annotations

import itertools
import math
import numbers
import time
from collections.abc import Sequence

import numpy as np

from halfspace_sss.backend import array_types
from halfspace_sss.checks import as_count, check_count, check_interval
from halfspace_sss.comparison.curve_set import TRACED, Curve, CurveSet
from halfspace_sss.comparison.sampled_exits import sampled_reflectance
from halfspace_sss.interface.model import BSSRDF
from halfspace_sss.materials import Material
from halfspace_sss.materials.catalogue import one_channel
from halfspace_sss.physics import single_scattering
from halfspace_sss.physics.fresnel import mu_internal
from halfspace_sss.physics.medium import Medium
from halfspace_sss.progress import Progress
from halfspace_sss.registry import bssrdf
from halfspace_sss.registry import models as all_models
from halfspace_sss.tracing.passes import launch_shape
from halfspace_sss.tracing.tracer import Line, trace, trace_curve

FIG10_THETA_I = (0.0, 30.0, 60.0, 75.0)
REFLECTANCE_POINTS = 2**12
MOST_MFP = 100.0  # transport mean free paths, end of the range where nothing is absorbed
EVENTS = 360_000_000  # scattering events, those of 64 million walks in the medium of Fig. 10
FEWEST, MOST, PILOT = 250_000, 64_000_000, 4096  # walks


def default_range(medium: Medium) -> tuple[float, float]:
    """Distances (mm) of a curve: 0.012 to 6 transport mean free paths, or to 4/sigma_tr if light gets farther.
    sigma_tr = sqrt(3 sigma_a sigma_t'), at most 100 transport mean free paths; two digits. Fig. 10: 0.05 to 25 mm."""
    mfp, sigma_tr = 1 / medium.sigma_t_prime, math.sqrt(3 * medium.sigma_a * medium.sigma_t_prime)
    far = max(6.025 * mfp, min(4 / max(sigma_tr, 1e-300), MOST_MFP * mfp))
    return float(f"{0.01205 * mfp:.2g}"), float(f"{far:.2g}")


def default_paths(medium: Medium, backend: str = "llvm") -> int:
    """Walks that take about as long in any medium: 64 million in Fig. 10, fewer where a walk is longer.
    Events per walk are counted in 4096 walks at normal incidence; at least 250 000 walks, two digits."""
    pilot = trace(medium, n_paths=PILOT, seed=0, backend=backend)
    paths = EVENTS * pilot.n_paths / max(pilot.n_events, 1)
    return int(min(max(float(f"{paths:.2g}"), FEWEST), MOST))


def _cell_mean(line: Line, model: BSSRDF, mu_i: float) -> np.ndarray:
    """S of a model as a mean over each cell, which is what the tracer measures: 4 x 5 Gauss nodes."""
    x, w = np.polynomial.legendre.leggauss(4)
    y, v = np.polynomial.legendre.leggauss(5)
    low, high = line.r_edges[:-1, None], line.r_edges[1:, None]
    r = 0.5 * (low + high) + 0.5 * (high - low) * x
    w_r = w * r / (w * r).sum(axis=1, keepdims=True)
    S = _S(line, model, r[..., None], mu_i, line.phi + line.half_width * y)
    return np.einsum("krs,kr,s->k", S, w_r, 0.5 * v)


def _S(line: Line, model: BSSRDF, r: np.ndarray, mu_i: float, psi: np.ndarray | float) -> np.ndarray:
    """The query for a line at azimuth psi from the forward direction: w_i lies at pi, w_o at delta_phi."""
    return np.asarray(model.eval(r, mu_i, math.pi - psi, line.mu_o, line.delta_phi - psi), dtype=np.float64)


def _meets_single_order(line: Line, theta_i: float, eta: float) -> bool:
    """Whether the cells hold points where the two refracted rays meet, which carry the single order."""
    tan_i, tan_o = (_tan_inside(mu, eta) for mu in (math.cos(theta_i), line.mu_o))
    x, y = tan_i + tan_o * math.cos(line.delta_phi), tan_o * math.sin(line.delta_phi)
    if math.hypot(x, y) < 1e-9:
        return False  # they meet at the entry point alone
    gap = math.remainder(math.atan2(y, x) - line.phi, 2 * math.pi)
    return abs(gap) <= line.half_width


def _tan_inside(mu_outside: float, eta: float) -> float:
    mu = float(mu_internal(mu_outside, eta))
    return math.sqrt((1 - mu) * (1 + mu)) / max(mu, 1e-12)


def curves(
    medium: Medium | Material | str = "fig10",
    *,
    channel: int | str | None = None,
    theta_i_deg: Sequence[float] = FIG10_THETA_I,
    theta_o_deg: float = 0.0,
    delta_phi_deg: float = 0.0,
    line_deg: float = 90.0,
    r_min: float | None = None,
    r_max: float | None = None,
    n_r: int = 36,
    half_width: float = 0.13,
    models: Sequence[str | BSSRDF] | None = None,
    orders: str = "multiple",
    n_paths: int | None = None,
    seed: int = 0,
    backend: str = "llvm",
    progress: Progress | None = None,
) -> CurveSet:
    """S along a line through the entry point, path traced with its standard error and by analytic or other models.

    Both are means over the same cells: r between edges spaced evenly in ln r, azimuth within `half_width` of the
    line (and its mirror image, where that is the same). Without arguments: the setting of Fig. 10.

    Args:
        medium: a Medium, a Material, or the name of one.
        channel: which channel of a coloured medium, number or name; the first by default.
        theta_i_deg: angles of incidence outside, degrees, [0, 90).
        theta_o_deg, delta_phi_deg: angle of observation outside, [0, 90), and azimuth of w_o from the forward direction
            of the plane of incidence (0 = the far side), degrees.
        line_deg: azimuth of x_o - x_i from the forward direction, degrees; 90 is perpendicular.
        r_min, r_max: smallest and largest r in mm; by default those of `default_range(medium)`.
        n_r: number of cells, 2 to 1000.
        half_width: half the angle of a cell, radians.
        models: names or models of this medium; by default all, less those that refuse the medium (see `notes`).
        orders: "multiple" compares reflectances at the orders that each model contains; "total" adds the exact single
            order to models that leave it out. The curve is the same, since the single order has no radiance off the
            line where the two refracted rays meet; on that line "total" is refused.
        n_paths: walks for each angle of incidence; by default `default_paths(medium)`. 0 leaves out the path-traced
            curve, and with it errors.
        seed, backend: as in `halfspace_sss.trace`; the same seed gives the same result.
        progress: called with (steps done, steps in all).

    Raises:
        ValueError: an argument is out of range; nothing has been traced then.

    Source: the paper's Fig. 10 (Neural SSS, EGSR 2024).
    """
    title, medium = one_channel(medium, channel)
    angles = _checked_angles(theta_i_deg, theta_o_deg, delta_phi_deg, line_deg)
    check_count("n_r", n_r, 2)
    if n_paths not in (None, 0):
        n_paths = as_count("n_paths", n_paths, 256)
    check_count("seed", seed, 0)
    array_types(backend)
    edges = np.geomspace(*_checked_range(r_min, r_max, medium), n_r + 1)
    theta_o, delta_phi, phi = (math.radians(a) for a in (theta_o_deg, delta_phi_deg, line_deg))
    line = Line(edges, math.cos(theta_o), delta_phi, phi, half_width)
    _check_orders(orders, line, angles, medium.eta)
    chosen, notes = _chosen_models(models, medium)
    n_paths = default_paths(medium, backend) if n_paths is None else n_paths
    passes = launch_shape(n_paths, backend == "cuda")[2] if n_paths else 0
    total, done = len(angles) * (passes + len(chosen)) + len(chosen), itertools.count()

    def advance(*_: int) -> None:
        if progress:
            progress(next(done), total)

    advance()
    results, walks, seconds = [], 0, 0.0
    for k, theta in enumerate(angles):
        if n_paths:
            traced = trace_curve(medium, math.cos(math.radians(theta)), line, n_paths, seed + k, backend, advance)
            walks, seconds = traced.n_paths, seconds + traced.seconds
            R = {order: tuple(traced.reflectance(order)) for order in ("multiple", "total")}
            results.append(Curve(TRACED, "multiple", theta, traced.S, traced.S, traced.standard_error, R))
        for model in chosen:
            results.append(_modelled(model, theta, line, orders))
            advance()
    speeds = {}
    for model in chosen:
        speeds[model.name] = evaluations_per_s(model, *line.r_edges[[0, -1]])
        advance()
    return CurveSet(
        title=title, medium=medium, theta_o_deg=float(theta_o_deg), delta_phi_deg=float(delta_phi_deg),
        line_deg=float(line_deg), half_width=half_width, orders=orders, r_edges=line.r_edges, curves=tuple(results),
        evaluations_per_s=speeds, n_paths=walks, seed=seed, backend=backend, seconds=seconds, notes=notes,
    )  # fmt: skip


def _modelled(model: BSSRDF, theta_deg: float, line: Line, orders: str) -> Curve:
    mu_i = math.cos(math.radians(theta_deg))
    order = "total" if orders == "total" else model.orders
    R, error = sampled_reflectance(model, mu_i, points=REFLECTANCE_POINTS)
    if order != model.orders:
        R += float(single_scattering.reflectance(model.medium, mu_i))
    middle = np.sqrt(line.r_edges[:-1] * line.r_edges[1:])
    S, S_at_r = _cell_mean(line, model, mu_i), _S(line, model, middle, mu_i, line.phi)
    return Curve(model.name, model.orders, theta_deg, S, S_at_r, np.zeros_like(S), {order: (R, error)})


def evaluations_per_s(model: BSSRDF, low: float, high: float, n: int = 4096, least_seconds: float = 0.1) -> float:
    """Evaluations of S per second in batches of n, NumPy, float64, at random queries with r from low to high."""
    rng = np.random.default_rng(0)
    r = np.exp(rng.uniform(*np.log((low, high)), n))
    query = (r, rng.random(n), rng.uniform(-math.pi, math.pi, n), rng.random(n), rng.uniform(-math.pi, math.pi, n))
    model.eval(*query)
    done, started = 0, time.perf_counter()
    while (elapsed := time.perf_counter() - started) < least_seconds:
        model.eval(*query)
        done += n
    return done / elapsed


def _checked_angles(theta_i_deg: Sequence[float], theta_o: float, delta_phi: float, line: float) -> list[float]:
    angles = np.atleast_1d(np.asarray(theta_i_deg, dtype=object)).tolist()
    if not angles:
        raise ValueError("theta_i_deg must hold at least one angle, got none")
    for name, value in (*(("theta_i_deg", a) for a in angles), ("theta_o_deg", theta_o)):
        if isinstance(value, bool) or not isinstance(value, numbers.Real) or not 0 <= value < 90:
            raise ValueError(f"{name} must be a number in [0, 90) degrees, got {value!r}")
    for name, value in (("delta_phi_deg", delta_phi), ("line_deg", line)):
        check_interval(name, value, -360.0, 360.0)
    if len(set(angles)) < len(angles):
        raise ValueError(f"theta_i_deg must be different angles, got {angles!r}")
    return [float(a) for a in angles]


def _checked_range(r_min: float | None, r_max: float | None, medium: Medium) -> tuple[float, float]:
    for name, value in (("r_min", r_min), ("r_max", r_max)):
        if value is not None:
            check_interval(name, value, 1e-12, 1e12)
    low, high = (end if given is None else float(given) for given, end in zip((r_min, r_max), default_range(medium)))
    if not low < high:
        raise ValueError(f"r_min must be < r_max = {high:g} mm, got {low!r}")
    return low, high


def _check_orders(orders: str, line: Line, angles: list[float], eta: float) -> None:
    if orders not in ("multiple", "total"):
        raise ValueError(f"orders must be 'multiple' or 'total', got {orders!r}")
    if orders == "multiple":
        return
    for theta in angles:
        if _meets_single_order(line, math.radians(theta), eta):
            raise ValueError(
                "orders must be 'multiple' on a line where the refracted rays meet and the single order is not a "
                f"function, got 'total' with the line at {math.degrees(line.phi):g} and theta_i {theta:g} degrees"
            )


def _chosen_models(models: Sequence[str | BSSRDF] | None, medium: Medium) -> tuple[list[BSSRDF], tuple[str, ...]]:
    """Models of the medium, and why some of all are left out."""
    if models is not None:
        chosen = [m if isinstance(m, BSSRDF) else bssrdf(m, medium) for m in models]
        for model in chosen:
            if model.medium != medium:
                raise ValueError(f"models must be of the medium {medium}, got {model.name!r} of {model.medium}")
        names = [model.name for model in chosen]
        if len(set(names)) < len(names):
            raise ValueError(f"models must be different, got {names!r}")
        return chosen, ()
    chosen, notes = [], []
    for name in all_models():
        try:
            chosen.append(bssrdf(name, medium))
        except ValueError as error:
            notes.append(f"{name} left out: {error}")
    return chosen, tuple(notes)
