"""Binds objects of a scene to models: which transport, which entries, which low orders each object is rendered by."""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import replace

import mitsuba as mi
import numpy as np

from full_geometry.geometry.instances import InstanceScene, shapes_of, shown_groups
from full_geometry.geometry.points import ObjectModel, Transport
from full_geometry.geometry.shape import Geometry, SceneMark, analyse_shape, check_together, name_of
from full_geometry.geometry.snapshot import Snapshot, same_objects
from full_geometry.objects.inclusions import check_sensors, find_inclusions
from full_geometry.objects.objects import (
    _MODELS,
    TranslucentObject,
    check_size,
    expected_of,
    outermost,
    places_of,
    refuse,
    refuse_textures,
    translucent_shapes,
    with_inclusions,
)
from full_geometry.settings import AUTO, AUTOMATIC, GATHERED_LIGHTS, NO_OBJECT, Capabilities, Choices, Settings
from full_geometry.surface.medium_derivatives import DifferentiableTransport, MediumDerivatives
from full_geometry.surface.sheets import check_sheets
from full_geometry.surface.translucent import MediumSpec, check_boundary
from full_geometry.surface.varying import equivalent, warn_of_means
from full_geometry.surface.wrapped import surface_of
from full_geometry.transport.half_space import check_turns, half_space_model
from full_geometry.transport.models import check_model, lookup, model_names
from full_geometry.transport.palette import palette_model

RIGID = 1e-3  # of lengths, by which instances of what is learnt may differ
Chooser = Callable[["mi.Scene", Settings], Choices]  # says what stands for "auto" in a scene


def _check_repeated(geometry: Geometry, spec: MediumSpec, settings: Settings) -> None:
    """ValueError if instances of an object are not what its model or light takes."""
    if spec.varying is not None:
        raise ValueError(f"the medium of an instance must not vary in space, got object {geometry.name}")
    if settings.light in GATHERED_LIGHTS:
        raise ValueError(
            f"light must be sampled of objects that instances show, got {settings.light} of {geometry.name}"
        )
    stretched = geometry.group.stretch > RIGID
    if spec.orders != "single" and stretched and not lookup(spec.model).capabilities.stretched:
        raise ValueError(
            f"instances of object {geometry.name} must be moved, turned or mirrored for the model {spec.model!r}, "
            f"got lengths that differ by {100 * geometry.group.stretch:.3g} %: give each size a group of its own, or "
            "take translucent_walk or a model of the half-space"
        )


def _asked(shape: mi.Shape, settings: Settings, model: str | None = None) -> MediumSpec:
    """What is inside an object, with the model and orders that the integrator asks for."""
    spec = surface_of(shape).spec
    asked = {"model": model or settings.model or spec.model, "orders": settings.orders or spec.orders}
    return spec if asked == {key: getattr(spec, key) for key in asked} else replace(spec, **asked)


def choices_of(scene: mi.Scene, settings: Settings, choose: Chooser) -> Choices:
    """What stands for "auto", measured if anything is."""
    specs = [_asked(shape, settings) for shape in translucent_shapes(scene)]
    if specs and (settings.light == AUTO or any(spec.model == AUTO for spec in specs)):
        if mi.is_spectral:
            raise ValueError("model must be named under a spectral variant, got 'auto'")
        for shape in outermost(scene):
            check_boundary(name_of(shape), surface_of(shape).boundary)
        return choose(scene, settings)
    return Choices({}, settings.light, {})


def _make_object(geometry: Geometry, spec: MediumSpec, settings: Settings) -> TranslucentObject:
    media = tuple(m.scaled(settings.mm_per_unit) for m in spec.channels())
    check_size(geometry, [float(m.sigma_t) for m in media], settings.mm_per_unit)
    varying = None if spec.varying is None else spec.varying.placed(geometry, settings.mm_per_unit)
    obj = TranslucentObject(geometry, media, varying)
    if spec.textured is not None:
        spec.textured.check(geometry)
        even = spec.textured.is_even(geometry.shape)
        textured = None if even else spec.textured.scaled(settings.mm_per_unit)
        obj = replace(obj, textured=textured, painted=Snapshot(geometry.shape))
    if spec.spectral is not None:
        obj = replace(obj, spectral=spec.spectral.scaled(settings.mm_per_unit))
    single_only = spec.orders == "single" or not any(float(m.sigma_s) > 0 for m in media)
    corrected = settings.light == "corrected"
    if not corrected:  # by walks, which know any boundary
        check_boundary(geometry.name, obj.surface.boundary)
    obj.wrapping.check(geometry)
    capabilities = lookup(spec.model).capabilities
    if geometry.inclusions is not None:
        if single_only or not capabilities.inclusions:
            refuse(geometry.inclusions.found[0], geometry, f"the model {spec.model!r}")
        if spec.orders != "total":
            told = f"got {spec.orders!r} of object {geometry.name}"
            raise ValueError(f"orders must be 'total' of objects with something inside, {told}")
    derivatives = MediumDerivatives(obj.surface, settings.mm_per_unit, spec.model, capabilities.derivatives)
    if spec.orders == "total" and not (single_only or capabilities.straight or corrected):
        check_turns(geometry, media, spec.model)
    none = ObjectModel(None, None)
    transport, proposals, entries = none if single_only else _model_of(obj, spec, settings)
    if transport and transport.orders == "total" and spec.orders == "multiple":
        raise ValueError(f"orders must be total for the model {spec.model!r}, which contains them all, got multiple")
    low_orders = _low_orders(spec, transport, corrected)
    if transport is not None and capabilities.derivatives and obj.textured is None and obj.spectral is None:
        transport = DifferentiableTransport(transport, derivatives)
    entries = entries if settings.entries == AUTOMATIC else settings.entries
    return replace(
        obj, transport=transport, proposals=proposals, entries=entries, low_orders=low_orders,
        expected=expected_of(media), derivatives=derivatives, capabilities=capabilities,
    )  # fmt: skip


