"""Everything that is known of a model by its name: what it is on an object, what learns it, the modules it is made of.

The half-space models are those of `interface.model`. Packages add others by entry points under the name of the model:

- `halfspace_sss.transports`: a function of (object, settings) that returns an `ObjectModel`: of the
  `TranslucentObject`, geometry and media, and the `Settings` of the integrator; where S has the paths that meet what
  lies inside an object, of all orders, it has an attribute `takes_contents` that is true; where it takes media by
  textures, `takes_textures`; where it has derivatives by the medium, as of `PerturbableTransport`, `varies_as`, the
  name of a half-space model that knows the same media;
- `halfspace_sss.learners`: a module or object that learns the model, see `scenes.learners`;
- `halfspace_sss.choosers`: a function of (scene, settings) that returns `Choices`, what stands for the name in a scene;
  "auto" stands for the cheapest that is good enough.

None is imported before it is asked for.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from importlib.metadata import EntryPoint
from typing import TYPE_CHECKING, Any, NamedTuple

from full_geometry.settings import Settings
from halfspace_sss.checks import check_choice
from halfspace_sss.extensions import CHOOSERS, LEARNERS, TRANSPORTS, loaded, offers
from halfspace_sss.interface.model import check_allowed, model_class, models
from halfspace_sss.lazy import once

if TYPE_CHECKING:
    import mitsuba as mi

AUTO = "auto"
PATH_TRACED = "path_traced"  # stands for walks by `translucent_walk` where a model is named
_BY_GROUP = once(offers)


@dataclass(frozen=True)
class ModelEntry:
    """What is known of one model.

    Args:
        name: of it.
        of_half_space: whether it is a model of the half-space.
        offers: entry points of its name, by group.
    """

    name: str
    of_half_space: bool
    offers: dict[str, EntryPoint]

    @property
    def knows_objects(self) -> bool:
        """Whether it knows whole objects, rather than the half-space."""
        return not self.of_half_space and (TRANSPORTS in self.offers or CHOOSERS in self.offers)

    @property
    def transport(self) -> Callable | None:
        """The function that makes an `ObjectModel` of an object; None for a half-space model, which is laid onto it.

        Raises:
            ValueError: what the entry point names is no function.
        """
        if self.of_half_space or TRANSPORTS not in self.offers:
            return None
        check_allowed(self.name)
        make = self.offers[TRANSPORTS].load()
        if not callable(make):
            raise ValueError(f"model {self.name!r} must be made by a function, got {make!r}")
        return make

    @property
    def takes_contents(self) -> bool:
        """Whether its transport takes objects with something inside."""
        return bool(getattr(self.transport, "takes_contents", False))

    @property
    def varies_as(self) -> str | None:
        """The half-space model of whose media it has derivatives; None where it has none."""
        return self.name if self.of_half_space else getattr(self.transport, "varies_as", None)

    @property
    def learner(self) -> Any:
        """What learns it; None where nothing does, or where it does not load, which a warning says."""
        return loaded(self.offers[LEARNERS]) if LEARNERS in self.offers else None

    @property
    def modules(self) -> tuple[str, ...]:
        """Dotted names of the modules where it begins, of all its kinds."""
        own = (model_class(self.name).__module__,) if self.of_half_space else ()
        return (*own, *(entry.module for entry in self.offers.values()))


def lookup(name: str) -> ModelEntry:
    """All that is known of a model.

    Raises:
        ValueError: there is none of that name; the message has the nearest.
    """
    check_model(name, (*model_names(), *learnt_names()))
    offered = {group: known[name] for group in (TRANSPORTS, CHOOSERS, LEARNERS) if name in (known := _BY_GROUP(group))}
    return ModelEntry(name, name in models(), offered)


def check_model(name: str, known: Iterable[str]) -> None:
    """ValueError if a name is not among the known ones; walks have an integrator of their own."""
    if name == PATH_TRACED:
        raise ValueError(f"model must have an S, got {name!r}: for walks take the integrator translucent_walk")
    check_choice("model", name, known)


def model_names() -> tuple[str, ...]:
    """All names that the `model` of a surface may have."""
    added = (*_BY_GROUP(TRANSPORTS), *_BY_GROUP(CHOOSERS))
    return tuple(dict.fromkeys((*models(), *added)))


def learnt_names() -> tuple[str, ...]:
    """Names of all models that something learns."""
    return tuple(_BY_GROUP(LEARNERS))


class Choices(NamedTuple):
    """What stands for "auto" in a scene.

    Args:
        models: by number among the translucent objects of the scene, of those whose model is "auto".
        light: "sampled" or "gathered".
        sentences: why, by id of the object.
    """

    models: dict[int, str]
    light: str
    sentences: dict[str, str]


def choices(scene: mi.Scene, settings: Settings) -> Choices:
    """A model for every object of a scene whose model is "auto", and the light if that is."""
    return _BY_GROUP(CHOOSERS)[AUTO].load()(scene, settings)
