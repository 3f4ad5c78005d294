"""The names that `model` may have in a scene: the half-space models, and what packages add that knows whole objects.

An entry point of the group `halfspace_sss.transports` is a mapping of names to "module:function"; the function takes
(found, inside, media, settings), the `Object`, the `Inside`, the medium of each channel in 1/(scene unit) and the
`Settings` of the integrator, and returns an `ObjectModel`. It is imported when it is asked for.
"auto" stands for the cheapest of these that is good enough, which `halfspace_sss.trade` finds at the first render.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Mapping
from typing import Any

from halfspace_sss.extensions import TRANSPORTS, offered, warn_left_out
from halfspace_sss.interface.model import models
from halfspace_sss.interface.model_lists import check_allowed
from halfspace_sss.lazy import once

__all__ = ["AUTO", "choose_models", "knows_objects", "model_names", "object_transport"]

AUTO = "auto"
_OWN = {"lambert": "halfspace_sss.rendering.object.lambert:lambert_model"}
_CHOICE = "halfspace_sss.trade.automatic"  # imported when it is asked for, as it renders


@once
def _added() -> dict[str, str]:
    found = dict(_OWN)
    for name, mapping in offered(TRANSPORTS):
        if not isinstance(mapping, Mapping) or not all(isinstance(v, str) and ":" in v for v in mapping.values()):
            warn_left_out(TRANSPORTS, name, f"it must map names to 'module:function', got {mapping!r}")
            continue
        found |= {key: value for key, value in mapping.items() if key not in found}
    return found


def model_names() -> tuple[str, ...]:
    """All names that the `model` of a surface may have."""
    return (*models(), *(name for name in _added() if name not in models()), AUTO)


def knows_objects(name: str) -> bool:
    """Whether a name is that of a model which knows whole objects, not one of the half-space."""
    return name not in models() and (name in _added() or name == AUTO)


def object_transport(name: str) -> Callable | None:
    """The function that makes the transport of that name for an object; None for a half-space model."""
    if name not in _added() or name in models():
        return None
    check_allowed(name)
    module, _, function = _added()[name].partition(":")
    return getattr(importlib.import_module(module), function)


def choose_models(scene: Any, settings: Any) -> None:
    """Give every surface of a scene whose model is "auto" one by name, which it keeps."""
    importlib.import_module(_CHOICE).choose(scene, settings)
