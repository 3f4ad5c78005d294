"""Training data of one object: descriptors of walks with their throughput, and of proposals with S_0 over the density.

Half-precision descriptors; S_0 is evaluated in NumPy, as its kernels would be compiled for each medium.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from full_geometry.learning.exits import trace_exits
from full_geometry.learning.pairs import Proposals
from full_geometry.neural_shape.backbone import Backbone
from full_geometry.neural_shape.descriptors import describe, end, medium
from full_geometry.neural_shape.mixing import mixed
from full_geometry.subject import Subject, SurfacePoint
from halfspace_sss.tracing.walk import generator, pass_seed

__all__ = ["PairData", "make_data"]

EVENTS = 1e6  # of the walks of one object
FEWEST_WALKS, WALKS = 2**13, 2**15
KEPT = 2**13  # walks that left, and proposals, of one object
FEWEST_EXITS = 128
ROULETTE_FROM = 8
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
        """For a file."""
        return {name: np.asarray(getattr(self, name)) for name in NAMES}

    @classmethod
    def from_arrays(cls, arrays: Any) -> PairData:
        """From a file; KeyError if it is another one."""
        found = {name: arrays[name] for name in NAMES}
        return cls(**{**found, "share": float(found["share"])})


def make_data(subject: Subject, events: float, seed: tuple[int, ...]) -> PairData | None:
    """Walks and proposals of an object; None if too few walks leave it.

    Args:
        subject: the object, of one channel or of equal ones.
        events: of a walk, about, which limits the number of walks.
        seed: of all of it.
    """
    import drjit as dr
    import mitsuba as mi

    n = int(np.clip(EVENTS / events, FEWEST_WALKS, WALKS))
    starts = subject.random_points(generator(mi, n, pass_seed(*seed, 0)))
    exits = trace_exits(subject, starts, (*seed, 1), roulette_from=ROULETTE_FROM)
    kept = dr.compress(exits.T[0] > 0)
    if dr.width(kept) < FEWEST_EXITS:
        return None
    share = dr.width(kept) / n
    mean = float(dr.sum(exits.T[0])[0]) / n
    kept = dr.gather(mi.UInt32, kept, dr.arange(mi.UInt32, min(dr.width(kept), KEPT)))
    T = dr.gather(mi.Float, exits.T[0], kept).numpy()
    mixtures = mixed(subject)
    half_space = Backbone(subject, mixtures)
    walks, _ = _columns(half_space, starts.gather(kept), exits.at.gather(kept))
    rng = generator(mi, KEPT, pass_seed(*seed, 2))
    starts = subject.random_points(rng)
    entries, weight = Proposals(subject, half_space).sample(starts, rng)
    proposals, S_0 = _columns(half_space, starts, entries)
    W = (S_0 * weight.numpy() / mean).astype(np.float32)
    T = (T / mean).astype(np.float32)
    return PairData(walks, T, proposals, W, medium(subject, 0, mixtures[0]), share)


def _columns(half_space: Backbone, exits: SurfacePoint, entries: SurfacePoint) -> tuple[np.ndarray, np.ndarray]:
    """Descriptors of pairs, (pairs, numbers), and S_0 P_o P_i of the first channel."""
    import drjit as dr
    import mitsuba as mi

    subject = half_space.subject
    o, i = (end(subject, at) for at in (exits, entries))
    query, F_t, above = half_space.query(exits, entries)
    added = F_t * half_space.added(o, i)[0]
    factor = dr.select(above, o.event.P[0] * i.event.P[0], 0)
    dr.eval(query, added, factor)
    S_0 = (half_space.models[0].eval(*(v.numpy() for v in query)) + added.numpy()) * factor.numpy()
    pair = describe(subject, o, i, half_space.shares([mi.Float(S_0.astype(np.float32))], o, i))[0]
    columns = [*pair.exit, *pair.entry, *pair.shared]
    dr.eval(columns)
    found = np.stack([np.broadcast_to(c.numpy(), dr.width(exits.p)) for c in columns], axis=-1)
    return np.nan_to_num(found, posinf=0, neginf=0).astype(np.float16), S_0
