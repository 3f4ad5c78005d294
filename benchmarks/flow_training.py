"""Learning flows and weights of patches by zuko, from walks alone or times a light."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from itertools import count
from typing import NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np
import torch
import zuko
from torch import nn

from benchmarks.fits import CpuSchedule, Objective
from benchmarks.flow import (
    BINS,
    LEAST_SLOPE,
    N_CONTEXT,
    Chart,
    ConditionalFlow,
    FlowSampler,
    context,
    direction_square,
)
from full_geometry.geometry.points import EntrySample, place
from full_geometry.geometry.rounding import ray_from
from full_geometry.objects.objects import TranslucentObject
from full_geometry.transport.exit_pairs import trace_exits
from full_geometry.transport.features import ObjectFrame, Side, first_event, side_features
from full_geometry.transport.patches import Patches
from full_geometry.transport.storing import Learnt
from halfspace_sss.arrays import Lanes
from halfspace_sss.checks import check_count
from halfspace_sss.neural.training.fit import Source, fit
from halfspace_sss.tracing.walk import generator, pass_seed

# ---- Training of conditional flows by zuko: -E[T log p(x | context)] over walks --------------------


HIDDEN = (32, 32)


class FlowNetwork(nn.Module):
    """One masked autoregressive transform of splines onto a uniform square.

    Args:
        n: dimensions.
        context: numbers that it is told.
        hidden: widths of the hidden layers.
        seed: of the initial weights.
    """

    def __init__(self, n: int, context: int, hidden: tuple[int, ...] = HIDDEN, seed: int = 0) -> None:
        super().__init__()
        spline = partial(zuko.transforms.MonotonicRQSTransform, bound=1.0, slope=LEAST_SLOPE)
        with torch.random.fork_rng():
            torch.manual_seed(seed)
            self.transform = zuko.flows.MaskedAutoregressiveTransform(
                features=n, context=context, univariate=spline, shapes=[(BINS,), (BINS,), (BINS - 1,)],
                hidden_features=hidden,
            )  # fmt: skip
        last = self.transform.hyper[-1]
        with torch.no_grad():  # uniform at the start
            last.weight.zero_()
            last.bias.zero_()

    def log_density(self, context: torch.Tensor, x: torch.Tensor) -> torch.Tensor:
        """Of x (m, n) in [0, 1)^n, given context (m, inputs)."""
        return self.transform(context).call_and_ladj(2 * x - 1)[1]

    def arrays(self) -> dict[str, np.ndarray]:
        """Matrices F_k with their masks multiplied in, and biases h_k."""
        arrays, layers = {}, [m for m in self.transform.hyper if hasattr(m, "weight")]
        for k, layer in enumerate(layers):
            arrays[f"F_{k}"] = (layer.mask * layer.weight).detach().numpy().copy()
            arrays[f"h_{k}"] = layer.bias.detach().numpy().copy()
        return arrays


# ---- A light that samplers may be fitted to: for an entry a direction, and the light from there over its density


@dataclass(frozen=True, eq=False)
class Lighting:
    """Light about an object, in whose shadow it is 0.

    Args:
        object: that casts shadows.
        sample_emitter: (entry, pair of uniforms) -> direction to the light, value over density, distance.
    """

    object: TranslucentObject
    sample_emitter: Callable[[Lanes, Lanes], tuple[Lanes, Lanes, Lanes]]

    def sample(self, entry: EntrySample, u: Lanes, active: Lanes) -> tuple[Lanes, Lanes]:
        """w_i at an entry, and the light from there over its density: 0 in the shadow."""
        w, value, distance = self.sample_emitter(entry, u)
        ray = ray_from(place(entry.p, entry.n), w, self.object.geometry.clearance)
        ray.maxt = distance
        lit = active & (dr.dot(w, entry.n) > 0)
        return w, dr.select(lit & ~self.object.geometry.scene.ray_test(ray, False, lit), value, 0)


# ---- Training data of flows: exits of walks as patches and coordinates in them, with their throughput


class Walks(NamedTuple):
    """Rows of walks that left; `drawn` were begun.

    Attributes:
        exit: features of the exit (n, inputs).
        told: of the exit as seen from the patch where the walk left (n, N_CONTEXT).
        entry: features of the point and direction where it left (n, inputs).
        u: its coordinates in the patch and of its direction (n, 4).
        patch: where it left (n,).
        T: throughput, times the light there if one is given (n, channels).
        starts: features of the exits of all walks (drawn, inputs). total: T of all walks (drawn, channels).
    """

    exit: np.ndarray
    told: np.ndarray
    entry: np.ndarray
    u: np.ndarray
    patch: np.ndarray
    T: np.ndarray
    starts: np.ndarray
    total: np.ndarray

    @property
    def drawn(self) -> int:
        return len(self.total)


def flow_walks(
    obj: TranslucentObject, frame: ObjectFrame, patches: Patches, chart: Chart, n: int, seed: tuple[int, ...],
    light: Lighting | None = None,
) -> Walks:  # fmt: skip
    """n walks of random exits.

    Args:
        obj, frame, patches, chart: of the object.
        n: walks.
        seed: of the pass.
        light: that falls on the object: one sample of it at each end, times mu_i, is multiplied to T.
    """
    rng = generator(mi, n, pass_seed(*seed, 0))
    starts = obj.random_points(rng)
    exits = trace_exits(obj, starts, (*seed, 1))
    T = exits.T
    if light is not None:
        entry = EntrySample(exits.at.p, exits.at.n, exits.at.n_out, mi.Float(1), exits.face)
        w, value = light.sample(entry, mi.Point2f(rng.next_float32(), rng.next_float32()), dr.max(T) > 0)
        T = T * (value * entry.facing(w).mu)
    from_all = side_features(frame, Side(starts, first_event(obj, starts)))
    total = _rows(list(T), n)
    starts_rows = _rows(from_all, n)
    kept = dr.compress(dr.max(T) > 0)
    m = dr.width(kept)
    k = np.array(kept, dtype=np.int64)
    at, out = exits.at.gather(kept), starts.gather(kept)
    face = dr.gather(mi.UInt32, exits.face, kept)
    patch = patches.row("patch", face)
    side = Side(out, first_event(obj, out))
    told = _rows(context(frame, side, chart.frame(patch)), m)
    back = direction_square(at.n_out, out.p - at.p, at.w)
    u = _rows([*chart.coordinates(face, at.p), *back], m)
    entry = _rows(side_features(frame, Side(at, first_event(obj, at))), m)
    return Walks(
        exit=starts_rows[k],
        told=told,
        entry=entry,
        u=u,
        patch=np.array(patch).astype(np.int64),
        T=total[k],
        starts=starts_rows,
        total=total,
    )


def _rows(columns: list[Lanes], n: int) -> np.ndarray:
    """(n, columns) float32."""
    dr.eval(columns)
    return np.ascontiguousarray(np.stack([np.broadcast_to(c.numpy(), n) for c in columns], axis=1))


# ----------------------------------------------------------------------------------------------------
# Learning a flow, or weights of patches, from the exits of walks; for any light or for a given one.


@dataclass(frozen=True)
class FlowRecipe:
    """How a sampler is fitted.

    Args:
        seconds: of CPU time of this process, data included.
        steps: instead of the seconds, where the end is to be the same every time.
        batch, rate: of a step.
        chunk: walks that are made at once.
        reuse: times that each is used.
        hidden: widths of the flow's network.
        patch_hidden: of the network of patches.
    """

    seconds: float = 30.0
    steps: int | None = None
    batch: int = 2048
    rate: float = 4e-3
    chunk: int = 2**16
    reuse: int = 4
    hidden: tuple[int, ...] = (32, 32)
    patch_hidden: tuple[int, ...] = (64, 32)

    def __post_init__(self) -> None:
        for name in ("batch", "chunk", "reuse"):
            check_count(name, getattr(self, name), 1)
        _ = self.schedule  # which refuses seconds, steps and rates out of range

    @property
    def schedule(self) -> CpuSchedule:
        return CpuSchedule(self.seconds, self.steps, self.rate, warm_up=50, last=0.02)


class FlowBatch(NamedTuple):
    """Rows of walks."""

    walks: Walks
    rows: np.ndarray


def walk_batches(data: Callable[[int], Walks], recipe: FlowRecipe, seed: int) -> Source:
    """Batches of chunks of walks, each chunk shuffled and used `reuse` times.

    Args:
        data: gives the walks of chunk k.
        recipe: sizes.
        seed: of the order.
    """

    def batches() -> Iterator[FlowBatch]:
        for chunk in count():
            walks, order = data(chunk), np.random.default_rng([seed, chunk])
            n = len(walks.T)
            if n == 0:
                raise ValueError(f"object must scatter light out of it, got none of {walks.drawn} walks that leaves")
            for _ in range(recipe.reuse):
                shuffled = order.permutation(n)
                for k in range(max(n // recipe.batch, 1)):
                    yield FlowBatch(walks, shuffled[k * recipe.batch : (k + 1) * recipe.batch])

    source = batches()
    return lambda _: next(source)


def likelihood_weights(batch: FlowBatch) -> torch.Tensor:
    """T of rows over the mean of all, mean over the channels that carry light."""
    walks, rows = batch
    mean = walks.total.mean(axis=0)
    live = mean > 0
    scaled = walks.T[rows][:, live] / mean[live]
    # a light leaves a few walks with very large values; the rest of them is noise to the fit
    return torch.from_numpy(np.minimum(scaled.mean(axis=1), 50.0).astype(np.float32))


def fit_flow(
    learnt: Learnt, recipe: FlowRecipe | None = None, *, light: Lighting | None = None, seed: int = 0
) -> FlowSampler:
    """A flow inside the patches of a trained object, by -E[T log p(u | exit, patch)].

    Args:
        learnt: the object, with its patches; their weights stay as they are.
        recipe: sizes and rates.
        light: that falls on the object; None fits to S itself.
        seed: of everything.
    """
    recipe, (model, sampler) = recipe or FlowRecipe(), learnt
    chart = Chart(model.object, sampler.frame, sampler.patches)
    net = FlowNetwork(2, N_CONTEXT, recipe.hidden, seed)

    def loss(batch: FlowBatch) -> torch.Tensor:
        walks, rows = batch
        told, u = torch.from_numpy(walks.told[rows]), torch.from_numpy(walks.u[rows, :2])
        return -(likelihood_weights(batch) * net.log_density(told, u)).mean()

    fit(Objective(net, loss), walks_of(learnt, chart, recipe, light, seed), recipe.schedule, seed)
    return FlowSampler(sampler, chart, ConditionalFlow(2, net.arrays()))


def walks_of(learnt: Learnt, chart: Chart, recipe: FlowRecipe, light: Lighting | None, seed: int) -> Source:
    obj, sampler = learnt.model.object, learnt.sampler

    def data(k: int) -> Walks:
        return flow_walks(obj, sampler.frame, sampler.patches, chart, recipe.chunk, (seed, 61, k), light)

    return walk_batches(data, recipe, seed)
