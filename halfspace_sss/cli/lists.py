"""The commands `halfspace-sss materials` and `halfspace-sss models`: what the registries hold."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from halfspace_sss.cli.shared import check_left_out, console


def materials_command(
    name: Annotated[str | None, typer.Argument(help="A material, to show all of it; or the word `import`.")] = None,
    file: Annotated[Path | None, typer.Argument(help="To import: OpenPBR in .mtlx, or .glb and .gltf.")] = None,
    out: Annotated[Path | None, typer.Option(help="Material file to write.", show_default="FILE.toml, here")] = None,
    mm_per_unit: Annotated[
        float | None, typer.Option(help="Unit of FILE in mm.", show_default="1 in .mtlx, 1000 in glTF")
    ] = None,
) -> None:
    """List materials with coefficients by channel in 1/mm, show one with its sources, or import those of a file."""
    if name == "import":
        _import(file, out, mm_per_unit)
        return
    beside = "unless the word import stands before"
    check_left_out({"file": file, "out": out, "mm_per_unit": mm_per_unit}, beside)
    if name is None:
        _print_materials()
    else:
        _print_material(name)


def _import(file: Path | None, out: Path | None, mm_per_unit: float | None) -> None:
    from halfspace_sss.materials.imports import import_materials, to_toml
    from halfspace_sss.provenance import write_atomically

    if file is None:
        raise ValueError("file must be given to import, got None")
    result, out = import_materials(file, mm_per_unit), out or Path(f"{file.stem}.toml")
    write_atomically(out, to_toml(result))
    for material in result:
        typer.echo(f"{material.name}: {material.medium}")
    typer.echo(f"wrote {out}")


def _print_materials() -> None:
    from rich.table import Table

    from halfspace_sss import materials

    table = Table("material", "set", "channels", "sigma_t [1/mm]", "albedo", "g", "eta", pad_edge=False)
    for (name, group), rows in materials.table().groupby(["material", "set"], sort=False):
        columns = [" ".join(f"{value:.4g}" for value in rows[column]) for column in ("sigma_t", "albedo")]
        g, eta = (_once([f"{value:.3g}" for value in rows[column]]) for column in ("g", "eta"))
        table.add_row(name, group, " ".join(rows["channel"]), *columns, g, eta)
    console().print(table)


def _once(values: list[str]) -> str:
    """The values, or one if they are the same in all channels."""
    return values[0] if len(set(values)) == 1 else " ".join(values)


def _print_material(name: str) -> None:
    from halfspace_sss import materials

    material = materials.load(name)
    lines = [f"{material.name} ({material.set})", f"source: {material.source}"]
    for row in materials.table().query("material == @material.name").to_dict("records"):
        numbers = ("sigma_s", "sigma_a", "sigma_t", "albedo", "g", "eta", "sigma_s_prime", "albedo_prime")
        values = "  ".join(f"{key} {row[key]:.5g}" for key in numbers)
        lines.append(f"{row['channel']}  {values}".strip() + "  (1/mm)")
    lines += [f"{quantity}: {source}" for quantity, source in material.sources.items()]
    lines += [f"assumed: {assumption}" for assumption in material.assumptions]
    lines += [f"note: {material.note}"] if material.note else []
    for line in lines:
        typer.echo(line)


def models_command() -> None:
    """List the models: scattering orders they contain, whether they are reciprocal, and their source."""
    from rich.table import Table

    from halfspace_sss import Medium, bssrdf, models

    table = Table("model", "orders", "reciprocal", "source", pad_edge=False)
    for name in models():
        try:
            model = bssrdf(name, Medium.from_albedo(0.75, 0.241))
        except ValueError as error:
            table.add_row(name, "", "", f"not made for a plain medium: {error}")
            continue
        table.add_row(name, model.orders, "yes" if model.reciprocal else "no", model.source)
    console().print(table)
