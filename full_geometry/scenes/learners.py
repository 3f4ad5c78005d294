"""What learns an object of a scene and says how wrong models of it are: the commands `train object`, `errors object`.

An entry point of the group `halfspace_sss.learners` has the name of the model that it learns, and is a module or an
object with the functions of `Learner`, or with `train_shapes` of `ShapeLearner`, for `train shapes`.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple, Protocol, runtime_checkable

from full_geometry.registry import learnt_names, lookup
from full_geometry.scenes.camera_walks import CameraWalks
from halfspace_sss.checks import check_choice
from halfspace_sss.extensions import LEARNERS, warn_left_out
from halfspace_sss.progress import NamedProgress


class ObjectError(NamedTuple):
    """How wrong a model of an object is: relative RMSE of the radiance of its exits, and the ratio of the means."""

    object: str
    channel: str
    model: str
    light: str
    error: float
    standard_error: float
    ratio: float


class LearntObject(NamedTuple):
    """What came of a training: where its weights lie (None: there are none), how wrong they are, and its cost."""

    object: str
    path: Path | None
    errors: list[ObjectError]
    steps: int
    seconds: float


class LearntShapes(NamedTuple):
    """What came of a training on shapes without end: where its weights lie, objects that were drawn, and its cost."""

    path: Path
    objects: int
    steps: int
    seconds: float


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
        """Ids of the objects that have the model and no weights, and that a render would learn first."""

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


@runtime_checkable
class CostedLearner(Protocol):
    """Knows what the weights of an object took."""

    def cost(self, scene: Any, object: str) -> float:
        """Seconds; ValueError if the object has not been trained."""


@runtime_checkable
class ShapeLearner(Protocol):
    """Learns one network for every shape."""

    def train_shapes(
        self,
        folder: Path,
        *,
        seconds: float,
        seed: int,
        meshes: Sequence[Path],
        work: Path | None,
        progress: NamedProgress | None,
    ) -> LearntShapes:
        """Write its weights in a folder; ValueError before anything is traced if an argument is out of range."""


def learners() -> dict[str, Learner]:
    """All learners of objects by the name of their model."""
    result = _found()
    for name, other in result.items():
        if not isinstance(other, Learner | ShapeLearner):
            warn_left_out(LEARNERS, name, f"it must have the functions train, untrained and errors, got {other!r}")
    return {name: each for name, each in result.items() if isinstance(each, Learner)}


def learner(name: str | None = None) -> Learner:
    """The learner of the model `name`, by default the first one.

    Raises:
        ValueError: there is none.
    """
    known = learners()
    if not known:
        raise ValueError("model must be one that is learnt from a scene, got none installed")
    if name is not None:
        check_choice("model", name, tuple(known))
    return known[name] if name is not None else next(iter(known.values()))


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


def shape_learner() -> ShapeLearner:
    """The first learner of shapes.

    Raises:
        ValueError: there is none.
    """
    for each in _found().values():
        if isinstance(each, ShapeLearner):
            return each
    raise ValueError("model must be one that is learnt from shapes, got none installed")


def _found() -> dict[str, Any]:
    """What learns models, by name; that which does not load is left out with a warning."""
    known = {name: lookup(name).learner for name in learnt_names()}
    return {name: each for name, each in known.items() if each is not None}
