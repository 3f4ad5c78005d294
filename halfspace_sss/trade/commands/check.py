"""The command `halfspace-sss study trade-check`: recommendations for random scenes, held against long runs."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from halfspace_sss.checks import check_count, check_interval
from halfspace_sss.cli.shared import Bar, Variant, console, use_mitsuba, whole
from halfspace_sss.provenance import check_folder


def check_command(
    scenes: Annotated[int, typer.Option(help="How many.", parser=whole)] = 60,
    first: Annotated[int, typer.Option(help="Number of the first one.", parser=whole)] = 0,
    seed: Annotated[int, typer.Option(help="Other seeds draw other scenes.", parser=whole)] = 0,
    tolerance: Annotated[float | None, typer.Option(help="Of all scenes; drawn for each if not given.")] = None,
    assess: Annotated[float, typer.Option(help="Seconds of measuring for a recommendation.")] = 4.0,
    truth: Annotated[float, typer.Option(help="Most seconds of the long runs, with seeds of their own.")] = 24.0,
    write_only: Annotated[bool, typer.Option("--write-only", help="Write the scenes, measure nothing.")] = False,
    variant: Variant = "llvm_ad_rgb",
    out: Annotated[Path, typer.Option(help="Folder; scenes that were measured there are not measured again.")] = Path(
        "trade-check"
    ),
) -> None:
    """Draw scenes (shape x medium x light x size x tolerance) and see whether recommendations keep what they say."""
    check_count("scenes", scenes, 1)
    check_count("first", first, 0)
    check_count("seed", seed, 0)
    if tolerance is not None:
        check_interval("tolerance", tolerance, 1e-4, 10.0)
    check_interval("assess", assess, 0.05, 1e5)
    check_interval("truth", truth, 0.05, 1e6)
    check_folder(out)
    numbers = range(first, first + scenes)
    from halfspace_sss.trade.checking.random_scenes import random_scene, write_scene

    if write_only:
        for k in numbers:
            console().print(f"  {write_scene(random_scene(k, seed, tolerance), out)}", highlight=False, soft_wrap=True)
        return
    use_mitsuba(variant)
    from halfspace_sss.provenance import provenance, write_together
    from halfspace_sss.trade.checking.check import check_scene
    from halfspace_sss.trade.checking.summary import markdown, outcomes, summary

    records = []
    with Bar("scenes") as bar:
        for k in numbers:
            records.append(check_scene(random_scene(k, seed, tolerance), out, assess, truth))
            bar.show(len(records), scenes, f"scene {k}")
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
