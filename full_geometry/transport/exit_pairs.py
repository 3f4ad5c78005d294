"""Training data of one object: walks with their throughput, and proposals with S_0 over their density.

A walk begins at x_o, goes inwards along the refracted w_o with the weight F_t(mu_o), is scattered, is reflected at the
boundary from inside, and leaves at x_i along w_i with the throughput T of each channel. Then

    L_o(x_o, w_o) = E[T L_i(x_i, w_i)],    E[T delta(x - x_i, w - w_i)] = S(x, w; x_o, w_o) mu.

A walk that meets something inside the object is one of two scattering events at least.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np

from full_geometry.geometry.points import (
    PositionSampler,
    RadialTable,
    SurfacePoint,
    channel_mean,
    cosine_direction,
    opaque,
)
from full_geometry.objects.objects import TranslucentObject
from full_geometry.transport.features import (
    ObjectFrame,
    PreparedExit,
    Side,
    entered,
    first_event,
    pair_features,
    side_features,
)
from full_geometry.transport.one_object import HalfSpace
from full_geometry.transport.patches import AREA_SHARE, LearntProposals, PatchSampler, WeightTable
from full_geometry.walk.media import media_within
from full_geometry.walk.random_walk import WalkExits, exits
from full_geometry.walk.scores import Score, scored_exits
from halfspace_sss.checks import check_count
from halfspace_sss.tracing.walk import generator, pass_seed

if TYPE_CHECKING:
    import torch


def trace_exits(
    obj: TranslucentObject, starts: SurfacePoint, seed: tuple[int, ...], *, fewest: int = 2, most: int = 2**31 - 1
) -> WalkExits:
    """One walk from each start. `starts`: where light is seen to leave, and the direction towards the eye. `seed`: of
    the pass, as for `walk.pass_seed`. `fewest`, `most`: numbers of scattering events that are kept. ValueError if
    fewest is not a whole number >= 0."""
    check_count("fewest", fewest, 0)
    return exits(media_within(obj), 0, starts, seed, fewest, most)


def trace_scores(obj: TranslucentObject, starts: SurfacePoint, seed: tuple[int, ...]) -> tuple[mi.Spectrum, Score]:
    """T of one walk from each start, of two events and more, and the scores of walks that left."""
    exits, scores = scored_exits(media_within(obj), 0, starts, seed, 2)
    return exits.T, scores


PATCH_SHARE = 0.6  # of those by patches, where they are learnt
ALBEDO_EVERY = 4  # walks, one tells its light under uniform illumination: that is simpler than S
ENOUGH = 1.5  # over the mean: pairs of less value are kept by chance, and then with more


class Numbers:
    """Uniform numbers of a generator under the names that Mitsuba's samplers give them."""

    def __init__(self, rng: mi.PCG32) -> None:
        self.rng = rng

    def next_1d(self) -> mi.Float:
        return self.rng.next_float32()

    def next_2d(self) -> mi.Point2f:
        return mi.Point2f(self.rng.next_float32(), self.rng.next_float32())


class AlbedoSamples(NamedTuple):
    """Exits of walks as columns, features (inputs, n), and T, (2 channels, n): of order one, then of the others."""

    features: np.ndarray
    T: np.ndarray


class Pairs(NamedTuple):
    """Pairs as columns: features (inputs, n), values (channels, n), whose sum over `drawn` is the mean of all drawn."""

    features: np.ndarray
    values: np.ndarray
    drawn: int
    faces: np.ndarray | None = None  # where walks left
    albedo: AlbedoSamples | None = None  # of some of the walks
    random: tuple[np.ndarray, int] | None = None  # where not all exits are random: which are, and how many were drawn

    def of_random_exits(self, x: torch.Tensor, values: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, int]:
        """Columns of features and values of random exits alone, and how many were drawn."""
        if self.random is None:
            return x, values, self.drawn
        places, drawn = self.random
        return x[:, places], values[:, places], drawn


