"""The commands `speeds`, of models in ordinary light, and `gathered`, of errors."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from benchmarks.tables import markdown
from full_geometry.cli.variants import use_mitsuba
from halfspace_sss.checks import check_choice, check_count, check_interval
from halfspace_sss.cli.shared import Bar, OutFolder, console, whole
from halfspace_sss.provenance import check_folder, write_together

__all__ = ["gathered_command", "speeds_command"]

SPEED_OBJECTS = ("bunny of potato", "bunny of marble", "dragon of potato", "candle", "mandarin")


def speeds_command(
    objects: Annotated[
        list[str] | None,
        typer.Option(
            "--object",
            help="bunny, dragon, hand or ribbon of MATERIAL, candle, mandarin, meat or croissant.",
            show_default="five",
        ),
    ] = None,
    model: Annotated[
        list[str] | None,
        typer.Option(
            help="full_geometry, neural_shape, neural or better_dipole; repeat for more.",
            show_default="all",
        ),
    ] = None,
    light: Annotated[
        list[str] | None,
        typer.Option(
            help="windows, lamp and sky, even sky, small light, or sun and sky; repeat for more.",
            show_default="the first two",
        ),
    ] = None,
    kind: Annotated[
        list[str] | None,
        typer.Option(help="sampled or gathered; repeat for more.", show_default="both"),
    ] = None,
    over: Annotated[str, typer.Option(help="Technique of speed 1: volpathmis or translucent_walk.")] = "volpathmis",
    passes: Annotated[int, typer.Option(help="Passes of 16 samples a pixel.", parser=whole)] = 6,
    frames: Annotated[bool, typer.Option(help="Time the next frames of gathered light too.")] = True,
    size: Annotated[int, typer.Option(help="Pixels of the square images.", parser=whole)] = 96,
    seconds: Annotated[float, typer.Option(help="CPU time of each training of full_geometry.")] = 24.0,
    seed: Annotated[int, typer.Option(help="Seed of all renders.", parser=whole)] = 0,
    out: OutFolder = Path("speeds"),
) -> None:
    """Measure the speed of models over volpathmis or walks: sampled and gathered."""
    use_mitsuba("llvm_ad_rgb")
    from benchmarks.speeds import (
        ALL_LIGHTS,
        KINDS,
        LIGHTS,
        MODELS,
        OVER,
        LitObject,
        Measuring,
        speeds,
        tables,
    )

    names, models, lights = tuple(objects or SPEED_OBJECTS), tuple(model or MODELS), tuple(light or LIGHTS)
    kinds = tuple(kind or KINDS)
    for name in models:
        check_choice("model", name, MODELS)
    for name in lights:
        check_choice("light", name, ALL_LIGHTS)
    for name in kinds:
        check_choice("kind", name, KINDS)
    check_choice("over", over, OVER)
    check_count("size", size, 16)
    check_count("passes", passes, 3)
    check_count("seed", seed, 0)
    check_interval("seconds", seconds, 0.1, 1e6)
    cases = [LitObject(name, each) for name in names for each in lights]
    check_folder(out)
    how = Measuring(
        models=models, kinds=kinds, size=size, passes=passes, over=over, frames=frames, seconds=seconds, seed=seed
    )
    with Bar("speeds") as bar:
        table = speeds(cases, how, out / "work", lambda what, k, n: bar.show(k, n, what))
    text = "\n".join(markdown(part) for part in tables(table))
    csv = table.to_csv(index=False, lineterminator="\n")
    write_together({out / "speeds.csv": csv, out / "speeds.md": text})
    console().print(text, highlight=False, markup=False, soft_wrap=True)


def gathered_command(
    objects: Annotated[
        list[str] | None, typer.Option("--object", help="Object, as in `speeds`.", show_default="bunny of potato")
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
        typer.Option(help="As of `speeds`; repeat for more.", show_default="the first two there"),
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
    from benchmarks.speeds import ALL_LIGHTS, LIGHTS, MODELS, LitObject

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