def _low_orders(spec: MediumSpec, transport: Transport | None, corrected: bool) -> tuple[int, ...]:
    """The orders below two that are traced beside a transport.
    No light passes a half-space: its models put into orders from two on what passes something thin, which a correction
    takes out of them."""
    if spec.orders != "total":
        return (1,) if spec.orders == "single" else ()
    if transport is not None and transport.orders == "total":
        return ()
    straight = transport is None or corrected or lookup(spec.model).capabilities.straight
    return (0, 1) if straight else (1,)


def _model_of(obj: TranslucentObject, spec: MediumSpec, settings: Settings) -> ObjectModel:
    entry = lookup(spec.model)
    if entry.capabilities.varying == "mean":
        warn_of_means(spec, obj.geometry)
    if not entry.capabilities.of_half_space:
        _check_object(obj, spec.model, entry.capabilities)
        return entry.transport(obj, settings)
    if obj.textured is not None:
        return palette_model(spec.model, obj.geometry, obj.media, obj.textured, settings)
    if obj.spectral is not None:
        of_mean = replace(obj.media[0], g=float(np.mean([m.g for m in obj.media])))
        return palette_model(spec.model, obj.geometry, (of_mean,) * len(obj.media), obj.spectral, settings)
    return half_space_model(spec.model, obj.geometry, obj.media, settings)


def _check_object(obj: TranslucentObject, model: str, takes: Capabilities) -> None:
    """ValueError if an object has a spectrum, a texture or a map of normals that its model does not take."""
    if obj.spectral is not None and not takes.spectra:
        raise ValueError(
            f"variant must be RGB or mono for the model {model!r} of object {obj.geometry.name}, got "
            f"{mi.variant()}: translucent_walk and models of the half-space take spectra"
        )
    if obj.textured is not None and not takes.textures:
        refuse_textures(obj.geometry.name, f"the model {model!r}")
    if obj.wrapping.bend is not None and not takes.normal_maps:
        raise ValueError(
            f"object {obj.geometry.name} must be without normal and bump maps for the model {model!r}: "
            "translucent_walk and models of the half-space take them"
        )


class TranslucentObjects:
    """The objects of the scene that was asked for last, made anew when its objects, their shape or media changed.
    `choose`: says what stands for "auto"."""

    def __init__(self, settings: Settings, choose: Chooser) -> None:
        self.settings, self.choose = settings, choose
        self._made: tuple[SceneMark | None, list, list[TranslucentObject]] = (None, [], [])
        self._places: list = []
        if settings.model:
            check_model(settings.model, model_names())
        self.choices = Choices({}, settings.light, {})  # for as long as the objects are the same

    def take_over(self, other: TranslucentObjects) -> None:
        """What another has made by the same settings but for the light, which no model needs to know."""
        self._made, self._places = other._made, other._places

    def of(self, scene: mi.Scene) -> list[TranslucentObject]:
        """The objects of a scene; errors as in `make_objects`."""
        shapes = scene.shapes()  # the scene itself, which holds its integrator, would never be freed
        mark, (world, before, objects) = SceneMark(scene), self._made
        same = world == mark and same_objects(before, shapes)
        current = bool(objects) and same and all(obj.is_current() for obj in objects)
        places = places_of(scene)
        if current and places != self._places:
            results = [obj.geometry for obj in objects]
            current = not any(geometry.inclusions for geometry in results) and not find_inclusions(scene, results)
            current = current and not objects[0].instance_scene.shapes
            if current:
                objects[0].instance_scene.measure(scene)
        if current:
            check_sensors(scene, [obj.geometry for obj in objects])
        else:
            if not (objects and same):
                self.choices = choices_of(scene, self.settings, self.choose)
            settings = replace(self.settings, light=self.choices.light)
            self._made = mark, shapes, make_objects(scene, settings, self.choices)
        self._places = places
        return self._made[2]


def make_objects(
    scene: mi.Scene, settings: Settings, chosen: Choices | None = None, without: Collection[str] = ()
) -> list[TranslucentObject]:
    """All objects of a scene that have a `translucent` surface, but for those in others or with the ids in `without`.
    `chosen`: what stands for "auto"; may be left out where no object has that model. `without`: ids. ValueError if
    there is none, a camera or a lamp is inside one, a model refuses its medium or what lies inside, or the orders that
    are asked for are not those of the model."""
    if mi.is_spectral and settings.light != "sampled":
        raise ValueError(f"light must be 'sampled' under a spectral variant, got {settings.light!r}")
    shapes = translucent_shapes(scene)
    if not shapes:
        raise ValueError(NO_OBJECT)
    groups = shown_groups(scene)
    check_sheets(shapes_of(scene, groups), settings.mm_per_unit)
    objects = [analyse_shape(shape, scene, groups) for shape in shapes]
    check_sensors(scene, objects)
    outer = with_inclusions(scene, objects, settings.mm_per_unit, _MODELS)
    check_together(scene, [part.scene for each in outer for part in (each, each.inclusions) if part is not None])
    models = {id(shape): chosen.models.get(k) if chosen else None for k, shape in enumerate(shapes)}
    named = [each for each in outer if each.shape.id() not in without]
    specs = [_asked(each.shape, settings, models[id(each.shape)]) for each in named]
    for each, spec in zip(named, specs):
        if each.group is not None:
            _check_repeated(each, spec, settings)
    results = [_make_object(each, equivalent(spec, each), settings) for each, spec in zip(named, specs)]
    instance_scene = InstanceScene.of(scene, groups)
    return [replace(obj, instance_scene=instance_scene) for obj in results]
