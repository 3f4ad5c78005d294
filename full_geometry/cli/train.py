"""The commands `halfspace-sss train`: networks of materials, for all media, for all shapes, of an object of a scene."""

from __future__ import annotations

from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from full_geometry.cli.variants import Variant, use_mitsuba
from halfspace_sss.checks import check_count
from halfspace_sss.cli.shared import (
    Albedo,
    Bar,
    Channels,
    Define,
    Eta,
    Materials,
    MeanCosine,
    OutFolder,
    Scheduler,
    SigmaT,
    Workers,
    by_channel,
    check_channel,
    console,
    defined,
    executor_of,
    stated_medium,
    whole,
    with_quiet,
)

if TYPE_CHECKING:
    from full_geometry.scenes.learners import LearntObject
    from halfspace_sss.physics.medium import Medium

HELP = "Train networks on path tracing: models find them by the medium, and by the shape of an object."

Seconds = Annotated[float, typer.Option(help="Time for data and fit, without compiling.")]
TargetError = Annotated[
    float | None, typer.Option(help="Stop early once the validation error is below this in 95 % of cases.")
]
Steps = Annotated[
    int | None, typer.Option(help="Steps of the optimiser.", parser=whole, show_default="from the recipe")
]
TrainingSeed = Annotated[int, typer.Option(help="Seed of data, batches and first numbers.", parser=whole)]
MapsBackend = Annotated[str, typer.Option(help="llvm or cuda, for the maps.")]
Objects = Annotated[
    list[str] | None,
    typer.Option(help="Its id in the scene; repeat for more.", show_default="the only translucent one"),
]
WeightsFolder = Annotated[
    Path | None, typer.Option(help="Folder for the weights.", show_default="where models find them")
]
Work = Annotated[Path | None, typer.Option(help="Folder for unfinished work, which an interrupted run continues.")]


def trainings() -> typer.Typer:
    """The command `train` with what it trains as commands of its own."""
    app = typer.Typer(no_args_is_help=True, help=HELP)
    for name, function in (
        ("material", material_command), ("object", object_command), ("shapes", shapes_command),
        ("universal", universal_command),
    ):  # fmt: skip
        app.command(name)(with_quiet(function))
    return app


def _need_torch() -> None:
    if find_spec("torch") is None:
        raise ValueError("training needs torch: `pip install halfspace-sss[train]`")


def material_command(
    material: Materials = None,
    channel: Channels = None,
    model: Annotated[str, typer.Option(help="neural_material or neural_paper.")] = "neural_material",
    sigma_t: SigmaT = None,
    albedo: Albedo = None,
    g: MeanCosine = None,
    eta: Eta = None,
    fast: Annotated[bool, typer.Option("--fast", help="A quarter of the time, about twice the error.")] = False,
    steps: Steps = None,
    target_error: TargetError = None,
    seed: TrainingSeed = 0,
    backend: MapsBackend = "llvm",
    workers: Workers = None,
    scheduler: Scheduler = None,
    out: WeightsFolder = None,
    work: Work = None,
) -> None:
    """Train the network of a medium, for each channel of materials or of the coefficients that are given."""
    _need_torch()
    from halfspace_sss.executors import completed

    media = _media(material or [], channel, {"sigma_t": sigma_t, "albedo": albedo, "g": g, "eta": eta})
    from halfspace_sss.neural.training.train_material import FAST, STANDARD

    recipe = _of_steps(FAST if fast else STANDARD, steps)
    how = {"model": model, "recipe": recipe, "seed": seed, "target_error": target_error, "backend": backend}
    rows: dict[str, list[Any]] = {}
    with executor_of(workers, scheduler) as executor, Bar("training") as bar:
        if executor:  # whose processes may run elsewhere
            out, work = (folder and folder.absolute() for folder in (out, work))
        how["folder"] = out
        parts = {name: (name, medium, how, work, None if executor else bar) for name, medium in media.items()}
        for name, result in completed(executor, _train, parts):
            rows[name] = result
            if executor:
                bar.show(len(rows), len(parts), name)
    _report([(name, each) for name in parts for each in rows[name]])


def object_command(
    scene: Annotated[Path, typer.Option(help="Mitsuba XML file with the object.")],
    object: Objects = None,
    seconds: Seconds = 60.0,
    model: Annotated[
        str | None, typer.Option(help="Name of a model that learns objects.", show_default="full_geometry")
    ] = None,
    target_error: TargetError = None,
    base_model: Annotated[
        str | None,
        typer.Option(
            help="neural_shape or a half-space model, which the network corrects.", show_default="better_dipole"
        ),
    ] = None,
    seed: TrainingSeed = 0,
    define: Define = None,
    variant: Variant = "llvm_ad_rgb",
    workers: Workers = None,
    scheduler: Scheduler = None,
    out: WeightsFolder = None,
    work: Work = None,
) -> None:
    """Train the networks of objects of a scene, which `render` then knows, and say how wrong they are."""
    _need_torch()
    parameters = defined(define)
    use_mitsuba(variant)
    from full_geometry.objects.objects import object_of
    from full_geometry.scenes.learners import learner
    from full_geometry.scenes.scene_files import load_objects
    from halfspace_sss.executors import completed

    learner(model)
    if object and len(object) > 1:  # all are looked for before one is trained
        loaded = load_objects(scene, parameters)
        for name in object:
            object_of(loaded, None, None, name)
    how = {"seconds": seconds, "target_error": target_error, "seed": seed}
    how |= {"base_model": base_model} if base_model is not None else {}
    with executor_of(workers, scheduler) as executor, Bar("training") as bar:
        if executor:  # whose processes may run elsewhere
            scene, out, work = (path and path.absolute() for path in (scene, out, work))
        how["folder"] = out
        of, parts = (scene, parameters, variant, model), {}
        for name in dict.fromkeys(object or (None,)):
            own = work / name if work and len(object or ()) > 1 else work
            parts[name or "object"] = (of, {**how, "object": name, "work": own}, None if executor else bar)
        learnt = {}
        for name, result in completed(executor, _train_object, parts):
            learnt[name] = result
            if executor:
                bar.show(len(learnt), len(parts), name)
    for name in parts:
        _report_object(learnt[name])


