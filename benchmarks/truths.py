"""Published, third-party and exact numbers of half-spaces, and the path tracer held against them by z-tests."""

from __future__ import annotations

import csv
import math
import re
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType

import numpy as np

from halfspace_sss.arrays import Lanes
from halfspace_sss.backend import array_types
from halfspace_sss.checks import check_cosine, check_count
from halfspace_sss.physics.fresnel import F_r
from halfspace_sss.physics.medium import Medium
from halfspace_sss.progress import Progress
from halfspace_sss.tracing.instrument import Instrument
from halfspace_sss.tracing.passes import Estimate, estimate, walk_passes
from halfspace_sss.tracing.tracer import Trace, trace
from halfspace_sss.tracing.walk import Boundary, Tally

TABLE = Path(__file__).with_name("truths.csv")
MEASURES = {
    "R_d": "R_d",
    "R_total": "R_total",
    "BRDF [1/sr]": "BRDF",
    "H(mu)": "H",
    "R_d(r) ring mean [1/cm^2]": "ring",
    "R_d(r,t) [1/(mm^2 ns)]": "ring in time",
    "R_d(f,t) [1/ns]": "frequency in time",
    "<r^2> [1/sigma_t^2]": "r2",
    "<x> [1/sigma_t]": "x",
    "<path length> [1/sigma_t]": "length",
    "R_d single scattering": "single",
    "R_d single scattering / albedo": "single",
    "R_d double scattering": "double",
    "R_d double scattering / albedo^2": "double",
}
FACTOR_ALBEDO = 0.5  # traced where the row gives a factor of albedo^n, which holds for every albedo
PER_CM2 = 100.0  # 1/mm² in 1/cm²
PER_NS = 1000.0  # 1/ps in 1/ns
_COEFFICIENTS = re.compile(r"mua=([\d.]+) mus=([\d.]+) 1/cm")
_RING = re.compile(r"\[([\d.]+),([\d.]+)\] cm")
_IN_TIME = re.compile(r"(?:\[([\d.]+),([\d.]+)\] mm|([\d.]+) /mm) \[([\d.]+),([\d.]+)\] ns")


@dataclass(frozen=True)
class Truth:
    """A number of the table that the tracer can be held against.

    Attributes:
        id, kind, quantity, source: as in the table.
        measure: what is traced, a value of `MEASURES`.
        medium: the medium; sigma_t = 1/mm where the table counts in mean free paths.
        mu_i: external cosine of incidence, or "diffuse".
        direction: (mu_o, delta_phi) of a BRDF, delta_phi = 0 forward.
        ring: inner and outer radius, mm.
        frequency: spatial, 1/mm.
        times: beginning and end, ps.
        factor: multiplies the traced value to give the row's quantity.
        value, uncertainty: the truth and one standard deviation (or bound) of it.
    """

    id: str
    kind: str
    quantity: str
    source: str
    measure: str
    medium: Medium
    mu_i: float | str
    direction: tuple[float, float] | None
    ring: tuple[float, float] | None
    factor: float
    value: float
    uncertainty: float
    frequency: float | None = None
    times: tuple[float, float] | None = None

    @property
    def alone(self) -> str | None:
        """What needs a run of its own beside the other rows of the same medium and incidence."""
        return self.measure if self.measure == "double" or self.times else None


@dataclass(frozen=True)
class NotCovered:
    """A row that the tracer cannot answer, and why."""

    id: str
    quantity: str
    reason: str


def read_truths() -> tuple[list[Truth], list[NotCovered]]:
    """Read the table: rows that speak of a half-space, and the others with the reason."""
    covered, others = [], []
    with TABLE.open(newline="", encoding="utf-8") as file:
        for row in csv.DictReader(line for line in file if not line.startswith("#")):
            reason = _reason(row)
            if reason:
                others.append(NotCovered(row["id"], row["quantity"], reason))
            else:
                covered.append(_truth(row))
    return covered, others


def _reason(row: dict[str, str]) -> str | None:
    """Why the tracer has no answer to a row; None if it has."""
    geometry = row["geometry"]
    if row["kind"] == "code_regression":
        return "value of a published model, not of the transport: a test of that model"
    if "glass slide" in geometry:
        return "a glass slide on the medium: another boundary"
    if "layers" in geometry:
        return "layers, not a half-space"
    if geometry.startswith("slab"):
        return "a slab, not a half-space"
    if row["quantity"] not in MEASURES:
        return "no quantity of a half-space"
    return None


