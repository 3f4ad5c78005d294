"""The command `gathered`: errors of gathered light."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from benchmarks.tables import markdown
from full_geometry.cli.variants import use_mitsuba
from halfspace_sss.checks import check_choice, check_count, check_interval
from halfspace_sss.cli.shared import Bar, OutFolder, console, whole
from halfspace_sss.provenance import check_folder, write_together


def gathered_command(
    objects: Annotated[
        list[str] | None,
        typer.Option(
            "--object",
            help="bunny, dragon, hand or ribbon of MATERIAL, candle, mandarin, meat or croissant.",
            show_default="bunny of potato",
        ),
    ] = None,
    model: Annotated[
        list[str] | None,
        typer.Option(
            help="full_geometry, neural_shape, neural or better_dipole; repeat for more.",
            show_default="full_geometry and better_dipole",
        ),
    ] = None,
    light: Annotated[
        list[str] | None,
        typer.Option(
            help="windows, lamp and sky, even sky, small light, or sun and sky; repeat for more.",
            show_default="the first two",
        ),
    ] = None,
    samples: Annotated[
        int,
        typer.Option(help="Samples a pixel of sampled light and walks; gathered light takes an eighth.", parser=whole),
    ] = 2048,
    size: Annotated[int, typer.Option(help="Pixels of the square images.", parser=whole)] = 64,
    seconds: Annotated[float, typer.Option(help="CPU time of each training of full_geometry.")] = 24.0,
    seed: Annotated[int, typer.Option(help="Seed of all renders.", parser=whole)] = 0,
    out: OutFolder = Path("gathered"),
) -> None:
    """Measure the error that gathered light adds to models, and the errors of both against walks, all orders."""
    use_mitsuba("llvm_ad_rgb")
    from benchmarks.gathered_error import Comparing, gathered_errors, shown
    from benchmarks.lit_objects import ALL_LIGHTS, LIGHTS, MODELS, LitObject

    models, lights = tuple(model or ("full_geometry", "better_dipole")), tuple(light or LIGHTS)
    for name in models:
        check_choice("model", name, MODELS)
    for name in lights:
        check_choice("light", name, ALL_LIGHTS)
    cases = [LitObject(name, each) for name in objects or ("bunny of potato",) for each in lights]
    check_count("samples", samples, 16)
    check_count("size", size, 16)
    check_count("seed", seed, 0)
    check_interval("seconds", seconds, 0.1, 1e6)
    check_folder(out)
    how = Comparing(models, samples, size=size, seconds=seconds, seed=seed)
    with Bar("gathered") as bar:
        table = gathered_errors(cases, how, out / "work", lambda what, k, n: bar.show(k, n, what))
    text = markdown(shown(table))
    write_together({out / "gathered.csv": table.to_csv(index=False, lineterminator="\n"), out / "gathered.md": text})
    console().print(text, highlight=False, markup=False, soft_wrap=True)
