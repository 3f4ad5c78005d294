"""Checks of arguments that several entry points share; each names the parameter, the bound and the value."""

from __future__ import annotations

import difflib
import math
import numbers
from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from halfspace_sss.arrays import Library, Real

ROUNDING_ULPS = 4


def _plain(value: object) -> object:
    """The value as messages show it: NumPy's numbers as Python's."""
    return value.item() if isinstance(value, np.generic) else value


def did_you_mean(value: object, known: Iterable[str], most: int = 1) -> str:
    """The end of a message about an unknown name: the nearest known ones, or nothing if none is near.
    `known`: names, or a mapping from what is compared to the name that is shown."""
    shown = dict(known) if isinstance(known, Mapping) else {name: name for name in known}
    close = difflib.get_close_matches(str(value), shown, n=most)
    return f"; did you mean {', '.join(repr(shown[key]) for key in close)}?" if close else ""


def check_choice(name: str, value: object, known: Iterable[str]) -> None:
    known = list(known)
    if value not in known:
        raise ValueError(f"{name} must be one of {', '.join(known)}, got {value!r}{did_you_mean(value, known)}")


def check_count(name: str, value: object, least: int) -> None:
    if isinstance(value, bool) or not isinstance(value, numbers.Integral) or value < least:
        raise ValueError(f"{name} must be a whole number >= {least}, got {_plain(value)!r}")


def as_count(name: str, value: object, least: int) -> int:
    """As `check_count`, of a number that may be written 1e6."""
    value = int(value) if isinstance(value, float) and value.is_integer() else value
    check_count(name, value, least)
    return int(value)


def check_interval(name: str, value: object, low: float, high: float) -> None:
    if (
        isinstance(value, bool)
        or not isinstance(value, numbers.Real)
        or not math.isfinite(value)
        or not low <= value <= high
    ):
        raise ValueError(f"{name} must be a number in [{low:g}, {high:g}], got {_plain(value)!r}")


def check_flag(name: str, value: object) -> None:
    if not isinstance(value, bool):
        raise ValueError(f"{name} must be true or false, got {value!r}")


def check_finite(name: str, value: object) -> None:
    if isinstance(value, bool) or not isinstance(value, numbers.Real) or not math.isfinite(value):
        raise ValueError(f"{name} must be a finite number, got {_plain(value)!r}")


def check_edges(name: str, value: object, kind: str = "lengths >= 0 in mm") -> np.ndarray:
    """The edges of rings or cells as an array."""
    try:
        edges = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{name} must be {kind.replace(' >= 0', '')}, got {value!r}") from error
    enough = edges.ndim == 1 and len(edges) > 1 and np.all(np.isfinite(edges))
    if not enough or edges[0] < 0 or np.any(np.diff(edges) <= 0):
        raise ValueError(f"{name} must be two or more finite, ascending {kind}, got {edges.tolist()}")
    return edges


def rounding(value: object) -> float:
    """The excess of a cosine over 1 that rounding alone explains: 4 units in the last place of its own precision."""
    kind = getattr(value, "dtype", None)
    if type(value).__module__.split(".")[0] == "torch":
        import torch

        return ROUNDING_ULPS * torch.finfo(kind).eps if kind.is_floating_point else 0.0
    return ROUNDING_ULPS * float(np.finfo(kind if getattr(kind, "kind", "") == "f" else np.float64).eps)


def check_cosine(name: str, value: object, low: float = 0.0) -> float:
    """The cosine as a number in [low, 1]; what exceeds 1 by rounding is 1."""
    if isinstance(value, numbers.Real) and 1 < value <= 1 + rounding(value):
        return 1.0
    check_interval(name, value, low, 1.0)
    return float(value)


QUERY = ("r", "mu_i", "phi_i", "mu_o", "phi_o")
RANGES = {"r": (0.0, math.inf), "mu_i": (0.0, 1.0), "mu_o": (0.0, 1.0)}  # azimuths are finite


def check_query(
    lib: Library, args: tuple[Real, ...], given: tuple[Real, ...], names: Sequence[str] = QUERY
) -> tuple[Real, ...]:
    """Arguments of a query in their ranges, cosines that exceed 1 by rounding as 1; also refuses NaN.
    `args`: the arguments in one library and precision. `given`: the same as they came, whose precision says what is
    rounding. `names`: of these."""
    if type(args[0]).__module__.startswith(("drjit", "mitsuba")):
        return args
    checked = []
    for name, value, raw in zip(names, args, given):
        checked.append(value)
        low, high = RANGES.get(name, (-math.inf, math.inf))
        if 0 in value.shape:
            continue
        plain = value.detach() if hasattr(value, "detach") else value
        try:
            smallest, largest = float(plain.min()), float(plain.max())
        except RuntimeError:  # torch.func.vmap shows no values
            continue
        if high == 1 < largest <= 1 + rounding(raw):
            checked[-1], largest = lib.minimum(value, 1.0), 1.0
        if not (smallest >= low and largest <= high and math.isfinite(smallest) and math.isfinite(largest)):
            what = f"finite and in [{low:g}, {high:g}]" if name in RANGES else "finite"
            wrong = smallest if not smallest >= low else largest
            raise ValueError(f"{name} must be {what}, got {wrong!r}")
    return tuple(checked)
