"""Training data of the network of all shapes: random objects, pairs of their points, groups of their exits."""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np

from full_geometry.geometry.points import SurfacePoint
from full_geometry.learning.shapes import TRAINING, Family, make_shape
from full_geometry.objects.objects import TranslucentObject, object_of
from full_geometry.transport.any_shape import ALBEDO, ETA, SIZE, Backbone, G
from full_geometry.transport.descriptors import ALONE, describe, end, medium, mixed
from full_geometry.transport.exit_pairs import EntryProposals, trace_exits
from halfspace_sss.physics.medium import Medium
from halfspace_sss.tracing.walk import generator, pass_seed

# ---- Which shapes and media the network is trained on: drawn at random, each from its own seed -----


RESOLUTION = (32, 56)  # of meshes
MESH_SHARE, SPHERE_SHARE, ISOTROPIC_SHARE = 0.08, 0.03, 0.45
DENSE_SHARE, CONSERVATIVE_SHARE, LEAST_ABSORPTION = 0.75, 0.04, 1e-4


@dataclass(frozen=True, eq=False)
class Drawn:
    """A shape filled with a medium.

    Args:
        family: of the shape, or the name of the mesh.
        obj: the object.
    """

    family: str
    object: TranslucentObject

    def record(self) -> dict[str, Any]:
        """The object as JSON has it."""
        m = self.object.media[0]
        size = float(self.object.mean_free_paths()[0])
        return {"family": self.family, "size_in_mfp": size, "albedo": float(m.albedo), "g": float(m.g), "eta": m.eta}


def draw_medium(rng: np.random.Generator) -> tuple[float, float, float]:
    """Albedo, g and eta of a medium.

    Reduced albedo: three in four log-uniform in its distance to 1 down to 1e-4, the rest uniform; one in 25 is 1. g: 45
    in 100 are 0, the others uniform. eta: uniform, one in twenty 1.
    """
    dense = rng.random() < DENSE_SHARE
    reduced = 1 - LEAST_ABSORPTION ** rng.random() if dense else rng.uniform(*ALBEDO)
    reduced = 1.0 if rng.random() < CONSERVATIVE_SHARE else max(reduced, ALBEDO[0])
    g = 0.0 if rng.random() < ISOTROPIC_SHARE else rng.uniform(*G)
    eta = 1.0 if rng.random() < 0.05 else rng.uniform(1.05, ETA[1])
    return min(float(reduced / (1 - g + g * reduced)), 1.0), float(g), float(eta)


def draw_object(
    seed: Sequence[int], families: Mapping[str, Family] | None = None, meshes: Sequence[Path] = ()
) -> Drawn:
    """A random shape with a random medium.

    Args:
        seed: numbers that it follows from.
        families: generators by name; by default those of training, with spheres and the meshes among them.
        meshes: PLY files that some of the shapes are taken from.
    """
    rng = np.random.default_rng(list(seed))
    u, path = rng.random(2), meshes[int(rng.integers(len(meshes)))] if meshes else None
    made = TRAINING if families is None else families
    family, number = str(rng.choice(list(made))), int(rng.integers(2**31))
    resolution = int(rng.integers(*RESOLUTION))
    if families is None and path is not None and u[0] < MESH_SHARE:
        family, shape = path.stem, mi.load_dict({"type": "ply", "filename": str(path)})
    elif families is None and u[1] < SPHERE_SHARE:
        family, shape = "sphere", mi.load_dict({"type": "sphere"})
    else:
        shape = make_shape(family, number, resolution, made).mitsuba(family)
    size = math.exp(rng.uniform(*np.log(SIZE)))
    albedo, g, eta = draw_medium(rng)
    area = float(np.sum(np.array(shape.surface_area())))
    sigma_t = size / math.sqrt(area)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # thin sheets look open to a survey of few rays
        obj = object_of(shape, Medium(albedo * sigma_t, (1 - albedo) * sigma_t, g, eta))
    return Drawn(family, obj)


def mean_events(obj: TranslucentObject) -> float:
    """About how many events a walk has: at most the mean path 4 eta² V/A in mean free paths, at most 1/(1 - albedo)."""
    m = obj.media[0]
    size = float(obj.mean_free_paths()[0])
    return 5 + min(1 / max(1 - float(m.albedo), 1e-9), 0.4 * size * m.eta**2)


# ----------------------------------------------------------------------------------------------------
# Training data of one object: descriptors of walks with their throughput, and of proposals with S_0 over the density.
# Half-precision descriptors; S_0 is evaluated in NumPy, as its kernels would be compiled for each medium.

EVENTS = 1e6  # of the walks of one object
FEWEST_WALKS, WALKS = 2**13, 2**15
KEPT = 2**13  # walks that left, and proposals, of one object
FEWEST_EXITS = 128
NAMES = ("walks", "T", "proposals", "W", "medium", "share")


