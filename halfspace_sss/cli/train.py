"""The command `halfspace-sss train`: networks of materials, for all media, for all shapes, of an object of a scene."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from halfspace_sss.cli.shared import (
    Albedo,
    Bar,
    Channels,
    Define,
    Eta,
    Materials,
    MeanCosine,
    ObjectId,
    SigmaT,
    Variant,
    by_channel,
    check_channel,
    check_left_out,
    console,
    defined,
    stated_medium,
    use_mitsuba,
    whole,
)

if TYPE_CHECKING:
    from halfspace_sss.physics.medium import Medium
    from halfspace_sss.rendering.scenes.learners import LearntObject

__all__ = ["train_command"]

MODEL, BACKEND, VARIANT = "neural_material", "llvm", "llvm_ad_rgb"
SECONDS, SHAPE_SECONDS = 60.0, 600.0  # for an object, for all shapes
SHAPE_VARIANT = "llvm_ad_mono"


def train_command(
    material: Materials = None,
    channel: Channels = None,
    universal: Annotated[bool, typer.Option("--universal", help="Train the network for all media instead.")] = False,
    shapes: Annotated[
        bool, typer.Option("--shapes", help="Train the network for all shapes and media instead.")
    ] = False,
    mesh: Annotated[
        list[Path] | None, typer.Option(help="With --shapes: a closed PLY file among the shapes; repeat for more.")
    ] = None,
    scene: Annotated[
        Path | None, typer.Option(help="Mitsuba XML file: train an object of it instead, which `render` then knows.")
    ] = None,
    object: ObjectId = None,
    seconds: Annotated[
        float | None,
        typer.Option(help="Time for an object or all shapes, without compiling.", show_default="60, 600"),
    ] = None,
    model: Annotated[
        str, typer.Option(help="neural_material or neural_paper; of an object full_geometry.", show_default=False)
    ] = MODEL,
    sigma_t: SigmaT = None,
    albedo: Albedo = None,
    g: MeanCosine = None,
    eta: Eta = None,
    fast: Annotated[bool, typer.Option("--fast", help="A quarter of the time, about twice the error.")] = False,
    steps: Annotated[
        int | None, typer.Option(help="Steps of the optimiser.", parser=whole, show_default="from the recipe")
    ] = None,
    target_error: Annotated[
        float | None, typer.Option(help="Stop early once the validation error is below this in 95 % of cases.")
    ] = None,
    start: Annotated[
        str | None,
        typer.Option(
            help="With --scene: neural_shape or the half-space model that the object's network begins with.",
            show_default="better_dipole",
        ),
    ] = None,
    seed: Annotated[int, typer.Option(help="Seed of maps, batches and first numbers.", parser=whole)] = 0,
    backend: Annotated[str, typer.Option(help="llvm or cuda, for the maps.")] = BACKEND,
    define: Define = None,
    variant: Variant = VARIANT,
    out: Annotated[
        Path | None, typer.Option(help="Folder for the weights.", show_default="where models find them")
    ] = None,
    work: Annotated[
        Path | None, typer.Option(help="Folder for unfinished work, which an interrupted run continues.")
    ] = None,
) -> None:
    """Train networks on path tracing; trained materials are then found by their medium, objects by their shape too."""
    if find_spec("torch") is None:
        raise ValueError("training needs torch: `pip install halfspace-sss[train]`")
    given = {"sigma_t": sigma_t, "albedo": albedo, "g": g, "eta": eta}
    if shapes:
        others = {"material": material, "channel": channel, "universal": universal, "scene": scene, "object": object,
                  **given, "fast": fast, "steps": steps, "target_error": target_error, "start": start, "define": define,
                  "model": None if model == MODEL else model, "variant": None if variant == VARIANT else variant,
                  "backend": None if backend == BACKEND else backend}  # fmt: skip
        check_left_out(others, "with --shapes")
        _shapes(out or Path("shapes"), SHAPE_SECONDS if seconds is None else seconds, seed, mesh or [], work)
        return
    check_left_out({"mesh": mesh}, "without --shapes")
    if scene is not None:
        others = {"material": material, "channel": channel, "universal": universal, **given, "fast": fast,
                  "steps": steps, "backend": None if backend == BACKEND else backend}  # fmt: skip
        check_left_out(others, "with --scene")
        how = {"object": object, "seconds": SECONDS if seconds is None else seconds, "target_error": target_error}
        files = {"seed": seed, "folder": out, "work": work} | ({"start": start} if start is not None else {})
        _object(scene, None if model == MODEL else model, {**how, **files}, variant, define)
        return
    of_scenes = {"object": object, "seconds": seconds, "start": start, "define": define}
    check_left_out({**of_scenes, "variant": None if variant == VARIANT else variant}, "without --scene")
    if universal:
        others = {
            "material": material,
            "channel": channel,
            **given,
            "fast": fast,
            "target_error": target_error,
            "work": work,
        }
        check_left_out({**others, "model": None if model == MODEL else model}, "with --universal")
        _universal(out or Path("universal"), seed, steps, backend)
        return
    media = _media(material or [], channel, given)
    recipe = _recipe(fast, steps)
    rows = []
    with Bar("training") as bar:
        for name, medium in media.items():
            rows += [
                (name, r) for r in _train(name, medium, bar, model, recipe, seed, out, work, target_error, backend)
            ]
    _report(rows)


def _media(names: list[str], channel: str | None, given: dict[str, float | None]) -> dict[str, Medium]:
    from halfspace_sss import materials

    check_channel(channel, names)
    if channel is not None:
        return dict(by_channel(names, channel))
    stated = stated_medium(names, given)
    if not names:
        return {"fig10": materials.load("fig10").medium} if stated is None else {"medium": stated}
    return {found.name: found.medium for found in map(materials.load, names)}


def _recipe(fast: bool, steps: int | None) -> Any:
    from dataclasses import replace

    from halfspace_sss.checks import check_count
    from halfspace_sss.neural.training.recipes import FAST, STANDARD

    recipe = FAST if fast else STANDARD
    if steps is None:
        return recipe
    check_count("steps", steps, 1)
    return replace(recipe, how=replace(recipe.how, steps=steps))


def _train(
    name: str, medium: Medium, bar: Bar, model: str, recipe: Any, seed: int, out: Path | None, work: Path | None,
    target_error: float | None, backend: str,
) -> list[Any]:  # fmt: skip
    from halfspace_sss.neural import train

    def show(what: str, done: int, total: int) -> None:
        bar.show(done, total, f"{name}: {what}")

    return train(
        medium, model=model, recipe=recipe, seed=seed, folder=out, work=work / name if work else None,
        target_error=target_error, backend=backend, progress=show,
    )  # fmt: skip


def _object(scene: Path, model: str | None, how: dict[str, Any], variant: str, define: list[str] | None) -> None:
    """Train an object of a scene and say how wrong the result is."""
    parameters = defined(define)
    use_mitsuba(variant)
    from halfspace_sss.rendering.scenes.learners import learner
    from halfspace_sss.rendering.scenes.scene_files import load_objects

    learns = learner(model)
    loaded = load_objects(scene, parameters)
    with Bar("training") as bar:
        found = learns.train(loaded, **how, progress=lambda what, done, total: bar.show(done, total, what))
    _report_object(found)


def _report_object(found: LearntObject) -> None:
    from halfspace_sss.cli.errors import OBJECT_DEFINITION, object_table

    screen = console()
    if found.path is None:
        screen.print(f"{found.object}: no weights are written", highlight=False, markup=False)
        return
    screen.print(object_table(found.errors), OBJECT_DEFINITION, highlight=False, sep="\n")
    told = f"{found.steps} steps in {found.seconds:.0f} s; written:"
    screen.print(told, f"  {found.path}", highlight=False, markup=False, soft_wrap=True, sep="\n")


def _shapes(folder: Path, seconds: float, seed: int, meshes: list[Path], work: Path | None) -> None:
    """Train the network of all shapes."""
    if find_spec("igl") is None:
        raise ValueError("training on shapes needs libigl: `pip install halfspace-sss[train]`")
    use_mitsuba(SHAPE_VARIANT)
    from halfspace_sss.rendering.scenes.learners import shape_learner

    with Bar("shapes") as bar:
        found = shape_learner().train_shapes(
            folder, seconds=seconds, seed=seed, meshes=meshes, work=work,
            progress=lambda what, done, total: bar.show(done, total, what),
        )  # fmt: skip
    screen = console()
    told = f"{found.objects} objects, {found.steps} steps in {found.seconds:.0f} s; written:"
    screen.print(told, f"  {found.path}", highlight=False, markup=False, soft_wrap=True, sep="\n")


def _universal(folder: Path, seed: int, steps: int | None, backend: str) -> None:
    from dataclasses import replace

    from halfspace_sss.checks import check_count
    from halfspace_sss.neural.training.recipes import UniversalRecipe, train_universal

    recipe = UniversalRecipe()
    if steps is not None:
        check_count("steps", steps, 1)
        recipe = replace(recipe, how=replace(recipe.how, steps=steps))
    with Bar("universal") as bar:
        path = train_universal(
            folder, seed, recipe, backend=backend, progress=lambda what, done, total: bar.show(done, total, what)
        )
    console().print(f"written: {path}", highlight=False, markup=False, soft_wrap=True)


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