def _train_object(
    of: tuple[Path, dict[str, str], str, str | None], how: dict[str, Any], bar: Bar | None
) -> LearntObject:
    """The network of an object of a scene file, by its parameters, variant and learner; on a worker without a bar."""
    scene, parameters, variant, model = of
    use_mitsuba(variant)
    from full_geometry.scenes.learners import learner
    from full_geometry.scenes.scene_files import load_objects

    def show(what: str, done: int, total: int) -> None:
        bar.show(done, total, what)

    return learner(model).train(load_objects(scene, parameters), **how, progress=show if bar else None)


def universal_command(
    steps: Steps = None,
    seed: TrainingSeed = 0,
    backend: MapsBackend = "llvm",
    out: OutFolder = Path("universal"),
) -> None:
    """Train the network for all media, in half an hour; the folder also holds what a killed run goes on with."""
    _need_torch()
    from halfspace_sss.neural.training.train_universal import UniversalRecipe, train_universal

    recipe = _of_steps(UniversalRecipe(), steps)
    with Bar("universal") as bar:
        path = train_universal(
            out, seed, recipe, backend=backend, progress=lambda what, done, total: bar.show(done, total, what)
        )
    console().print(f"written: {path}", highlight=False, markup=False, soft_wrap=True)


def shapes_command(
    mesh: Annotated[
        list[Path] | None, typer.Option(help="A closed PLY file among the shapes; repeat for more.")
    ] = None,
    seconds: Seconds = 600.0,
    seed: TrainingSeed = 0,
    out: OutFolder = Path("shapes"),
    work: Work = None,
) -> None:
    """Train the network for all shapes and media, on objects that are drawn without end."""
    _need_torch()
    if find_spec("igl") is None:
        raise ValueError("training on shapes needs libigl: `pip install halfspace-sss[train]`")
    use_mitsuba("llvm_ad_mono")
    from full_geometry.scenes.learners import shape_learner

    with Bar("shapes") as bar:
        result = shape_learner().train_shapes(
            out, seconds=seconds, seed=seed, meshes=mesh or [], work=work,
            progress=lambda what, done, total: bar.show(done, total, what),
        )  # fmt: skip
    screen = console()
    told = f"{result.objects} objects, {result.steps} steps in {result.seconds:.0f} s; written:"
    screen.print(told, f"  {result.path}", highlight=False, markup=False, soft_wrap=True, sep="\n")


def _media(names: list[str], channel: str | None, given: dict[str, float | None]) -> dict[str, Medium]:
    from halfspace_sss import materials

    check_channel(channel, names)
    if channel is not None:
        return dict(by_channel(names, channel))
    stated = stated_medium(names, given)
    if not names:
        return {"fig10": materials.load("fig10").medium} if stated is None else {"medium": stated}
    return {each.name: each.medium for each in map(materials.load, names)}


def _of_steps(recipe: Any, steps: int | None) -> Any:
    """A recipe with another number of steps, if one is given."""
    if steps is None:
        return recipe
    check_count("steps", steps, 1)
    return replace(recipe, how=replace(recipe.how, steps=steps))


def _train(name: str, medium: Medium, how: dict[str, Any], work: Path | None, bar: Bar | None) -> list[Any]:
    """Networks of the channels of a medium; on a worker without a bar."""
    from halfspace_sss.neural import train

    def show(what: str, done: int, total: int) -> None:
        bar.show(done, total, f"{name}: {what}")

    return train(medium, **how, work=work / name if work else None, progress=show if bar else None)


def _report_object(learnt: LearntObject) -> None:
    from full_geometry.cli.errors import OBJECT_DEFINITION, object_table

    screen = console()
    if learnt.path is None:
        screen.print(f"{learnt.object}: no weights are written", highlight=False, markup=False)
        return
    screen.print(object_table(learnt.errors), OBJECT_DEFINITION, highlight=False, sep="\n")
    told = f"{learnt.steps} steps in {learnt.seconds:.0f} s; written:"
    screen.print(told, f"  {learnt.path}", highlight=False, markup=False, soft_wrap=True, sep="\n")


def _report(rows: list[tuple[str, Any]]) -> None:
    from rich.box import SIMPLE_HEAD
    from rich.table import Table

    caption = "error: energy-weighted relative L1 of unseen maps in blocks of 2 x 2 cells, noise removed; order >= 2"
    table = Table(box=SIMPLE_HEAD, pad_edge=False, caption=caption, caption_justify="left")
    for heading in ("material", "albedo", "g", "eta", "error %", "noise %", "bias %", "maps s", "fit s"):
        table.add_column(heading, justify="left" if heading == "material" else "right")
    for name, r in rows:
        ratios = (f"{float(getattr(r.medium, key)):.4g}" for key in ("albedo", "g", "eta"))
        errors = (r.error.known.told(), f"{100 * r.error.noise:.2f}", f"{100 * r.error.bias:+.2f}")
        table.add_row(name, *ratios, *errors, f"{r.data_seconds:.0f}", f"{r.fit_seconds:.0f}")
    screen = console()
    screen.print(table)
    for _, r in rows:
        screen.print(f"  {r.path}", highlight=False, markup=False, soft_wrap=True)
