"""A translucent object ready to be rendered: its geometry, its models, and how events are chosen at its surface."""

from __future__ import annotations

import warnings
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from halfspace_sss import measure
from halfspace_sss.interface.model import bssrdf
from halfspace_sss.physics import single_scattering
from halfspace_sss.physics.medium import Medium
from halfspace_sss.rendering.object.half_space import Variation, half_space_model
from halfspace_sss.rendering.object.placement import check_empty, check_sensors, places_of, translucent_shapes
from halfspace_sss.rendering.object.points import ObjectAlbedo, ObjectModel, Proposals, Transport, number
from halfspace_sss.rendering.object.registry import AUTO, Choices, choices, lookup
from halfspace_sss.rendering.object.settings import AUTOMATIC, Settings
from halfspace_sss.rendering.object.shape import Geometry, check_together, number_of, same_objects, survey
from halfspace_sss.rendering.object.translucent import Inside
from halfspace_sss.rendering.object.varying import equivalent, warn_of_means

__all__ = ["TranslucentObjects", "TranslucentObject", "Expected", "check_size", "expected_of", "make_objects"]

_MODELS = "models of their light"
SMALL, LARGE = 1.0, 5e3  # mean free paths across an object, beyond which the units of the scene are doubted


@dataclass(frozen=True, eq=False)
class TranslucentObject:
    """One translucent object.

    Args:
        geometry: of its shape.
        surface: its `translucent` BSDF.
        media: medium of each channel, 1/(scene unit).
        transport: what light that enters elsewhere is worth here; None where no order from two on is asked for.
        proposals: where it may enter; None without a transport.
        entries: how many of them an exit draws.
        few: the orders below two that are traced beside it: (0, 1), (1,) or none.
        expected: what each kind of light is expected to bring.
        variation: how its light varies with its medium.
        gathered: what leaves by orders from two on, in place of a transport, see `paths.gathering`.
        control: control variate of entries at the first vertex of a path, see `paths.control_variate`.
    """

    geometry: Geometry
    surface: Any
    media: list[Medium]
    transport: Transport | None
    proposals: Proposals | None
    entries: int
    few: tuple[int, ...]
    expected: Expected
    variation: Variation
    gathered: Any = None
    control: Any = None

    @property
    def eta(self) -> Any:
        """Relative index of the media, as data of kernels."""
        return number(self.media[0].eta)

    @property
    def alpha(self) -> ObjectAlbedo | None:
        """Its directional albedo, where its transport knows one."""
        return None if self.transport is None else self.transport.alpha

    @property
    def splits(self) -> bool:
        """Whether light is of both kinds, orders below two and the transport's."""
        return self.transport is not None and bool(self.few)

    def is_current(self) -> bool:
        """Whether the object still has the shape and the medium that it was made of."""
        return self.surface.inside is self.variation.inside and self.geometry.is_current()


class TranslucentObjects:
    """The bodies of the scene that was asked for last, made anew when its objects, their shape or media changed."""

    def __init__(self, settings: Settings) -> None:
        self.settings = settings
        self._made: tuple[int, list, list[TranslucentObject]] = (0, [], [])
        self._places: tuple[list, list] = ([], [])
        if settings.model:
            lookup(settings.model)
        self.choices = Choices({}, settings.light, {})  # for as long as the objects are the same

    def of(self, scene: Any) -> list[TranslucentObject]:
        """The bodies of a scene; errors as in `make_objects`."""
        shapes = scene.shapes()  # the scene itself, which holds its integrator, would never be freed
        world, before, bodies = self._made
        same = world == number_of(scene) and same_objects(before, shapes)
        if not bodies or not same or not all(body.is_current() for body in bodies):
            if not (bodies and same):
                self.choices = _choices(scene, self.settings)
            self._made = number_of(scene), shapes, make_objects(scene, self.settings, (), self.choices)
            self._places = places_of(scene)
        elif (places := places_of(scene))[0] != self._places[0]:
            check_empty(scene, [body.geometry for body in bodies], _MODELS)
            self._places = places
        return self._made[2]


