"""The commands `halfspace-sss train material` and `train universal`: networks of media, trained on path tracing."""

from __future__ import annotations

from dataclasses import dataclass, replace
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal, TypeVar

import typer

from halfspace_sss.cli import shared

if TYPE_CHECKING:
    from halfspace_sss.neural.training.train_material import MaterialRecipe, TrainedChannel
    from halfspace_sss.neural.training.train_universal import UniversalRecipe
    from halfspace_sss.physics.medium import Medium

Recipe = TypeVar("Recipe", "MaterialRecipe", "UniversalRecipe")
Steps = Annotated[
    int | None, typer.Option(help="Steps of the optimiser.", parser=shared.whole, show_default="from the recipe")
]

Work = Annotated[Path | None, typer.Option(help="Folder for unfinished work, which an interrupted run continues.")]


@dataclass(frozen=True)
class ResultOptions:
    """Where a training leaves weights and what it goes on with, and when they are good enough."""

    target_error: Annotated[
        float | None, typer.Option(help="Stop early once the validation error is below this in 95 % of cases.")
    ] = None
    seed: shared.Seed = 0
    out: Annotated[Path | None, typer.Option(help="Folder for the weights.", show_default="where models find them")] = (
        None
    )
    work: Work = None

    def elsewhere(self) -> ResultOptions:
        """With folders that processes elsewhere find."""
        out, work = (folder and folder.absolute() for folder in (self.out, self.work))
        return replace(self, out=out, work=work)


def need_torch() -> None:
    """ValueError unless it is installed."""
    if find_spec("torch") is None:
        raise ValueError("training needs torch: `pip install halfspace-sss[train]`")


@dataclass(frozen=True)
class RecipeOptions:
    """The model of a medium, and how long it is trained."""

    model: Annotated[Literal["neural_material", "neural_paper"], typer.Option(help="The model that is trained.")] = (
        "neural_material"
    )
    fast: Annotated[bool, typer.Option("--fast", help="A quarter of the time, about twice the error.")] = False
    steps: Steps = None
    backend: shared.Backend = "llvm"


def train_material(
    stated: shared.MediumOptions,
    wanted: RecipeOptions,
    results: ResultOptions,
    places: shared.Places,
    material: shared.Materials = None,
    channel: shared.Channels = None,
) -> None:
    """Train networks of media: one for each channel of the materials, or for the given coefficients."""
    need_torch()
    from halfspace_sss.executors import completed
    from halfspace_sss.neural.training.train_material import FAST, STANDARD

    media = stated.media(material or [], channel)
    recipe = _of_steps(FAST if wanted.fast else STANDARD, wanted.steps)
    rows: dict[str, list[TrainedChannel]] = {}
    with places.executor() as executor, shared.Bar("training") as bar:
        results = results.elsewhere() if executor else results
        how = {"model": wanted.model, "recipe": recipe, "backend": wanted.backend, "seed": results.seed}
        how |= {"target_error": results.target_error, "folder": results.out}
        parts = {name: (name, medium, how, results.work, None if executor else bar) for name, medium in media.items()}
        for name, result in completed(executor, _train, parts):
            rows[name] = result
            if executor:
                bar.show(len(rows), len(parts), name)
    _report([(name, each) for name in parts for each in rows[name]])


def train_universal(
    steps: Steps = None,
    seed: shared.Seed = 0,
    backend: shared.Backend = "llvm",
    out: shared.OutFolder = Path("universal"),
) -> None:
    """Train the network for all media, in half an hour; a killed run goes on in the same folder."""
    need_torch()
    from halfspace_sss.neural.training.train_universal import UniversalRecipe
    from halfspace_sss.neural.training.train_universal import train_universal as trained

    recipe = _of_steps(UniversalRecipe(), steps)
    with shared.Bar("universal") as bar:
        path = trained(out, seed, recipe, backend=backend, progress=bar.told)
    shared.say(f"written: {path}")


def _of_steps(recipe: Recipe, steps: int | None) -> Recipe:
    """A recipe with another number of steps, if one is given."""
    from halfspace_sss.checks import check_count

    if steps is None:
        return recipe
    check_count("steps", steps, 1)
    return replace(recipe, how=replace(recipe.how, steps=steps))


def _train(
    name: str, medium: Medium, how: dict[str, object], work: Path | None, bar: shared.Bar | None
) -> list[TrainedChannel]:
    """Networks of the channels of a medium; on a worker without a bar."""
    from halfspace_sss import neural

    def show(what: str, done: int, total: int) -> None:
        bar.show(done, total, f"{name}: {what}")

    return neural.train(medium, **how, work=work / name if work else None, progress=show if bar else None)


def _report(rows: list[tuple[str, TrainedChannel]]) -> None:
    cells = []
    for name, r in rows:
        ratios = (f"{float(getattr(r.medium, key)):.4g}" for key in ("albedo", "g", "eta"))
        errors = (r.error.known.told(), f"{100 * r.error.noise:.2f}", f"{100 * r.error.bias:+.2f}")
        cells.append((name, *ratios, *errors, f"{r.data_seconds:.0f}", f"{r.fit_seconds:.0f}"))
    headings = ("material", "albedo", "g", "eta", "error %", "noise %", "bias %", "maps s", "fit s")
    caption = "error: energy-weighted relative L1 of unseen maps in blocks of 2 x 2 cells, noise removed; order >= 2"
    shared.say(shared.table(headings, cells, caption=caption))
    shared.say_files(r.path for _, r in rows)
