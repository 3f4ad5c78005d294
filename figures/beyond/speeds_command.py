"""The command `study speeds`: models over Mitsuba's volume path tracer in ordinary light."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from figures.studies.commands import markdown
from halfspace_sss.checks import check_choice, check_count, check_interval
from halfspace_sss.cli.shared import Bar, OutFolder, console, use_mitsuba, whole
from halfspace_sss.provenance import check_folder, write_together

__all__ = ["speeds_command"]

SPEED_OBJECTS = ("bunny of potato", "bunny of marble", "dragon of potato", "candle", "mandarin")


def speeds_command(
    objects: Annotated[
        list[str] | None,
        typer.Option("--object", help="SCAN of MATERIAL, candle or mandarin; repeat for more.", show_default="five"),
    ] = None,
    model: Annotated[
        list[str] | None,
        typer.Option(help="full_geometry, neural or better_dipole; repeat for more.", show_default="all three"),
    ] = None,
    size: Annotated[int, typer.Option(help="Pixels of the square images.", parser=whole)] = 96,
    seconds: Annotated[float, typer.Option(help="CPU time of each training of full_geometry.")] = 24.0,
    seed: Annotated[int, typer.Option(help="Seed of all renders.", parser=whole)] = 0,
    out: OutFolder = Path("speeds"),
) -> None:
    """Measure the speed of models over volpathmis: windows, lamp and sky; sampled, corrected and gathered."""
    chosen, models = tuple(objects or SPEED_OBJECTS), tuple(model or ("full_geometry", "neural", "better_dipole"))
    scans = [f"{scan} of" for scan in ("bunny", "dragon")]
    for name in chosen:
        if name not in ("candle", "mandarin") and not name.startswith(tuple(scans)):
            raise ValueError(f"object must be candle, mandarin or one of {', '.join(scans)} MATERIAL, got {name!r}")
    for name in models:
        check_choice("model", name, ("full_geometry", "neural", "better_dipole"))
    check_count("size", size, 16)
    check_count("seed", seed, 0)
    check_interval("seconds", seconds, 0.1, 1e6)
    check_folder(out)
    use_mitsuba("llvm_ad_rgb")
    from figures.beyond.speeds import speeds, tables

    with Bar("speeds") as bar:
        table = speeds(list(chosen), models, size, seconds, out / "work", seed, lambda what, k, n: bar.show(k, n, what))
    text = "\n".join(markdown(part) for part in tables(table))
    csv = table.to_csv(index=False, lineterminator="\n")
    write_together({out / "speeds.csv": csv, out / "speeds.md": text})
    console().print(text, highlight=False, markup=False, soft_wrap=True)
