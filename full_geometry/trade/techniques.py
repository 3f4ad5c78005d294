"""The techniques by which a scene can be rendered, and the same loaded scene rendered by one after the other."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import mitsuba as mi

from full_geometry.capabilities import AUTO
from full_geometry.integrators.bssrdf import is_bssrdf
from full_geometry.integrators.gathering import Gathering
from full_geometry.objects.objects import KnowsUnit, millimetres, refuse_instances, translucent_shapes
from full_geometry.objects.small_emitters import is_delta
from full_geometry.scenes.scene_files import PATH_TRACED, load_objects
from full_geometry.settings import check_variant
from full_geometry.trade.smoothed_environment import SmoothedEnvironment
from full_geometry.transport.models import model_names
from halfspace_sss.checks import check_choice
from halfspace_sss.registry import model_class, models

LAMBERT = "lambert"
NO_SINGLE = "without single scattering"
GATHERED, PRECOMPUTED = "gathered", "precomputed"
RAYS = 2**19  # of light precomputed for walks, for each object: its noise at a point is 3 to 8 %


@dataclass(frozen=True)
class Technique:
    """A model for all objects, or "path_traced"; with orders instead of those of the scene, if any.

    Args:
        model: name of a model, or "path_traced": walks.
        orders: "multiple" leaves single scattering out; None takes the orders of the scene.
        light: "sampled"; of models "gathered", see `Settings`; of walks "precomputed", see `unscattered_light`.
        part: of gathered light, see `Gathering`, 0 for all of it; of precomputed light one independent of other parts.
        blur: of walks, see `translucent_walk`.
        smoothed: whether by the smoothed environment, see `smoothed_environment`.
    """

    model: str
    orders: str | None = None
    light: str = "sampled"
    part: int = 0
    blur: float = 1.0
    smoothed: bool = False

    @property
    def walks(self) -> bool:
        """Whether the integrator is `translucent_walk`."""
        return self.model == PATH_TRACED

    @property
    def exact(self) -> bool:
        """Whether it is walks with sampled light, by which biases are told."""
        return self.walks and self.light == "sampled"

    @property
    def halves(self) -> tuple[Technique, ...]:
        """The techniques that it is measured by: itself, or two independent parts of gathered or precomputed light."""
        return (self,) if self.light == "sampled" else (replace(self, part=1), replace(self, part=2))

    @property
    def name(self) -> str:
        """The name in tables."""
        parts = (self.model, NO_SINGLE if self.orders else "", "" if self.light == "sampled" else self.light)
        return ", ".join(filter(None, parts))

    @property
    def flags(self) -> str:
        """The options of the command `render` for it."""
        asked = f"--model {self.model}" + (f" --orders {self.orders}" if self.orders else "")
        return asked + (f" --light {self.light}" if self.walks or self.light != "sampled" else "")

    @classmethod
    def of(cls, name: str) -> Technique:
        """The technique of that name; ValueError if there is none."""
        model, *more = name.split(", ")
        check_choice("way", model, (PATH_TRACED, *(m for m in model_names() if m != AUTO)))
        of_model = (NO_SINGLE,) if model == LAMBERT else (NO_SINGLE, GATHERED)
        for part in more:
            check_choice(f"light of {model}", part, (PRECOMPUTED,) if model == PATH_TRACED else of_model)
        light = next((part for part in more if part != NO_SINGLE), "sampled")
        return cls(model, "multiple" if NO_SINGLE in more else None, light)


WALKS = Technique(PATH_TRACED)
PRECOMPUTED_WALKS = Technique(PATH_TRACED, light=PRECOMPUTED)


def techniques() -> list[Technique]:
    """All of them: path traced first, with light sampled and precomputed, a diffuse surface, every model with light
    sampled and gathered, and those without the single scattering."""
    names = [name for name in model_names() if name not in (AUTO, LAMBERT)]
    results = [WALKS, PRECOMPUTED_WALKS, Technique(LAMBERT), *map(Technique, names)]
    results += [Technique(name, light=GATHERED) for name in names]
    bare = [name for name in models() if model_class(name).orders == "multiple"]
    return results + [Technique(name, "multiple") for name in bare if name in ("better_dipole", "neural")]


@dataclass(eq=False)
class Stage:
    """A loaded scene, and the integrators of several techniques for it.

    Args:
        scene: the Mitsuba scene.
        shapes: its translucent shapes.
        settings: of its integrator, by parameter name.
        bssrdf: parameters that `bssrdf` alone understands.
        paces: first `Sampled` of earlier runs by (object, technique), so that the next run knows what a sample takes.
        smoothed: environment by which biases are told; None where the light of the scene tells them.
    """

    scene: mi.Scene
    shapes: list[mi.Shape]
    settings: dict[str, Any]
    bssrdf: dict[str, Any]
    paces: dict[tuple[int, Technique], Any] = field(default_factory=dict)
    smoothed: SmoothedEnvironment | None = None
    _integrators: dict[Technique, mi.Integrator] = field(default_factory=dict)

    @property
    def mm_per_unit(self) -> float:
        return float(self.settings["mm_per_unit"])

    @property
    def names(self) -> list[str]:
        """Ids of the objects."""
        return [shape.id() for shape in self.shapes]

    @property
    def blurs(self) -> bool:
        """Whether walks spread light of a delta light over a blur, so that they are not exact."""
        return any(map(is_delta, self.scene.emitters()))

    @contextmanager
    def with_smoothed_environment(self) -> Iterator[Stage]:
        """The stage with its environment map smoothed too, if it has one; its own is put back at the end."""
        smoothed = SmoothedEnvironment.of(self.scene)
        try:
            yield replace(self, smoothed=smoothed)
        finally:
            if smoothed is not None:
                smoothed.show(False)

    def runs(self, technique: Technique) -> tuple[Technique, ...]:
        """The runs of a technique: its halves; smoothed for the bias, with one half unsmoothed for the cost."""
        if self.smoothed is None:
            return technique.halves
        *rest, last = (replace(half, smoothed=True) for half in technique.halves)
        return (*rest, technique.halves[-1], last)

    def lit(self, technique: Technique) -> mi.Scene:
        """The scene in the light of a run."""
        if self.smoothed is not None:
            self.smoothed.show(technique.smoothed)
        return self.scene

    def integrator(self, technique: Technique) -> mi.Integrator:
        """The integrator of a technique, which keeps what it has made ready; shapes are the same in all light."""
        technique = replace(technique, smoothed=technique.smoothed and technique.light == PRECOMPUTED)
        if technique not in self._integrators:
            if technique.walks:
                plugin = {"type": "translucent_walk", **self.settings, "blur": technique.blur, "light": technique.light}
            else:
                plugin = {"type": "bssrdf", **self.settings, **self.bssrdf}
                plugin |= {"model": technique.model, "light": technique.light}
                plugin |= {"orders": technique.orders} if technique.orders else {}
            self._integrators[technique] = mi.load_dict(plugin)
            if technique.part and not technique.walks:
                self._integrators[technique].gathering = Gathering(technique.part)
            sampled = self._integrators.get(replace(technique, light="sampled", part=0))
            # spectral variants refuse gathered light
            if technique.light == GATHERED and sampled is not None and not mi.is_spectral:
                self._integrators[technique].take_over(sampled)
        return self._integrators[technique]

    def forget(self, technique: Technique) -> None:
        """Drop what has been made ready for a technique."""
        self._integrators.pop(technique, None)


def stage(scene: mi.Scene | dict[str, Any] | str | Path, parameters: dict[str, str] | None = None) -> Stage:
    """A scene made ready to be rendered by several techniques.

    Args:
        scene: a Mitsuba scene, a dict, or the path of an XML file.
        parameters: values of the parameters $name of an XML file.

    Raises:
        ValueError: as `load_objects`; there is no translucent object or no sensor, or it is an instance.
    """
    check_variant()
    loaded = scene if isinstance(scene, mi.Scene) else load_objects(scene, parameters)
    shapes = translucent_shapes(loaded)
    if not shapes:
        raise ValueError("the scene must have an object with a translucent BSDF, got none")
    if not loaded.sensors():
        raise ValueError("the scene must have a sensor, got none")
    refuse_instances(loaded, shapes, "the trade")
    return Stage(loaded, shapes, *_settings(loaded))


def _settings(scene: mi.Scene) -> tuple[dict[str, Any], dict[str, Any]]:
    """Settings of both integrators, and of `bssrdf` alone, from the integrator of the scene where it is one of them."""
    integrator = scene.integrator()
    if is_bssrdf(integrator):
        return integrator.settings.shared(), integrator.settings.of_models()
    common: dict[str, Any] = {"mm_per_unit": millimetres(scene), "hide_emitters": False, "max_depth": -1, "rr_depth": 5}
    if isinstance(integrator, KnowsUnit):  # `translucent_walk`
        common |= {"hide_emitters": integrator.hidden}
    return common, {}