def shuffled(parts: list[Pairs], order: np.random.Generator) -> Pairs:
    """The pairs of several sources, the last of random exits, as those of one: exits then are as those of all."""
    features = np.concatenate([part.features for part in parts], axis=1)
    values = np.concatenate([part.values for part in parts], axis=1)
    places = order.permutation(values.shape[1])
    faces = None if parts[0].faces is None else np.concatenate([part.faces for part in parts])[places]
    random = np.flatnonzero(places >= values.shape[1] - parts[-1].values.shape[1]), parts[-1].drawn
    drawn = sum(part.drawn for part in parts)
    pairs = Pairs(features[:, places], values[:, places], drawn, faces, random=random)
    if parts[0].albedo is None:
        return pairs
    exits, T = (np.concatenate(columns, axis=1) for columns in zip(*(part.albedo for part in parts)))
    places = order.permutation(T.shape[1])
    return pairs._replace(albedo=AlbedoSamples(exits[:, places], T[:, places]))


class EntryProposals:
    """Entries for given exits: probes and uniform points, and learnt patches beside them; directions by the cosine.

    Probes have the density D of all their hits, patches q; with a share s of patches (balance heuristic) a point of
    weight v by a probe alone counts v D / ((1 - s) D + s q), one of a patch 1 / ((1 - s) D + s q).

    Args:
        base: whose radial densities the probes follow.
        area_share: of the candidates that are uniform over the area, without patches.
        patches: learnt weights, or None.
    """

    def __init__(
        self,
        obj: TranslucentObject,
        base: HalfSpace,
        area_share: float = AREA_SHARE,
        patches: PatchSampler | None = None,
    ) -> None:
        live = [m for m in base.models if float(m.medium.sigma_s) > 0]
        table = RadialTable(live or base.models, obj.geometry.size)
        self.object, self.base, self.patches = obj, base, patches
        # light may leave by another piece of the surface than it entered by
        self.positions = PositionSampler(replace(obj.geometry, pieces=None), table, obj.points, area_share)

    def sample(
        self, exit: SurfacePoint, rng: mi.PCG32, table: WeightTable | None = None, k: mi.UInt32 | int = 0
    ) -> tuple[SurfacePoint, mi.Float]:
        """An entry for each exit, and mu_i over its density; 0 where none was found.
        `exit`: points of the surface. `rng`: generator of as many lanes. `table`: of weights of patches, which are
        asked of the network otherwise. `k`: of each exit, its number in the table."""
        out = exit._replace(sign=opaque(self.object.geometry.sign))
        known = (out, mi.UInt32(k))
        if self.patches is None:
            entry = self.positions.sample(*known, Numbers(rng), mi.Bool(True))
        else:
            drawn = LearntProposals(self.patches, self.positions, PATCH_SHARE, self.object.geometry.sign, table)
            where = drawn.prepare(out, PreparedExit(Side(exit, first_event(self.object, exit)), []), mi.Bool(True))
            entry = drawn.sample(*known, where, Numbers(rng), mi.Bool(True))
        return entry.facing(cosine_direction(entry.n_out, entry.n, rng)), dr.pi * entry.weight

    def with_patches(self, patches: PatchSampler | None) -> EntryProposals:
        """The same with learnt weights of patches, which take the place of uniform points."""
        return EntryProposals(self.object, self.base, 0.0, patches) if patches is not None else self


