"""What an optics laboratory records of a traced beam: light in time, any absorption, fluence, fibres and rings.

The tallies stand beside those of `trace` and cost nothing where they are not asked for. Path length L inside the medium
gives the time eta L / c and, by Beer and Lambert, the reflectance at any further absorption,

    R(r; sigma_a + a) = sum over exits of weight exp(-a L),

from one trace (white Monte Carlo: Kienle and Patterson 1996). Fluence is a collision estimator, weight / sigma_t.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from types import ModuleType

import numpy as np

from halfspace_sss.arrays import Lanes, aligned
from halfspace_sss.checks import check_edges, check_finite, check_interval
from halfspace_sss.lazy import LazyModule
from halfspace_sss.physics.medium import Medium
from halfspace_sss.tracing.passes import CellSums, Estimate, Pass, estimate, find_cell, ratio_estimate
from halfspace_sss.tracing.walk import Boundary, Scatter, Tally

dr = LazyModule("drjit")

LIGHT_SPEED = 0.299792458  # mm/ps, exact by the definition of the metre
SHORTEST, LONGEST, LOG_STEP = 1e-3, 1e7, 0.02  # path lengths of the histogram, mean free paths; ln of the ratio of bins
MOST_BEYOND = 1e-3  # of what leaves, farther than the last of the radii of a transform


@dataclass(frozen=True)
class Ring:
    """A detector of all light that leaves between two radii about the point of entry.

    Args:
        inner, outer: radii, mm, 0 <= inner < outer.
        numerical_aperture: sine of the largest angle to the normal outside, (0, 1].

    Raises:
        ValueError: a value is out of range.
    """

    inner: float
    outer: float
    numerical_aperture: float = 1.0

    def __post_init__(self) -> None:
        check_interval("inner", self.inner, 0.0, 1e12)
        check_interval("outer", self.outer, self.inner * (1 + 1e-9) + 1e-12, 1e12)
        check_interval("numerical_aperture", self.numerical_aperture, 1e-6, 1.0)

    def lengths(self) -> tuple[float, ...]:
        """What `seen` wants, mm."""
        return self.inner, self.outer

    @staticmethod
    def seen(x: Lanes, y: Lanes, lengths: tuple[Lanes, ...], symmetric: bool) -> Lanes:
        """Share of the light at (x, y) that lies on the detector, lengths in the unit of x and y."""
        r2, (inner, outer) = x * x + y * y, lengths
        return dr.select((r2 >= inner * inner) & (r2 < outer * outer), type(x)(1), 0.0)


@dataclass(frozen=True)
class Fibre:
    """A detector with a round core on the surface, as of an optical fibre that looks along the normal.

    Args:
        x: from the point of entry to the middle of the core, forward in the plane of incidence, mm.
        radius: of the core, mm, > 0.
        numerical_aperture: sine of the largest angle to the normal outside, (0, 1].
        y: the same, across the plane of incidence, mm.

    Raises:
        ValueError: a value is out of range.
    """

    x: float
    radius: float
    numerical_aperture: float = 1.0
    y: float = 0.0

    def __post_init__(self) -> None:
        check_finite("x", self.x)
        check_finite("y", self.y)
        check_interval("radius", self.radius, 1e-9, 1e12)
        check_interval("numerical_aperture", self.numerical_aperture, 1e-6, 1.0)

    def lengths(self) -> tuple[float, ...]:
        """As `Ring.lengths`."""
        return self.x, self.y, math.hypot(self.x, self.y), self.radius

    @staticmethod
    def seen(x: Lanes, y: Lanes, lengths: tuple[Lanes, ...], symmetric: bool) -> Lanes:
        """As `Ring.seen`; light of a beam along the normal counts by the share of its circle that the core covers."""
        at_x, at_y, d, radius = lengths
        if symmetric:
            r = dr.sqrt(x * x + y * y)
            cosine = (r * r + d * d - radius * radius) / dr.maximum(2 * r * d, 1e-30)
            return dr.acos(dr.clip(cosine, -1, 1)) / math.pi
        # the mirror y -> -y changes nothing: the mean over both sides
        sides = (dr.square(x - at_x) + dr.square(side - at_y) < radius * radius for side in (y, -y))
        return sum(dr.select(side, type(x)(0.5), 0.0) for side in sides)


@dataclass(frozen=True)
class Instrument:
    """What `trace` is to record besides reflectance, for `Trace.readings`.

    Args:
        times: edges of time bins in ps, ascending, for light in time. A path of length L takes eta L / c: above the
            plane is air, and time outside the medium is left out.
        depths: edges of cells in depth, mm, ascending, for fluence and for the mean depth.
        white: keep a histogram of path lengths, which gives the same for any larger absorption; most useful in a
            medium that does not absorb.
        detectors: rings and fibres.
        beam_radius: distance from the axis of a Gaussian beam at which irradiance has fallen to 1/e², mm, measured
            across the beam; 0 is a pencil beam.

    Raises:
        ValueError: a value is out of range.
    """

    times: Sequence[float] | None = None
    depths: Sequence[float] | None = None
    white: bool = False
    detectors: Sequence[Ring | Fibre] = ()
    beam_radius: float = 0.0

    def __post_init__(self) -> None:
        for name in ("times", "depths"):
            if getattr(self, name) is not None:
                kind = "times >= 0 in ps" if name == "times" else "lengths >= 0 in mm"
                object.__setattr__(self, name, check_edges(name, getattr(self, name), kind))
        check_interval("beam_radius", self.beam_radius, 0.0, 1e12)
        object.__setattr__(self, "detectors", tuple(self.detectors))
        for detector in self.detectors:
            if not isinstance(detector, Ring | Fibre):
                raise ValueError(f"detectors must be Ring or Fibre, got {detector!r}")


class PathTally(Tally):
    """Flux by place and path length; cells (ring or elsewhere, length), lengths between edges or logarithmic."""

    def __init__(self, types: ModuleType, edges2: Lanes | None, lengths: np.ndarray | None) -> None:
        self.edges2 = edges2
        self.lengths: Lanes | None = None if lengths is None else aligned(types.Float, lengths)
        self.n: int = len(log_lengths()) + 1 if lengths is None else len(lengths) - 1
        self.cells: CellSums = CellSums(types, _places(edges2) * self.n)

    def boundary(self, sums: tuple[Lanes, ...], event: Boundary) -> tuple[Lanes, ...]:
        if self.lengths is None:
            at = (dr.log(dr.maximum(event.length, SHORTEST)) - math.log(SHORTEST)) * (1 / LOG_STEP) + 1
            at = dr.select(event.length < SHORTEST, 0, dr.minimum(at, self.n - 1))
            bin, inside = dr.uint32_array_t(type(event.x))(at), True
        else:
            bin, inside = find_cell(self.lengths, event.length)
        cell = _place(self.edges2, event) * self.n + bin
        self.cells.add(event.weight, cell, event.lane, inside & (event.weight > 0))
        return sums


class DepthTally(Tally):
    """Weight after each scattering event; cells (ring or elsewhere, depth).

    Sums are flux times the largest depth of its path, flux, and the depth so far of each lane's walk.
    """

    def __init__(self, types: ModuleType, edges2: Lanes | None, depths: np.ndarray) -> None:
        self.edges2 = edges2
        self.Float: type[Lanes] = types.Float
        self.depths: Lanes = aligned(types.Float, depths)
        self.n: int = len(depths) - 1
        self.cells: CellSums = CellSums(types, _places(edges2) * self.n)

    def start(self, lanes: int) -> tuple[Lanes, ...]:
        return tuple(dr.zeros(self.Float, lanes) for _ in range(3))

    def boundary(self, sums: tuple[Lanes, ...], event: Boundary) -> tuple[Lanes, ...]:
        return sums[0] + event.weight * sums[2], sums[1] + event.weight, sums[2]

    def scatter(self, sums: tuple[Lanes, ...], event: Scatter) -> tuple[Lanes, ...]:
        depth, inside = find_cell(self.depths, event.z)
        self.cells.add(event.weight, _place(self.edges2, event) * self.n + depth, event.lane, inside)
        return sums[0], sums[1], dr.select(event.order == 1, event.z, dr.maximum(sums[2], event.z))


class DetectorTally(Tally):
    """Flux on each detector within its aperture."""

    def __init__(self, types: ModuleType, detectors: Sequence[Ring | Fibre], medium: Medium, symmetric: bool) -> None:
        self.detectors = detectors
        self.symmetric = symmetric
        self.Float: type[Lanes] = types.Float
        scale = float(medium.sigma_t)
        self.lengths: list[tuple[Lanes, ...]] = [
            tuple(dr.opaque(types.Float, v * scale) for v in d.lengths()) for d in detectors
        ]
        sines = [min(d.numerical_aperture / medium.eta, 1.0) for d in detectors]
        self.least: list[Lanes] = [
            dr.opaque(types.Float, math.sqrt(1 - s * s))
            for s in sines  # cosine inside, by Snell
        ]

    def start(self, lanes: int) -> tuple[Lanes, ...]:
        return tuple(dr.zeros(self.Float, lanes) for _ in self.detectors)

    def boundary(self, sums: tuple[Lanes, ...], event: Boundary) -> tuple[Lanes, ...]:
        found = []
        for total, detector, lengths, least in zip(sums, self.detectors, self.lengths, self.least):
            value = event.weight * detector.seen(event.x, event.y, lengths, self.symmetric)
            found.append(total + dr.select((event.weight > 0) & (event.mu >= least), value, 0.0))
        return tuple(found)


def log_lengths() -> np.ndarray:
    """Edges of the logarithmic bins of path length, mean free paths."""
    return np.exp(np.arange(math.log(SHORTEST), math.log(LONGEST), LOG_STEP))


def _places(edges2: Lanes | None) -> int:
    """Rings, and elsewhere."""
    return 1 if edges2 is None else len(edges2)


def _place(edges2: Lanes | None, event: Boundary | Scatter) -> Lanes | int:
    """The ring of an event, or the number of rings if it lies in none."""
    if edges2 is None:
        return 0
    ring, inside = find_cell(edges2, event.x * event.x + event.y * event.y)
    return dr.select(inside, ring, type(ring)(len(edges2) - 1))


class Recorder:
    """The tallies of an instrument for the passes of one trace of a beam, and what they found."""

    def __init__(
        self, instrument: Instrument, types: ModuleType, medium: Medium, mu_i: float, radii: np.ndarray | None
    ) -> None:
        self.instrument = instrument
        self.types = types
        self.medium = medium
        self.radii = radii
        self.symmetric: bool = mu_i == 1
        self.sigma_t: float = float(medium.sigma_t)
        if instrument.depths is not None and not medium.albedo > 0:
            raise ValueError("depths must be left out of a medium with albedo 0, where nothing scatters, got depths")
        sigma = 0.5 * instrument.beam_radius * self.sigma_t  # exp(-2 r² / w²) is normal with the deviation w/2
        self.spot: tuple[float, float] | None = (sigma / max(mu_i, 1e-6), sigma) if sigma > 0 else None
        self.parts: dict[str, list[np.ndarray]] = {}

    def tallies(self) -> list[Tally]:
        """New ones for a pass."""
        asked, types = self.instrument, self.types
        edges2 = None if self.radii is None else aligned(types.Float, (self.radii * self.sigma_t) ** 2)
        self.named: dict[str, Tally] = {}
        if asked.times is not None:
            lengths = asked.times * (LIGHT_SPEED / self.medium.eta * self.sigma_t)
            self.named["times"] = PathTally(types, edges2, lengths)
        if asked.white:
            self.named["white"] = PathTally(types, edges2, None)
        if asked.depths is not None:
            self.named["depths"] = DepthTally(types, edges2, asked.depths * self.sigma_t)
        if asked.detectors:
            self.named["detectors"] = DetectorTally(types, asked.detectors, self.medium, self.symmetric)
        return list(self.named.values())

    def add(self, done: Pass) -> None:
        """Keep what a pass has found; its tallies end with those of the instrument."""
        for (name, tally), sums in zip(self.named.items(), done.sums[len(done.sums) - len(self.named) :]):
            if hasattr(tally, "cells"):
                cells = done.cells(tally.cells).reshape(tally.cells.batches, -1, tally.n)
                self.parts.setdefault(name, []).append(cells)
            if sums:
                lanes = np.stack([s.numpy() for s in sums], axis=1) * (done.T_i / done.per_lane)[:, None]
                self.parts.setdefault(f"{name} by lane", []).append(lanes)

    def readings(self) -> Readings:
        """What all passes found together."""
        samples = {name: np.concatenate(parts) for name, parts in self.parts.items()}
        return Readings(self.instrument, self.medium, self.radii, samples)


@dataclass(frozen=True, repr=False)
class Readings:
    """What an `Instrument` recorded, per incident flux; every method returns an `Estimate` (value, standard_error).

    Attributes:
        instrument, medium, radii: what was asked.
    """

    instrument: Instrument
    medium: Medium
    radii: np.ndarray | None
    _samples: dict[str, np.ndarray]

    def reflectance_in_time(self) -> Estimate:
        """R(t) over each of `times`, all that leaves anywhere, 1/ps."""
        return estimate(self._asked("times").sum(axis=1) / np.diff(self.instrument.times))

    def exitance_in_time(self) -> Estimate:
        """R(r, t) over each of `radii` and `times`, 1/(mm² ps), shape (rings, times)."""
        samples = self._rings("times") / self._areas()[:, None]
        return estimate(samples / np.diff(self.instrument.times))

    def frequency_in_time(self, frequencies: Sequence[float]) -> Estimate:
        """R(f, t), the transform of R(r, t) at spatial frequencies in 1/mm, 1/ps, shape (frequencies, times)."""
        found = transformed(self._asked("times"), self.radii, frequencies)
        return estimate(found / np.diff(self.instrument.times))

    def reflectance_at(self, sigma_a: float | Sequence[float]) -> Estimate:
        """The reflectance if the medium absorbed sigma_a (1/mm), not less than it does, of the shape of sigma_a."""
        return estimate(self.at_absorptions(sigma_a).sum(axis=1).reshape(-1, *np.shape(sigma_a)))

    def exitance_at(self, sigma_a: float | Sequence[float]) -> Estimate:
        """R(r) over each of `radii` if the medium absorbed sigma_a, 1/mm², shape (rings, *sigma_a)."""
        self._rings("white")
        found = self.at_absorptions(sigma_a)[:, :-1] / self._areas()[:, None]
        return estimate(found.reshape(*found.shape[:2], *np.shape(sigma_a)))

    def frequency_at(self, frequencies: Sequence[float], sigma_a: float | Sequence[float]) -> Estimate:
        """R(f) if the medium absorbed sigma_a, shape (frequencies, *sigma_a)."""
        found = transformed(self.at_absorptions(sigma_a), self.radii, frequencies)
        return estimate(found.reshape(*found.shape[:2], *np.shape(sigma_a)))

    def fluence(self) -> Estimate:
        """Mean fluence rate over each of `radii` and `depths`, 1/mm², shape (rings, depths).

        Without radii the integral over the plane, that is under uniform irradiance 1; shape (depths,).
        """
        samples = self._asked("depths") / (float(self.medium.sigma_s) * np.diff(self.instrument.depths))
        return estimate(samples[:, 0] if self.radii is None else samples[:, :-1] / self._areas()[:, None])

    def mean_depth(self) -> Estimate:
        """Mean of the largest depth that the light that leaves has reached, mm."""
        depth, flux = self._asked("depths by lane")[:, :2].T
        return ratio_estimate(depth, flux, self.medium.mfp)

    def collected(self) -> Estimate:
        """Fraction of incident flux on each of `detectors` within its aperture."""
        return estimate(self._asked("detectors by lane"))

    def _asked(self, name: str) -> np.ndarray:
        if name not in self._samples:
            raise ValueError(f"{name.split()[0]} must be given in the instrument for this reading, got none")
        return self._samples[name]

    def _rings(self, name: str) -> np.ndarray:
        if self.radii is None:
            raise ValueError("radii must be given to trace() for exitance, got None")
        return self._asked(name)[:, :-1]

    def _areas(self) -> np.ndarray:
        return np.pi * np.diff(self.radii**2)

    def histogram(self) -> np.ndarray:
        """Flux by place and path length, shape (samples, rings and elsewhere, lengths)."""
        return self._asked("white")

    def at_absorptions(self, sigma_a: float | Sequence[float]) -> np.ndarray:
        """Flux by place at each absorption, shape (samples, places, absorptions)."""
        histogram, least = self.histogram(), float(self.medium.sigma_a)
        further = np.ravel(np.asarray(sigma_a, dtype=np.float64)) - least
        if not (further.size and np.all(further >= -1e-12 * least) and np.all(np.isfinite(further))):
            raise ValueError(f"sigma_a must be finite and >= {least:g} (1/mm), as traced, got {sigma_a!r}")
        edges = np.r_[0.0, log_lengths(), LONGEST] * float(self.medium.mfp)
        a, width = np.maximum(further, 0.0), np.diff(edges)[:, None]
        # mean of exp(-a L) over each bin
        with np.errstate(invalid="ignore"):
            inside = -np.expm1(-a * width) / (a * width)
        return histogram @ (np.exp(-a * edges[:-1, None]) * np.where(a > 0, inside, 1.0))


def transformed(flux: np.ndarray, radii: np.ndarray | None, frequencies: Sequence[float]) -> np.ndarray:
    """∫ M(r) J_0(2 pi f r) dA of flux in rings, taken as even over each ring.

    Args:
        flux: shape (samples, rings and elsewhere, ...).
        radii: edges of the rings, mm.
        frequencies: spatial frequencies, 1/mm, >= 0.

    Returns:
        Shape (samples, frequencies, ...).

    Raises:
        ValueError: no radii, more than a thousandth lies in no ring, or a frequency is out of range.
    """
    from scipy.special import j1

    if radii is None:
        raise ValueError("radii must be given to trace() for spatial frequencies, got None")
    f = checked_frequencies(frequencies)
    beyond = flux[:, -1].sum() / max(flux.sum(), 1e-300)
    if beyond > MOST_BEYOND:
        raise ValueError(f"radii must hold all but {MOST_BEYOND:g} of what leaves, got {beyond:.2g} elsewhere")
    k = 2 * np.pi * np.maximum(f, 1e-12 / radii[-1])[:, None]
    mean = np.diff(radii * j1(k * radii) / k, axis=1) * 2 / np.diff(radii**2)
    return np.einsum("sr...,fr->sf...", flux, np.column_stack([mean, np.where(f == 0, 1.0, 0.0)]))


def checked_frequencies(frequencies: Sequence[float]) -> np.ndarray:
    """Spatial frequencies in 1/mm as an array; ValueError if one is out of range."""
    f = np.atleast_1d(np.asarray(frequencies, dtype=np.float64))
    if f.ndim != 1 or not f.size or not np.all((f >= 0) & np.isfinite(f)):
        raise ValueError(f"frequencies must be finite and >= 0 (1/mm), got {frequencies!r}")
    return f
