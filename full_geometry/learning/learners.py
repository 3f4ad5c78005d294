"""What trains an object of a scene and says how wrong models of it are: the commands `train object`, `errors object`.

A learner has the name of the model that it trains, and is a module or an object with the functions of `Learner`. Those
of this project are in `LEARNERS`; packages of others add theirs by entry points of the group `halfspace_sss.learners`.
"""

from __future__ import annotations

import importlib
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, runtime_checkable

from full_geometry.learning.records import LearntObject, ObjectError
from halfspace_sss.checks import check_choice
from halfspace_sss.extensions import LEARNERS as GROUP
from halfspace_sss.extensions import loaded, offers, warn_left_out
from halfspace_sss.lazy import once
from halfspace_sss.progress import NamedProgress

if TYPE_CHECKING:
    from full_geometry.scenes.camera_walks import CameraWalks

LEARNERS = {"full_geometry": "full_geometry.learning.object_learner"}


@runtime_checkable
class Learner(Protocol):
    """Learns objects of scenes from `scene_files.load_objects`, and measures models of them.

    All functions raise ValueError before they trace anything: an argument is out of range, the object cannot be
    learnt, or there are several and none is named.
    """

    def train(
        self,
        scene: Any,
        *,
        object: str | None,
        seconds: float,
        target_error: float | None,
        seed: int,
        folder: Path | None,
        work: Path | None,
        progress: NamedProgress | None,
        camera: CameraWalks | None = None,
        base_model: str | None = None,
    ) -> LearntObject:
        """Learn an object and write its weights; walks of a camera that is given are data too.

        `base_model` names the model that its network corrects, where the learner knows several.
        """

    def untrained(self, scene: Any) -> list[str]:
        """Ids of the objects that have the model and no weights, so that a render refuses them."""

    def errors(
        self,
        scene: Any,
        models: Sequence[str],
        *,
        object: str | None,
        exits: int,
        seed: int,
        progress: NamedProgress | None,
    ) -> list[ObjectError]:
        """The errors of models of an object, over so many exits; of all that can be asked where none is named."""

    def cost(self, scene: Any, object: str) -> float:
        """Seconds that the weights of an object took; ValueError if it has not been trained."""


@once
def learners() -> dict[str, Learner]:
    """All learners by the name of their model; what does not load, or is none, is left out with a warning."""
    results: dict[str, Learner] = {name: importlib.import_module(place) for name, place in LEARNERS.items()}
    for name, entry in offers(GROUP).items():
        each = None if name in results else loaded(entry)
        if isinstance(each, Learner):
            results[name] = each
        elif each is not None:
            warn_left_out(GROUP, name, f"it must have the functions train, untrained, errors and cost, got {each!r}")
    return results


def learner(name: str | None = None) -> Learner:
    """The learner of the model `name`, by default the first one; ValueError if nothing trains that model."""
    known = learners()
    name = next(iter(known)) if name is None else name
    check_choice("model", name, tuple(known))
    return known[name]


def object_errors(scene: Any, models: Sequence[str], **how: Any) -> list[ObjectError]:
    """The errors of models of an object: a learner measures the model of its name, the first one all others.

    Args:
        scene, models, how: as for `Learner.errors`.
    """
    first, known = learner(), learners()
    own = [name for name in models if known.get(name, first) is not first]
    others = [name for name in models if name not in own]
    result = first.errors(scene, others, **how) if others or not own else []
    return [*result, *(row for name in own for row in known[name].errors(scene, [name], **how))]
