"""The command `study inversion`: the tables of docs/inverse.md."""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated

import typer

from figures.studies.commands import markdown
from halfspace_sss.checks import check_choice, check_count
from halfspace_sss.cli.shared import Bar, OutFolder, console, use_mitsuba, whole
from halfspace_sss.provenance import check_folder, write_together

TABLES = ("media", "textures")


def inversion_command(
    table: Annotated[
        list[str] | None, typer.Option(help="media or textures; repeat for both.", show_default="both")
    ] = None,
    size: Annotated[int, typer.Option(help="Pixels of the square images.", parser=whole)] = 24,
    spp: Annotated[
        int, typer.Option(help="Samples a pixel of each render of a step; textures take a quarter.", parser=whole)
    ] = 64,
    steps: Annotated[int, typer.Option(help="Of `fit`, of media; textures take twice as many.", parser=whole)] = 30,
    prb_steps: Annotated[int, typer.Option(help="Of `prbvolpath`.", parser=whole)] = 200,
    seed: Annotated[int, typer.Option(help="Seed of everything.", parser=whole)] = 0,
    out: OutFolder = Path("inversion"),
) -> None:
    """Measure fits of media beside Mitsuba's `prbvolpath`, and the fit of textures of a bunny."""
    chosen = table or list(TABLES)
    for name in chosen:
        check_choice("table", name, TABLES)
    for key, value, least in (("size", size, 4), ("spp", spp, 1), ("steps", steps, 1), ("prb-steps", prb_steps, 1)):
        check_count(key, value, least)
    check_count("seed", seed, 0)
    check_folder(out)
    use_mitsuba("llvm_ad_rgb")
    import pandas

    from figures.beyond import inversion

    files = {}
    for name in chosen:
        with Bar(name) as bar:

            def show(what: str, done: int, total: int, bar: Bar = bar) -> None:
                bar.show(done, total, what)

            if name == "media":
                rows = list(inversion.medium_rows(size, spp, steps, prb_steps, seed, show))
            else:
                with TemporaryDirectory() as folder:
                    few = max(spp // 4, 1)
                    rows = [inversion.texture_row(2 * size, few, 2 * steps, seed, Path(folder), show)]
        frame = pandas.DataFrame(rows)
        files[out / f"{name}.csv"] = frame.to_csv(index=False, lineterminator="\n")
        files[out / f"{name}.md"] = markdown(frame)
        console().print(files[out / f"{name}.md"], highlight=False, markup=False, soft_wrap=True)
    write_together(files)
