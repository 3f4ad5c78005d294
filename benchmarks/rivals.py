"""Tables of models of one object, and of ways of drawing its entries, at equal CPU time."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np

from benchmarks.alpha_p import fit_alpha_p
from benchmarks.bench import kernel_seconds
from benchmarks.flow import FlowProposals, FlowSampler
from benchmarks.flow_training import FlowRecipe, Lighting, fit_flow
from benchmarks.lightings import LIGHTINGS, fit_patches, lighting
from benchmarks.published.paper_network import PaperNetwork, PaperRecipe, estimate, fit_paper
from full_geometry.geometry.points import (
    ObjectModel,
    PositionSampler,
    Proposals,
    RadialTable,
    SurfacePoint,
    cosine_above,
    lifted,
    opaque,
    turned,
)
from full_geometry.learning import model_errors
from full_geometry.learning.model_errors import ExitTruth, RadianceError, compare, transport_of
from full_geometry.learning.training import train_unattended
from full_geometry.objects.objects import TranslucentObject, object_of
from full_geometry.transport.exit_pairs import EntryProposals, Numbers
from full_geometry.transport.half_space import HalfSpaceProposals
from full_geometry.transport.one_object import HalfSpace
from full_geometry.transport.patches import AREA_SHARE, LearntProposals, PatchTable
from full_geometry.transport.storing import Learnt
from halfspace_sss.checks import check_choice, check_count
from halfspace_sss.tracing.walk import generator, pass_seed

if TYPE_CHECKING:
    import pandas

# ---- The table of models: errors of one object after equal CPU time, data included -----------------
# `full_geometry`, S = alpha p, and the paper's network with its points from walks (as it was trained) and uniform.


BACKBONE = "better_dipole"
POINTS = ("walks", "uniform")  # of the paper's network


def error_table(
    scene: mi.Scene, name: str | None = None, *, seconds: float = 60.0, exits: int = 256, walks: int = 4096,
    samples: int = 4096, n: int = 16, seed: int = 0, progress: Callable[[str, int, int], object] | None = None,
) -> pandas.DataFrame:  # fmt: skip
    """Rows of model, channel, light, error, standard error and ratio of the means.

    Args:
        scene: with the object.
        name: its id; may be left out where there is one.
        seconds: of CPU time for each model.
        exits, walks, samples: of the truth and of the models.
        n: incident samples of the paper's network.
        seed: of everything.
        progress: called with (what, done, total).
    """
    import pandas

    obj, rows = object_of(scene, None, None, name), []
    truth = model_errors.reference(obj, exits, walks, seed)

    def tell(what: str, done: int) -> None:
        if progress:
            progress(what, done, 4)

    tell("full_geometry", 0)
    with TemporaryDirectory() as folder:
        learnt = train_unattended(obj, folder, cpu_seconds=seconds, seed=seed)
    proposals = EntryProposals(obj, HalfSpace(obj, BACKBONE)).with_patches(learnt.sampler)
    tell("S = alpha p", 1)
    models = {BACKBONE: transport_of(obj, BACKBONE), "full_geometry": learnt.model}
    models["S = alpha p"] = fit_alpha_p(obj, FlowRecipe(seconds=seconds), seed)
    for key, model in models.items():
        errors = compare(model_errors.modelled(model, proposals, truth.exits, samples, seed), truth.truth)
        rows += [{"model": key, **row._asdict()} for row in errors]
    tell("full_geometry_paper", 2)
    net, _ = fit_paper(obj, PaperRecipe(n=n, seconds=seconds), seed)
    for points in POINTS:
        errors = paper_errors(obj, net, truth, points=points, seed=seed)
        rows += [{"model": f"full_geometry_paper, points {points}", **row._asdict()} for row in errors]
    tell("models", 4)
    return pandas.DataFrame(rows)


def paper_errors(
    obj: TranslucentObject,
    net: PaperNetwork,
    truth: ExitTruth,
    *,
    points: str = "walks",
    repeats: int = 16,
    seed: int = 0,
) -> list[RadianceError]:
    """Errors per channel, under constant light and lobes.

    Args:
        obj: the object.
        net: its network.
        truth: exits and their radiance.
        points: "walks" or "uniform".
        repeats: of each exit.
        seed: of the points.

    Raises:
        ValueError: an argument is out of range.
    """
    check_choice("points", points, POINTS)
    check_count("repeats", repeats, 2)
    return compare(estimate(obj, net, truth.exits, points, repeats, seed), truth.truth)


# ----------------------------------------------------------------------------------------------------
# Variance of a sample of an object's light, over the squared mean, and its time, for ways of drawing entries.
# Exits are uniform over the area with w_o by the cosine. With the estimates X of exit k,
#
#     V = mean_k var(X_k) / (mean_k E[X_k])²,    mean over channels,
#
# is what one sample contributes to the squared relative error of an image; V t, t its time, is what counts. An exit's
# own work is shared by its N samples: V (t_exit/N + t_sample).


TIMED_LANES, MANY = 2**14, 8
REPEATS = 6
LANES = 2**19


class Spread(NamedTuple):
    """V, mean over the channels, and the mean radiance of the exits per channel."""

    variance: float
    mean: np.ndarray


class Cost(NamedTuple):
    """Seconds a million: of what is done once for an exit, and of each of its samples."""

    exit: float
    sample: float

    def of(self, n: int) -> float:
        """Seconds a million samples, n for each exit."""
        return self.exit / n + self.sample


@dataclass(frozen=True, eq=False)
class _Exits:
    """Exits as a renderer has them, with their faces."""

    out: SurfacePoint
    face: mi.UInt32


def _exits(obj: TranslucentObject, n: int, repeated: int, seed: int) -> _Exits:
    """n random exits, `repeated` neighbouring lanes for each."""
    rng = Numbers(generator(mi, n, pass_seed(seed, 31)))
    at = obj.points.sample(rng.next_1d(), rng.next_2d(), True)
    sign = opaque(obj.geometry.sign)
    n_out = mi.Normal3f(turned(at.n_shading, at.n) * sign)
    n_face = mi.Normal3f(at.n * sign)
    w, _ = cosine_above(n_out, n_face, rng.next_2d())
    points = (mi.Point3f(at.p), lifted(n_out, n_face, w), w, n_face, mi.UInt32(at.prim_index))
    dr.eval(points)
    k = dr.arange(mi.UInt32, n * repeated) // repeated
    p, n_out, w, n_face, face = (dr.gather(type(v), v, k) for v in points)
    dr.eval(p, n_out, w, n_face, face)
    return _Exits(SurfacePoint(p, n_face, n_out, w, mi.Float(sign)), face)


def _estimates(model: ObjectModel, light: Lighting, exits: _Exits, rng: Numbers, n: int) -> mi.Spectrum:
    """Sum of n samples of each exit, per channel."""
    on = mi.Bool(True)
    prepared = model.transport.prepare(exits.out, on)
    where = model.proposals.prepare(exits.out, prepared, on)
    total = mi.Spectrum(0)
    for _ in range(n):
        entry = model.proposals.sample(exits.out, exits.face, where, rng, on)
        w, value = light.sample(entry, rng.next_2d(), entry.weight > 0)
        at = entry.facing(w)
        total += model.transport.S(prepared, at, value > 0) * at.mu * (entry.weight * value)
    return total


def spread(
    obj: TranslucentObject,
    model: ObjectModel,
    light: Lighting,
    *,
    exits: int = 256,
    samples: int = 2048,
    seed: int = 0,
) -> Spread:
    """The variance of one sample of a transport by its proposals.

    Args:
        obj: the object.
        model: transport and proposals.
        light: that falls on it.
        exits, samples: random exits, and samples of each.
        seed: of both.
    """
    sums, per_pass = 0.0, max(min(LANES // exits, samples), 1)
    passes = max(samples // per_pass, 1)
    lanes = _exits(obj, exits, per_pass, seed)
    for k in range(passes):
        rng = Numbers(generator(mi, exits * per_pass, pass_seed(seed, 32, k)))
        estimates = _estimates(model, light, lanes, rng, 1)
        rows = [dr.block_sum(v, per_pass) for x in estimates for v in (x, x * x)]
        dr.eval(rows)
        sums = sums + np.stack([r.numpy().astype(float) for r in rows]).reshape(len(estimates), 2, exits)
    mean, square = np.moveaxis(sums / (passes * per_pass), 1, 0)
    total = mean.mean(axis=1)
    live = total > 0
    variance = (square - mean**2).mean(axis=1)[live] / total[live] ** 2
    return Spread(float(variance.mean()), total)


def costs(obj: TranslucentObject, models: Mapping[str, ObjectModel], light: Lighting) -> dict[str, Cost]:
    """Time of each; they take turns, and of the repeats the fastest counts, which is the one that least delayed."""
    lanes = _exits(obj, TIMED_LANES, 1, 5)
    rng = generator(mi, TIMED_LANES, pass_seed(6))
    dr.eval(rng.state, rng.inc)
    best = {(name, n): np.inf for name in models for n in (1, MANY)}
    for k in range(REPEATS + 1):  # the first compiles
        for name, n in best:
            numbers = Numbers(mi.PCG32(rng))
            seconds = kernel_seconds(lambda: _estimates(models[name], light, lanes, numbers, n))  # noqa: B023
            best[name, n] = min(best[name, n], seconds) if k else np.inf
    scale, cost = 1e6 / TIMED_LANES, {}
    for name in models:
        each = max(best[name, MANY] - best[name, 1], 0.0) / (MANY - 1)
        cost[name] = Cost(scale * max(best[name, 1] - each, 0.0), scale * each)
    return cost


# ---- The table of samplers: variance of a sample, its time and their product, under each light -----

SAMPLERS = (
    "uniform", "probes", "patches by network", "patches", "patches and probes", "flow", "patches, light", "flow, light",
)  # fmt: skip
SAMPLES_OF_AN_EXIT = (1, 8)


def samplers(
    learnt: Learnt, recipe: FlowRecipe, light: Lighting, flow: FlowSampler, seed: int = 0
) -> dict[str, Proposals]:
    """All ways of drawing entries of a trained object, by name.

    Args:
        learnt: the object.
        recipe: of what is fitted to the light.
        light: that "..., light" are fitted to, walks times its light.
        flow: fitted to S alone.
        seed: of the fits.
    """
    model, patches = learnt
    object, sign = model.object.geometry, model.object.geometry.sign
    backbone = model.base.models
    table = RadialTable([m for m in backbone if float(m.medium.sigma_s) > 0], object.size)
    probes = PositionSampler(replace(object, pieces=None), table, model.object.points, AREA_SHARE)
    lit = fit_patches(learnt, recipe, light=light, seed=seed)
    lit_flow = fit_flow(learnt._replace(sampler=lit), recipe, light=light, seed=seed)
    by_face, lit_by_face = PatchTable(patches), PatchTable(lit)
    return {
        "uniform": HalfSpaceProposals(replace(probes, area_share=1.0), backbone[0]),
        "probes": HalfSpaceProposals(probes, backbone[0]),
        "patches by network": LearntProposals(patches, probes, 1.0, sign),
        "patches": LearntProposals(patches, probes, 1.0, sign, by_face),
        "patches and probes": LearntProposals(patches, probes, 0.5, sign, by_face),
        "flow": FlowProposals(flow, sign, by_face),
        "patches, light": LearntProposals(lit, probes, 1.0, sign, lit_by_face),
        "flow, light": FlowProposals(lit_flow, sign, lit_by_face),
    }


def sampler_table(
    learnt: Learnt, recipe: FlowRecipe, *, exits: int = 256, samples: int = 2048, seed: int = 0,
    progress: Callable[[str, int, int], object] | None = None,
) -> pandas.DataFrame:  # fmt: skip
    """Rows of light, sampler, V, seconds a million of an exit and of a sample, and V t for 1 and 8 samples an exit.

    Args:
        learnt: the object.
        recipe: of the flow, and of what is fitted to each light.
        exits, samples: of the variance.
        seed: of everything.
        progress: called with (what, done, total).
    """
    import pandas

    obj, rows = learnt.model.object, []
    transport = learnt.model
    flow, total = fit_flow(learnt, recipe, seed=seed), len(LIGHTINGS) * len(SAMPLERS)
    for name in LIGHTINGS:
        light = lighting(name, obj)
        models = {key: ObjectModel(transport, p) for key, p in samplers(learnt, recipe, light, flow, seed).items()}
        spent = costs(obj, models, light)
        for key, each in models.items():
            V = spread(obj, each, light, exits=exits, samples=samples, seed=seed)
            row = {"light": name, "sampler": key, "V": V.variance, "t exit": spent[key].exit, "t": spent[key].sample}
            row |= {f"V t, {n} of an exit": V.variance * spent[key].of(n) for n in SAMPLES_OF_AN_EXIT}
            rows.append({**row, "mean": float(V.mean.mean())})
            if progress:
                progress(f"{name}, {key}", len(rows), total)
    return pandas.DataFrame(rows)
