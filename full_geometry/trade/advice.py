"""The cheapest way that keeps a tolerance for a whole job, and why not the others.

With the bias b of a way, its variance V of a sample and its seconds t for one, a job of images with n pixels of the
object each takes, until bias and noise together are at the tolerance e,

    T = training + preparation + images n t V / (e² - b²),

and a way with b >= e never gets there. Noise of denoised walks falls by a power of the samples (`denoised_walks`).
With standard errors s of b² and v of V, and x = 1 / samples, b² + V x + sqrt(s² + v² x² / 4) is taken: biases of models
are spread over decades, so that few lie where that errs; noise is as likely below what was measured as above it.

Without a scene, `recommend_flat` finds the cheapest model of a medium for curves over a range of distances. Error:
energy-weighted relative L1 over pairs of directions against path tracing, see `comparison.model_errors`; cost: seconds
of a million values of S. Path tracing finds those of all cells and directions at once, and takes until their own noise
is at the tolerance.
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from full_geometry.settings import GATHERED_LIGHTS, PATH_TRACED
from full_geometry.trade.assessing import assess
from full_geometry.trade.results import UNNAMED, Assessment, ObjectTrade, TechniqueTrade
from full_geometry.trade.techniques import WALKED, Job, Technique
from halfspace_sss.checks import check_choice, check_count, check_interval
from halfspace_sss.comparison.curve_set import TRACED
from halfspace_sss.comparison.model_errors import TracedMaps, model_error, references
from halfspace_sss.comparison.reflectance_curves import evaluations_per_s
from halfspace_sss.noise_free import NoiseFree, short
from halfspace_sss.physics.medium import Medium, medium_of
from halfspace_sss.provenance import without_nan
from halfspace_sss.registry import bssrdf
from halfspace_sss.registry import models as registered

if TYPE_CHECKING:
    import mitsuba as mi
    import pandas

INTEGRATOR = "bssrdf"
DARK = "no light comes from it, every technique shows it black"


@dataclass(frozen=True)
class Option:
    """A way for a job: seconds and samples for each pixel, the error then, and one sentence that says why or why not.
    A way that never keeps the tolerance has infinite seconds; `error` is then its bias."""

    way: str
    seconds: float
    spp: int
    error: float
    why: str


@dataclass(frozen=True)
class ObjectAdvice:
    """The way for one object; None where nothing is known. `options` has all of them, the chosen one first."""

    object: str
    way: str | None
    options: tuple[Option, ...]

    def __str__(self) -> str:
        return "\n".join(f"{self.object or UNNAMED}: {option.why}" for option in self.options)


@dataclass(frozen=True, repr=False)
class Advice:
    """The ways for a scene.

    Attributes:
        objects: for each object alone.
        integrator: "path_traced", "bssrdf", either with its light, and of walks "denoised", which serves all objects at
            once in the least time.
        seconds: that it takes.
        assessment: what this rests on.
        tolerance: that was asked.
        spp: samples of a pixel, the most of all objects.
    """

    objects: tuple[ObjectAdvice, ...]
    integrator: str
    seconds: float
    assessment: Assessment
    tolerance: float
    spp: int = 0

    def __repr__(self) -> str:
        ways = ", ".join(f"{each.object or UNNAMED}: {each.way}" for each in self.objects)
        return f"<{self.integrator} for a tolerance of {self.tolerance:.3g}; {ways}>"

    def _repr_html_(self) -> str:
        return _html([{"object": each.object, **asdict(option)} for each in self.objects for option in each.options])

    def __str__(self) -> str:
        text = [str(each) for each in self.objects]
        if len(self.objects) > 1:
            text.append(f"all objects together: {self.integrator}, {_time(self.seconds)}")
        return "\n".join(text)


def _html(rows: list[dict[str, Any]]) -> str:
    """A table with whole sentences."""
    import pandas

    with pandas.option_context("display.max_colwidth", None):
        return pandas.DataFrame(rows).to_html(index=False, float_format="{:.3g}".format)


def recommend(
    scene: mi.Scene | dict[str, Any] | str | Path | Assessment,
    *,
    tolerance: float = 0.05,
    images: int = 1,
    seconds: float | None = None,
    seed: int = 0,
    **assessing: Any,
) -> Advice:
    """The cheapest way of rendering a scene that keeps a tolerance, with a sentence on every other one.

    For curves of a medium see `flat.recommend_flat`.

    Args:
        scene: as in `assess`, or an `Assessment` that has been made.
        tolerance: relative error of radiance over the visible points of an object, bias and noise together.
        images: number of images; preparation and training count once.
        seconds: longest time of the whole job; if no technique keeps the tolerance then, the least error is named.
        seed: of the assessment.
        assessing: what else `assess` takes; its `seconds` is called `assess_seconds` here.

    Raises:
        ValueError: an argument is out of range, or the scene cannot be rendered.
    """
    job = Job(tolerance, images, seconds)
    if isinstance(scene, Assessment):
        return advise(scene, job)
    if "assess_seconds" in assessing:
        assessing["seconds"] = assessing.pop("assess_seconds")
    return advise(assess(scene, job=job, seed=seed, **assessing), job)


def advise(assessment: Assessment, job: Job) -> Advice:
    """The ways for a job, from what has been measured."""
    objects = tuple(_object(o, job) for o in assessment.objects)
    told = [o for o in objects if o.way is not None]
    models = (INTEGRATOR, *(f"{INTEGRATOR}, {light}" for light in GATHERED_LIGHTS))
    best = {kind: [_best(o, kind) for o in told] for kind in (*models, *(each.name for each in WALKED))}
    times = {kind: sum(option.seconds for option in options) for kind, options in best.items()}
    integrator = min(times, key=lambda kind: times[kind])
    spp = max((option.spp for option in best[integrator]), default=0)
    return Advice(objects, integrator, times[integrator], assessment, job.tolerance, spp)


def _best(advice: ObjectAdvice, kind: str) -> Option:
    """The fastest of an object by an integrator."""
    light = kind.removeprefix(INTEGRATOR).removeprefix(", ") or "sampled"
    walks = kind.startswith(PATH_TRACED)
    options = [o for o in advice.options if o.way and (o.way == kind if walks else Technique.of(o.way).serves(light))]
    return min(options, key=lambda o: o.seconds, default=Option("", math.inf, 0, math.nan, ""))


def _object(assessed: ObjectTrade, job: Job) -> ObjectAdvice:
    if not assessed.ways:
        return ObjectAdvice(assessed.object, None, (Option("", math.inf, 0, math.nan, "; ".join(assessed.notes)),))
    rows = [row for row in assessed.ways if not row.refusal]
    if assessed.is_dark:
        rows = sorted(rows, key=lambda row: row.seconds)
        dark = tuple(Option(w.way, w.preparation, 1, 0.0, f"{w.way}: {DARK}") for w in rows)
        return ObjectAdvice(assessed.object, dark[0].way, dark)
    options = [_option(assessed, row, job) for row in rows]
    allowed = [o for o in options if o[0] <= (job.seconds or math.inf)]
    if allowed and min(allowed)[0] < math.inf:
        best = min(allowed, key=lambda o: o[0])
        told = [_told(assessed, o, best, job) for o in sorted(options, key=lambda o: (o is not best, o[0]))]
    else:
        options = [_in_time(assessed, o[3], job) for o in options]
        best = min(options, key=lambda o: o[2])
        told = [_nearest(o, best, job) for o in sorted(options, key=lambda o: o[2])]
    refused = [Option(w.way, math.inf, 0, math.nan, f"{w.way}: {w.refusal}") for w in assessed.ways if w.refusal]
    return ObjectAdvice(assessed.object, best[3].way, (*told, *refused))


_Raw = tuple[float, float, float, TechniqueTrade]  # seconds, samples of a pixel, error, the way


def _option(assessed: ObjectTrade, row: TechniqueTrade, job: Job) -> _Raw:
    took, spp = assessed.job(row, job.tolerance, job.images)
    return took, spp, math.hypot(row.bias, math.sqrt(row.noise2(spp))) if spp else row.bias, row


def _in_time(assessed: ObjectTrade, row: TechniqueTrade, job: Job) -> _Raw:
    """Samples and error of a technique in the time that is allowed; its bias where there is no limit."""
    if job.seconds is None:
        return math.inf, 0, row.bias, row
    left = job.seconds - row.job_seconds(job.images, 0.0)
    spp = math.floor(left / (job.images * assessed.pixels * row.seconds)) if left > 0 else 0
    error = math.hypot(row.bias, math.sqrt(row.noise2(spp))) if spp > 0 else math.inf
    return float(job.seconds), spp, error, row


def _told(assessed: ObjectTrade, option: _Raw, best: _Raw, job: Job) -> Option:
    took, spp, error, row = option
    off, training = _off(row), f", its training of {_time(row.training)} counted" if row.training else ""
    if option is best:
        size = f"{assessed.mfp[0]:.3g} to {assessed.mfp[1]:.3g} mean free paths across"
        images = "an image" if job.images == 1 else f"{job.images} images"
        why = f"{row.way} is the cheapest that keeps {job.tolerance:.3g} ({size}): {off}, {images} in {_time(took)}"
        why += f" with {int(spp)} {'sample' if spp == 1 else 'samples'} a pixel" + training
        why += f"; render {Technique.of(row.way).flags} --spp {int(spp)}"
        if Technique.of(row.way).walks:
            why += f", or --target-error {job.tolerance:g}, which stops by the error of the picture"
    elif took < math.inf:
        over = job.seconds is not None and took > job.seconds
        why = f"{row.way} takes {_time(took)}"
        why += f", allowed {_time(job.seconds)}" if over else f", {short(took / best[0])} times as long" + f" ({off})"
        why += training
    elif row.bias2 - 2 * row.bias2_error < job.tolerance**2:
        why = f"{row.way} is {off}: whether it keeps {job.tolerance:.3g} cannot be measured with so few samples"
    else:
        why = f"{row.way} is {off}, the tolerance is {100 * job.tolerance:.3g} %"
    return Option(row.way, took, int(spp), error, why)


def _nearest(option: _Raw, best: _Raw, job: Job) -> Option:
    took, spp, error, row = option
    within = f" in {_time(took)}" if took < math.inf else ""
    if option is best:
        why = f"no technique keeps {job.tolerance:.3g}{within}; {row.way} comes nearest, {100 * error:.3g} %"
    elif not within:
        why = f"{row.way} is {_off(row)}"
    elif spp > 0:
        why = f"{row.way} comes to {100 * error:.3g} % in {_time(took)}"
    else:
        why = f"{row.way} has no time for an image in {_time(took)}"
    return Option(row.way, took, int(spp), error, why)


def _off(row: TechniqueTrade) -> str:
    """A bias in words."""
    return "exact" if row.is_exact else f"{row.told_bias} % off"


def _time(seconds: float) -> str:
    if not seconds < math.inf:
        return "no time"
    for unit, length in (("h", 3600.0), ("min", 60.0)):
        if seconds >= 1.6 * length:
            return f"{seconds / length:.3g} {unit}"
    return f"{short(seconds)} s"


EVENTS = 4e6  # of the walks of each channel
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
        return _html([asdict(option) for option in self.options])

    def __str__(self) -> str:
        return "\n".join(option.why for option in self.options)

    def record(self) -> dict[str, Any]:
        """Ready for JSON; what is not finite, as of a model that refuses, is None there."""
        return without_nan(asdict(self))

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
    parts = [m for m in medium.channels() if float(m.sigma_s) > 0]
    if not parts:
        raise ValueError("medium must scatter, got albedo 0: S of order 2 and more is 0, no model is needed")
    _check_range(r)
    started = time.perf_counter()
    result = references([m.in_mfp() for m in parts], events * len(parts), seed, 4)
    tracing = time.perf_counter() - started
    within = [(r[0] * float(m.sigma_t), r[1] * float(m.sigma_t)) if r else REACH for m in parts]
    values = 0
    for m, one, (low, high) in zip(parts, result, within):
        energies, radii = one.energies(), one.block_radii()
        lit = ((radii >= low) & (radii <= high))[:, None, None, :, None]
        if not (energies * lit).sum() > 0:
            raise ValueError(
                f"r must hold distances at which light comes back, got {low:.3g} to {high:.3g} mean free paths for "
                f"albedo {float(m.albedo):.4g}; walks reach {radii.min():.2g} to {radii.max():.3g}"
            )
        values += int(np.broadcast_to(lit, energies[:, :1].shape).sum())  # of S, of cells and pairs of directions
    rows = [_row(name, parts, result, within) for name in models or registered()]
    noise = max((row.noise for row in rows if row.noise < math.inf), default=math.inf)
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
        seconds += 1 / evaluations_per_s(model, 0.01, 10.0, least_seconds=0.01)
    return _Row(name, max(errors, key=lambda e: e.bound), max(noises), seconds / len(media))


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
