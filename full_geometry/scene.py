"""What has been learnt of an object in a scene: its transport, and entries drawn by patches and probes."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from full_geometry.model import FullGeometry, PreparedExit
from full_geometry.pairs import AREA_SHARE
from full_geometry.patches import PatchSampler, PatchWeights
from full_geometry.storing import find_weights, load
from full_geometry.subject import Subject, SurfacePoint
from halfspace_sss.physics.medium import Medium
from halfspace_sss.rendering.surface.inside import Inside
from halfspace_sss.rendering.surface.object import Object
from halfspace_sss.rendering.transport.half_space import HalfSpaceProposals
from halfspace_sss.rendering.transport.plane import Exit, number
from halfspace_sss.rendering.transport.positions import PositionSampler
from halfspace_sss.rendering.transport.protocols import Entry, Means
from halfspace_sss.rendering.transport.radial_table import RadialTable
from halfspace_sss.rendering.transport.settings import AUTOMATIC, Settings

__all__ = ["LearntProposals", "LearntTransport", "learnt_means"]

FINE = 2.0  # mean distances of light across a patch, up to which patches do without probes
PATCH_SHARE = 0.5  # of the entries where patches are larger


@dataclass(frozen=True, eq=False)
class LearntTransport:
    """S of one object, orders two and more.

    Args:
        model: what was learnt.
        sign: that turns geometric normals outwards.
    """

    model: FullGeometry
    sign: float
    orders = "multiple"

    def prepare(self, out: Exit, active: Any) -> PreparedExit:
        return self.model.prepare(SurfacePoint(out.p, out.n_face, out.n, out.w), active)

    def S_mu(self, prepared: PreparedExit, entry: Entry, w_i: Any, active: Any) -> Any:
        import drjit as dr
        import mitsuba as mi

        at = SurfacePoint(entry.p, mi.Normal3f(entry.n * number(self.sign)), entry.n_out, w_i)
        return self.model.S(prepared, at, active) * dr.maximum(dr.dot(w_i, entry.n_out), 0)


class _Prepared(NamedTuple):
    """Of an exit: the weights of patches, and the axes of probes."""

    weights: PatchWeights
    axes: tuple[Any, Any, Any]


@dataclass(frozen=True, eq=False)
class LearntProposals:
    """Entries by learnt weights of patches, a share of them by probes, with the density of both (balance heuristic).

    Args:
        patches: their sampler.
        positions: probes and uniform points.
        patch_share: of the entries, (0, 1]; 1 shoots no ray.
        sign: that turns geometric normals outwards.
    """

    patches: PatchSampler
    positions: PositionSampler
    patch_share: float
    sign: float

    def prepare(self, out: Exit, prepared: PreparedExit, active: Any) -> _Prepared:
        import mitsuba as mi

        return _Prepared(self.patches.prepare(prepared.side), (out.n, *mi.coordinate_system(out.n)))

    def sample(self, out: Exit, prim_index: Any, prepared: _Prepared, sampler: Any, active: Any) -> Entry:
        import drjit as dr
        import mitsuba as mi

        by_patch = active & (sampler.next_1d() < number(self.patch_share))
        at, _ = self.patches.sample(prepared.weights, sampler.next_1d(), sampler.next_1d(), sampler.next_2d())
        n_out = dr.select(dr.dot(at.n_shading, at.n) < 0, -at.n_shading, at.n_shading) * number(self.sign)
        entry = Entry(mi.Point3f(at.p), mi.Normal3f(at.n), mi.Normal3f(n_out), mi.Float(1), mi.UInt32(at.prim_index))
        if self.patch_share < 1:
            probed = self.positions.sample(out, prim_index, sampler, active & ~by_patch)
            entry = Entry(*(dr.select(by_patch, a, b) for a, b in zip(entry, probed)))
        learnt = self.patches.density(prepared.weights, entry.face)
        if self.patch_share == 1:
            return entry._replace(weight=dr.select(by_patch, 1 / learnt, 0))
        near = self.positions.density(entry.p, entry.n, out, prepared.axes)
        share = number(self.patch_share)
        # of a probe the weight is that of one hit among all, 1/density on average
        scale = dr.select(by_patch, 1, near) / (share * learnt + (1 - share) * near)
        return entry._replace(weight=dr.select(active, entry.weight * scale, 0))

    def sample_direction(self, entry: Entry, out: Exit, u: Any) -> tuple[Any, Any]:
        import mitsuba as mi

        local = mi.warp.square_to_cosine_hemisphere(u)
        return mi.Frame3f(entry.n_out).to_world(local), mi.warp.square_to_cosine_hemisphere_pdf(local)

    def pdf_direction(self, entry: Entry, out: Exit, w_i: Any) -> Any:
        import drjit as dr

        return dr.maximum(dr.dot(w_i, entry.n_out), 0) / dr.pi


def learnt_means(found: Object, inside: Inside, media: list[Medium], settings: Settings) -> Means:
    """Transport and proposals of an object that was trained.

    Raises:
        ValueError: the object was not trained, its boundary is rough, or weights are damaged.
    """
    subject = Subject.surveyed(found, tuple(media))
    model, sampler = load(find_weights(subject), subject)
    transport = LearntTransport(model, found.sign)
    backbone = model.half_space.models
    table = RadialTable([m for m in backbone if float(m.medium.sigma_s) > 0], found.size)
    share = AREA_SHARE if settings.area_share == AUTOMATIC else settings.area_share
    positions = PositionSampler(replace(found, pieces=None), table, subject.points, share)
    if sampler is None:
        return Means(transport, HalfSpaceProposals(positions, backbone[0]))
    radius = np.sqrt(found.area / (np.pi * sampler.patches.n))
    patch_share = 1.0 if radius < FINE * table.mean else PATCH_SHARE
    return Means(transport, LearntProposals(sampler, positions, patch_share, found.sign))
