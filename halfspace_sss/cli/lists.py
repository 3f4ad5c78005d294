"""The commands `halfspace-sss materials` and `halfspace-sss models`: what the registries hold."""

from __future__ import annotations

from typing import Annotated

import typer

from halfspace_sss.cli.shared import console

__all__ = ["materials_command", "models_command"]


def materials_command(
    name: Annotated[str | None, typer.Argument(help="A material, to show everything about it.")] = None,
) -> None:
    """List the materials with their coefficients by channel in 1/mm, or show one with the source of its numbers."""
    if name is None:
        _print_materials()
    else:
        _print_material(name)


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
