"""The command `inversion`: fits of media and textures, and gradients, by this library and by Mitsuba."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated

import typer

from benchmarks.kept_rows import KeptRows
from benchmarks.tables import markdown
from figures.parts.part import Row
from full_geometry.cli.variants import use_mitsuba
from halfspace_sss.checks import check_choice, check_count
from halfspace_sss.cli.shared import Bar, OutFolder, console, whole
from halfspace_sss.provenance import check_folder, write_together

TABLES = ("media", "textures", "gradients")


def inversion_command(
    table: Annotated[
        list[str] | None, typer.Option(help="media, textures or gradients; repeat for more.", show_default="all")
    ] = None,
    only: Annotated[
        list[str] | None,
        typer.Option(help='Parts whose name begins so, as "eta 1.4" or "ball"; repeat for more.', show_default="all"),
    ] = None,
    targets: Annotated[int, typer.Option(help="Media to be found in each case.", parser=whole)] = 1,
    size: Annotated[int, typer.Option(help="Pixels of the square images of media.", parser=whole)] = 24,
    spp: Annotated[
        int, typer.Option(help="Samples a pixel of each render of a step; textures take a quarter.", parser=whole)
    ] = 64,
    target_spp: Annotated[int, typer.Option(help="Samples a pixel of given images of media.", parser=whole)] = 2048,
    steps: Annotated[
        int, typer.Option(help="Steps of `fit` for media; textures take twice as many.", parser=whole)
    ] = 30,
    prb_steps: Annotated[int, typer.Option(help="Steps of `prbvolpath`; 0 leaves it out.", parser=whole)] = 200,
    seed: Annotated[int, typer.Option(help="Seed of random numbers.", parser=whole)] = 0,
    out: OutFolder = Path("inversion"),
) -> None:
    """Measure fits of media beside `prbvolpath`, of textures beside a dipole, and gradients of both.

    Parts that are finished are kept: the same command goes on after them, and tables hold all parts of equal settings.
    """
    chosen = table or list(TABLES)
    for name in chosen:
        check_choice("table", name, TABLES)
    counts = {"size": (size, 4), "spp": (spp, 1), "target-spp": (target_spp, 1), "steps": (steps, 1)}
    counts |= {"prb-steps": (prb_steps, 0), "targets": (targets, 1), "seed": (seed, 0)}
    for key, (value, least) in counts.items():
        check_count(key, value, least)
    check_folder(out)
    use_mitsuba("llvm_ad_rgb")
    import pandas

    from benchmarks import inversion, inversion_gradients, inversion_textures

    how = {"target_spp": target_spp, "steps": steps, "prb_steps": prb_steps, "seed": seed}
    media = {
        f"{case}, target {k}": partial(inversion.medium_rows, case, k, size, spp, **how)
        for case in inversion.CASES
        for k in range(targets)
    }  # fmt: skip
    few = max(spp // 4, 1)
    painted = {
        thing: partial(_painted, inversion_textures.texture_rows, thing, 2 * size, few, 2 * steps, seed)
        for thing in inversion_textures.THINGS
    }
    slopes = {
        case: partial(inversion_gradients.gradient_rows, case, size, spp, seed) for case in inversion_gradients.CASES
    }
    every = {"media": media, "textures": painted, "gradients": slopes}
    how = {"size": size, "spp": spp, "target_spp": target_spp, "steps": steps, "prb_steps": prb_steps, "seed": seed}
    every = {name: {k: f for k, f in every[name].items() if k.startswith(tuple(only or [""]))} for name in chosen}
    if not any(every.values()):
        raise ValueError(f"only must be the beginning of a name as 'eta 1.4' or 'ball', got {', '.join(only)}")
    files = {}
    for name, parts in every.items():
        kept = KeptRows(out / f"{name}.part", how)
        with Bar(name) as bar:
            for part in parts:
                if part not in kept:
                    kept[part] = parts[part](progress=lambda what, k, n, bar=bar: bar.show(k, n, what))
        frame = pandas.DataFrame([row for rows in kept.values() for row in rows])
        files[out / f"{name}.csv"] = frame.to_csv(index=False, lineterminator="\n")
        files[out / f"{name}.md"] = markdown(frame)
        console().print(files[out / f"{name}.md"], highlight=False, markup=False, soft_wrap=True)
    write_together(files)


def _painted(rows: Callable[..., list[Row]], *how: object, progress: Callable) -> list[Row]:
    with TemporaryDirectory() as folder:
        return rows(*how, Path(folder), progress)
