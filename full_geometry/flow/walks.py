"""Training data of flows: exits of walks as patches and coordinates in them, with their throughput."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from full_geometry.features import Frame, Side, side_features
from full_geometry.first_event import first_event
from full_geometry.flow.chart import Chart
from full_geometry.flow.context import context, direction_square
from full_geometry.flow.lights import Lighting
from full_geometry.learning.exits import trace_exits
from full_geometry.patches import Patches
from full_geometry.subject import Subject
from halfspace_sss.rendering.transport.protocols import Entry
from halfspace_sss.tracing.walk import generator, pass_seed

__all__ = ["Walks", "flow_walks"]


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
    subject: Subject, frame: Frame, patches: Patches, chart: Chart, n: int, seed: tuple[int, ...],
    light: Lighting | None = None,
) -> Walks:  # fmt: skip
    """n walks of random exits.

    Args:
        subject, frame, patches, chart: of the object.
        n: walks.
        seed: of the pass.
        light: that falls on the object: one sample of it at each end, times mu_i, is multiplied to T.
    """
    import drjit as dr
    import mitsuba as mi

    rng = generator(mi, n, pass_seed(*seed, 0))
    starts = subject.random_points(rng)
    exits = trace_exits(subject, starts, (*seed, 1))
    T = exits.T
    if light is not None:
        n_mesh = mi.Normal3f(exits.at.n * subject.found.sign)
        entry = Entry(exits.at.p, n_mesh, exits.at.n_out, mi.Float(1), exits.face)
        w, value = light.sample(entry, mi.Point2f(rng.next_float32(), rng.next_float32()), dr.max(T) > 0)
        T = T * (value * entry.seen(w)[1])
    from_all = side_features(frame, Side(starts, first_event(subject, starts)))
    total = _rows(list(T), n)
    starts_rows = _rows(from_all, n)
    kept = dr.compress(dr.max(T) > 0)
    m = dr.width(kept)
    k = np.array(kept, dtype=np.int64)
    at, out = exits.at.gather(kept), starts.gather(kept)
    face = dr.gather(mi.UInt32, exits.face, kept)
    patch = patches.row("patch", face)
    side = Side(out, first_event(subject, out))
    told = _rows(context(frame, side, chart.frame(patch)), m)
    back = direction_square(at.n_out, out.p - at.p, at.w)
    u = _rows([*chart.coordinates(face, at.p), *back], m)
    entry = _rows(side_features(frame, Side(at, first_event(subject, at))), m)
    return Walks(starts_rows[k], told, entry, u, np.array(patch).astype(np.int64), total[k], starts_rows, total)


def _rows(columns: list[Any], n: int) -> np.ndarray:
    """(n, columns) float32."""
    import drjit as dr

    dr.eval(columns)
    return np.ascontiguousarray(np.stack([np.broadcast_to(c.numpy(), n) for c in columns], axis=1))
