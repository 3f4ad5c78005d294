"""Entries by learnt patches and, within the patch, by a flow."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

from full_geometry.features import Frame, Side
from full_geometry.flow.chart import Chart
from full_geometry.flow.conditional import ConditionalFlow
from full_geometry.flow.context import context
from full_geometry.model import PreparedExit
from full_geometry.patch_table import PatchTable
from full_geometry.patches import PatchSampler, PatchWeights
from halfspace_sss.rendering.surface.object import turned
from halfspace_sss.rendering.transport.area_points import Point
from halfspace_sss.rendering.transport.plane import Exit, number
from halfspace_sss.rendering.transport.protocols import CosineProposals, Entry

__all__ = ["FlowProposals", "FlowSampler"]


@dataclass(frozen=True, eq=False)
class FlowSampler:
    """density(x | exit) = (share of the patch of x) / A_k p(u | exit, patch), u the coordinates of x in the patch.

    Args:
        patches: weights of the patches.
        chart: their coordinates.
        flow: of two dimensions.
    """

    patches: PatchSampler
    chart: Chart
    flow: ConditionalFlow

    @property
    def frame(self) -> Frame:
        """Of the object."""
        return self.patches.frame

    def sample(self, exit: Side, weights: PatchWeights, u_patch: Any, u: tuple[Any, Any]) -> tuple[Point, Any]:
        """A point of entry and its density, 1/(scene unit)²."""
        patch, of_patch = self.patches.patch(weights, u_patch)
        told = context(self.frame, exit, self.chart.frame(patch))
        x, density = self.flow.sample(told, u)
        return self.chart.point(patch, tuple(x)), of_patch * density

    def density(self, exit: Side, weights: PatchWeights, face: Any, p: Any) -> Any:
        """Density of `sample` at a point of a face, 1/(scene unit)²."""
        patch = self.patches.patches.row("patch", face)
        told = context(self.frame, exit, self.chart.frame(patch))
        return self.patches.density(weights, face) * self.flow.density(told, self.chart.coordinates(face, p))


class _Prepared(NamedTuple):
    side: Side
    weights: PatchWeights | None


@dataclass(frozen=True, eq=False)
class FlowProposals(CosineProposals):
    """The proposals of a flow; directions by the cosine.

    Args:
        sampler: of the points.
        sign: that turns geometric normals outwards.
        table: of the weights of patches by the face of an exit; without it the network is asked for each exit.
    """

    sampler: FlowSampler
    sign: float
    table: PatchTable | None = None

    def prepare(self, out: Exit, prepared: PreparedExit, active: Any) -> _Prepared:
        weights = self.sampler.patches.prepare(prepared.side) if self.table is None else None
        return _Prepared(prepared.side, weights)

    def sample(self, out: Exit, prim_index: Any, prepared: _Prepared, sampler: Any, active: Any) -> Entry:
        import drjit as dr
        import mitsuba as mi

        u = sampler.next_1d(), tuple(sampler.next_2d())
        weights = prepared.weights if self.table is None else self.table.weights(prim_index)
        at, density = self.sampler.sample(prepared.side, weights, *u)
        n_out = turned(at.n_shading, at.n) * number(self.sign)
        weight = dr.select(active & (density > 0), 1 / density, 0)
        return Entry(mi.Point3f(at.p), mi.Normal3f(at.n), mi.Normal3f(n_out), weight, mi.UInt32(at.prim_index))
