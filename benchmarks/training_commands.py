"""The commands `train-universal` and `train-shapes`: new weights of the networks that are in the package."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from full_geometry.cli.variants import use_mitsuba
from halfspace_sss.checks import check_count
from halfspace_sss.cli import shared


def train_universal_command(
    steps: Annotated[
        int | None, typer.Option(help="Steps of the optimiser.", parser=shared.whole, show_default="from the recipe")
    ] = None,
    seed: shared.Seed = 0,
    backend: shared.Backend = "llvm",
    out: shared.OutFolder = Path("universal"),
) -> None:
    """Train the network for all media, in half an hour; a killed run goes on in the same folder."""
    from benchmarks.universal_training import UniversalRecipe, train_universal

    recipe = UniversalRecipe()
    if steps is not None:
        check_count("steps", steps, 1)
        recipe = replace(recipe, how=replace(recipe.how, steps=steps))
    with shared.Bar("universal") as bar:
        path = train_universal(out, seed, recipe, backend=backend, progress=bar.told)
    shared.say(f"written: {path}")


def train_shapes_command(
    mesh: Annotated[
        list[Path] | None, typer.Option(help="Closed PLY file to draw shapes from, too; repeat for more.")
    ] = None,
    seconds: Annotated[float, typer.Option(help="Seconds for data and fit, without compilation.")] = 600.0,
    seed: shared.Seed = 0,
    out: shared.OutFolder = Path("shapes"),
    work: Annotated[
        Path | None, typer.Option(help="Folder for unfinished work, which an interrupted run continues.")
    ] = None,
) -> None:
    """Train the network for all shapes and media on random objects until the time is over."""
    use_mitsuba("llvm_ad_mono")
    from benchmarks.shape_training import train_shapes

    with shared.Bar("shapes") as bar:
        result = train_shapes(out, seconds=seconds, seed=seed, meshes=mesh or [], work=work, progress=bar.told)
    shared.say(f"{result.objects} objects, {result.steps} steps in {result.seconds:.0f} s; written:")
    shared.say_files([result.path])
