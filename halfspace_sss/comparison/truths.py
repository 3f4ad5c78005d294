"""The table of published, third-party and exact half-space numbers, and what of it a half-space tracer can answer."""

from __future__ import annotations

import csv
import math
import re
from dataclasses import dataclass
from pathlib import Path

from halfspace_sss.physics.medium import Medium

__all__ = ["MEASURES", "NotCovered", "Truth", "read_truths"]

TABLE = Path(__file__).parent / "data" / "truths.csv"
MEASURES = {
    "R_d": "R_d",
    "R_total": "R_total",
    "BRDF [1/sr]": "BRDF",
    "H(mu)": "H",
    "R_d(r) ring mean [1/cm^2]": "ring",
    "<r^2> [1/sigma_t^2]": "r2",
    "<x> [1/sigma_t]": "x",
    "<path length> [1/sigma_t]": "length",
    "R_d single scattering": "single",
    "R_d single scattering / albedo": "single",
    "R_d double scattering": "double",
    "R_d double scattering / albedo^2": "double",
}
FACTOR_ALBEDO = 0.5  # traced where the row gives a factor of albedo^n, which holds for every albedo
PER_CM2 = 100.0  # 1/mm² in 1/cm²
_COEFFICIENTS = re.compile(r"mua=([\d.]+) mus=([\d.]+) 1/cm")
_RING = re.compile(r"\[([\d.]+),([\d.]+)\] cm")


@dataclass(frozen=True)
class Truth:
    """A number of the table that the tracer can be held against.

    Attributes:
        id, kind, quantity, source: as in the table.
        measure: what is traced, a value of `MEASURES`.
        medium: the medium; sigma_t = 1/mm where the table counts in mean free paths.
        mu_i: external cosine of incidence, or "diffuse".
        direction: (mu_o, delta_phi) of a BRDF, delta_phi = 0 forward.
        ring: inner and outer radius, mm.
        factor: multiplies the traced value to give the row's quantity.
        value, uncertainty: the truth and one standard deviation (or bound) of it.
    """

    id: str
    kind: str
    quantity: str
    source: str
    measure: str
    medium: Medium
    mu_i: float | str
    direction: tuple[float, float] | None
    ring: tuple[float, float] | None
    factor: float
    value: float
    uncertainty: float


@dataclass(frozen=True)
class NotCovered:
    """A row that the tracer cannot answer, and why."""

    id: str
    quantity: str
    reason: str


def read_truths(path: Path | str | None = None) -> tuple[list[Truth], list[NotCovered]]:
    """Read the table: rows that speak of a half-space, and the others with the reason.

    Args:
        path: a CSV file with the columns of the packaged table, which is read if None.

    Raises:
        ValueError: a row cannot be read; names the file, the row and the column.
    """
    path = TABLE if path is None else Path(path)
    covered, others = [], []
    with path.open(newline="", encoding="utf-8") as file:
        for row in csv.DictReader(line for line in file if not line.startswith("#")):
            reason = _reason(row)
            if reason:
                others.append(NotCovered(row["id"], row["quantity"], reason))
                continue
            try:
                covered.append(_truth(row))
            except ValueError as error:
                raise ValueError(f"{path.name}, row {row['id']}: {error}") from error
    return covered, others


def _reason(row: dict[str, str]) -> str | None:
    """Why the tracer has no answer to a row; None if it has."""
    geometry = row["geometry"]
    if row["kind"] == "code_regression":
        return "value of a published model, not of the transport: a test of that model"
    if "glass slide" in geometry:
        return "a glass slide on the medium: another boundary"
    if "layers" in geometry:
        return "layers, not a half-space"
    if geometry.startswith("slab"):
        return "a slab, not a half-space"
    if row["quantity"] not in MEASURES:
        return "no quantity of a half-space"
    return None


def _truth(row: dict[str, str]) -> Truth:
    measure = MEASURES[row["quantity"]]
    mu_i = "diffuse" if row["mu_i"] == "diffuse" else _number(row, "mu_i")
    medium, factor = _medium(row)
    direction = ring = None
    if measure == "BRDF":
        phi = 0.0 if row["phi_deg"] == "any" else math.radians(_number(row, "phi_deg"))
        direction = (_number(row, "mu_o"), phi)
    elif measure == "H" and medium.albedo == 1:
        direction = (mu_i, 0.0)
    elif measure == "ring":
        match = _RING.search(row["other"])
        if match is None:
            raise ValueError(f"other must hold a ring [a,b] cm, got {row['other']!r}")
        ring, factor = tuple(round(10 * float(v), 9) for v in match.groups()), PER_CM2
    return Truth(
        row["id"], row["kind"], row["quantity"], row["source"], measure, medium, mu_i, direction, ring, factor,
        _number(row, "value"), _uncertainty(row),
    )  # fmt: skip


def _medium(row: dict[str, str]) -> tuple[Medium, float]:
    """The medium of a row, and the factor from its traced value to the row's quantity."""
    g, eta = _number(row, "g"), _number(row, "eta")
    coefficients = _COEFFICIENTS.search(row["geometry"])
    if coefficients:
        sigma_a, sigma_s = (float(v) / 10 for v in coefficients.groups())
        return Medium(sigma_s, sigma_a, g, eta), 1.0
    if row["albedo"] == "factor":
        order = 2 if row["quantity"].endswith("albedo^2") else 1
        return Medium.from_albedo(FACTOR_ALBEDO, 1.0, g, eta), FACTOR_ALBEDO**-order
    return Medium.from_albedo(_number(row, "albedo"), 1.0, g, eta), 1.0


def _number(row: dict[str, str], column: str) -> float:
    try:
        return float(row[column])
    except ValueError as error:
        raise ValueError(f"{column} must be a number, got {row[column]!r}") from error


def _uncertainty(row: dict[str, str]) -> float:
    """The column's number, "~" allowed before it; "rel" after it makes it relative to the value."""
    number, _, unit = row["uncertainty"].partition(" ")
    try:
        size = float(number.lstrip("~"))
    except ValueError as error:
        raise ValueError(f"uncertainty must be a number or 'number rel', got {row['uncertainty']!r}") from error
    if unit not in ("", "rel") or not size >= 0:
        raise ValueError(f"uncertainty must be a number >= 0 or 'number rel', got {row['uncertainty']!r}")
    return size * abs(_number(row, "value")) if unit else size
