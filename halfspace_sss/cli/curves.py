"""The commands `materials` and `models`, what the registries hold; and `curves` of a medium, with a table of errors."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from halfspace_sss.cli import shared
from halfspace_sss.cli.shared import AsJson, OneMaterial, say, table
from halfspace_sss.provenance import JsonDict, check_folder

if TYPE_CHECKING:
    import pandas
    from rich.table import Table

    from halfspace_sss.comparison.curve_set import CurveSet

NUMBERS = ("sigma_s", "sigma_a", "sigma_t", "albedo", "g", "eta", "sigma_s_prime", "albedo_prime")


def _say_json(value: JsonDict | list[JsonDict]) -> None:
    say(json.dumps(value, indent=1, ensure_ascii=False))


def _records(frame: pandas.DataFrame) -> list[JsonDict]:
    return json.loads(frame.to_json(orient="records"))


def materials_list(as_json: AsJson = False) -> None:
    """List materials with coefficients by channel in 1/mm."""
    from halfspace_sss import materials

    if as_json:
        _say_json(_records(materials.table()))
        return
    rows = []
    for (name, group), of in materials.table().groupby(["material", "set"], sort=False):
        columns = [" ".join(f"{value:.4g}" for value in of[column]) for column in ("sigma_t", "albedo")]
        columns += [" ".join(_once([f"{value:.3g}" for value in of[column]])) for column in ("g", "eta")]
        rows.append([name, group, " ".join(of["channel"]), *columns])
    say(table(["material", "set", "channels", "sigma_t [1/mm]", "albedo", "g", "eta"], rows, left=7))


def _once(values: list[str]) -> list[str]:
    """The values, or one if they are the same in all channels."""
    return values[:1] if len(set(values)) == 1 else values


def materials_show(name: OneMaterial, as_json: AsJson = False) -> None:
    """Show a material with its sources."""
    from halfspace_sss import materials

    material = materials.load(name)
    rows = materials.table().query("material == @material.name")
    about = {"name": material.name, "set": material.set, "source": material.source, "note": material.note}
    about |= {"sources": dict(material.sources), "assumptions": list(material.assumptions)}
    if as_json:
        _say_json({**about, "channels": _records(rows)})
        return
    say(f"{material.name} ({material.set})", f"source: {material.source}")
    for row in rows.to_dict("records"):
        values = "  ".join(f"{key} {row[key]:.5g}" for key in NUMBERS)
        say(f"{row['channel']}  {values}".strip() + "  (1/mm)")
    say(*(f"{quantity}: {source}" for quantity, source in material.sources.items()))
    say(*(f"assumed: {assumption}" for assumption in material.assumptions))
    say(*([f"note: {material.note}"] if material.note else []))


def materials_import(
    file: Annotated[Path, typer.Argument(help="OpenPBR in .mtlx, or .glb and .gltf.")],
    out: Annotated[Path | None, typer.Option(help="Material file to write.", show_default="FILE.toml, here")] = None,
    mm_per_unit: Annotated[
        float | None, typer.Option(help="Unit of FILE in mm.", show_default="1 in .mtlx, 1000 in glTF")
    ] = None,
) -> None:
    """Import the materials of a file of another program into a material file."""
    from halfspace_sss.materials.catalogue import write
    from halfspace_sss.materials.imports import import_materials

    result, out = import_materials(file, mm_per_unit), out or Path(f"{file.stem}.toml")
    write(out, *result)
    say(*(f"{material.name}: {material.medium}" for material in result), f"wrote {out}")


def models(as_json: AsJson = False) -> None:
    """List the models: scattering orders they contain, whether they are reciprocal, and their source."""
    from halfspace_sss import Medium, bssrdf
    from halfspace_sss import models as names

    rows = []
    for name in names():
        try:
            model = bssrdf(name, Medium.from_albedo(0.75, 0.241))
        except ValueError as error:
            rows.append({"model": name, "source": f"not made for a plain medium: {error}"})
        else:
            about = {"model": name, "orders": model.orders, "reciprocal": model.reciprocal}
            rows.append(about | {"source": model.source})
    if as_json:
        _say_json(rows)
        return
    told = {True: "yes", False: "no", None: ""}
    cells = [[r["model"], r.get("orders", ""), told[r.get("reciprocal")], r["source"]] for r in rows]
    say(table(["model", "orders", "reciprocal", "source"], cells, left=4))


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
