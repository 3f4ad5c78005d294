"""The command `shapes`: the network of all shapes on held-out objects, a mesh and spheres."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Annotated

import typer

from full_geometry.cli.variants import use_mitsuba
from halfspace_sss.checks import check_count, check_interval
from halfspace_sss.cli.shared import Bar
from halfspace_sss.provenance import check_folder, write_atomically

MATERIALS = ("marble", "apple", "potato", "ketchup", "regular chocolate milk")  # of Fig. 9
MM_PER_UNIT = 3.8  # the bunny of Fig. 9 is 37 mm tall
VARIANT = "llvm_ad_mono"
SPHERE_NOTE = "albedo 0.95, g = 0, eta = 1.3"


def shapes_command(
    objects: Annotated[int, typer.Option(help="Held-out shapes, each with its medium.")] = 35,
    mesh: Annotated[
        Path | None, typer.Option(help="A closed PLY file: an unseen shape, in the media of Fig. 9.")
    ] = None,
    mm_per_unit: Annotated[float, typer.Option(help="Millimetres in a unit of that file.")] = MM_PER_UNIT,
    work: Annotated[
        Path | None, typer.Option(help="Work folder of `train-shapes`, to fit short ablations on its objects.")
    ] = None,
    seconds: Annotated[float, typer.Option(help="Processor time of each ablation.")] = 60.0,
    pictures: Annotated[Path | None, typer.Option(help="PNG file of the ten worst held-out shapes.")] = None,
    out: Annotated[Path, typer.Option(help="Markdown file: the text between its marks is replaced.")] = Path(
        "shapes.md"
    ),
) -> None:
    """Measure the network of all shapes: held-out objects, a mesh, spheres, speed; tables into a Markdown file."""
    check_count("objects", objects, 1)
    check_interval("mm_per_unit", mm_per_unit, 1e-9, 1e9)
    check_interval("seconds", seconds, 1e-3, 1e7)
    for name, path in (("out", out), ("pictures", pictures)):
        if path is not None:
            check_folder(path.parent)
            if path.is_dir():
                raise ValueError(f"{name} must be a file, got the folder {str(path)!r}")
    if pictures is not None and pictures.suffix.lower() != ".png":
        raise ValueError(f"pictures must end in .png, got {str(pictures)!r}")
    if mesh is not None and not mesh.is_file():
        raise ValueError(f"mesh must be a PLY file, got {str(mesh)!r}, which is none")
    use_mitsuba(VARIANT)
    from benchmarks import shape_errors

    tables: dict[str, str] = {}
    with Bar("shapes") as bar:

        def show(what: str, done: int, total: int) -> None:
            bar.show(done, total, what)

        balls = shape_errors.evaluate(shape_errors.spheres(), len(shape_errors.RADII), progress=show)
        tables[f"Spheres: {SPHERE_NOTE}"] = shape_errors.case_table(balls)
        if mesh is not None:
            bunny = list(shape_errors.of_mesh(mesh, MATERIALS, mm_per_unit))
            tables["speed"] = shape_errors.speed_table(shape_errors.seconds_per_million(bunny[6].object))
            rows = shape_errors.evaluate(iter(bunny), len(bunny), progress=show)
            tables[f"{mesh.stem}"] = shape_errors.summary(rows) + "\n" + shape_errors.case_table(rows)
        rows = shape_errors.evaluate(shape_errors.held_out(objects), objects, progress=show)
        tables["held-out"] = (
            shape_errors.summary(rows) + "\n" + shape_errors.by_property(rows) + "\n" + shape_errors.case_table(rows)
        )
        if pictures is not None:
            from benchmarks.shape_errors import worst_pictures
            from full_geometry.scenes.reference_store import as_png

            write_atomically(pictures, as_png(worst_pictures(rows, show)[..., None]))
        if work is not None:
            from benchmarks.shape_ablation import ablation_table

            tables["ablation"] = ablation_table(work, seconds, show)
    _write(out, tables)
    typer.echo(f"written: {out}")


def _write(out: Path, tables: dict[str, str]) -> None:
    """Replace what stands between the marks of each table; what has no marks is put at the end."""
    text = out.read_text(encoding="utf-8") if out.exists() else ""
    for name, table in tables.items():
        key = name.split(":")[0].lower()
        marks = f"<!-- {key} -->\n", f"<!-- end of {key} -->\n"
        block = f"{marks[0]}{table}{marks[1]}"
        if marks[0] in text:
            text = re.sub(re.escape(marks[0]) + ".*?" + re.escape(marks[1]), lambda _, b=block: b, text, flags=re.S)
        else:
            text += f"\n{block}"
    write_atomically(out, text)