def _truth(row: dict[str, str]) -> Truth:
    measure = MEASURES[row["quantity"]]
    mu_i = "diffuse" if row["mu_i"] == "diffuse" else float(row["mu_i"])
    medium, factor = _medium(row)
    direction = ring = frequency = times = None
    if measure == "BRDF":
        phi = 0.0 if row["phi_deg"] == "any" else math.radians(float(row["phi_deg"]))
        direction = (float(row["mu_o"]), phi)
    elif measure == "H" and medium.albedo == 1:
        direction = (mu_i, 0.0)
    elif measure == "ring":
        ring, factor = tuple(round(10 * float(v), 9) for v in _RING.search(row["other"]).groups()), PER_CM2
    elif measure.endswith("in time"):
        numbers = [float(v) for v in _IN_TIME.fullmatch(row["other"]).groups() if v is not None]
        ring, frequency = (tuple(numbers[:2]), None) if measure.startswith("ring") else (None, numbers[0])
        times, factor = tuple(round(1000 * v, 9) for v in numbers[-2:]), PER_NS
    return Truth(
        **{name: row[name] for name in ("id", "kind", "quantity", "source")}, measure=measure, medium=medium, mu_i=mu_i,
        direction=direction, ring=ring, factor=factor, value=float(row["value"]), uncertainty=_uncertainty(row),
        frequency=frequency, times=times,
    )  # fmt: skip


def _medium(row: dict[str, str]) -> tuple[Medium, float]:
    """The medium of a row, and the factor from its traced value to the row's quantity."""
    g, eta = float(row["g"]), float(row["eta"])
    coefficients = _COEFFICIENTS.search(row["geometry"])
    if coefficients:
        sigma_a, sigma_s = (float(v) / 10 for v in coefficients.groups())
        return Medium(sigma_s, sigma_a, g, eta), 1.0
    if row["albedo"] == "factor":
        order = 2 if row["quantity"].endswith("albedo^2") else 1
        return Medium.from_albedo(FACTOR_ALBEDO, 1.0, g, eta), FACTOR_ALBEDO**-order
    return Medium.from_albedo(float(row["albedo"]), 1.0, g, eta), 1.0


def _uncertainty(row: dict[str, str]) -> float:
    """The column's number, "~" allowed before it; "rel" after it makes it relative to the value."""
    number, _, unit = row["uncertainty"].partition(" ")
    size = float(number.lstrip("~"))
    return size * abs(float(row["value"])) if unit == "rel" else size


Z_LIMIT = 4.0
PILOT, MOST_PATHS, RING_PATHS, TIME_PATHS = 65536, 1_500_000_000, 64_000_000, 131_072
FREQUENCY_RADII = np.linspace(0.0, 120.0, 1201)  # mm
REFLECTANCE_ERROR, DIM_ERROR, OTHER_ERROR = 1e-3, 3e-3, 2e-3  # relative: albedo >= 0.5, below it, other quantities
LEAST_CERTAIN = 0.2  # relative: beyond it a standard error rests on too few walks to be trusted
SHARE = 0.3  # of the row's own uncertainty: a smaller error would not sharpen the test
DIRECTION_COUNTS = (1, 2, 4, 8)  # kernels are compiled for these numbers of directions


@dataclass(frozen=True)
class Comparison:
    """One row: traced value with its standard error, and z = (traced - truth) / sqrt(error² + uncertainty²)."""

    truth: Truth
    traced: float
    standard_error: float
    n_paths: int
    n_events: int
    seed: int

    @property
    def reflected(self) -> float:
        """The traced value without the surface reflection that R_total adds to it."""
        truth = self.truth
        return self.traced - (float(F_r(truth.mu_i, truth.medium.eta)) if truth.measure == "R_total" else 0.0)

    @property
    def z(self) -> float:
        """Distance from the truth in units of the two errors together; inf if both are 0 and the values differ."""
        distance = self.traced - self.truth.value
        error = math.hypot(self.standard_error, self.truth.uncertainty)
        if error == 0:
            return 0.0 if distance == 0 else math.copysign(math.inf, distance)
        return distance / error if math.isfinite(distance) else math.inf


