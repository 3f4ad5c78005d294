"""Material files: TOML that people write, checked key by key."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated, ClassVar, Literal

import numpy as np
from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, StringConstraints, ValidationError
from pydantic_core import ErrorDetails

from halfspace_sss.checks import did_you_mean
from halfspace_sss.materials.material import Material
from halfspace_sss.physics.medium import CLEAR, Medium
from halfspace_sss.provenance import read_text

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

PER_MM = {"1/mm": 1.0, "1/cm": 10.0}  # divisors: 2.41 / 10 is 0.241, 2.41 * 0.1 is not
COEFFICIENTS = (("sigma_s", "sigma_a"), ("sigma_s_prime", "sigma_a"), ("sigma_t", "albedo"))
Quantity = Literal["sigma_s", "sigma_s_prime", "sigma_t", "sigma_a", "albedo", "g", "eta", "sample_ml"]


def _as_list(value: object) -> object:
    return value if isinstance(value, list) else [value]


Text = Annotated[str, StringConstraints(strip_whitespace=True, min_length=1)]
Positive = Annotated[float, Field(gt=0)]
Coefficients = Annotated[list[Annotated[float, Field(ge=0)]], BeforeValidator(_as_list)]
Albedos = Annotated[list[Annotated[float, Field(ge=0, le=1)]], BeforeValidator(_as_list)]
Cosines = Annotated[list[Annotated[float, Field(gt=-1, lt=1)]], BeforeValidator(_as_list)]


class _Strict(BaseModel):
    model_config: ClassVar[ConfigDict] = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False)


class Entry(_Strict):
    """One [[material]] table."""

    name: Text
    sigma_s: Coefficients | None = None
    sigma_s_prime: Coefficients | None = None
    sigma_t: Coefficients | None = None
    sigma_a: Coefficients | None = None
    albedo: Albedos | None = None
    g: Cosines | None = None
    eta: Positive | None = None
    sample_ml: Positive | None = None
    dilutable: bool | None = None
    note: str = ""


class MaterialFile(_Strict):
    """A whole file: what its materials share, and the materials."""

    set: Text
    unit: Literal["1/mm", "1/cm"]
    source: Text
    channels: Annotated[list[Text], Field(min_length=1)] | None = None
    eta: Positive | None = None
    tank_ml: Positive | None = None
    dilutable: bool = False
    assumptions: list[Text] = []
    sources: dict[Quantity, Text] = {}
    material: Annotated[list[Entry], Field(min_length=1)]


def read(path: Path) -> list[Material]:
    """The materials of a file.
    ValueError if the file cannot be read, or `parse` refuses it."""
    try:
        text = read_text(path)
    except (OSError, UnicodeDecodeError) as error:
        raise ValueError(f"{path}: must be a readable TOML file in UTF-8, got {error}") from error
    return parse(text, str(path))


def parse(text: str, origin: str) -> list[Material]:
    """The materials in the text of a file called `origin`.
    ValueError if the text is no TOML, or a key, unit, value or combination is wrong; names file, key, bound, value."""
    try:
        raw = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise ValueError(f"{origin}: must be TOML, got {error}") from error
    try:
        file = MaterialFile.model_validate(raw)
    except ValidationError as error:
        problems = [_problem(e, raw) for e in error.errors()]
        raise ValueError(f"{origin}: " + "; ".join(problems)) from None
    materials = []
    for entry in file.material:
        try:
            materials.append(_material(file, entry))
        except ValueError as error:
            raise ValueError(f"{origin}: material {entry.name!r}: {error}") from error
    return materials


def _problem(error: ErrorDetails, raw: dict) -> str:
    loc = list(error["loc"])
    where, model = "", MaterialFile
    if len(loc) > 1 and loc[0] == "material":
        table = raw["material"][loc[1]]
        name = table.get("name") if isinstance(table, dict) else None
        where, loc, model = f"material {name!r}, " if name else f"material {loc[1] + 1}, ", loc[2:], Entry
    # pydantic appends this part to a wrong key of a table, whose name is in the part before it
    loc = [part for part in loc if part != "[key]"]
    key = "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in loc).lstrip(".")
    if error["type"] == "extra_forbidden":
        hint = did_you_mean(loc[-1], list(model.model_fields)) or f"; known keys: {', '.join(model.model_fields)}"
        return f"{where}key {key} is unknown{hint}"
    if error["type"] == "missing":
        return f"{where}key {key} is required, got nothing"
    message = error["msg"][0].lower() + error["msg"][1:]
    ballistic = f"; with g = 1 nothing is scattered: {CLEAR}" if key.startswith("g") and error["input"] == 1 else ""
    return f"{where}key {key or '[[material]]'}: {message}, got {repr(error['input'])[:80]}{ballistic}"


def _material(file: MaterialFile, entry: Entry) -> Material:
    eta = entry.eta if entry.eta is not None else file.eta
    if eta is None:
        raise ValueError("key eta is required, here or for the whole file, got nothing")
    return Material(
        name=entry.name,
        medium=_medium(file, entry, eta),
        channels=None if file.channels is None else tuple(file.channels),
        set=file.set,
        source=file.source,
        assumptions=tuple(file.assumptions),
        note=entry.note,
        sources=dict(file.sources),
        g_assumed=entry.g is None,
        dilutable=file.dilutable if entry.dilutable is None else entry.dilutable,
        published_dilution=_published_dilution(file, entry),
    )


def _medium(file: MaterialFile, entry: Entry, eta: float) -> Medium:
    known = ("sigma_s", "sigma_s_prime", "sigma_t", "sigma_a", "albedo")
    given = tuple(key for key in known if getattr(entry, key) is not None)
    if given not in COEFFICIENTS:
        allowed = " or ".join(" and ".join(pair) for pair in COEFFICIENTS)
        raise ValueError(f"keys must be {allowed}, got {' and '.join(given) or 'none of them'}")
    if entry.g is None and "sigma_s_prime" not in given:
        raise ValueError(f"key g is required with {given[0]}, got nothing")
    first, second = (_per_channel(file, entry, key) for key in given)
    g = _per_channel(file, entry, "g") if entry.g is not None else 0.0
    scatters = np.greater(second if "albedo" in given else first, 0)
    g = np.where(scatters, g, 0.0)  # without scattering there is no phase function
    first = first / PER_MM[file.unit]
    if "albedo" in given:
        return Medium.from_albedo(second, first, g, eta)
    second = second / PER_MM[file.unit]
    make = Medium.from_reduced if "sigma_s_prime" in given else Medium
    return make(first, second, g, eta)


def _per_channel(file: MaterialFile, entry: Entry, key: str) -> np.ndarray | float:
    values = getattr(entry, key)
    if file.channels is None:
        if len(values) != 1:
            raise ValueError(f"key {key} must be one number, as the file names no channels, got {values!r}")
        return float(values[0])
    if len(values) not in (1, len(file.channels)):
        raise ValueError(f"key {key} must have one value for each of {file.channels!r}, got {values!r}")
    return np.broadcast_to(np.asarray(values, dtype=np.float64), len(file.channels))


def _published_dilution(file: MaterialFile, entry: Entry) -> float | None:
    if entry.sample_ml is None:
        return None
    if file.tank_ml is None or entry.sample_ml > file.tank_ml:
        raise ValueError(f"key sample_ml must be at most tank_ml ({file.tank_ml}), got {entry.sample_ml!r}")
    return entry.sample_ml / file.tank_ml
