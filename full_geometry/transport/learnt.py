"""Binds what was trained of an object: its transport, and entries drawn by patches and probes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from full_geometry.geometry.points import ObjectModel, PositionSampler, RadialTable
from full_geometry.objects.objects import TranslucentObject, check_geometry
from full_geometry.settings import AUTOMATIC, Settings
from full_geometry.transport.half_space import HalfSpaceProposals
from full_geometry.transport.patches import AREA_SHARE, LearntProposals, PatchTable
from full_geometry.transport.storing import CHECKSUMS, KIND, find_weights, load
from halfspace_sss.neural.store import checksum_of, load_weights

FINE = 2.5  # transport mean free paths of the radius of a patch, up to which patches do without probes
PATCH_SHARE = 0.2  # of the entries where patches are larger: they reach what probes miss
ENTRIES = 2  # of an exit: its own work is done once, and patches draw without a ray


def learnt_model(obj: TranslucentObject, settings: Settings) -> ObjectModel:
    """Transport and proposals of an object that was trained.

    Raises:
        ValueError: the object cannot be trained or was not, which says the command that trains it; or weights are
            damaged.
    """
    geometry = obj.geometry
    check_geometry(geometry)
    path = find_weights(obj)
    model, sampler = load(path, obj)
    backbone = model.base.models
    transport = replace(model, checksums=(checksum_of(path, KIND), *load_weights(path, KIND)[1][CHECKSUMS]))
    table = RadialTable([m for m in backbone if float(m.medium.sigma_s) > 0], geometry.size)
    by_itself = AREA_SHARE if sampler is None else 0.0  # patches reach everywhere
    share = by_itself if settings.area_share == AUTOMATIC else settings.area_share
    positions = PositionSampler(replace(geometry, pieces=None), table, obj.points, share)
    if sampler is None:
        return ObjectModel(transport, HalfSpaceProposals(positions, backbone[0]))
    radius = np.sqrt(geometry.area / (np.pi * sampler.patches.n))
    sigma_t_prime = np.mean([float(m.sigma_t_prime) for m in obj.media])
    patch_share = 1.0 if radius * sigma_t_prime < FINE else PATCH_SHARE
    proposals = LearntProposals(sampler, positions, patch_share, geometry.sign, PatchTable(sampler))
    return ObjectModel(transport, proposals, ENTRIES)
