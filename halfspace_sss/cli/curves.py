"""The command `halfspace-sss curves`: path-traced and modelled curves of a medium, a table of errors, files."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from halfspace_sss.cli import shared

if TYPE_CHECKING:
    import pandas
    from rich.table import Table

    from halfspace_sss.comparison.curve_set import CurveSet


@dataclass(frozen=True)
class LineOptions:
    """Directions of a curve, and distances."""

    theta_i: Annotated[str, typer.Option(help="Angles of incidence, degrees.")] = "0,30,60,75"
    theta_o: Annotated[float, typer.Option(help="Angle of observation, degrees.")] = 0.0
    delta_phi: Annotated[float, typer.Option(help="Azimuth of observation from forward, degrees.")] = 0.0
    line: Annotated[float, typer.Option(help="Azimuth of the line from forward, degrees.")] = 90.0
    r_min: Annotated[float | None, typer.Option(help="Smallest distance, mm.", show_default="from the medium")] = None
    r_max: Annotated[float | None, typer.Option(help="Largest distance, mm.", show_default="from the medium")] = None


@dataclass(frozen=True)
class WalkOptions:
    """How the path-traced curve is made."""

    paths: Annotated[
        int | None,
        typer.Option(
            help="Walks for each theta_i; 0: models alone.", parser=shared.whole, show_default="from the medium"
        ),
    ] = None
    seed: shared.Seed = 0
    backend: shared.Backend = "llvm"


def curves(
    stated: shared.MediumOptions,
    line: LineOptions,
    walks: WalkOptions,
    material: shared.OneMaterial = None,
    channel: Annotated[str | None, typer.Option(help="Channel, by name or number.", show_default="first")] = None,
    model: shared.Models = None,
    orders: Annotated[
        Literal["multiple", "total"],
        typer.Option(help="multiple: reflectance at the orders of each model; total: with single."),
    ] = "multiple",
    out: shared.OutFolder = Path("curves"),
) -> None:
    """Compare curves of S, path traced and by every model; without arguments the setting of Fig. 10."""
    from halfspace_sss.comparison import reflectance_curves
    from halfspace_sss.provenance import check_folder

    check_folder(out)
    medium = stated.stated([] if material is None else [material]) or material or "fig10"
    angles = {f"{name}_deg": getattr(line, name) for name in ("theta_o", "delta_phi", "line")}
    with shared.Bar("tracing") as bar:
        result = reflectance_curves.curves(
            medium, channel=channel, theta_i_deg=shared.numbers("theta_i", line.theta_i), **angles, r_min=line.r_min,
            r_max=line.r_max, models=model or None, orders=orders, n_paths=walks.paths, seed=walks.seed,
            backend=walks.backend, progress=bar.show,
        )  # fmt: skip
    files = result.save(out)
    shared.say(error_table(result), *result.notes)
    if not any(file.suffix == ".pdf" for file in files):
        shared.say("no figure: it needs `pip install halfspace-sss[figures]`")
    told = f"{result.n_paths:,} walks for each direction, {result.seconds:.0f} s" if result.n_paths else "no walks"
    shared.say(f"{told}; written:")
    shared.say_files(files)


def error_table(result: CurveSet) -> Table:
    """Per cent of error by range of r, its bias over all, reflectance and its error, and speed, by direction."""
    errors, m = result.errors(), result.medium
    ranges = dict.fromkeys(zip(errors["r_from_mm"], errors["r_to_mm"]))
    headings = ["series\nerror of S, %", *(f"{low:g}–\n{high:g} mm" for low, high in ranges)]
    headings += ["bias\n(all)", "reflec-\ntance R", "R error\n%", "S per\nsecond"]
    rows = []
    for theta in result.theta_i_deg:
        rows.append([f"θi = {theta:g}°", *[""] * (len(headings) - 1)])
        of_theta = errors[errors["theta_i_deg"] == theta]
        rows += [_row(of_theta[of_theta["series"] == series], series) for series in result.series]
    title = f"{result.title}: " if result.title else ""
    title += f"sigma_t {m.sigma_t:.4g}/mm, albedo {m.albedo:.4g}, g {m.g:.3g}, eta {m.eta:.4g}; "
    title += f"theta_o {result.theta_o_deg:g}°, line at {result.line_deg:g}°"
    caption = "* contains single scattering, which the path-traced curve lacks; its R is compared at total."
    return shared.table(headings, rows, title=title, caption=caption)


def _row(rows: pandas.DataFrame, series: str) -> list[str]:
    """Cells of one series: of the path-traced one, what noise does to each."""
    from halfspace_sss.comparison.curve_set import TRACED

    first, traced = rows.iloc[0], series == TRACED
    digits = "±{:.2g}" if traced else "{:.0f}"
    cells = [digits.format(100 * L1) if L1 == L1 else "–" for L1 in rows["L1"]]
    bias = 100 * first["bias_standard_error" if traced else "bias"]
    R, R_t = first["reflectance"], first["reflectance_traced"]
    spread, error = (100 * v / R_t if R_t > 0 else math.nan for v in (first["reflectance_standard_error"], R - R_t))
    cells += ["–" if bias != bias else f"±{bias:.1g}" if traced else f"{round(bias):+d}", f"{R:.4f}"]
    cells += ["–" if error != error else f"±{spread:.1g}" if traced else f"{error:+.1f}"]
    star = "*" if rows["orders"].iloc[0] == "total" else ""
    return [series + star, *cells, "" if traced else f"{first['evaluations_per_s']:.1e}"]
