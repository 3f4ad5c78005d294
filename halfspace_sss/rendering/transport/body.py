"""A translucent object ready to be rendered: its geometry, its models, and how events are chosen at its surface."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from typing import Any

import numpy as np

from halfspace_sss import measure
from halfspace_sss.interface.model import bssrdf
from halfspace_sss.physics import single_scattering
from halfspace_sss.physics.medium import Medium
from halfspace_sss.rendering.surface.object import Object, is_inside, same_objects, survey
from halfspace_sss.rendering.surface.varying import equivalent
from halfspace_sss.rendering.transport.area_points import AreaPoints
from halfspace_sss.rendering.transport.positions import PositionSampler
from halfspace_sss.rendering.transport.radial_table import RadialTable
from halfspace_sss.rendering.transport.settings import AUTOMATIC, Settings
from halfspace_sss.rendering.transport.variation import Variation

__all__ = ["Bodies", "Body", "make_bodies"]

SMALL, LARGE = 1.0, 5e3  # mean free paths across an object, beyond which the units of the scene are doubted
LEAST_SHARE = 0.2  # of the events inside that each of the two kinds gets


@dataclass(frozen=True, eq=False)
class Body:
    """One translucent object.

    Args:
        found: its geometry.
        surface: its `translucent` BSDF.
        media: medium of each channel, 1/(scene unit).
        models: model of each channel; empty where only single scattering is asked for.
        positions: sampler of points of entry; None without models.
        single_share: probability of single scattering among the events inside.
        variation: how its light varies with its medium.
    """

    found: Object
    surface: Any
    media: list[Medium]
    models: list[Any]
    positions: PositionSampler | None
    single_share: float
    variation: Variation

    def is_current(self) -> bool:
        """Whether the object still has the shape and the medium that it was made of."""
        return self.surface.inside is self.variation.inside and self.found.is_current()


class Bodies:
    """The bodies of the scene that was asked for last, made anew when its objects, their shape or media changed."""

    def __init__(self, settings: Settings) -> None:
        self.settings = settings
        self._made: tuple[list, list[Body]] = ([], [])

    def of(self, scene: Any) -> list[Body]:
        """The bodies of a scene; errors as in `make_bodies`."""
        shapes = scene.shapes()  # the scene itself, which holds its integrator, would never be freed
        before, bodies = self._made
        if not bodies or not same_objects(before, shapes) or not all(body.is_current() for body in bodies):
            self._made = shapes, make_bodies(scene, self.settings)
        return self._made[1]


def make_bodies(scene: Any, settings: Settings) -> list[Body]:
    """All objects of a scene that have a `translucent` surface.

    Raises:
        ValueError: there is none, a camera is inside one, a model refuses its medium, or the orders that are asked for
            are not those of the model.
    """
    shapes = [s for s in scene.shapes() if hasattr(s.bsdf(), "inside")]
    if not shapes:
        raise ValueError("the scene must have an object with a translucent BSDF, got none")
    bodies = [_make_body(shape, settings) for shape in shapes]
    for body in bodies:
        for sensor in scene.sensors():
            if is_inside(body.found, np.array(sensor.world_transform().translation()).ravel()):
                raise ValueError(f"the camera must be outside of every object, got it inside {body.found.shape.id()!r}")
    return bodies


def _make_body(shape: Any, settings: Settings) -> Body:
    found, surface = survey(shape), shape.bsdf()
    inside = equivalent(surface.inside, found)
    media = [m.scaled(settings.mm_per_unit) for m in inside.channels()]
    _check_size(found, media, settings)
    scatters = [float(m.sigma_s) > 0 for m in media]
    single_only = inside.orders == "single" or not any(scatters)
    models = [] if single_only else [bssrdf(inside.model, m) for m in media]
    if models and models[0].orders == "total" and inside.orders == "multiple":
        raise ValueError(f"orders must be total for the model {inside.model!r}, which contains them all, got multiple")
    adds_single = inside.orders == "single" or (inside.orders == "total" and models and models[0].orders == "multiple")
    share = _single_share(media) if adds_single and models else float(bool(adds_single))
    variation = Variation(surface, settings.mm_per_unit)
    if not models:
        return Body(found, surface, media, [], None, share, variation)
    live = [model for model, s in zip(models, scatters) if s]
    table = RadialTable(live, found.size)
    area_share = settings.area_share
    if area_share == AUTOMATIC:
        area_share = _area_share(table.mean / found.size)
    positions = PositionSampler(found, table, AreaPoints(shape), area_share)
    return Body(found, surface, media, models, positions, share, variation)


def _area_share(ratio: float) -> float:
    """Share of uniform entries for a ratio of mean distance to object size."""
    return float(np.clip(0.5 * (np.log10(max(ratio, 1e-9)) + 0.5), 0.0, 0.5))


def _single_share(media: list[Medium]) -> float:
    """Single scattering's share of what comes back at normal incidence, mean over channels."""
    shares = []
    for m in media:
        single = float(single_scattering.reflectance(m, 1.0))
        total = single + float(measure.reflectance(bssrdf("better_dipole", m), 1.0))
        shares.append(single / total if total > 0 else 0.5)
    return float(np.clip(np.mean(shares), LEAST_SHARE, 1 - LEAST_SHARE))


def _check_size(found: Object, media: list[Medium], settings: Settings) -> None:
    thickness = [found.size * float(m.sigma_t) for m in media]
    if min(thickness) < SMALL or max(thickness) > LARGE:
        warnings.warn(
            f"object {found.shape.id()!r} is {min(thickness):.3g} to {max(thickness):.3g} mean free paths across, "
            f"{found.size * settings.mm_per_unit:.3g} mm: check mm_per_unit = {settings.mm_per_unit:g}",
            stacklevel=2,
        )
