"""The command `halfspace-sss figures`: compute what changed of the paper's figures, and draw them."""

from __future__ import annotations

import time
from enum import Enum
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

import figures
from full_geometry.cli.variants import Variant, use_mitsuba
from halfspace_sss.backend import BackendError, cores
from halfspace_sss.cli.shared import Bar, Scheduler, console, executor_of, whole

if TYPE_CHECKING:
    from collections.abc import Iterator
    from concurrent.futures import Executor

    from figures.parts.runner import Plan

DRAWING = ("PIL", "flip_evaluator", "matplotlib")
EXTRAS = ("PIL", "flip_evaluator", "matplotlib", "mitsuba")
WORKERS = "Processes that share the cores and the parts of the work."
MOST_WORKERS = 2  # that are not asked for: each has its kernels in memory
AHEAD = 2  # parts that each process has been given, so that none waits while a figure is drawn


class Action(str, Enum):
    """What is done with the figures."""

    list = "list"
    compute = "compute"
    draw = "draw"
    all = "all"


class Quality(str, Enum):
    """How much is spent on them."""

    draft = "draft"
    paper = "paper"


def figures_command(
    action: Annotated[
        Action, typer.Argument(help="list what there is, compute parts, draw, or all: compute and draw.")
    ],
    names: Annotated[
        list[str] | None, typer.Argument(help="Names of figures.", metavar="[NAMES]...", show_default="all")
    ] = None,
    quality: Annotated[Quality, typer.Option(help="draft: minutes on two cores. paper: as published.")] = Quality.draft,
    workers: Annotated[int | None, typer.Option(help=WORKERS, parser=whole, show_default="2 for drafts")] = None,
    scheduler: Scheduler = None,
    variant: Variant = "llvm_ad_rgb",
    out: Annotated[Path, typer.Option(help="Folder for parts and pictures of all figures.")] = Path("out"),
) -> None:
    """Make the figures of the paper; a part that is there is computed again only if what it depends on changed."""
    from figures.parts.runner import figure, plan

    if variant != "llvm_ad_rgb":
        if workers or scheduler:
            raise ValueError(f"variant must be llvm_ad_rgb with --workers or --scheduler, got {variant!r}")
        use_mitsuba(variant, ("llvm_ad_rgb", "cuda_ad_rgb"))
    chosen = list(dict.fromkeys(names or figures.figure_modules()))
    do = {Action.list: _list, Action.compute: _compute, Action.draw: _draw, Action.all: _all}[action]
    try:
        for name in chosen:
            figure(name)
        if action in (Action.draw, Action.all):
            _check_drawing()
        plans = [plan(name, quality.value, out) for name in chosen]
        if workers is None and scheduler is None and variant == "llvm_ad_rgb" and quality is Quality.draft:
            workers = _workers(plans) if action in (Action.compute, Action.all) else None
        with executor_of(workers, scheduler) as executor:
            do(plans, out, executor, workers and AHEAD * workers)
    except ModuleNotFoundError as error:
        if (error.name or "").split(".")[0] not in EXTRAS:
            raise
        raise BackendError(f'figures need {error.name}: pip install "halfspace-sss[figures,render]"') from error


def _workers(plans: list[Plan]) -> int | None:
    """Processes for drafts, whose parts are too small for several threads; None for this one."""
    number = min(cores(), MOST_WORKERS, len({p.keys[name] for p in plans for name in p.missing}))
    return number if number > 1 else None


def _check_drawing() -> None:
    """Before anything is computed: BackendError unless the libraries that figures are drawn with are there."""
    for name in DRAWING:
        if find_spec(name) is None:
            raise BackendError(f'figures need {name}: pip install "halfspace-sss[figures,render]"')


def _say(text: str) -> None:
    console().print(text, highlight=False, markup=False, soft_wrap=True)


def _list(plans: list[Plan], out: Path, executor: Executor | None, most: int | None) -> None:
    from rich.box import SIMPLE_HEAD
    from rich.table import Table

    from figures.parts.runner import figure

    table = Table(box=SIMPLE_HEAD, pad_edge=False, title=f"quality {plans[0].quality}, in {out}", title_justify="left")
    for heading in ("figure", "shows", "parts", "computed", "damaged", "time for the rest", "drawn"):
        table.add_column(heading, justify="left" if heading in ("figure", "shows") else "right", overflow="fold")
    for p in plans:
        done = len(p.parts) - len(p.missing)
        drawn = "yes" if (p.folder / f"{p.name}.json").exists() else "no"
        counts = (str(len(p.parts)), str(done), str(len(p.damaged)))
        table.add_row(p.name, figure(p.name).TITLE, *counts, _time(p), drawn)
    console().print(table)
    for p in plans:
        for reason in p.damaged.values():
            _say(f"damaged: {reason}")


def _time(p: Plan) -> str:
    """What the missing parts will take, and how many of them nobody has measured."""
    from figures.parts.runner import duration

    if not p.missing:
        return "none"
    unknown = f"{len(p.unmeasured)} parts not measured yet" if p.unmeasured else ""
    if len(p.unmeasured) == len(p.missing):
        return unknown
    return f"about {duration(p.projected_seconds)}" + (f" and {unknown}" if unknown else "")


def _announce(p: Plan) -> None:
    """The time, before it is spent."""
    if not p.missing:
        _say(f"{p.name} {p.quality}: all {len(p.parts)} parts are there")
        return
    _say(f"{p.name} {p.quality}: {len(p.missing)} of {len(p.parts)} parts to compute, {_time(p)}")
    if p.unmeasured and p.quality == "paper":
        _say(f"  `halfspace-sss figures compute {p.name} --quality draft` measures them first")
    sources = [each.source for each in p.seconds.values() if each.source]
    for source in dict.fromkeys(sources):
        _say(f"  {sources.count(source)} measured by {source}, scaled by work")


def _compute(plans: list[Plan], out: Path, executor: Executor | None, most: int | None) -> None:
    for _ in _completed(plans, executor, most):
        pass


def _completed(plans: list[Plan], executor: Executor | None, most: int | None) -> Iterator[Plan]:
    """The figures as all of their parts are computed."""
    from figures.parts.runner import completed_plans, duration

    _announce_all(plans)
    started = time.perf_counter()
    with Bar(plans[0].name if len(plans) == 1 else "figures") as bar:
        for p in completed_plans(plans, bar.show, _say, executor, most):
            with bar.standing():
                yield p
    if any(p.missing for p in plans):
        _say(f"computed in {duration(time.perf_counter() - started)}")


def _announce_all(plans: list[Plan]) -> None:
    from figures.parts.runner import duration

    for p in plans:
        _announce(p)
    if sum(bool(p.missing) for p in plans) > 1:
        unknown = sum(len(p.unmeasured) for p in plans)
        more = f" and {unknown} parts not measured yet" if unknown else ""
        each = {p.keys[name]: s.seconds or 0.0 for p in plans for name, s in p.seconds.items()}  # shared ones once
        _say(f"together about {duration(sum(each.values()))}{more}")


def _draw(plans: list[Plan], out: Path, executor: Executor | None, most: int | None) -> None:
    from figures.parts.runner import draw

    for p in plans:
        for path in draw(p.name, p.quality, out):
            _say(f"  {path}")


def _all(plans: list[Plan], out: Path, executor: Executor | None, most: int | None) -> None:
    for p in _completed(plans, executor, most):
        _draw([p], out, executor, most)
