"""What has been learnt of an object in a scene: its transport, and entries drawn by patches and probes."""

from __future__ import annotations

import warnings
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from full_geometry.entries import AREA_SHARE, LearntProposals
from full_geometry.first_event import first_event
from full_geometry.learnable import check_surface
from full_geometry.model import FullGeometry, PreparedExit
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
from halfspace_sss.tracing.walk import _generator, pass_seed

__all__ = ["LearntTransport", "learnt_means", "warn_of_unscattered"]

FINE = 2.0  # mean distances of light across a patch, up to which patches do without probes
POINTS, MOST_UNSCATTERED = 4096, 0.02  # of the light that enters, above which a warning says so
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


def warn_of_unscattered(subject: Subject) -> None:
    """Warn where much light would pass unscattered: renders hold what is scattered once, directly, or more often."""
    import drjit as dr
    import mitsuba as mi

    at = subject.random_points(_generator(mi, POINTS, pass_seed(3)))
    through = 1 - float(np.mean(np.array(first_event(subject, at).P)))
    dr.eval()
    if through > MOST_UNSCATTERED:
        warnings.warn(
            f"object {subject.found.shape.id()!r} lets {100 * through:.0f} % of the light pass unscattered; renders by "
            "full_geometry leave that out, and single scattering after a reflection inside: take translucent_walk",
            stacklevel=2,
        )


def learnt_means(found: Object, inside: Inside, media: list[Medium], settings: Settings) -> Means:
    """Transport and proposals of an object that was trained.

    Raises:
        ValueError: the object was not trained or cannot be, or weights are damaged.
    """
    check_surface(found.shape.id(), found.shape.bsdf())
    subject = Subject.surveyed(found, tuple(media), inside.varying, settings.mm_per_unit)
    model, sampler = load(find_weights(subject), subject)
    warn_of_unscattered(subject)
    transport = LearntTransport(model, found.sign)
    backbone = model.half_space.models
    table = RadialTable([m for m in backbone if float(m.medium.sigma_s) > 0], found.size)
    by_itself = AREA_SHARE if sampler is None else 0.0  # patches reach everywhere
    share = by_itself if settings.area_share == AUTOMATIC else settings.area_share
    positions = PositionSampler(replace(found, pieces=None), table, subject.points, share)
    if sampler is None:
        return Means(transport, HalfSpaceProposals(positions, backbone[0]))
    radius = np.sqrt(found.area / (np.pi * sampler.patches.n))
    patch_share = 1.0 if radius < FINE * table.mean else PATCH_SHARE
    return Means(transport, LearntProposals(sampler, positions, patch_share, found.sign))