@dataclass(frozen=True, eq=False)
class PairData:
    """Descriptors (pairs, numbers): exit, entry, shared; one channel.

    Args:
        walks: of walks that left at order two or more.
        T: their throughput over the mean of all walks.
        proposals: of proposals.
        W: their S_0 mu_i over the density and the same mean.
        medium: its numbers.
        share: of the walks that were begun which the first stand for.
    """

    walks: np.ndarray
    T: np.ndarray
    proposals: np.ndarray
    W: np.ndarray
    medium: np.ndarray
    share: float

    def arrays(self) -> dict[str, np.ndarray]:
        """The arrays for a file."""
        return {name: np.asarray(getattr(self, name)) for name in NAMES}

    @classmethod
    def from_arrays(cls, arrays: Any) -> PairData:
        """Read pairs from the arrays of a file; KeyError if it is another one."""
        stored = {name: arrays[name] for name in NAMES}
        return cls(**{**stored, "share": float(stored["share"])})


def make_data(obj: TranslucentObject, events: float, seed: tuple[int, ...]) -> PairData | None:
    """Walks and proposals of an object; None if too few walks leave it.

    Args:
        obj: the object, of one channel or of equal ones.
        events: of a walk, about, which limits the number of walks.
        seed: of all of it.
    """
    n = int(np.clip(EVENTS / events, FEWEST_WALKS, WALKS))
    starts = obj.random_points(generator(mi, n, pass_seed(*seed, 0)))
    exits = trace_exits(obj, starts, (*seed, 1))
    kept = dr.compress(exits.T[0] > 0)
    if dr.width(kept) < FEWEST_EXITS:
        return None
    share = dr.width(kept) / n
    mean = float(dr.sum(exits.T[0])[0]) / n
    kept = dr.gather(mi.UInt32, kept, dr.arange(mi.UInt32, min(dr.width(kept), KEPT)))
    T = dr.gather(mi.Float, exits.T[0], kept).numpy()
    mixtures = mixed(obj)
    half_space = Backbone(obj, mixtures)
    walks, _ = _columns(half_space, starts.gather(kept), exits.at.gather(kept))
    rng = generator(mi, KEPT, pass_seed(*seed, 2))
    starts = obj.random_points(rng)
    entries, weight = EntryProposals(obj, half_space).sample(starts, rng)
    proposals, S_0 = _columns(half_space, starts, entries)
    W = (S_0 * weight.numpy() / mean).astype(np.float32)
    T = (T / mean).astype(np.float32)
    return PairData(walks, T, proposals, W, medium(obj, 0, mixtures[0]), share)


def _columns(half_space: Backbone, exits: SurfacePoint, entries: SurfacePoint) -> tuple[np.ndarray, np.ndarray]:
    """Descriptors of pairs, (pairs, numbers), and S_0 P_o P_i of the first channel."""
    obj = half_space.object
    o, i = (end(obj, at) for at in (exits, entries))
    query, F_t, above = half_space.query(exits, entries)
    added = F_t * half_space.added(o, i)[0]
    factor = dr.select(above, o.event.P[0] * i.event.P[0], 0)
    dr.eval(query, added, factor)
    S_0 = (half_space.models[0].eval(*(v.numpy() for v in query)) + added.numpy()) * factor.numpy()
    pair = describe(obj, o, i, half_space.shares([mi.Float(S_0.astype(np.float32))], o, i))[0]
    columns = [*pair.exit, *pair.entry, *pair.shared]
    dr.eval(columns)
    rows = np.stack([np.broadcast_to(c.numpy(), dr.width(exits.p)) for c in columns], axis=-1)
    return np.nan_to_num(rows, posinf=0, neginf=0).astype(np.float16), S_0


# ---- Exits of one object in groups of those that look alike, whose light a fit holds to that of walks
# The likelihood of pairs cares little for what leaves in sum: where things are thick, most of what f brings is a choice
# between entries, and the sum over them is off by some percent. So for a group of exits, B the mean throughput of its
# walks, Z and Z' the means of (S_0 mu_i / q) exp f of two halves of its proposals, whose product has no bias,
#
#     w (Z/B - 1)(Z'/B - 1)/2,    w = 4/(1 + v/0.03),
#
# stands beside the likelihood, v the squared noise of Z/B.

HALVINGS = 4
GROUPS = 2**HALVINGS
AXIS_FROM = 512  # exits
EMPHASIS = 4.0  # 16 is better for what is thick and worse for what is not
NOISE, PAIRS = 0.03, 64  # squared, of the mean of so many proposals
LEAST_LIGHT, FEWEST_PROPOSALS, FEWEST_WALKS_OF_GROUP = 1e-3, 128, 32


class GroupPart(NamedTuple):
    """Some pairs of one group.

    Args:
        walks, proposals: descriptors (pairs, numbers).
        T: of walks, so that their sum is a sample of the mean over the whole object.
        W: of proposals.
        medium: its numbers.
        share: of the mean of W in the mean over the whole object.
        light: B of the group.
        weight: w.
    """

    walks: np.ndarray
    T: np.ndarray
    proposals: np.ndarray
    W: np.ndarray
    medium: np.ndarray
    share: float
    light: float
    weight: float


