"""Binds objects of a scene to models: which transport, which entries, which low orders each object is rendered by."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace
from typing import Any

import mitsuba as mi
import numpy as np

from full_geometry.geometry.instances import (
    InstanceScene,
    shown_groups,
)
from full_geometry.geometry.points import (
    ObjectModel,
    Transport,
)
from full_geometry.geometry.shape import (
    Geometry,
    SceneMark,
    check_together,
    name_of,
)
from full_geometry.geometry.snapshot import Snapshot, same_objects
from full_geometry.objects.inclusions import check_sensors, contents
from full_geometry.objects.objects import (
    _MODELS,
    TranslucentObject,
    check_size,
    expected_of,
    filled,
    outermost,
    places_of,
    refuse,
    refuse_textures,
    surveyed,
    translucent_shapes,
)
from full_geometry.registry import AUTO, Choices, choices, lookup
from full_geometry.settings import AUTOMATIC, Settings
from full_geometry.surface.translucent import Inside, check_boundary
from full_geometry.surface.variation import Variation, VariedTransport
from full_geometry.surface.varying import equivalent, warn_of_means
from full_geometry.surface.wrapped import surface_of
from full_geometry.transport.half_space import check_turns, half_space_model
from full_geometry.transport.palette import palette_model

LAMBERT = "lambert"
RIGID = 1e-3  # of lengths, by which instances of what is learnt may differ


def _check_repeated(geometry: Geometry, inside: Inside, settings: Settings) -> None:
    """ValueError if instances of an object are not what its model or light takes."""
    if inside.varying is not None:
        raise ValueError(f"the medium of an instance must not vary in space, got that of object {geometry.name}")
    if settings.light == "gathered":
        raise ValueError(f"light must be sampled of objects that instances show, got gathered of {geometry.name}")
    of_object = inside.orders != "single" and lookup(inside.model).transport
    if of_object and inside.model != LAMBERT and geometry.group.stretch > RIGID:
        raise ValueError(
            f"instances of object {geometry.name} must be moved, turned or mirrored for the model {inside.model!r}, "
            f"got lengths that differ by {100 * geometry.group.stretch:.3g} %: give each size a group of its own, or "
            "take translucent_walk or a model of the half-space"
        )


def _asked(shape: Any, settings: Settings, model: str | None = None) -> Inside:
    """What is inside an object, with the model and orders that the integrator asks for."""
    inside = surface_of(shape).inside
    asked = {"model": model or settings.model or inside.model, "orders": settings.orders or inside.orders}
    return inside if asked == {key: getattr(inside, key) for key in asked} else replace(inside, **asked)


def _choices(scene: Any, settings: Settings) -> Choices:
    """What stands for "auto", measured if anything is."""
    insides = [_asked(shape, settings) for shape in translucent_shapes(scene)]
    if insides and (settings.light == AUTO or any(inside.model == AUTO for inside in insides)):
        if mi.is_spectral:
            raise ValueError("model must be named under a spectral variant, got 'auto'")
        for shape in outermost(scene):
            check_boundary(name_of(shape), surface_of(shape).boundary)
        return choices(scene, settings)
    return Choices({}, settings.light, {})


def _make_object(geometry: Geometry, inside: Inside, settings: Settings) -> TranslucentObject:
    media = tuple(m.scaled(settings.mm_per_unit) for m in inside.channels())
    check_size(geometry, [float(m.sigma_t) for m in media], settings.mm_per_unit)
    varying = None if inside.varying is None else inside.varying.scaled(settings.mm_per_unit)
    obj = TranslucentObject(geometry, media, varying)
    if inside.textured is not None:
        inside.textured.check(geometry)
        even = inside.textured.is_even(geometry.shape)
        textured = None if even else inside.textured.scaled(settings.mm_per_unit)
        obj = replace(obj, textured=textured, painted=Snapshot.of(geometry.shape))
    if inside.spectral is not None:
        obj = replace(obj, spectral=inside.spectral.scaled(settings.mm_per_unit))
    single_only = inside.orders == "single" or not any(float(m.sigma_s) > 0 for m in media)
    check_boundary(geometry.name, obj.surface.boundary)
    obj.wrapping.check(geometry)
    if geometry.contents is not None:
        _check_takes(geometry, inside, single_only)
    variation = Variation(obj.surface, settings.mm_per_unit, inside.model)
    if inside.orders == "total" and not single_only and (lookup(inside.model).of_half_space or inside.model == LAMBERT):
        check_turns(geometry, media, inside.model)
    none = ObjectModel(None, None)
    transport, proposals, entries = none if single_only else _model_of(obj, inside, settings)
    if transport and transport.orders == "total" and inside.orders == "multiple":
        raise ValueError(f"orders must be total for the model {inside.model!r}, which contains them all, got multiple")
    low_orders = _low_orders(inside, transport)
    transport = VariedTransport(transport, variation) if hasattr(transport, "beside") else transport
    entries = entries if settings.entries == AUTOMATIC else settings.entries
    return replace(
        obj, transport=transport, proposals=proposals, entries=entries, low_orders=low_orders,
        expected=expected_of(media), variation=variation,
    )  # fmt: skip


def _check_takes(geometry: Geometry, inside: Inside, single_only: bool) -> None:
    """ValueError if a model does not take what lies inside its object, or some orders only are asked for."""
    if single_only or not lookup(inside.model).takes_contents:
        refuse(geometry.contents.found[0], geometry, f"the model {inside.model!r}")
    if inside.orders != "total":
        raise ValueError(
            f"orders must be 'total' of objects with something inside, got {inside.orders!r} of object {geometry.name}"
        )


def _low_orders(inside: Inside, transport: Transport | None) -> tuple[int, ...]:
    """The orders below two that are traced beside a transport.

    No light passes a half-space: its models put into orders from two on what passes something thin.
    """
    if inside.orders != "total":
        return (1,) if inside.orders == "single" else ()
    if transport is not None and transport.orders == "total":
        return ()
    return (0, 1) if transport is None or lookup(inside.model).knows_objects else (1,)


def _model_of(obj: TranslucentObject, inside: Inside, settings: Settings) -> ObjectModel:
    of_object = lookup(inside.model).transport
    if of_object is not None:
        if obj.spectral is not None:
            raise ValueError(
                f"variant must be RGB or mono for the model {inside.model!r} of object {obj.geometry.name}, got "
                f"{mi.variant()}: translucent_walk and models of the half-space take spectra"
            )
        if obj.textured is not None and not getattr(of_object, "takes_textures", False):
            refuse_textures(obj.geometry.name, f"the model {inside.model!r}")
        if obj.wrapping.bend is not None and lookup(inside.model).learner is not None:
            raise ValueError(
                f"object {obj.geometry.name} must be without normal and bump maps for the model {inside.model!r}: "
                "translucent_walk and models of the half-space take them"
            )
        return of_object(obj, settings)
    if obj.textured is not None:
        return palette_model(inside.model, obj.geometry, obj.media, obj.textured, settings)
    if obj.spectral is not None:
        of_mean = replace(obj.media[0], g=float(np.mean([m.g for m in obj.media])))
        return palette_model(inside.model, obj.geometry, (of_mean,) * len(obj.media), obj.spectral, settings)
    warn_of_means(inside, obj.geometry)
    return half_space_model(inside.model, obj.geometry, obj.media, settings)


class TranslucentObjects:
    """The objects of the scene that was asked for last, made anew when its objects, their shape or media changed."""

    def __init__(self, settings: Settings) -> None:
        self.settings = settings
        self._made: tuple[SceneMark | None, list, list[TranslucentObject]] = (None, [], [])
        self._places: list = []
        if settings.model:
            lookup(settings.model)
        self.choices = Choices({}, settings.light, {})  # for as long as the objects are the same

    def take_over(self, other: TranslucentObjects) -> None:
        """What another has made by the same settings but for the light, which no model needs to know."""
        self._made, self._places = other._made, other._places

    def of(self, scene: Any) -> list[TranslucentObject]:
        """The objects of a scene; errors as in `make_objects`."""
        shapes = scene.shapes()  # the scene itself, which holds its integrator, would never be freed
        mark, (world, before, objects) = SceneMark(scene), self._made
        same = world == mark and same_objects(before, shapes)
        current = bool(objects) and same and all(obj.is_current() for obj in objects)
        places = places_of(scene)
        if current and places != self._places:
            results = [obj.geometry for obj in objects]
            current = not any(geometry.contents for geometry in results) and not contents(scene, results)
            current = current and not objects[0].instance_scene.shapes
        if not current:
            if not (objects and same):
                self.choices = _choices(scene, self.settings)
            self._made = mark, shapes, make_objects(scene, self.settings, (), self.choices)
        self._places = places
        return self._made[2]


def make_objects(
    scene: Any, settings: Settings, without: Collection[str] = (), chosen: Choices | None = None
) -> list[TranslucentObject]:
    """All objects of a scene that have a `translucent` surface, but for those in others or with the ids in `without`.

    Args:
        scene: of Mitsuba.
        settings: of the integrator.
        without: ids.
        chosen: what stands for "auto", by default chosen now.

    Raises:
        ValueError: there is none, a camera or a lamp is inside one, a model refuses its medium or what lies inside, or
            the orders that are asked for are not those of the model.
    """
    if mi.is_spectral and settings.light != "sampled":
        raise ValueError(f"light must be 'sampled' under a spectral variant, got {settings.light!r}")
    shapes = translucent_shapes(scene)
    if not shapes:
        raise ValueError("the scene must have an object with a translucent BSDF, got none")
    groups = shown_groups(scene)
    objects = [surveyed(shape, scene, groups) for shape in shapes]
    check_sensors(scene, objects)
    outer = filled(scene, objects, settings.mm_per_unit, _MODELS)
    check_together(scene, [part.scene for each in outer for part in (each, each.contents) if part is not None])
    chosen = chosen or _choices(scene, settings)
    models = {id(shape): chosen.models.get(k) for k, shape in enumerate(shapes)}
    named = [each for each in outer if each.shape.id() not in without]
    insides = [_asked(each.shape, settings, models[id(each.shape)]) for each in named]
    for each, inside in zip(named, insides):
        if each.group is not None:
            _check_repeated(each, inside, settings)
    results = [_make_object(each, equivalent(inside, each), settings) for each, inside in zip(named, insides)]
    instance_scene = InstanceScene.of(scene, groups)
    return [replace(obj, instance_scene=instance_scene) for obj in results]
