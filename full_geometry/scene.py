"""What has been learnt of an object in a scene: its transport, and entries drawn by patches and probes."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from full_geometry.entries import AREA_SHARE, LearntProposals
from full_geometry.flow.sampler import FlowProposals
from full_geometry.model import FullGeometry, PreparedExit
from full_geometry.patch_table import PatchTable
from full_geometry.storing import CHECKSUMS, KIND, find_weights, load
from full_geometry.subject import Subject, SurfacePoint, check_surface
from halfspace_sss.neural.store import checksum_of, load_weights
from halfspace_sss.physics.medium import Medium
from halfspace_sss.rendering.surface.inside import Inside
from halfspace_sss.rendering.surface.object import Object
from halfspace_sss.rendering.transport.half_space import HalfSpaceProposals
from halfspace_sss.rendering.transport.plane import Exit
from halfspace_sss.rendering.transport.positions import PositionSampler
from halfspace_sss.rendering.transport.protocols import Entry, Means
from halfspace_sss.rendering.transport.radial_table import RadialTable
from halfspace_sss.rendering.transport.settings import AUTOMATIC, Settings

__all__ = ["LearntTransport", "learnt_means"]

FINE = 2.5  # transport mean free paths of the radius of a patch, up to which patches do without probes
PATCH_SHARE = 0.2  # of the entries where patches are larger: they reach what probes miss
ENTRIES = 2  # of an exit: its own work is done once, and patches draw without a ray


@dataclass(frozen=True, eq=False)
class LearntTransport:
    """S of one object, orders two and more.

    Args:
        model: what was learnt.
        checksums: of the file of weights, and of those of its start.
    """

    model: FullGeometry
    checksums: tuple[str, ...]
    orders = "multiple"

    def prepare(self, out: Exit, active: Any) -> PreparedExit:
        return self.model.prepare(SurfacePoint(out.p, out.n_face, out.n, out.w), active)

    @property
    def alpha(self) -> Callable[[Exit, Any], tuple[Any, Any]]:
        """See `Transport`; AttributeError where the model does not know it."""
        known = self.model.alpha
        return lambda out, active: known(SurfacePoint(out.p, out.n_face, out.n, out.w), active)

    @property
    def evened(self) -> tuple[Any, Any]:
        """See `Transport`."""
        return self.model.alpha.evened

    def S_mu(self, prepared: PreparedExit, entry: Entry, w_i: Any, active: Any) -> Any:
        n_out, mu_i = entry.seen(w_i)
        return self.model.S(prepared, SurfacePoint(entry.p, entry.n_face, n_out, w_i), active) * mu_i


def _weights(subject: Subject, settings: Settings) -> Path:
    """The file of its weights, learnt first where there is none and the settings give time for it."""
    try:
        return find_weights(subject)
    except ValueError:
        if settings.train_seconds == 0 or find_spec("torch") is None:
            raise
    from full_geometry.learning.training import train

    warnings.warn(
        f"object {subject.found.name} has no weights: it is learnt first, for {settings.train_seconds:g} s",
        stacklevel=2,
    )
    return train(subject, seconds=settings.train_seconds, target_error=settings.train_error).path


def learnt_means(found: Object, inside: Inside, media: list[Medium], settings: Settings) -> Means:
    """Transport and proposals of an object that was trained, or is now for `train_seconds` of the settings.

    Raises:
        ValueError: the object cannot be trained, was not and has no time for it, or weights are damaged.
    """
    check_surface(found.shape.id(), found.shape.bsdf())
    subject = Subject.surveyed(found, tuple(media), inside.varying, settings.mm_per_unit)
    path = _weights(subject, settings)
    model, sampler, flow = load(path, subject)
    backbone = model.start.models
    transport = LearntTransport(model, (checksum_of(path, KIND), *load_weights(path, KIND)[1][CHECKSUMS]))
    table = RadialTable([m for m in backbone if float(m.medium.sigma_s) > 0], found.size)
    by_itself = AREA_SHARE if sampler is None else 0.0  # patches reach everywhere
    share = by_itself if settings.area_share == AUTOMATIC else settings.area_share
    positions = PositionSampler(replace(found, pieces=None), table, subject.points, share)
    if sampler is None:
        return Means(transport, HalfSpaceProposals(positions, backbone[0]))
    if flow is not None:
        return Means(transport, FlowProposals(flow, found.sign, PatchTable(flow.patches)), ENTRIES)
    radius = np.sqrt(found.area / (np.pi * sampler.patches.n))
    sigma_t_prime = np.mean([float(m.sigma_t_prime) for m in media])
    patch_share = 1.0 if radius * sigma_t_prime < FINE else PATCH_SHARE
    proposals = LearntProposals(sampler, positions, patch_share, found.sign, PatchTable(sampler))
    return Means(transport, proposals, ENTRIES)