@dataclass(frozen=True)
class Validation:
    """What `validate` found: a comparison for each row covered, the rows not covered, and the wall time."""

    comparisons: list[Comparison]
    not_covered: list[NotCovered]
    seed: int
    quick: bool
    seconds: float

    @property
    def failures(self) -> list[Comparison]:
        """Rows with |z| of `Z_LIMIT` or more."""
        return [c for c in self.comparisons if not abs(c.z) < Z_LIMIT]


class OrderTally(Tally):
    """Flux through the boundary after exactly `order` scattering events."""

    def __init__(self, types: ModuleType, order: int) -> None:
        self.types = types
        self.order = order

    def start(self, lanes: int) -> tuple[Lanes, ...]:
        import drjit as dr

        return (dr.zeros(self.types.Float, lanes),)

    def boundary(self, sums: tuple[Lanes, ...], event: Boundary) -> tuple[Lanes, ...]:
        import drjit as dr

        return (sums[0] + dr.select(event.order == self.order, event.weight, 0.0),)


def trace_order(
    medium: Medium, mu_i: float | str, order: int, n_paths: int, seed: int = 0, backend: str = "llvm"
) -> tuple[Estimate, int, int]:
    """Trace the fraction of incident flux that leaves after exactly `order` scattering events.

    Args:
        medium: scalar medium.
        mu_i: external cosine of incidence, [0, 1], or "diffuse".
        order: number of scattering events, at least 1.
        n_paths, seed, backend: as in `trace`.

    Returns:
        The estimate, the number of walks and the number of scattering events traced.

    Raises:
        ValueError: an argument is out of range.
    """
    check_count("order", order, 1)
    check_count("n_paths", n_paths, 256)
    if mu_i != "diffuse":
        mu_i = check_cosine("mu_i", mu_i)
    types = array_types(backend)
    samples, events, paths = [], 0, 0
    for done in walk_passes(types, medium, mu_i, n_paths, (seed, order), lambda: [OrderTally(types, order)]):
        samples.append(done.lanes()[:, 0])
        events, paths = events + done.n_events, paths + done.n_paths
    return estimate(np.concatenate(samples)), paths, events


def validate(
    rows: Callable[[Truth], bool] | None = None, seed: int = 0, quick: bool = False, *, progress: Progress | None = None
) -> Validation:
    """Trace every row of the packaged table of half-space numbers and compare.

    Rows of the same medium and incidence share one run. Walks are added until the standard error is 0.1 % of a
    reflectance for albedo >= 0.5; 0.3 % of it below, and 0.2 % of other quantities, or 0.3 times the row's own
    uncertainty if that is more. Rings take what 64 million walks give, light in time what 131 thousand do. `quick`
    asks for errors ten times as large.

    Args:
        rows: which rows to take, all if None.
        seed: each group of rows has its own seed, derived from this one.
        quick: looser errors.
        progress: called with (groups done, groups in all).

    Raises:
        ValueError: seed is negative, or no row is left.
    """
    check_count("seed", seed, 0)
    truths, not_covered = read_truths()
    if rows is not None:
        truths = [t for t in truths if rows(t)]
    if not truths:
        raise ValueError("rows must leave at least one row that the tracer covers, got none")
    started, comparisons = time.perf_counter(), {}
    groups: dict[tuple, list[Truth]] = {}  # that one run answers each
    for truth in truths:
        groups.setdefault((truth.medium, truth.mu_i, truth.alone), []).append(truth)
    for done, group in enumerate(groups.values(), 1):
        # a seed of its own, the same whichever other rows are traced
        own = int(np.random.SeedSequence([seed, int(group[0].id[1:])]).generate_state(1)[0])
        for comparison in _compare(group, own, 10.0 if quick else 1.0):
            comparisons[comparison.truth.id] = comparison
        if progress:
            progress(done, len(groups))
    ordered = [comparisons[t.id] for t in truths]
    return Validation(ordered, not_covered, seed, quick, time.perf_counter() - started)


def _compare(group: Sequence[Truth], seed: int, loosen: float) -> list[Comparison]:
    """Trace a group until its errors are small enough, each attempt with walks of its own."""
    n = int(PILOT / min(loosen, 4.0))
    if group[0].times:
        n = int(TIME_PATHS / loosen)
    elif any(t.ring for t in group):
        n = max(n, int(RING_PATHS / loosen**2))
    for attempt in range(6):
        results = _run(group, n, seed + attempt)
        excess = max(_excess(c, loosen) for c in results)
        if excess <= 1 or n >= MOST_PATHS:
            break
        n = min(int(n * 1.3 * min(excess**2, 300.0)) + 1, MOST_PATHS)
    return results


