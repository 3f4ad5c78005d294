"""The commands `halfspace-sss materials` and `halfspace-sss models`: what the registries hold."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from halfspace_sss.cli.shared import AsJson, OneMaterial, say, table

if TYPE_CHECKING:
    import pandas

    from halfspace_sss.provenance import JsonDict

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
    from halfspace_sss.materials.imports import import_materials, to_toml
    from halfspace_sss.provenance import write_atomically

    result, out = import_materials(file, mm_per_unit), out or Path(f"{file.stem}.toml")
    write_atomically(out, to_toml(result))
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
