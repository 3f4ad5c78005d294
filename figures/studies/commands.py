"""Commands of studies: `rivals`, tables of one object at equal time, and `shapes`, those of docs/neural_shape.md."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from halfspace_sss.checks import check_choice, check_count, check_interval
from halfspace_sss.cli.shared import Bar, Define, ObjectId, OutFolder, Variant, console, defined, use_mitsuba, whole
from halfspace_sss.provenance import check_folder, write_atomically, write_together

if TYPE_CHECKING:
    import pandas


# ---- Tables of samplers, of models and of base models of one object --------------------------------

KEYS = {"errors": ["model"], "base_models": ["base_model", "planned", "seconds", "steps"]}  # of errors of a training
TABLES = ("errors", "samplers", "base_models")


def rivals_command(
    scene: Annotated[Path, typer.Option(help="Mitsuba XML file with the object.")],
    object: ObjectId = None,
    table: Annotated[
        list[str] | None, typer.Option(help="errors, samplers or base_models; repeat for several.", show_default="all")
    ] = None,
    seconds: Annotated[
        float, typer.Option(help="CPU time of each training, data included; of base models of the longest.")
    ] = 60.0,
    samples: Annotated[int, typer.Option(help="Of each exit, for errors and variances.", parser=whole)] = 2048,
    seed: Annotated[int, typer.Option(help="Seed of everything.", parser=whole)] = 0,
    define: Define = None,
    variant: Variant = "llvm_ad_rgb",
    out: OutFolder = Path("rivals"),
) -> None:
    """Compare ways of drawing entries by variance x time, models and base models by errors, by CPU time."""
    chosen = table or list(TABLES)
    for name in chosen:
        check_choice("table", name, TABLES)
    check_interval("seconds", seconds, 0.1, 1e6)
    for key, value, least in (("samples", samples, 2), ("seed", seed, 0)):
        check_count(key, value, least)
    parameters = defined(define)
    check_folder(out)
    use_mitsuba(variant)
    from halfspace_sss.rendering.scenes.scene_files import load_objects

    loaded, files = load_objects(scene, parameters), {}
    for name in chosen:
        with Bar(name) as bar:
            frame = _made(name, loaded, object, seconds, samples, seed, bar)
        files[out / f"{name}.csv"] = frame.to_csv(index=False, lineterminator="\n")
        files[out / f"{name}.md"] = markdown(_errors_wide(frame, KEYS[name]) if name in KEYS else frame)
    write_together(files)
    for path, text in files.items():
        if path.suffix == ".md":
            console().print(text, highlight=False, markup=False, soft_wrap=True)
        console().print(f"  {path}", highlight=False, markup=False, soft_wrap=True)


def _made(
    table: str, scene: Any, name: str | None, seconds: float, samples: int, seed: int, bar: Bar
) -> pandas.DataFrame:
    from tempfile import TemporaryDirectory

    from figures.studies import rivals
    from figures.studies.flow_training import FlowRecipe
    from figures.studies.rivals import sampler_table
    from full_geometry.learning.training import train_by_cpu
    from halfspace_sss.rendering.object.objects import object_of

    def show(what: str, done: int, total: int) -> None:
        bar.show(done, total, what)

    if table in KEYS:
        make = {"errors": rivals.error_table, "base_models": rivals.base_model_table}[table]
        return make(scene, name, seconds=seconds, walks=samples, samples=samples, seed=seed, progress=show)
    with TemporaryDirectory() as folder:
        learnt, _ = train_by_cpu(object_of(scene, None, None, name), seconds, folder, seed=seed)
    return sampler_table(learnt, FlowRecipe(seconds=0.5 * seconds), samples=samples, seed=seed, progress=show)


def _errors_wide(table: pandas.DataFrame, keys: list[str]) -> pandas.DataFrame:
    """A row for each training, told by the columns `keys`; a column for each channel and light: error ± its own, %."""
    texts = table.assign(
        what=[f"{light}, channel {channel}" for light, channel in zip(table["light"], table["channel"])],
        text=[f"{100 * a:.2g} ± {100 * b:.1g}" for a, b in zip(table["error"], table["standard_error"])],
    )
    wide = texts.pivot(index=keys, columns="what", values="text")
    rows = table[keys].drop_duplicates().set_index(keys).index
    return wide.loc[rows, list(dict.fromkeys(texts["what"]))].reset_index()


def markdown(table: pandas.DataFrame) -> str:
    """The table for a page."""
    rows = [[f"{v:.3g}" if isinstance(v, float) else str(v) for v in row] for row in table.itertuples(index=False)]
    kinds = ["---:" if table[key].dtype.kind == "f" else "---" for key in table]
    lines = [list(map(str, table.columns)), kinds, *rows]
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)


# ---- The network of all shapes on held-out objects, a mesh and spheres -----------------------------

MATERIALS = ("marble", "apple", "potato", "ketchup", "regular chocolate milk")  # of Fig. 9
MM_PER_UNIT = 3.8  # the bunny of Fig. 9 is 37 mm tall
VARIANT = "llvm_ad_mono"
SPHERE_NOTE = "albedo 0.95, g = 0, eta = 1.3"


def shapes_command(
    objects: Annotated[int, typer.Option(help="Held-out shapes, each with its medium.")] = 35,
    mesh: Annotated[
        Path | None, typer.Option(help="A closed PLY file: an unseen shape, in the media of Fig. 9.")
    ] = None,
    mm_per_unit: Annotated[float, typer.Option(help="Of that file.")] = MM_PER_UNIT,
    work: Annotated[
        Path | None, typer.Option(help="Work of `train shapes`: fit short ablations on its objects.")
    ] = None,
    seconds: Annotated[float, typer.Option(help="Processor time of each ablation.")] = 60.0,
    pictures: Annotated[Path | None, typer.Option(help="PNG file of the ten worst held-out shapes.")] = None,
    out: Annotated[Path, typer.Option(help="Markdown file: the text between its marks is replaced.")] = Path(
        "neural_shape.md"
    ),
) -> None:
    """Measure the network of all shapes: held-out objects, a mesh, spheres, speed; tables into a Markdown file."""
    from halfspace_sss.cli.shared import Bar, use_mitsuba

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
    from figures.studies import shape_errors

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
            from figures.studies.shape_errors import worst_pictures
            from halfspace_sss.rendering.scenes.picture import as_png

            write_atomically(pictures, as_png(worst_pictures(rows, show)[..., None]))
        if work is not None:
            from figures.studies.shape_ablation import ablation_table

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