def _run(group: Sequence[Truth], n_paths: int, seed: int) -> list[Comparison]:
    medium, mu_i = group[0].medium, group[0].mu_i
    if group[0].measure == "double":
        (value, error), n, events = trace_order(medium, mu_i, 2, n_paths, seed)
        return [Comparison(t, t.factor * value, t.factor * error, n, events, seed) for t in group]
    directions = list(dict.fromkeys(t.direction for t in group if t.direction))
    edges = sorted({r for t in group if t.ring for r in t.ring})
    if group[0].times:
        return _run_in_time(group, edges or FREQUENCY_RADII, n_paths, seed)
    count = next((n for n in DIRECTION_COUNTS if n >= len(directions)), len(directions))
    padded = directions + directions[:1] * (count - len(directions))
    result = trace(medium, mu_i, n_paths, seed, directions=padded or None, radii=edges or None)
    comparisons = []
    for truth in group:
        value, error = _answer(truth, result, directions, edges)
        comparisons.append(Comparison(truth, float(value), float(error), result.n_paths, result.n_events, seed))
    return comparisons


def _run_in_time(group: Sequence[Truth], radii: Sequence[float], n_paths: int, seed: int) -> list[Comparison]:
    times = sorted({t for truth in group for t in truth.times})
    result = trace(group[0].medium, group[0].mu_i, n_paths, seed, radii=radii, instrument=Instrument(times=times))
    comparisons = []
    for t in group:
        at = times.index(t.times[0])
        if t.ring:
            values, errors = (v[radii.index(t.ring[0])] for v in result.readings.exitance_in_time())
        else:
            values, errors = (v[0] for v in result.readings.frequency_in_time([t.frequency]))
        value, error = (float(t.factor * v[at]) for v in (values, errors))
        comparisons.append(Comparison(t, value, error, result.n_paths, result.n_events, seed))
    return comparisons


def _answer(truth: Truth, result: Trace, directions: list, edges: list[float]) -> Estimate:
    """The row's quantity from a run, with its standard error."""
    medium, measure = truth.medium, truth.measure
    if measure in ("BRDF", "ring"):
        at = directions.index(truth.direction) if truth.direction else edges.index(truth.ring[0])
        values, errors = result.angular_reflectance() if truth.direction else result.exitance()
        value, error = values[at], errors[at]
    elif measure == "R_total":
        value, error = result.reflectance()
        value += F_r(truth.mu_i, medium.eta)
    elif measure == "H":
        return _h_function(truth, result, directions)
    else:
        method = {"r2": "mean_r2", "x": "mean_x", "length": "mean_path_length"}.get(measure, "reflectance")
        value, error = getattr(result, method)("single" if measure == "single" else "total")
    return Estimate(truth.factor * value, truth.factor * error)


def _h_function(truth: Truth, result: Trace, directions: list) -> Estimate:
    """H(mu) from R = 1 - sqrt(1 - albedo) H(mu), for albedo 1 from BRDF(mu, mu) = H(mu)² / (8 pi mu)."""
    if truth.medium.albedo < 1:
        root = math.sqrt(1 - truth.medium.albedo)
        R, error = result.reflectance()
        return Estimate((1 - R) / root, error / root)
    values, errors = result.angular_reflectance()
    at = directions.index(truth.direction)
    H = math.sqrt(8 * math.pi * truth.mu_i * values[at])
    return Estimate(H, H * errors[at] / (2 * values[at]))


def _excess(c: Comparison, loosen: float) -> float:
    """Standard error over the one that is asked for."""
    truth = c.truth
    if truth.measure == "ring" or truth.times:
        return 0.0
    if truth.measure in ("R_d", "R_total"):
        bright = truth.medium.albedo >= 0.5
        wanted = loosen * (REFLECTANCE_ERROR if bright else DIM_ERROR) * abs(c.reflected)
        wanted = wanted if bright else max(wanted, SHARE * truth.uncertainty)
    else:
        wanted = max(loosen * OTHER_ERROR * abs(c.traced), SHARE * truth.uncertainty)
    if not c.reflected or not c.standard_error or not wanted:
        return math.inf if truth.value else 0.0  # too few walks to see anything
    return max(c.standard_error / wanted, c.standard_error / abs(c.reflected) / LEAST_CERTAIN)
