"""Entries of an object drawn by learnt weights of patches, and by probes for what patches do not resolve."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

from full_geometry.model import PreparedExit
from full_geometry.patch_table import PatchTable
from full_geometry.patches import PatchSampler, PatchWeights
from halfspace_sss.rendering.surface.object import turned
from halfspace_sss.rendering.transport.plane import Exit, number
from halfspace_sss.rendering.transport.positions import PositionSampler
from halfspace_sss.rendering.transport.protocols import CosineProposals, Entry

__all__ = ["AREA_SHARE", "LearntProposals"]

AREA_SHARE = 0.75  # of the candidates for entries without patches that are uniform over the area


class _Prepared(NamedTuple):
    """Of an exit: the weights of patches, and the axes of probes."""

    weights: PatchWeights | None
    axes: tuple[Any, Any, Any]


@dataclass(frozen=True, eq=False)
class LearntProposals(CosineProposals):
    """Entries by learnt weights of patches, a share of them by probes, with the density of both (balance heuristic).

    Args:
        patches: their sampler.
        positions: probes and uniform points.
        patch_share: of the entries, (0, 1]; 1 shoots no ray.
        sign: that turns geometric normals outwards.
        table: of the weights by the face of an exit; without it the network is asked for each exit.
    """

    patches: PatchSampler
    positions: PositionSampler
    patch_share: float
    sign: float
    table: PatchTable | None = None

    def prepare(self, out: Exit, prepared: PreparedExit, active: Any) -> _Prepared:
        import mitsuba as mi

        weights = self.patches.prepare(prepared.side) if self.table is None else None
        return _Prepared(weights, (out.n, *mi.coordinate_system(out.n)))

    def sample(self, out: Exit, prim_index: Any, prepared: _Prepared, sampler: Any, active: Any) -> Entry:
        import drjit as dr
        import mitsuba as mi

        by_patch = active & (sampler.next_1d() < number(self.patch_share))
        weights = prepared.weights if self.table is None else self.table.weights(prim_index)
        at, _ = self.patches.sample(weights, sampler.next_1d(), sampler.next_1d(), sampler.next_2d())
        n_out = turned(at.n_shading, at.n) * number(self.sign)
        entry = Entry(mi.Point3f(at.p), mi.Normal3f(at.n), mi.Normal3f(n_out), mi.Float(1), mi.UInt32(at.prim_index))
        if self.patch_share < 1:
            probed = self.positions.sample(out, prim_index, sampler, active & ~by_patch)
            entry = Entry(*(dr.select(by_patch, a, b) for a, b in zip(entry, probed)))
        learnt = self.patches.density(weights, entry.face)
        if self.patch_share == 1:
            return entry._replace(weight=dr.select(by_patch, 1 / learnt, 0))
        near = self.positions.density(entry.p, entry.n, out, prepared.axes)
        share = number(self.patch_share)
        # of a probe the weight is that of one hit among all, 1/density on average
        scale = dr.select(by_patch, 1, near) / (share * learnt + (1 - share) * near)
        return entry._replace(weight=dr.select(active, entry.weight * scale, 0))