def make_objects(
    scene: Any, settings: Settings, without: Collection[str] = (), chosen: Choices | None = None
) -> list[TranslucentObject]:
    """All objects of a scene that have a `translucent` surface, but for those with the ids in `without`.

    Args:
        scene: of Mitsuba.
        settings: of the integrator.
        without: ids.
        chosen: what stands for "auto", by default chosen now.

    Raises:
        ValueError: there is none, a camera or anything else is inside one, a model refuses its medium, or the orders
            that are asked for are not those of the model.
    """
    shapes = translucent_shapes(scene)
    if not shapes:
        raise ValueError("the scene must have an object with a translucent BSDF, got none")
    objects = [survey(shape, scene) for shape in shapes]
    check_together(scene, [found.scene for found in objects])
    check_sensors(scene, objects)
    check_empty(scene, objects, _MODELS)
    chosen = chosen or _choices(scene, settings)
    insides = [_asked(shape, settings, chosen.models.get(k)) for k, shape in enumerate(shapes)]
    named = [pair for pair in zip(objects, insides) if pair[0].shape.id() not in without]
    return [_make_object(found, equivalent(inside, found), settings) for found, inside in named]


def _asked(shape: Any, settings: Settings, model: str | None = None) -> Inside:
    """What is inside an object, with the model and orders that the integrator asks for."""
    inside = shape.bsdf().inside
    asked = {"model": model or settings.model or inside.model, "orders": settings.orders or inside.orders}
    return inside if asked == {key: getattr(inside, key) for key in asked} else replace(inside, **asked)


def _choices(scene: Any, settings: Settings) -> Choices:
    """What stands for "auto", measured if anything is."""
    insides = [_asked(shape, settings) for shape in translucent_shapes(scene)]
    if insides and (settings.light == AUTO or any(inside.model == AUTO for inside in insides)):
        return choices(scene, settings)
    return Choices({}, settings.light, {})


def _make_object(found: Geometry, inside: Inside, settings: Settings) -> TranslucentObject:
    surface = found.shape.bsdf()
    media = [m.scaled(settings.mm_per_unit) for m in inside.channels()]
    check_size(found, [float(m.sigma_t) for m in media], settings.mm_per_unit)
    single_only = inside.orders == "single" or not any(float(m.sigma_s) > 0 for m in media)
    variation = Variation(surface, settings.mm_per_unit, inside.model)
    none = ObjectModel(None, None)
    transport, proposals, entries = none if single_only else _model_of(inside, found, media, settings, variation)
    if transport and transport.orders == "total" and inside.orders == "multiple":
        raise ValueError(f"orders must be total for the model {inside.model!r}, which contains them all, got multiple")
    few = _few(inside, transport)
    entries = entries if settings.entries == AUTOMATIC else settings.entries
    return TranslucentObject(found, surface, media, transport, proposals, entries, few, expected_of(media), variation)


def _few(inside: Inside, transport: Transport | None) -> tuple[int, ...]:
    """The orders below two that are traced beside a transport.

    No light passes a half-space: its models put into orders from two on what passes something thin.
    """
    if inside.orders != "total":
        return (1,) if inside.orders == "single" else ()
    if transport is not None and transport.orders == "total":
        return ()
    return (0, 1) if transport is None or lookup(inside.model).knows_objects else (1,)


def _model_of(
    inside: Inside, found: Geometry, media: list[Medium], settings: Settings, variation: Variation
) -> ObjectModel:
    of_object = lookup(inside.model).transport
    if of_object is not None:
        return of_object(found, inside, media, settings)
    warn_of_means(inside, found)
    return half_space_model(inside.model, found, media, settings, variation)


def check_size(found: Geometry, sigma_t: Sequence[float], mm_per_unit: float) -> None:
    """Warn of an object whose size in mean free paths speaks of another unit of length.

    Args:
        found: the object.
        sigma_t: of each channel, 1/(scene unit).
        mm_per_unit: length of a scene unit, mm.
    """
    thickness = [found.size * value for value in sigma_t]
    if min(thickness) < SMALL or max(thickness) > LARGE:
        warnings.warn(
            f"object {found.name} is {min(thickness):.3g} to {max(thickness):.3g} mean free paths across, "
            f"{found.size * mm_per_unit:.3g} mm: check mm_per_unit = {mm_per_unit:g}",
            stacklevel=2,
        )


# --------------------------------------------------------------------------------------------------
# What the kinds of light that leave an object are expected to bring, by which the path loop chooses among them.


class Expected(NamedTuple):
    """Means over channels.

    Args:
        single: reflectance of the half-space at normal incidence by single scattering.
        multiple: by the orders from two on.
        albedo: of single scattering, which nearly all leaves something thin.
    """

    single: float
    multiple: float
    albedo: float


def expected_of(media: Sequence[Medium]) -> Expected:
    """Of the media of the channels."""
    rows = []
    for m in media:
        multiple = float(measure.reflectance(bssrdf("better_dipole", m), 1.0)) if float(m.sigma_s) > 0 else 0.0
        rows.append((float(single_scattering.reflectance(m, 1.0)), multiple, float(m.albedo)))
    return Expected(*np.mean(rows, axis=0).tolist())
