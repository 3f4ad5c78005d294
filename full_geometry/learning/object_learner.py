"""The learner `full_geometry` of the commands `train object` and `errors object`; objects are those of a scene."""

from __future__ import annotations

from collections.abc import Sequence
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any

import numpy as np

from full_geometry.learning.model_errors import RadianceError, errors_of, transport_of
from full_geometry.learning.records import LearntObject, ObjectError
from full_geometry.objects.objects import TranslucentObject, object_of, outermost
from full_geometry.surface.wrapped import surface_of
from full_geometry.transport.models import model_names
from full_geometry.transport.storing import KIND, find_weights, trained
from halfspace_sss.checks import check_count
from halfspace_sss.neural.store import check_weights_folder, load_weights
from halfspace_sss.progress import NamedProgress
from halfspace_sss.registry import models as half_space_models

if TYPE_CHECKING:
    import mitsuba as mi


def untrained(scene: mi.Scene) -> list[str]:
    """Ids of the objects of a scene that have this model and no weights yet; none without torch, which learns them.

    Raises:
        ValueError: one cannot be learnt, or the folder of weights cannot be written to.
    """
    missing = []
    for shape in outermost(scene) if find_spec("torch") else ():
        spec = surface_of(shape).spec
        asked = spec.model == KIND and spec.orders != "single"
        if not asked or not np.any(spec.medium.sigma_s > 0):
            continue
        obj = object_of(scene, None, None, shape.id())
        if not trained(obj):
            missing.append(shape.id())
    if missing:
        check_weights_folder()
    return missing


def train(scene: mi.Scene, **how: Any) -> LearntObject:
    """As `learning.training.train`; rows of errors have the names of object and channels."""
    from full_geometry.learning.training import train as learn

    learnt = learn(scene, **how)
    name = learnt.model.object.geometry.shape.id()
    return LearntObject(name, learnt.path, _rows(name, KIND, learnt.errors), learnt.steps, learnt.seconds)


def errors(
    scene: mi.Scene,
    models: Sequence[str] = (),
    *,
    object: str | None = None,
    exits: int = 256,
    seed: int = 0,
    progress: NamedProgress | None = None,
) -> list[ObjectError]:
    """How wrong models of an object are, the truth of each kind of orders traced once.

    Args:
        scene: with the object.
        models: "full_geometry", whose weights must have been trained, others that know objects, and half-space models;
            by default all of them that have learnt the object or take its medium.
        object: its id; may be left out where there is one.
        exits: how many, at random.
        seed: of everything.
        progress: called with (what, done, total).

    Raises:
        ValueError: there is no such model or object, or a model that is named refuses it.
    """
    check_count("seed", seed, 0)
    check_count("exits", exits, 2)
    obj = object_of(scene, None, None, object)
    transports = {name: transport_of(obj, name) for name in models} or _that_take(obj)
    name = obj.geometry.shape.id()
    by_model = errors_of(obj, transports, exits=exits, seed=seed, progress=progress)
    return [row for model, rows in by_model.items() for row in _rows(name, model, rows)]


def cost(scene: mi.Scene, object: str) -> float:
    """Seconds that the weights of an object of a scene took to learn; ValueError if it has not been trained."""
    path = find_weights(object_of(scene, None, None, object))
    return float(load_weights(path, KIND)[1].get("seconds", 0.0))


def _that_take(obj: TranslucentObject) -> dict[str, Any]:
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
