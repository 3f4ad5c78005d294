"""A flow inside patches: splines, the conditional flow, its sampler of entries; in Dr.Jit, with exact densities."""

from __future__ import annotations

import functools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np

from figures.studies.flow_chart import Chart, context
from full_geometry.object.features import ObjectFrame, PreparedExit, Side
from full_geometry.object.patches import PatchSampler, PatchTable, PatchWeights
from halfspace_sss.neural.perceptron import Perceptron, relu
from halfspace_sss.rendering.object.entries import Point
from halfspace_sss.rendering.object.points import CosineProposals, EntrySample, SurfacePoint, number, turned

# ----------------------------------------------------------------------------------------------------
# Monotonic rational-quadratic splines of [-1, 1] onto itself, in Dr.Jit (Durkan, Bekasov, Murray, Papamakarios 2019).
# K bins with widths, heights and K - 1 slopes between them; slopes are 1 at both ends. The numbers are bounded as zuko
# bounds them: with l = -log(least), a/(1 + 2|a|/l) before the softmax of widths and heights, a/(1 + |a|/l) as logarithm
# of a slope, so that no slope leaves [least, 1/least].


BINS = 8
LEAST_SLOPE = 1e-2
PARAMETERS = 3 * BINS - 1


class _Bin(NamedTuple):
    """Ends of a bin in x and y, and the slopes at both."""

    x: Any
    y: Any
    dx: Any
    dy: Any
    d: Any
    d_next: Any


class Spline:
    """One spline for each lane.

    Args:
        raw: 3 K - 1 numbers of a network: widths, heights, slopes.
    """

    def __init__(self, raw: Sequence[Any]) -> None:
        bound = -math.log(LEAST_SLOPE)
        slopes = [dr.exp(a / (1 + dr.abs(a) / bound)) for a in raw[2 * BINS :]]
        self.widths, self.heights = (_shares(part, bound) for part in (raw[:BINS], raw[BINS : 2 * BINS]))
        self.slopes = [1.0, *slopes, 1.0]

    def _bin(self, at: Any, by_y: bool) -> _Bin:
        """The bin in which x, or y, lies."""
        bin = _Bin(*map(mi.Float, (-1, -1, self.widths[0], self.heights[0], self.slopes[0], self.slopes[1])))
        x, y = mi.Float(-1), mi.Float(-1)
        for k in range(1, BINS):
            x, y = x + self.widths[k - 1], y + self.heights[k - 1]
            here = _Bin(x, y, self.widths[k], self.heights[k], self.slopes[k], self.slopes[k + 1])
            beyond = at >= (y if by_y else x)
            bin = _Bin(*(dr.select(beyond, a, b) for a, b in zip(here, bin)))
        return bin

    def forward(self, x: Any) -> tuple[Any, Any]:
        """y and dy/dx."""
        b = self._bin(x, False)
        z = dr.clip((x - b.x) / b.dx, 0, 1)
        return b.y + b.dy * _rational(b, z), _slope(b, z)

    def inverse(self, y: Any) -> tuple[Any, Any]:
        """x and dy/dx there."""
        b = self._bin(y, True)
        s, t = b.dy / b.dx, dr.clip((y - b.y) / b.dy, 0, 1)
        bend = t * (b.d + b.d_next - 2 * s)
        p, q, c = s - b.d + bend, b.d - bend, -s * t
        z = dr.clip(2 * c / (-q - dr.safe_sqrt(q * q - 4 * p * c)), 0, 1)
        return b.x + z * b.dx, _slope(b, z)


def _shares(raw: Sequence[Any], bound: float) -> list[Any]:
    """2 softmax of bounded numbers."""
    logits = [dr.exp(a / (1 + 2 * dr.abs(a) / bound)) for a in raw]
    scale = 2 / sum(logits)
    return [v * scale for v in logits]


def _rational(b: _Bin, z: Any) -> Any:
    s = b.dy / b.dx
    return (s * z * z + b.d * z * (1 - z)) / (s + (b.d + b.d_next - 2 * s) * z * (1 - z))


def _slope(b: _Bin, z: Any) -> Any:
    s = b.dy / b.dx
    over = s + (b.d + b.d_next - 2 * s) * z * (1 - z)
    return s * s * (2 * s * z * (1 - z) + b.d * (1 - z) * (1 - z) + b.d_next * z * z) / (over * over)


