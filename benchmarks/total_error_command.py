"""The command `total-error`: what images are off after so many seconds."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from benchmarks.tables import markdown
from full_geometry.cli.variants import use_mitsuba
from halfspace_sss.checks import check_choice, check_count, check_interval
from halfspace_sss.cli.shared import Bar, OutFolder, console, whole
from halfspace_sss.provenance import check_folder, write_together

if TYPE_CHECKING:
    from benchmarks.lit_objects import LitObject

__all__ = ["time_to_error_command", "total_error_command"]

OBJECTS, LIGHTS = ("hand of potato", "ribbon of cream", "bunny of skin1"), ("windows", "lamp and sky")
Size = Annotated[int, typer.Option(help="Pixels of the square images.", parser=whole)]
RenderSeed = Annotated[int, typer.Option(help="Seed of all renders.", parser=whole)]


@dataclass(frozen=True)
class LitOptions:
    """Which objects, each in which lights."""

    objects: Annotated[
        list[str] | None,
        typer.Option("--object", help="As of `gathered`; repeat for more.", show_default="of the study"),
    ] = None
    light: Annotated[
        list[str] | None, typer.Option(help="As of `gathered`; repeat for more.", show_default="of the study")
    ] = None

    def cases(self, objects: Sequence[str], lights: Sequence[str]) -> list[LitObject]:
        """Each object in each light, of those where none is named; ValueError if there is no such one."""
        from benchmarks.lit_objects import ALL_LIGHTS, LitObject

        lights = tuple(self.light or lights)
        for name in lights:
            check_choice("light", name, ALL_LIGHTS)
        return [LitObject(name, each) for name in self.objects or objects for each in lights]


def total_error_command(
    shown: LitOptions,
    seconds: Annotated[
        list[float] | None, typer.Option(help="CPU seconds of an image; repeat for more.", show_default="5, 20, 80")
    ] = None,
    reference: Annotated[float, typer.Option(help="CPU seconds of the reference.")] = 600.0,
    size: Size = 128,
    seed: RenderSeed = 0,
    way: Annotated[list[str] | None, typer.Option(help="A way; repeat for more.", show_default="all")] = None,
    truth: Annotated[Literal["sampled", "precomputed"], typer.Option(help="Light of the reference.")] = "sampled",
    out: OutFolder = Path("total_error"),
) -> None:
    """Measure total error over seconds of path tracing, raw and denoised, over long walks: all orders."""
    use_mitsuba("llvm_ad_rgb")
    from benchmarks.total_error import PRECOMPUTED, SAMPLED, WAYS, TotalErrors, total_errors
    from benchmarks.total_error_plot import draw
    from halfspace_sss.comparison.style import saved

    times, cases = tuple(sorted(seconds or TotalErrors.seconds)), shown.cases(OBJECTS, LIGHTS)
    for value in (*times, reference):
        check_interval("seconds", value, 0.1, 1e6)
    check_count("size", size, 16)
    check_count("seed", seed, 0)
    for name in way or ():
        check_choice("way", name, WAYS)
    check_folder(out)
    with Bar("total error") as bar:
        ways, light = tuple(way or WAYS), {"sampled": SAMPLED, "precomputed": PRECOMPUTED}[truth]
        how = TotalErrors(times, reference, size, seed, ways, light)
        for measured in total_errors(cases, how, out / "work", lambda what, k, n: bar.show(k, n, what)):
            text, csv = markdown(measured.table.round(3)), measured.table.to_csv(index=False, lineterminator="\n")
            write_together({out / "total_error.csv": csv, out / "total_error.md": text})
    drawn = saved(draw(measured))
    write_together({out / "total_error.pdf": drawn["pdf"], out / "total_error.png": drawn["png"]})
    console().print(text, highlight=False, markup=False, soft_wrap=True)


TIMED = ("bunny of skin1", "dragon of marble", "hand of potato", "ribbon of ketchup", "pawn of wholemilk")
TIMED_LIGHTS = ("windows", "lamp and sky", "sun and sky", "small light")


def time_to_error_command(
    shown: LitOptions,
    pixels: Annotated[float, typer.Option(help="Relative error of pixels to reach.")] = 0.04,
    blocks: Annotated[float, typer.Option(help="Relative error of means over 8 x 8 pixels to reach.")] = 0.015,
    most: Annotated[float, typer.Option(help="CPU seconds after which walks are given up.")] = 60.0,
    volume: Annotated[float, typer.Option(help="The same of volpathmis.")] = 12.0,
    size: Size = 512,
    seed: RenderSeed = 0,
    out: OutFolder = Path("time_to_error"),
) -> None:
    """Measure CPU seconds to a total error of denoised path tracing, of walks and of volpathmis: all orders."""
    use_mitsuba("llvm_ad_rgb")
    from benchmarks.time_to_error import ErrorsWanted, times_to_error

    cases = shown.cases(TIMED, TIMED_LIGHTS)
    for name, value in (("pixels", pixels), ("blocks", blocks)):
        check_interval(name, value, 1e-4, 1.0)
    for name, value in (("most", most), ("volume", volume)):
        check_interval(name, value, 0.1, 1e6)
    check_count("size", size, 16)
    check_count("seed", seed, 0)
    check_folder(out)
    with Bar("time to error") as bar:
        how = ErrorsWanted(pixels, blocks, most, volume, size, seed)
        for table in times_to_error(cases, how, out / "work", lambda what, k, n: bar.show(k, n, what)):
            text, csv = markdown(table.round(3)), table.to_csv(index=False, lineterminator="\n")
            write_together({out / "time_to_error.csv": csv, out / "time_to_error.md": text})
    console().print(text, highlight=False, markup=False, soft_wrap=True)
