"""The ways in which a scene can be rendered, and the same loaded scene shown by one after the other."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from typing import Any

from halfspace_sss.checks import check_choice
from halfspace_sss.interface.model import model_class, models
from halfspace_sss.rendering.object.placement import translucent_shapes
from halfspace_sss.rendering.object.registry import AUTO, model_names
from halfspace_sss.rendering.scenes.scene_files import PATH_TRACED, load_objects, millimetres

__all__ = ["LAMBERT", "NO_SINGLE", "Stage", "Way", "stage", "ways"]

LAMBERT = "lambert"
NO_SINGLE = "without single scattering"


@dataclass(frozen=True)
class Way:
    """A model for all objects, or "path_traced"; with orders instead of those of the scene, if any.

    Args:
        model: name of a model, or "path_traced".
        orders: "multiple" leaves single scattering out; None takes the orders of the scene.
    """

    model: str
    orders: str | None = None

    @property
    def name(self) -> str:
        """As tables show it."""
        return self.model if self.orders is None else f"{self.model}, {NO_SINGLE}"

    @classmethod
    def of(cls, name: str) -> Way:
        """The way of that name; ValueError if there is none."""
        model, _, left_out = name.partition(", ")
        check_choice("way", model, (PATH_TRACED, *(m for m in model_names() if m != AUTO)))
        if left_out:
            check_choice("orders that are left out", left_out, (NO_SINGLE,))
        return cls(model, "multiple" if left_out else None)


def ways() -> list[Way]:
    """All of them: path traced first, a diffuse surface, every model, and those without the single scattering."""
    found = [Way(PATH_TRACED), Way(LAMBERT)]
    found += [Way(name) for name in model_names() if name not in (AUTO, LAMBERT)]
    bare = [name for name in models() if model_class(name).orders == "multiple"]
    return found + [Way(name, "multiple") for name in bare if name in ("better_dipole", "neural")]


@dataclass(eq=False)
class Stage:
    """A loaded scene whose objects take models in turn.

    Args:
        scene: the Mitsuba scene.
        shapes: its translucent shapes.
        settings: of its integrator, by parameter name.
        bssrdf: parameters that `bssrdf` alone understands.
        paces: what an earlier look found by (object, way), by which the next one need not feel its way.
    """

    scene: Any
    shapes: list[Any]
    settings: dict[str, Any]
    bssrdf: dict[str, Any]
    paces: dict[tuple[int, Way], Any] = field(default_factory=dict)
    _integrators: dict[Way, Any] = field(default_factory=dict)
    _insides: dict[Way, list[Any]] = field(default_factory=dict)

    @property
    def mm_per_unit(self) -> float:
        return float(self.settings["mm_per_unit"])

    @property
    def names(self) -> list[str]:
        """Ids of the objects."""
        return [shape.id() for shape in self.shapes]

    @contextmanager
    def shown_by(self, way: Way) -> Iterator[Any]:
        """The integrator of a way, while the surfaces have its model; afterwards they are as they were."""
        surfaces = [shape.bsdf() for shape in self.shapes]
        before = [surface.inside for surface in surfaces]
        for surface, inside in zip(surfaces, self._of(way, before)):
            surface.inside = inside
        try:
            yield self._integrator(way)
        finally:
            for surface, inside in zip(surfaces, before):
                surface.inside = inside

    def forget(self, way: Way) -> None:
        """What has been made ready for a way."""
        self._integrators.pop(way, None)
        self._insides.pop(way, None)

    def _of(self, way: Way, before: list[Any]) -> list[Any]:
        """The same `Inside` each time a way is shown, by which an integrator knows what it has made ready."""
        if way.model == PATH_TRACED:
            return before
        if way not in self._insides:
            changes = {"model": way.model} | ({"orders": way.orders} if way.orders else {})
            made: dict[int, Any] = {}  # objects may share a surface
            self._insides[way] = [made.setdefault(id(i), replace(i, **changes)) for i in before]
        return self._insides[way]

    def _integrator(self, way: Way) -> Any:
        import mitsuba as mi

        if way not in self._integrators:
            walks = way.model == PATH_TRACED
            plugin = {"type": "translucent_walk" if walks else "bssrdf"} | self.settings
            # an object that was not learnt is refused: who asks does not wait for its training
            alone = {} if walks else {**self.bssrdf, "train_seconds": 0.0}
            self._integrators[way] = mi.load_dict(plugin | alone)
        return self._integrators[way]


def stage(scene: Any, parameters: dict[str, str] | None = None) -> Stage:
    """A scene made ready to be shown in several ways.

    Args:
        scene: a Mitsuba scene, a dict, or the path of an XML file.
        parameters: values of the parameters $name of an XML file.

    Raises:
        ValueError: as `load_objects`; there is no translucent object or no sensor, or it is an instance.
    """
    import mitsuba as mi

    loaded = scene if isinstance(scene, mi.Scene) else load_objects(scene, parameters)
    shapes = translucent_shapes(loaded)
    if not shapes:
        raise ValueError("the scene must have an object with a translucent BSDF, got none")
    if not loaded.sensors():
        raise ValueError("the scene must have a sensor, got none")
    _check_instances(shapes)
    return Stage(loaded, shapes, *_settings(loaded))


def _check_instances(shapes: Sequence[Any]) -> None:
    for shape in shapes:
        if "nstance" in shape.class_name():
            raise ValueError(f"a translucent object must not be an instance, got {shape.id()!r}")


def _settings(scene: Any) -> tuple[dict[str, Any], dict[str, Any]]:
    """What both integrators are told, and `bssrdf` alone; what the scene says, where its integrator is one of them."""
    integrator = scene.integrator()
    stated = getattr(integrator, "settings", None)
    if stated is not None:
        return stated.shared(), stated.of_models()
    common: dict[str, Any] = {"mm_per_unit": millimetres(scene), "hide_emitters": False, "max_depth": 8, "rr_depth": 5}
    if hasattr(integrator, "mm_per_unit"):
        common |= {"hide_emitters": integrator.hidden}
    return common, {}
