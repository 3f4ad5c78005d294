"""The models of objects: what each takes, and the function that binds it to an object.

A new model is one file with a function of (object, settings) that returns an `ObjectModel`, and one line of `MODELS`.
The half-space models of `halfspace_sss.models()` need no line: `transport.half_space` lays them onto any surface, and
`HALF_SPACE` says what they take then. Packages of others add models by entry points of the group
`halfspace_sss.transports`, each the name of the model with a `ModelEntry`. No module of a model is imported before the
model is asked for.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from full_geometry.settings import AUTO, PATH_TRACED, Capabilities
from halfspace_sss.checks import check_choice
from halfspace_sss.extensions import TRANSPORTS, offers
from halfspace_sss.lazy import once
from halfspace_sss.registry import models

if TYPE_CHECKING:
    from full_geometry.geometry.points import ObjectModel
    from full_geometry.objects.objects import TranslucentObject
    from full_geometry.settings import Settings


@dataclass(frozen=True)
class ModelEntry:
    """One model of objects.

    Args:
        make: the function of (`TranslucentObject`, `Settings`) that returns its `ObjectModel`, or where it stands,
            "package.module:function"; "" for a half-space model, which `transport.half_space` lays onto the surface.
        capabilities: what it takes.
        name: filled in by `lookup`.
    """

    make: str | Callable
    capabilities: Capabilities
    name: str = ""

    @property
    def transport(self) -> Callable | None:
        """The function that binds it to an object; None for a half-space model.

        Raises:
            ValueError: `make` is no function.
        """
        if self.capabilities.of_half_space:
            return None
        make = self.make
        if isinstance(make, str):
            module, _, function = make.partition(":")
            make = getattr(importlib.import_module(module), function)
        if not callable(make):
            raise ValueError(f"model {self.name!r} must be made by a function, got {make!r}")
        return make


HALF_SPACE = Capabilities(
    of_half_space=True, orders="", textures=True, spectra=True, varying="mean", stretched=True, normal_maps=True,
    gathered=True,
)  # fmt: skip
MODELS = {
    "full_geometry": ModelEntry(
        "full_geometry.transport.storing:learnt_model",
        Capabilities(straight=True, textures=True, inclusions=True, varying="exact", gathered=True, trained=True),
    ),
    "lambert": ModelEntry(
        "full_geometry.transport.lambert:lambert_model",
        Capabilities(orders="total", textures=True, varying="mean", stretched=True, normal_maps=True),
    ),
    "neural_shape": ModelEntry(
        "full_geometry.transport.any_shape:shape_model",
        Capabilities(straight=True, gathered=True, derivatives="neural"),
    ),
}
WALKS = Capabilities(  # what the integrator `translucent_walk` takes, which needs no model
    orders="total", straight=True, textures=True, spectra=True, inclusions=True, varying="exact", stretched=True,
    normal_maps=True, derivatives="all",
)  # fmt: skip
CORRECTED = replace(WALKS, spectra=False, derivatives="", gathered=True)  # what corrected light takes, of any model
_others = once(lambda: offers(TRANSPORTS))


def lookup(name: str) -> ModelEntry:
    """The entry of a model of the half-space or of objects.

    Raises:
        ValueError: there is none of that name, or that of another package is no `ModelEntry`.
    """
    check_model(name, model_names())
    if name in models():
        return ModelEntry("", replace(HALF_SPACE, derivatives=name), name)
    if name == AUTO:
        return ModelEntry(_not_chosen, Capabilities(), name)
    entry = MODELS[name] if name in MODELS else _others()[name].load()
    if not isinstance(entry, ModelEntry):
        raise ValueError(f"model {name!r} must be a ModelEntry, got {entry!r}")
    return replace(entry, name=name)


def _not_chosen(obj: TranslucentObject, settings: Settings) -> ObjectModel:
    raise ValueError(f"model must be one that has S for two points of a surface, got {AUTO!r}")


def check_model(name: str, known: Iterable[str]) -> None:
    """ValueError if a name is not among the known ones; walks have an integrator of their own."""
    if name == PATH_TRACED:
        raise ValueError(f"model must have an S, got {name!r}: for walks take the integrator translucent_walk")
    check_choice("model", name, known)


def model_names() -> tuple[str, ...]:
    """All names that the `model` of a surface may have, "auto" included."""
    return tuple(dict.fromkeys((*models(), *MODELS, *_others(), AUTO)))


def of_objects(name: str) -> bool:
    """Whether a model knows whole objects, rather than the half-space; so does what "auto" may stand for."""
    return not lookup(name).capabilities.of_half_space
