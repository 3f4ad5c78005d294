"""The cheapest model of a medium for curves, over a range of distances, without a scene.

Error: energy-weighted relative L1 over pairs of directions against path tracing, see `comparison.model_errors`; cost:
seconds of a million values of S. Path tracing finds those of all cells and directions at once, and takes until their
own noise is at the tolerance.
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from full_geometry.trade.results import html_table, plain
from halfspace_sss.checks import check_choice, check_count, check_interval
from halfspace_sss.comparison.curve_set import TRACED
from halfspace_sss.comparison.model_errors import TracedMaps, model_error, references
from halfspace_sss.interface.model import BSSRDF
from halfspace_sss.neural.symmetric import channels
from halfspace_sss.noise_free import NoiseFree
from halfspace_sss.physics.medium import Medium, medium_of
from halfspace_sss.registry import bssrdf
from halfspace_sss.registry import models as registered

if TYPE_CHECKING:
    import pandas

EVENTS = 4e6  # of the walks of each channel
QUERIES = 2**12
REACH = (0.02, 60.0)  # mean free paths that are compared where no range is given


@dataclass(frozen=True)
class FlatOption:
    """A model for a medium: largest error of its channels, what that is below in 95 % of cases, seconds for a million
    values, one sentence."""

    model: str
    error: float
    bound: float
    seconds_per_million: float
    why: str


@dataclass(frozen=True, repr=False)
class FlatAdvice:
    """The model for a medium, and all that were compared, the chosen one first."""

    model: str
    tolerance: float
    r: tuple[float, float]
    options: tuple[FlatOption, ...]

    def __repr__(self) -> str:
        return f"<{self.model} for a tolerance of {self.tolerance:.3g}, of {len(self.options)} ways>"

    def _repr_html_(self) -> str:
        return html_table(("way", "error", "seconds a million", ""), [
            (o.model, f"{o.error:.3g}", f"{o.seconds_per_million:.3g}", o.why) for o in self.options
        ])  # fmt: skip

    def __str__(self) -> str:
        return "\n".join(option.why for option in self.options)

    def record(self) -> dict[str, Any]:
        """Ready for JSON; what is not finite, as of a model that refuses, is None there."""
        return plain(asdict(self))

    def table(self) -> pandas.DataFrame:
        """One row for each way."""
        import pandas

        return pandas.DataFrame([asdict(option) for option in self.options])


def recommend_flat(
    medium: Medium,
    r: tuple[float, float] | None = None,
    *,
    tolerance: float = 0.05,
    models: Sequence[str] | None = None,
    events: float = EVENTS,
    seed: int = 0,
) -> FlatAdvice:
    """The cheapest model of the half-space that keeps a tolerance over a range of distances.

    Args:
        medium: or a material; of several channels the worst counts.
        r: smallest and largest distance, mm; by default 0.02 to 60 mean free paths.
        tolerance: relative error of S mu_i mu_o, summed over cells of the range and pairs of directions.
        models: names, by default all.
        events: scattering events of the walks, for each channel.
        seed: of the walks.

    Raises:
        ValueError: an argument is out of range, or no light comes back within the distances.
    """
    medium = medium_of(medium)
    check_interval("tolerance", tolerance, 1e-4, 10.0)
    check_interval("events", events, 1e4, 1e12)
    check_count("seed", seed, 0)
    for name in models or ():
        check_choice("model", name, registered())
    parts = [m for m in channels(medium) if float(m.sigma_s) > 0]
    if not parts:
        raise ValueError("medium must scatter, got albedo 0: S of order 2 and more is 0, no model is needed")
    _check_range(r)
    started = time.perf_counter()
    result = references([m.in_mfp() for m in parts], events * len(parts), seed, 4)
    tracing = time.perf_counter() - started
    within = [(r[0] * float(m.sigma_t), r[1] * float(m.sigma_t)) if r else REACH for m in parts]
    for m, one, bounds in zip(parts, result, within):
        _check_light(m, one, bounds)
    rows = [_row(name, parts, result, within) for name in models or registered()]
    noise = max((row.noise for row in rows if row.noise < math.inf), default=math.inf)
    values = sum(_values(one, bounds) for one, bounds in zip(result, within))
    rows.append(_Row(TRACED, NoiseFree(0.0, 0.0), tolerance, tracing * (noise / tolerance) ** 2 / values))
    return _advice(rows, tolerance, r or REACH, "mm" if r else "mean free paths")


def _check_range(r: tuple[float, float] | None) -> None:
    if r is None:
        return
    if len(r) != 2:
        raise ValueError(f"r must be a smallest and a largest distance, mm, got {r!r}")
    check_interval("r[0]", r[0], 0.0, 1e9)
    check_interval("r[1]", r[1], 0.0, 1e9)
    if not r[0] < r[1]:
        raise ValueError(f"r must ascend, got {r!r}")


def _lit(maps: TracedMaps, within: tuple[float, float]) -> np.ndarray:
    """Which cells count: an array that fits energies of halves."""
    radii = maps.block_radii()
    return ((radii >= within[0]) & (radii <= within[1]))[:, None, None, :, None]


def _values(maps: TracedMaps, within: tuple[float, float]) -> int:
    """How many values of S the walks have found, of cells and pairs of directions."""
    return int(np.broadcast_to(_lit(maps, within), maps.energies()[:, :1].shape).sum())


def _check_light(m: Medium, maps: TracedMaps, within: tuple[float, float]) -> None:
    if not (maps.energies() * _lit(maps, within)).sum() > 0:
        (low, high), radii = within, maps.block_radii()
        raise ValueError(
            f"r must hold distances at which light comes back, got {low:.3g} to {high:.3g} mean free paths for "
            f"albedo {float(m.albedo):.4g}; walks reach {radii.min():.2g} to {radii.max():.3g}"
        )


class _Row(NamedTuple):
    """Largest error of the channels of a model, noise of the walks, seconds of a value, why it refuses."""

    name: str
    error: NoiseFree
    noise: float
    seconds: float
    refusal: str = ""


def _row(name: str, media: list[Medium], maps: list[TracedMaps], within: list[tuple[float, float]]) -> _Row:
    errors, noises, seconds = [], [], 0.0
    for m, one, bounds in zip(media, maps, within):
        try:
            model = bssrdf(name, m.in_mfp())
        except ValueError as error:
            return _Row(name, NoiseFree(math.inf, 0.0), math.inf, math.inf, str(error))
        e = model_error(model, one, bounds)
        errors.append(e.known)
        noises.append(e.noise)
        seconds += _seconds(model)
    return _Row(name, max(errors, key=lambda e: e.bound), max(noises), seconds / len(media))


def _seconds(model: BSSRDF) -> float:
    """Seconds of one value of S in NumPy."""
    rng = np.random.default_rng(0)
    r, mu = 10 ** rng.uniform(-2, 1, QUERIES), rng.uniform(0.05, 1, (2, QUERIES))
    took = []
    for _ in range(2):
        started = time.perf_counter()
        model.eval(r, mu[0], 0.3, mu[1], 1.0)
        took.append(time.perf_counter() - started)
    return min(took) / QUERIES


def _advice(rows: list[_Row], tolerance: float, r: tuple[float, float], unit: str) -> FlatAdvice:
    keeping = [row for row in rows if row.error.bound <= tolerance and row.name != TRACED]
    best = min(keeping, key=lambda row: row.seconds) if keeping else rows[-1]
    options = []
    for row in sorted(rows, key=lambda row: (row is not best, row.error.value)):
        name, error, _, seconds, refusal = row
        off = f"{error.told()} % off"
        cost = f"{1e6 * seconds:.3g} s for a million values"
        if name == TRACED:
            why = f"{name} takes {cost}, of all directions at once, until their noise is {100 * tolerance:.3g} %"
        elif refusal:
            why = f"{name}: {refusal}"
        elif row is best:
            why = f"{name} is the cheapest model that keeps {100 * tolerance:.3g} %, "
            why += f"r {r[0]:.3g} to {r[1]:.3g} {unit}: {off}, {cost}"
        elif row in keeping:
            why = f"{name} is {seconds / best.seconds:.2g} times dearer: {off}, {cost}"
        elif error.square - 2 * error.square_error > tolerance**2:
            why = f"{name} is {off}, the tolerance is {100 * tolerance:.3g} %"
        else:
            why = f"{name} is {off}: whether it keeps {100 * tolerance:.3g} % is open, more events would tell"
        options.append(FlatOption(name, error.value, error.bound, 1e6 * seconds, why))
    return FlatAdvice(best.name, tolerance, r, tuple(options))
