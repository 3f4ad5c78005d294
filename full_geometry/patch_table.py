"""Weights of patches tabulated over the exits: looked up by the face of an exit, where the network would be asked.

The surface is cut into cells, finer than patches; of each the learnt weights are averaged over random exits in it. The
density stays exact, as samples are drawn by the table itself. Against the network at every exit the variance rises by a
fifth at most, and of the time of an exit most goes.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from full_geometry.features import Side, side_features
from full_geometry.first_event import first_event
from full_geometry.patches import HIGHEST, Patches, PatchSampler, PatchWeights, cluster
from full_geometry.subject import SurfacePoint, cosine_direction, surface_point
from halfspace_sss.rendering.surface.object import turned
from halfspace_sss.tracing.walk import generator, pass_seed

__all__ = ["CELLS", "ExitTable", "PatchTable"]

CELLS = 4096
EXITS = 4  # of a cell


@dataclass(frozen=True, eq=False)
class _Row:
    """The cumulative weights of a cell, as a lane asks for them."""

    table: Any
    start: Any

    def __getitem__(self, k: Any) -> Any:
        import drjit as dr

        return dr.gather(type(self.table), self.table, self.start + k)


class ExitTable:
    """Weights of given exits, looked up by their number.

    Args:
        sampler: whose network is asked, once for each.
        exits: points of the surface.
    """

    def __init__(self, sampler: PatchSampler, exits: SurfacePoint) -> None:
        import drjit as dr
        import mitsuba as mi

        side = Side(exits, first_event(sampler.patches.subject, exits))
        rows = np.cumsum(_weights(sampler, side, dr.width(exits.p)), axis=1).astype(np.float32)
        self.n, self.table, self.last = rows.shape[1], mi.Float(rows.ravel()), mi.Float(rows[:, -1].copy())

    def weights(self, k: Any) -> PatchWeights:
        """Of exit k."""
        import drjit as dr

        return PatchWeights(_Row(self.table, k * self.n), dr.gather(type(self.last), self.last, k))


class PatchTable:
    """The table of an object.

    Args:
        sampler: whose network is asked, once.
        cells: at most so many.
    """

    def __init__(self, sampler: PatchSampler, cells: int = CELLS) -> None:
        import drjit as dr
        import mitsuba as mi

        subject, n = sampler.patches.subject, len(sampler.patches.of_face)
        of_face = np.arange(n, dtype=np.uint32)
        if n > cells:
            centres = cluster(subject, sampler.frame, cells, seed=1, rounds=1)
            parts = Patches(subject, sampler.frame, centres)
            of_face, n = parts.of_face, cells
        faces = mi.UInt32(of_face)
        total = 0.0
        for k in range(EXITS):
            rng = generator(mi, n, pass_seed(51, k))
            u_face, u = rng.next_float32(), mi.Point2f(rng.next_float32(), rng.next_float32())
            cell = dr.arange(mi.UInt32, n)
            at = subject.points.on_face(cell, u) if n == len(of_face) else parts.point(cell, u_face, u)
            n_out = mi.Normal3f(turned(at.n_shading, at.n) * subject.found.sign)
            normal = mi.Normal3f(at.n * subject.found.sign)
            exit = surface_point(at.p, normal, n_out, cosine_direction(n_out, normal, rng))
            total = total + _weights(sampler, Side(exit, first_event(subject, exit)), n)
        rows = np.cumsum(total / EXITS, axis=1).astype(np.float32)
        self.n, self.table, self.of_face = sampler.patches.n, mi.Float(rows.ravel()), faces
        self.last = mi.Float(rows[:, -1].copy())
        dr.eval(self.table, self.of_face, self.last)

    def weights(self, face: Any) -> PatchWeights:
        """Of an exit on a face."""
        import drjit as dr

        cell = dr.gather(type(self.of_face), self.of_face, face)
        return PatchWeights(_Row(self.table, cell * self.n), dr.gather(type(self.last), self.last, cell))


def _weights(sampler: PatchSampler, exit: Side, n: int) -> np.ndarray:
    """Weights of all patches for n exits, (n, patches), rows of sum 1."""
    import drjit as dr

    columns = side_features(sampler.frame, exit)
    dr.eval(columns)
    x = np.stack([np.broadcast_to(c.numpy(), n) for c in columns])
    depth = len(sampler.weights) // 2
    for k in range(depth):
        W, b = (sampler.weights[f"{name}_{k}"].astype(np.float32) for name in ("V", "c"))
        x = W @ x + b[:, None]
        if k < depth - 1:
            x = x * np.clip(x / 6 + 0.5, 0, 1)
    areas = sampler.patches.areas
    log_share = np.log(np.maximum(areas / areas.sum(), 1e-30))
    weights = np.exp(np.minimum(x + log_share[:, None].astype(np.float32), HIGHEST))
    return (weights / weights.sum(axis=0)).T
