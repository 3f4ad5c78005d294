"""What trains an object of a scene and says how wrong models of it are: the commands `train object`, `errors object`.

A learner has the name of the model that it trains, and is a module or an object with the functions of `Learner`. Those
of this project are in `LEARNERS`; packages of others add theirs by entry points of the group `halfspace_sss.learners`.
"""

from __future__ import annotations

from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple, Protocol, runtime_checkable

import mitsuba as mi
import numpy as np

from full_geometry.geometry.points import Transport
from full_geometry.learning.model_errors import RadianceError, errors_of, transport_of
from full_geometry.objects.objects import TranslucentObject, object_of, outermost
from full_geometry.scenes.camera_walks import CameraWalks
from full_geometry.surface.wrapped import surface_of
from full_geometry.transport.models import model_names
from full_geometry.transport.storing import KIND, find_weights, trained
from halfspace_sss.checks import check_choice, check_count
from halfspace_sss.extensions import LEARNERS as GROUP
from halfspace_sss.extensions import loaded, offers, warn_left_out
from halfspace_sss.lazy import once
from halfspace_sss.neural.store import check_weights_folder, load_weights
from halfspace_sss.progress import NamedProgress
from halfspace_sss.registry import models as half_space_models


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
    """The result of a training: the file of its weights (None: there are none), their errors, and the cost."""

    object: str
    path: Path | None
    errors: list[ObjectError]
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
        scene: mi.Scene,
        *,
        object: str | None,
        folder: Path | None,
        work: Path | None,
        progress: NamedProgress | None,
        camera: CameraWalks | None = None,
        **plan: Any,
    ) -> LearntObject:
        """Learn an object and write its weights; walks of a camera that is given are data too.

        `plan` has `seconds`, `target_error` and `seed`.
        """

    def untrained(self, scene: mi.Scene) -> list[str]:
        """Ids of the objects that have the model and no weights, so that a render refuses them."""

    def errors(
        self,
        scene: mi.Scene,
        models: Sequence[str],
        *,
        object: str | None,
        exits: int,
        seed: int,
        progress: NamedProgress | None,
    ) -> list[ObjectError]:
        """The errors of models of an object, over so many exits; of all that can be asked where none is named."""

    def cost(self, scene: mi.Scene, object: str) -> float:
        """Seconds that the weights of an object took; ValueError if it has not been trained."""


class ObjectLearner:
    """The learner of the model `full_geometry`."""

    def train(self, scene: mi.Scene, **how: Any) -> LearntObject:
        """As `learning.training.train`; rows of errors have the names of object and channels."""
        from full_geometry.learning.training import train

        learnt = train(scene, **how)
        name = learnt.model.object.geometry.shape.id()
        return LearntObject(name, learnt.path, _rows(name, KIND, learnt.errors), learnt.steps, learnt.seconds)

    def untrained(self, scene: mi.Scene) -> list[str]:
        """As `Learner.untrained`; none without torch, which learns them, or where the folder cannot be written to."""
        missing = []
        for shape in outermost(scene) if find_spec("torch") else ():
            spec = surface_of(shape).spec
            asked = spec.model == KIND and spec.orders != "single"
            if not asked or not np.any(spec.medium.sigma_s > 0):
                continue
            if not trained(object_of(scene, None, None, shape.id())):
                missing.append(shape.id())
        if missing:
            check_weights_folder()
        return missing

    def errors(
        self,
        scene: mi.Scene,
        models: Sequence[str] = (),
        *,
        object: str | None = None,
        exits: int = 256,
        seed: int = 0,
        progress: NamedProgress | None = None,
    ) -> list[ObjectError]:
        """As `Learner.errors`, also of other models that know objects; the truth of each kind of orders is traced once.

        The default is all that have learnt the object or take its medium.
        """
        check_count("seed", seed, 0)
        check_count("exits", exits, 2)
        obj = object_of(scene, None, None, object)
        transports = {name: transport_of(obj, name) for name in models} or _that_take(obj)
        name = obj.geometry.shape.id()
        by_model = errors_of(obj, transports, exits=exits, seed=seed, progress=progress)
        return [row for model, rows in by_model.items() for row in _rows(name, model, rows)]

    def cost(self, scene: mi.Scene, object: str) -> float:
        path = find_weights(object_of(scene, None, None, object))
        return float(load_weights(path, KIND)[1].get("seconds", 0.0))


def _that_take(obj: TranslucentObject) -> dict[str, Transport]:
    """All transports of an object that can be asked."""
    transports = {}
    for name in sorted(model_names(), key=half_space_models().__contains__):
        try:
            transports[name] = transport_of(obj, name)
        except ValueError:
            continue
    return transports


def _rows(name: str, model: str, errors: list[RadianceError]) -> list[ObjectError]:
    n = 1 + max((row.channel for row in errors), default=0)
    channels = "RGB" if n == 3 else ["mono"]
    return [ObjectError(name, channels[e.channel], model, e.light, e.error, e.standard_error, e.ratio) for e in errors]


LEARNERS: dict[str, Learner] = {KIND: ObjectLearner()}


@once
def learners() -> dict[str, Learner]:
    """All learners by the name of their model; what does not load, or is none, is left out with a warning."""
    results = dict(LEARNERS)
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


def object_errors(scene: mi.Scene, models: Sequence[str], **how: Any) -> list[ObjectError]:
    """The errors of models of an object: a learner measures the model of its name, the first one all others.

    Args:
        scene, models, how: as for `Learner.errors`.
    """
    first, known = learner(), learners()
    own = [name for name in models if known.get(name, first) is not first]
    others = [name for name in models if name not in own]
    result = first.errors(scene, others, **how) if others or not own else []
    return [*result, *(row for name in own for row in known[name].errors(scene, [name], **how))]
