"""The command `trade-check`: recommendations for random scenes, held against long runs."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from full_geometry.cli.variants import Variant, use_mitsuba
from halfspace_sss.checks import check_count, check_interval
from halfspace_sss.cli.shared import Bar, Places, console, whole
from halfspace_sss.provenance import JsonDict, check_folder

if TYPE_CHECKING:
    from benchmarks.random_scenes import RandomScene


def check_command(
    places: Places,
    scenes: Annotated[int, typer.Option(help="Number of scenes.", parser=whole)] = 60,
    first: Annotated[int, typer.Option(help="Number of the first scene.", parser=whole)] = 0,
    seed: Annotated[int, typer.Option(help="Other seeds draw other scenes.", parser=whole)] = 0,
    tolerance: Annotated[float | None, typer.Option(help="Tolerance of all scenes; by default drawn for each.")] = None,
    assess: Annotated[float, typer.Option(help="Seconds of measuring for a recommendation.")] = 4.0,
    truth: Annotated[float, typer.Option(help="Seconds of a long run for each denoised way.")] = 24.0,
    write_only: Annotated[bool, typer.Option("--write-only", help="Write the scenes, measure nothing.")] = False,
    variant: Variant = "llvm_ad_rgb",
    out: Annotated[Path, typer.Option(help="Folder; scenes that were measured there are not measured again.")] = Path(
        "trade-check"
    ),
) -> None:
    """Draw scenes (shape x medium x light x size x tolerance) and check recommendations against long runs."""
    check_count("scenes", scenes, 1)
    check_count("first", first, 0)
    check_count("seed", seed, 0)
    if tolerance is not None:
        check_interval("tolerance", tolerance, 1e-4, 10.0)
    check_interval("assess", assess, 0.05, 1e5)
    check_interval("truth", truth, 0.05, 1e6)
    check_folder(out)
    numbers = range(first, first + scenes)
    from benchmarks.random_scenes import random_scene, write_scene

    if write_only:
        for k in numbers:
            console().print(f"  {write_scene(random_scene(k, seed, tolerance), out)}", highlight=False, soft_wrap=True)
        return
    use_mitsuba(variant)
    from benchmarks.trade_summary import markdown, outcomes, summary
    from halfspace_sss.executors import completed
    from halfspace_sss.provenance import provenance, write_together

    parts = {f"scene {k}": (random_scene(k, seed, tolerance), out.absolute(), assess, truth, variant) for k in numbers}
    done: dict[str, JsonDict] = {}
    with places.executor() as executor, Bar("scenes") as bar:
        for name, record in completed(executor, _record, parts):
            done[name] = record
            bar.show(len(done), scenes, name)
    records = [done[name] for name in parts]
    table, result = outcomes(records), summary(records)
    how = {"scenes": scenes, "first": first, "seed": seed, "tolerance": tolerance, "assess": assess, "truth": truth}
    text = markdown(result, table, how)
    about = {"provenance": provenance(**how), **result}
    write_together(
        {
            out / "check.csv": table.to_csv(index=False, lineterminator="\n"),
            out / "check.json": json.dumps(about, indent=1) + "\n",
            out / "check.md": text,
        }
    )
    console().print(text, highlight=False, markup=False, soft_wrap=True)


def _record(scene: RandomScene, out: Path, assess: float, truth: float, variant: str) -> JsonDict:
    """The record of a scene; a worker takes the variant with its first one."""
    import mitsuba as mi

    from benchmarks.trade_check import check_scene

    if mi.variant() != variant:
        use_mitsuba(variant)
    return check_scene(scene, out, assess, truth)
