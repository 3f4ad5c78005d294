"""The command `halfspace-sss curves`: path-traced and modelled curves of a medium, a table of errors, files."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from halfspace_sss.cli.shared import (
    Albedo,
    Backend,
    Bar,
    Eta,
    MeanCosine,
    OutFolder,
    SigmaT,
    console,
    numbers,
    stated_medium,
    whole,
)
from halfspace_sss.comparison.curve_set import TRACED, CurveSet
from halfspace_sss.provenance import check_folder

if TYPE_CHECKING:
    import pandas
    from rich.table import Table


def curves_command(
    material: Annotated[str | None, typer.Argument(help="Name of a material; see `halfspace-sss materials`.")] = None,
    channel: Annotated[str | None, typer.Option(help="Channel, by name or number.", show_default="first")] = None,
    sigma_t: SigmaT = None,
    albedo: Albedo = None,
    g: MeanCosine = None,
    eta: Eta = None,
    theta_i: Annotated[str, typer.Option(help="Angles of incidence, degrees.")] = "0,30,60,75",
    theta_o: Annotated[float, typer.Option(help="Angle of observation, degrees.")] = 0.0,
    delta_phi: Annotated[float, typer.Option(help="Azimuth of observation from forward, degrees.")] = 0.0,
    line: Annotated[float, typer.Option(help="Azimuth of the line from forward, degrees.")] = 90.0,
    r_min: Annotated[float | None, typer.Option(help="Smallest distance, mm.", show_default="from the medium")] = None,
    r_max: Annotated[float | None, typer.Option(help="Largest distance, mm.", show_default="from the medium")] = None,
    model: Annotated[
        list[str] | None, typer.Option(help="A model; repeat for more.", metavar="NAME", show_default="all")
    ] = None,
    orders: Annotated[
        str, typer.Option(help="multiple: reflectance at the orders of each model; total: with single.")
    ] = ("multiple"),
    paths: Annotated[
        int | None,
        typer.Option(help="Walks for each theta_i; 0: models alone.", parser=whole, show_default="from the medium"),
    ] = None,
    seed: Annotated[int, typer.Option(help="Seed of the tracer.", parser=whole)] = 0,
    backend: Backend = "llvm",
    out: OutFolder = Path("curves"),
) -> None:
    """Compare curves of S, path traced and by every model; without arguments the setting of Fig. 10."""
    from halfspace_sss.comparison.reflectance_curves import curves

    check_folder(out)
    given = {"sigma_t": sigma_t, "albedo": albedo, "g": g, "eta": eta}
    medium = stated_medium([] if material is None else [material], given)
    if medium is None:
        medium = "fig10" if material is None else material
    with Bar("tracing") as bar:
        result = curves(
            medium, channel=channel, theta_i_deg=numbers("theta_i", theta_i), theta_o_deg=theta_o,
            delta_phi_deg=delta_phi, line_deg=line, r_min=r_min, r_max=r_max, models=model or None, orders=orders,
            n_paths=paths, seed=seed, backend=backend, progress=bar.show,
        )  # fmt: skip
    _report(result, result.save(out))


def error_table(result: CurveSet) -> Table:
    """Per cent of error by range of r, its bias over all, reflectance and its error, and speed, by direction."""
    from rich.box import SIMPLE_HEAD
    from rich.table import Table

    errors = result.errors()
    ranges = list(dict.fromkeys(zip(errors["r_from_mm"], errors["r_to_mm"])))
    headings = [f"{low:g}–\n{high:g} mm" for low, high in ranges]
    headings += ["bias\n(all)", "reflec-\ntance R", "R error\n%", "S per\nsecond"]
    caption = "* contains single scattering, of which the path-traced curve has none; its R is compared at total."
    table = Table(title=_heading(result), caption=caption, box=SIMPLE_HEAD, pad_edge=False, caption_justify="left")
    table.add_column("series\nerror of S, %", overflow="fold")
    for heading in headings:
        table.add_column(heading, justify="right", overflow="fold")
    for theta in result.theta_i_deg:
        table.add_row(f"[bold]θi = {theta:g}°[/bold]")
        for series in result.series:
            rows = errors[(errors["theta_i_deg"] == theta) & (errors["series"] == series)]
            table.add_row(*_table_row(rows, series), end_section=series == result.series[-1])
    return table


def _heading(result: CurveSet) -> str:
    m = result.medium
    name = f"{result.title}: " if result.title else ""
    medium = f"sigma_t {m.sigma_t:.4g}/mm, albedo {m.albedo:.4g}, g {m.g:.3g}, eta {m.eta:.4g}"
    return f"{name}{medium}; theta_o {result.theta_o_deg:g}°, line at {result.line_deg:g}°"


def _table_row(rows: pandas.DataFrame, series: str) -> list[str]:
    """Cells of one series: of the path-traced one, what noise does to each."""
    first, traced = rows.iloc[0], series == TRACED
    digits = "±{:.2g}" if traced else "{:.0f}"
    cells = [digits.format(100 * L1) if L1 == L1 else "–" for L1 in rows["L1"]]
    bias = 100 * first["bias_standard_error" if traced else "bias"]
    R, R_t = first["reflectance"], first["reflectance_traced"]
    spread, error = (100 * v / R_t if R_t > 0 else math.nan for v in (first["reflectance_standard_error"], R - R_t))
    ends = ["–" if bias != bias else f"±{bias:.1g}" if traced else f"{round(bias):+d}", f"{R:.4f}"]
    ends += ["–" if error != error else f"±{spread:.1g}" if traced else f"{error:+.1f}"]
    star = "*" if "total" == rows["orders"].iloc[0] else ""
    return [series + star, *cells, *ends, "" if traced else f"{first['evaluations_per_s']:.1e}"]


def _report(result: CurveSet, files: list[Path]) -> None:
    screen = console()
    screen.print(error_table(result))
    for note in result.notes:
        screen.print(note, highlight=False, markup=False)
    if not any(file.suffix == ".pdf" for file in files):
        screen.print("no figure: it needs `pip install halfspace-sss[figures]`", highlight=False, markup=False)
    walks = f"{result.n_paths:,} walks for each direction, {result.seconds:.0f} s" if result.n_paths else "no walks"
    screen.print(f"{walks}; written:", highlight=False, markup=False)
    for file in files:
        screen.print(f"  {file}", highlight=False, markup=False, soft_wrap=True)