@dataclass(frozen=True, eq=False)
class GroupedPairs:
    """Data in the order of groups.

    Args:
        data: of an object.
        proposals, walks: where groups begin and end among them, (GROUPS + 1,).
        share: of the exits that a group has, (GROUPS,).
        light: B over the mean of all walks, (GROUPS,).
        weight: w, (GROUPS,); 0 where too little is known.
    """

    data: PairData
    proposals: np.ndarray
    walks: np.ndarray
    share: np.ndarray
    light: np.ndarray
    weight: np.ndarray

    def part(self, n: int, rng: np.random.Generator) -> GroupPart:
        """n walks and proposals, or all there are, of a random group."""
        data, u = self.data, rng.random(3)
        k = int(u[0] * GROUPS)
        i, j = _some(self.proposals, k, n, u[1]), _some(self.walks, k, n, u[2], repeated=False)
        among = data.share * (self.walks[k + 1] - self.walks[k]) / len(data.T)
        T = data.T[j] * (among * GROUPS / max(len(j), 1))
        numbers = float(self.share[k] * GROUPS), float(self.light[k]), float(self.weight[k])
        return GroupPart(data.walks[j], T, data.proposals[i], data.W[i], data.medium, *numbers)


def grouped(data: PairData) -> GroupedPairs:
    """The data of an object in 16 groups of exits, halved four times at the median of their first principal axis."""
    exits = [v[:, ALONE].astype(np.float32) for v in (data.proposals, data.walks)]
    mean, spread = exits[0].mean(axis=0), exits[0].std(axis=0) + 1e-6
    labels = [np.zeros(len(v), np.int16) for v in exits]
    _halve([(v - mean) / spread for v in exits], labels, [np.arange(len(v)) for v in exits], HALVINGS, 0)
    (i, j), counts = (
        [np.argsort(v, kind="stable") for v in labels],
        [np.bincount(v, minlength=GROUPS) for v in labels],
    )
    data = replace(data, proposals=data.proposals[i], W=data.W[i], walks=data.walks[j], T=data.T[j])
    bounds = [np.concatenate([[0], np.cumsum(v)]) for v in counts]
    share = counts[0] / len(data.W)
    W, T = (_moments(v, at) for v, at in zip((data.W, data.T), bounds))
    light = T[0] * counts[1] * data.share / len(data.T) / np.maximum(share, 1e-9)
    known = (light > LEAST_LIGHT) & (counts[0] >= FEWEST_PROPOSALS) & (counts[1] >= FEWEST_WALKS_OF_GROUP)
    noise = W[1] / PAIRS + (1 + T[1]) / np.maximum(counts[1], 1)
    weight = np.where(known, EMPHASIS / (1 + noise / NOISE), 0.0)
    return GroupedPairs(data, *bounds, share, np.where(known, light, 1.0), weight)


def _halve(exits: list[np.ndarray], labels: list[np.ndarray], kept: list[np.ndarray], times: int, first: int) -> None:
    """Label the kept rows of proposals and walks, the axis and the median those of proposals."""
    if times == 0:
        for label, k in zip(labels, kept):
            label[k] = first
        return
    own = exits[0][kept[0]]
    axis = np.linalg.eigh(np.cov(own[:AXIS_FROM].T))[1][:, -1] if len(own) > 1 else np.ones(len(ALONE))
    along = [v[k] @ axis for v, k in zip(exits, kept)]
    middle = float(np.median(along[0])) if len(own) else math.inf
    lower, upper = ([k[side] for k, side in zip(kept, sides)]
                    for sides in ([v <= middle for v in along], [v > middle for v in along]))  # fmt: skip
    _halve(exits, labels, lower, times - 1, first)
    _halve(exits, labels, upper, times - 1, first + 2 ** (times - 1))


def _moments(values: np.ndarray, bounds: np.ndarray) -> np.ndarray:
    """Mean, and variance over its square, of each group, (2, GROUPS); 0 of what is empty."""
    parts = [values[a:b].astype(float) for a, b in zip(bounds, bounds[1:])]
    means, variances = (np.array([float(f(v)) if len(v) else 0.0 for v in parts]) for f in (np.mean, np.var))
    return np.stack([means, variances / np.maximum(means, 1e-6) ** 2])


def _some(bounds: np.ndarray, k: int, n: int, u: float, repeated: bool = True) -> np.ndarray:
    """n neighbours of group k from a random one on, in a circle; of fewer than n none twice unless it is allowed."""
    first, count = int(bounds[k]), int(bounds[k + 1] - bounds[k])
    if count == 0:
        return np.zeros(0, int)
    return first + (int(u * count) + np.arange(n if repeated else min(n, count))) % count