@dataclass(frozen=True, eq=False)
class PairSource:
    """Makes training data.
    `base`: S_0, which values of proposals have. `proposals`: where they come from. `scale`: of T of each
    channel, one over its mean; without it every walk that left is kept."""

    object: TranslucentObject
    frame: ObjectFrame
    base: HalfSpace
    proposals: EntryProposals
    scale: mi.Spectrum | None = None

    def scaled(self, scale: np.ndarray) -> PairSource:
        """The same with the scale of a fit, so that its mean over channels that have any light is 1."""
        live = max(np.count_nonzero(scale), 1)
        return replace(self, scale=mi.Spectrum([opaque(v * len(scale) / live) for v in scale.tolist()]))

    def walks(self, n: int, seed: tuple[int, ...]) -> Pairs:
        """n walks of random exits; of those that left at an order that counts some, see `ended`."""
        return self.ended(*self.traced(n, seed), seed)

    def traced(self, n: int, seed: tuple[int, ...]) -> tuple[SurfacePoint, WalkExits]:
        """Starts and ends of n walks of random exits."""
        starts = self.object.random_points(generator(mi, n, pass_seed(*seed, 0)))
        return starts, trace_exits(self.object, starts, (*seed, 1), fewest=1)

    def ended(self, starts: SurfacePoint, exits: WalkExits, seed: tuple[int, ...]) -> Pairs:
        """The pairs of walks whose ends and orders from one on are known, those of two and more, T as values.

        With t the mean over channels of T over its mean, a walk is kept with the chance p = min(1, t / 1.5), as T / p:
        one of little T costs a step as much as another, and tells it less."""
        n, albedo = dr.width(starts.p), self._albedo_samples(starts, exits)
        T = dr.select(exits.order == 1, 0, exits.T)
        if self.scale is not None:
            p = dr.minimum(channel_mean(T * self.scale) / ENOUGH, 1)
            stays = generator(mi, n, pass_seed(*seed, 4)).next_float32() < p
            T = dr.select(stays, T / dr.maximum(p, 1e-20), 0)
        kept = dr.compress(dr.max(T) > 0)
        if dr.width(kept) == 0:
            nothing = self._columns(starts, starts, dr.zeros(mi.Spectrum, n))
            return nothing._replace(faces=np.zeros(n, np.uint32), albedo=albedo)
        ends, T = exits.at.gather(kept), dr.gather(mi.Spectrum, T, kept)
        faces = np.array(dr.gather(mi.UInt32, exits.face, kept))
        return self._columns(starts.gather(kept), ends, T)._replace(drawn=n, faces=faces, albedo=albedo)

    def _albedo_samples(self, starts: SurfacePoint, exits: WalkExits) -> AlbedoSamples:
        """What walks bring under the same light from everywhere, of every fourth walk."""
        n = max(dr.width(starts.p) // ALBEDO_EVERY, 1)
        lanes = dr.arange(mi.UInt32, n) * ALBEDO_EVERY
        at, T = starts.gather(lanes), dr.gather(mi.Spectrum, exits.T, lanes)
        once = dr.gather(mi.UInt32, exits.order, lanes) == 1
        columns = side_features(self.frame, Side(at, first_event(self.object, at)))
        return AlbedoSamples(_stacked(columns, n), _stacked([*dr.select(once, T, 0), *dr.select(once, 0, T)], n))

    def proposed(self, n: int, seed: tuple[int, ...], starts: SurfacePoint | None = None) -> Pairs:
        """n proposals, S mu_i of the base model over their density as values.
        `n`: how many. `starts`: n exits that they are of; by default random ones."""
        rng = generator(mi, n, pass_seed(*seed, 2))
        starts = starts or self.object.random_points(rng)
        entries, weight = self.proposals.sample(starts, rng)
        return self._columns(starts, entries, weight)

    def _columns(self, exits: SurfacePoint, entries: SurfacePoint, value: mi.Spectrum | mi.Float) -> Pairs:
        """Features of pairs; `value` is a spectrum, or a weight that S_0 is to be multiplied by."""
        exit, entry = (self.base.end(at) for at in (exits, entered(entries, exits)))
        if isinstance(value, mi.Float):
            value = self.base(exit, entry) * value
        columns = [*side_features(self.frame, exit), *side_features(self.frame, entry)]
        columns += pair_features(self.frame, exit, entry)
        dr.eval(columns, value)
        n = dr.width(value)
        features = _stacked(columns, n)
        return Pairs(features, np.array(value, dtype=np.float32).reshape(len(value), n), n)


def _stacked(columns: list[mi.Float], n: int) -> np.ndarray:
    """Columns of n lanes as rows."""
    dr.eval(columns)
    return np.stack([np.broadcast_to(c.numpy(), n) for c in columns])
