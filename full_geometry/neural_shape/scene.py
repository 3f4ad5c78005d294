"""The network of all shapes in a scene: transport, entries by probes and over the area, and warnings out of range."""

from __future__ import annotations

import math
import warnings
from dataclasses import replace

from full_geometry.neural_shape.ranges import ALBEDO, ETA, SIZE, G
from full_geometry.neural_shape.storing import checksums, transport
from full_geometry.scene import LearntTransport
from full_geometry.subject import Subject, check_surface
from halfspace_sss.physics.medium import Medium
from halfspace_sss.rendering.surface.inside import Inside
from halfspace_sss.rendering.surface.object import Object
from halfspace_sss.rendering.transport.area_points import AreaPoints
from halfspace_sss.rendering.transport.half_space import HalfSpaceProposals, area_share
from halfspace_sss.rendering.transport.positions import PositionSampler
from halfspace_sss.rendering.transport.protocols import Means
from halfspace_sss.rendering.transport.radial_table import RadialTable
from halfspace_sss.rendering.transport.settings import Settings

__all__ = ["shape_means", "warn_out_of_range"]

SLACK = 1e-3  # of the bounds, for rounding


def warn_out_of_range(found: Object, media: tuple[Medium, ...]) -> None:
    """Warn, by name and number, of what the network was not trained on: size, medium, or an object that is open."""
    name, reasons = found.shape.id(), []
    scattering = [m for m in media if float(m.sigma_s) > 0]
    numbers = {
        "sigma_t sqrt(area)": (SIZE, [float(m.sigma_t) * math.sqrt(found.area) for m in scattering]),
        "reduced albedo": (ALBEDO, [float(m.albedo_prime) for m in scattering]),
        "g": (G, [float(m.g) for m in scattering]),
        "eta": (ETA, [float(m.eta) for m in scattering]),
    }
    for what, ((low, high), values) in numbers.items():
        outside = [v for v in values if not low - SLACK * abs(low) <= v <= high + SLACK * abs(high)]
        if outside:
            reasons.append(f"{what} {', '.join(f'{v:.4g}' for v in outside)} is not in [{low:g}, {high:g}]")
    if not found.closed:
        reasons.append("it is not closed")
    if reasons:
        warnings.warn(
            f"object {name!r} is out of the range that neural_shape was trained on: {'; '.join(reasons)}", stacklevel=2
        )


def shape_means(found: Object, inside: Inside, media: list[Medium], settings: Settings) -> Means:
    """Transport and proposals of any object with a homogeneous medium and a smooth boundary.

    Raises:
        ValueError: the boundary is rough, the medium varies or is out of the range of `neural`, or normals of pieces
            of the object disagree.
    """
    surface = found.shape.bsdf()
    if hasattr(surface, "inside"):
        check_surface(found.shape.id(), surface)
    subject = Subject.surveyed(found, tuple(media), inside.varying, settings.mm_per_unit)
    warn_out_of_range(found, subject.media)
    model = transport(subject)
    live = [m for m in model.half_space.models if float(m.medium.sigma_s) > 0]
    table = RadialTable(live, found.size)
    share = area_share(found, table.mean / found.size, settings.area_share)
    # light may leave by another piece of the surface than it entered by
    positions = PositionSampler(replace(found, pieces=None), table, AreaPoints(found.shape), share)
    return Means(LearntTransport(model, checksums(subject)), HalfSpaceProposals(positions, live[0]))
