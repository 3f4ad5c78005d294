"""Half-space models by name.

Those of `analytic_models` and `halfspace_sss.neural` are listed there. Models of other packages join by entry points of
the group `halfspace_sss.models`, each a list of classes: it is taken as a whole, or left out with a warning.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping

from analytic_models import MODELS as ANALYTIC
from halfspace_sss.checks import did_you_mean
from halfspace_sss.extensions import FAILURES, MODELS, offered, warn_left_out
from halfspace_sss.interface.model import BSSRDF
from halfspace_sss.lazy import once
from halfspace_sss.neural import MODELS as NEURAL
from halfspace_sss.physics.medium import Layers, Medium, medium_of

_registered: dict[str, type[BSSRDF]] = {}


@once
def _installed() -> Mapping[str, type[BSSRDF]]:
    """Models of this project, then those of all installed packages."""
    results = _new_models([*ANALYTIC, *NEURAL], {})
    for name, classes in offered(MODELS):
        try:
            results |= _new_models(classes, results)
        except FAILURES as error:
            warn_left_out(MODELS, name, error)
    return results


def register_model(cls: type[BSSRDF]) -> type[BSSRDF]:
    """Add a model class under its `name`; usable as a decorator.

    A class of the same module and qualified name as one that was registered before, as from a cell of a notebook that
    runs again, takes its place.

    Raises:
        ValueError: it is not a BSSRDF with name and orders, or the name is taken by another class.
    """
    _check_class(cls)
    before = _registered.get(cls.name)
    again = before and (before.__module__, before.__qualname__) == (cls.__module__, cls.__qualname__)
    if cls.name in models() and not again:
        raise ValueError(f"model name must be new, got {cls.name!r}, which is registered already")
    _registered[cls.name] = cls
    return cls


def models() -> tuple[str, ...]:
    """Names of all models, in the order of their lists."""
    return (*_installed(), *_registered)


def bssrdf(name: str, medium: Medium) -> BSSRDF:
    """The model called `name` for a medium, or for that of a material.

    Raises:
        ValueError: no such model (the nearest name is given), or the model refuses the medium, as all refuse `Layers`.
    """
    if isinstance(medium, Layers):
        raise ValueError(f"medium must be one Medium for {name}, got Layers of {len(medium)}; `trace` takes those")
    return model_class(name)(medium_of(medium))


def models_of(medium: Medium, names: Iterable[str] | None = None) -> Iterator[BSSRDF]:
    """The models for a medium, of all or of some names; those that refuse it are left out."""
    for name in models() if names is None else names:
        try:
            model = bssrdf(name, medium)
        except ValueError:
            continue
        yield model


def model_class(name: str) -> type[BSSRDF]:
    """The class of a model; ValueError with the nearest name if there is none."""
    known = {**_installed(), **_registered}
    if not isinstance(name, str) or name not in known:
        hint = did_you_mean(name, list(known)) + "; `render` and `errors object` take models of objects"
        raise ValueError(f"model must be one of {', '.join(known)}, got {name!r}{hint}")
    return known[name]


def _check_class(cls: object) -> None:
    """ValueError if it is no class of a model, or has no usable name or orders."""
    if not (isinstance(cls, type) and issubclass(cls, BSSRDF)):
        raise ValueError(f"a model must be a subclass of BSSRDF, got {cls!r}")
    name, orders = getattr(cls, "name", None), getattr(cls, "orders", None)
    if not isinstance(name, str) or not name:
        raise ValueError(f"name of a model must be a text that is not empty, got {name!r}")
    if orders not in ("multiple", "total"):
        raise ValueError(f"orders of a model must be multiple or total, got {orders!r}")


def _new_models(classes: Iterable[type], known: Mapping[str, type]) -> dict[str, type]:
    new: dict[str, type] = {}
    for cls in classes:
        _check_class(cls)
        if known.get(cls.name) is cls:  # from a list that is offered twice
            continue
        if cls.name in known or cls.name in new:
            raise ValueError(f"model name must be new, got {cls.name!r}, which is registered already")
        new[cls.name] = cls
    return new