# ----------------------------------------------------------------------------------------------------
# A masked autoregressive flow of splines over [0, 1)^d given a context, evaluated in Dr.Jit with trained weights.
# z_j = s_j(x_j; network(x_1 ... x_{j-1}, context)), z uniform: p(x | context) = prod_j ds_j/dx_j. The hidden layers are
# masked, so one evaluation of the network gives the density, and d of them a sample.


@dataclass(frozen=True, eq=False)
class ConditionalFlow:
    """The flow.

    Args:
        n: its dimensions d.
        weights: F_k (outputs, inputs) and h_k of the layers, masks multiplied in; inputs are d coordinates and the
            context, outputs 3 K - 1 numbers for each coordinate.
    """

    n: int
    weights: Mapping[str, np.ndarray]

    @functools.cached_property
    def _network(self) -> Perceptron:
        return Perceptron.named(self.weights, "F", "h", activation=relu, looped=True)

    def _splines(self, x: Sequence[Any], context: Sequence[Any]) -> list[Any]:
        return self._network([*x, *context])

    def _spline(self, raw: list[Any], j: int) -> Spline:
        return Spline(raw[j * PARAMETERS : (j + 1) * PARAMETERS])

    def sample(self, context: Sequence[Any], u: Sequence[Any]) -> tuple[list[Any], Any]:
        """x in [0, 1)^d for d uniform numbers, and its density."""
        x, density = [0.0] * self.n, 1.0
        for j in range(self.n):
            spline = self._spline(self._splines(x, context), j)
            x[j], slope = spline.inverse(2 * u[j] - 1)
            density = density * slope
        return [0.5 * (v + 1) for v in x], density

    def density(self, context: Sequence[Any], x: Sequence[Any]) -> Any:
        """Of x in [0, 1)^d."""
        inner, density = [2 * v - 1 for v in x], 1.0
        raw = self._splines(inner, context)
        for j in range(self.n):
            density = density * self._spline(raw, j).forward(inner[j])[1]
        return density

    def uniforms(self, context: Sequence[Any], x: Sequence[Any]) -> list[Any]:
        """The uniform numbers that `sample` makes x of."""
        inner = [2 * v - 1 for v in x]
        raw = self._splines(inner, context)
        return [0.5 * (self._spline(raw, j).forward(inner[j])[0] + 1) for j in range(self.n)]


# ---- Entries by learnt patches and, within the patch, by a flow ------------------------------------


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
    def frame(self) -> ObjectFrame:
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


class _FlowOfExit(NamedTuple):
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

    def prepare(self, out: SurfacePoint, prepared: PreparedExit, active: Any) -> _FlowOfExit:
        weights = self.sampler.patches.prepare(prepared.side) if self.table is None else None
        return _FlowOfExit(prepared.side, weights)

    def sample(
        self, out: SurfacePoint, prim_index: Any, prepared: _FlowOfExit, sampler: Any, active: Any
    ) -> EntrySample:
        u = sampler.next_1d(), tuple(sampler.next_2d())
        weights = prepared.weights if self.table is None else self.table.weights(prim_index)
        at, density = self.sampler.sample(prepared.side, weights, *u)
        n_out = turned(at.n_shading, at.n) * number(self.sign)
        weight = dr.select(active & (density > 0), 1 / density, 0)
        n = mi.Normal3f(at.n * number(self.sign))
        return EntrySample(mi.Point3f(at.p), n, mi.Normal3f(n_out), weight, mi.UInt32(at.prim_index))


def draw_by(scene: mi.Scene, flow: Mapping[str, np.ndarray]) -> None:
    """Let the entries of the learnt object of a scene be drawn by a flow inside its patches.

    Args:
        scene: with one `translucent` object, of the model `full_geometry`.
        flow: weights of a `ConditionalFlow`, those of `fit_flow` for the object.
    """
    bodies = scene.integrator().prepare(scene)
    (body,) = bodies
    patches: PatchSampler = body.proposals.patches
    chart = Chart(body.transport.subject, patches.frame, patches.patches)
    sampler = FlowSampler(patches, chart, ConditionalFlow(2, flow))
    bodies[0] = replace(body, proposals=FlowProposals(sampler, body.geometry.sign, PatchTable(patches)))
