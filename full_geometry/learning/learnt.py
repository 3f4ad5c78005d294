"""What has been learnt of an object in a scene: its transport, and entries drawn by patches and probes."""

from __future__ import annotations

import math
import warnings
from dataclasses import asdict, replace
from importlib.util import find_spec
from pathlib import Path

import numpy as np

from full_geometry.geometry.points import ObjectModel, PositionSampler, RadialTable
from full_geometry.geometry.shape import Geometry
from full_geometry.objects.objects import TranslucentObject, check_geometry
from full_geometry.settings import AUTOMATIC, Settings
from full_geometry.transport.any_shape import ALBEDO, ETA, MODEL, SIZE, G, transport
from full_geometry.transport.half_space import HalfSpaceProposals, area_share
from full_geometry.transport.patches import AREA_SHARE, LearntProposals, PatchTable
from full_geometry.transport.storing import CHECKSUMS, KIND, find_weights, load, nearest
from halfspace_sss.neural.store import checksum_of, load_weights
from halfspace_sss.physics.medium import Medium

FINE = 2.5  # transport mean free paths of the radius of a patch, up to which patches do without probes
PATCH_SHARE = 0.2  # of the entries where patches are larger: they reach what probes miss
REFINED = 5.0  # seconds of a training that starts from weights of the same shape
ENTRIES = 2  # of an exit: its own work is done once, and patches draw without a ray


def _weights(obj: TranslucentObject, settings: Settings) -> Path:
    """The file of its weights, learnt first where there is none and the settings give time for it."""
    try:
        return find_weights(obj)
    except ValueError:
        if settings.train_seconds == 0 or find_spec("torch") is None:
            raise
    from full_geometry.learning.training import STANDARD, train

    start, seconds, more = nearest(obj, asdict(STANDARD)), settings.train_seconds, ""
    if start is not None:
        seconds = min(seconds, REFINED)
        more = f", from weights of the same shape with another medium, {start.path.name}"
    warnings.warn(
        f"object {obj.geometry.name} has no weights: it is learnt first, for {seconds:g} s{more}", stacklevel=2
    )
    return train(obj, seconds=seconds, target_error=settings.train_error, start=start).path


def learnt_model(obj: TranslucentObject, settings: Settings) -> ObjectModel:
    """Transport and proposals of an object that was trained, or is now for `train_seconds` of the settings.

    Raises:
        ValueError: the object cannot be trained, was not and has no time for it, or weights are damaged.
    """
    geometry = obj.geometry
    check_geometry(geometry)
    path = _weights(obj, settings)
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


learnt_model.takes_contents = True
learnt_model.takes_textures = True

# ----------------------------------------------------------------------------------------------------
# The network of all shapes in a scene: transport, entries by probes and over the area, and warnings out of range.

SLACK = 1e-3  # of the bounds, for rounding


def warn_out_of_range(geometry: Geometry, media: tuple[Medium, ...]) -> None:
    """Warn, by name and number, of what the network was not trained on: size, medium, or an object that is open."""
    name, reasons = geometry.shape.id(), []
    scattering = [m for m in media if float(m.sigma_s) > 0]
    numbers = {
        "sigma_t sqrt(area)": (SIZE, [float(m.sigma_t) * math.sqrt(geometry.area) for m in scattering]),
        "reduced albedo": (ALBEDO, [float(m.albedo_prime) for m in scattering]),
        "g": (G, [float(m.g) for m in scattering]),
        "eta": (ETA, [float(m.eta) for m in scattering]),
    }
    for what, ((low, high), values) in numbers.items():
        outside = [v for v in values if not low - SLACK * abs(low) <= v <= high + SLACK * abs(high)]
        if outside:
            reasons.append(f"{what} {', '.join(f'{v:.4g}' for v in outside)} is not in [{low:g}, {high:g}]")
    if not geometry.closed:
        reasons.append("it is not closed")
    if reasons:
        warnings.warn(
            f"object {name!r} is out of the range that neural_shape was trained on: {'; '.join(reasons)}", stacklevel=2
        )


def shape_model(obj: TranslucentObject, settings: Settings) -> ObjectModel:
    """Transport and proposals of any object with a homogeneous medium and a smooth boundary.

    Raises:
        ValueError: the medium varies or is out of the range of `neural`, or normals of pieces of the object disagree.
    """
    geometry = obj.geometry
    check_geometry(geometry)
    warn_out_of_range(geometry, obj.media)
    model = transport(obj)
    live = [m for m in model.half_space.models if float(m.medium.sigma_s) > 0]
    table = RadialTable(live, geometry.size)
    share = area_share(geometry, table.mean / geometry.size, settings.area_share)
    # light may leave by another piece of the surface than it entered by
    positions = PositionSampler(replace(geometry, pieces=None), table, obj.points, share)
    return ObjectModel(model, HalfSpaceProposals(positions, live[0]))


shape_model.varies_as = MODEL
