"""The commands `halfspace-sss figures ...`: compute what changed of the paper's figures, and draw them."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

import figures
from full_geometry.cli.variants import use_mitsuba
from halfspace_sss.backend import BackendError, cores
from halfspace_sss.cli.shared import Bar, Places, say, say_files, table

if TYPE_CHECKING:
    from figures.parts.runner import Plan

DRAWING = ("PIL", "flip_evaluator", "matplotlib")
MOST_WORKERS = 2  # that are not asked for: each has its kernels in memory
AHEAD = 2  # parts that each process has been given, so that none waits while a figure is drawn


@dataclass(frozen=True)
class FigureOptions:
    """Figures, and how much is spent on them."""

    names: Annotated[
        list[str] | None,
        typer.Argument(help="Names of figures.", show_default="all", autocompletion=figures.figure_modules),
    ] = None
    quality: Annotated[
        Literal["draft", "paper"], typer.Option(help="draft: minutes on two cores. paper: as published.")
    ] = "draft"
    out: Annotated[Path, typer.Option(help="Folder for parts and pictures of all figures.")] = Path("out")

    def plans(self) -> list[Plan]:
        """What is there and what is missing of each."""
        from figures.parts.runner import figure, plan

        chosen = list(dict.fromkeys(self.names or figures.figure_modules()))
        for name in chosen:
            figure(name)
        return [plan(name, self.quality, self.out) for name in chosen]


@contextmanager
def _libraries(drawing: bool = False) -> Iterator[None]:
    """Say of a missing library how it is installed; of one that figures are drawn with before anything is computed."""
    try:
        for name in DRAWING if drawing else ():
            if find_spec(name) is None:
                raise ModuleNotFoundError(name=name)
        yield
    except ModuleNotFoundError as error:
        if (error.name or "").split(".")[0] not in (*DRAWING, "mitsuba"):
            raise
        raise BackendError(f'figures need {error.name}: pip install "halfspace-sss[figures,render]"') from error


def list_figures(chosen: FigureOptions) -> None:
    """List figures: how many of their parts are computed, and how long the others will take."""
    from figures.parts.runner import figure

    with _libraries():
        plans = chosen.plans()
    rows = []
    for p in plans:
        counts = (len(p.parts), len(p.parts) - len(p.missing))
        drawn = "yes" if (p.folder / f"{p.name}.json").exists() else "no"
        rows.append((p.name, figure(p.name).TITLE, *map(str, counts), _time(p), drawn))
    headings = ("figure", "shows", "parts", "computed", "time for the rest", "drawn")
    say(table(headings, rows, title=f"quality {chosen.quality}, in {chosen.out}", left=2))


Variant = Annotated[Literal["llvm_ad_rgb", "cuda_ad_rgb"], typer.Option(help="Variant of Mitsuba.")]


def compute(chosen: FigureOptions, places: Places, variant: Variant = "llvm_ad_rgb") -> None:
    """Compute parts of figures; a finished part is computed again only if its inputs changed."""
    with _libraries():
        for _ in _completed(chosen, places, variant):
            pass


def draw(chosen: FigureOptions) -> None:
    """Draw figures from their parts."""
    with _libraries(drawing=True):
        for p in chosen.plans():
            _draw(p, chosen.out)


def make_all(chosen: FigureOptions, places: Places, variant: Variant = "llvm_ad_rgb") -> None:
    """Compute figures, and draw each as soon as its parts are there."""
    with _libraries(drawing=True):
        for p in _completed(chosen, places, variant):
            _draw(p, chosen.out)


COMMANDS = {"list": list_figures, "compute": compute, "draw": draw, "all": make_all}


def _draw(p: Plan, out: Path) -> None:
    from figures.parts.runner import draw

    say_files(draw(p.name, p.quality, out))


def _completed(chosen: FigureOptions, places: Places, variant: str) -> Iterator[Plan]:
    """The figures as all of their parts are computed."""
    from figures.parts.runner import completed_plans, duration

    if variant != "llvm_ad_rgb":
        if places != Places():
            raise ValueError(f"variant must be llvm_ad_rgb with --workers or --scheduler, got {variant!r}")
        use_mitsuba(variant)
    plans = chosen.plans()
    if places == Places() and variant == "llvm_ad_rgb" and chosen.quality == "draft":
        # drafts have parts too small for several threads: processes
        number = min(cores(), MOST_WORKERS, len({p.keys[name] for p in plans for name in p.missing}))
        places = Places(workers=number if number > 1 else None)
    _announce(plans)
    started = time.perf_counter()
    with places.executor() as executor, Bar(plans[0].name if len(plans) == 1 else "figures") as bar:
        most = places.workers and AHEAD * places.workers
        for p in completed_plans(plans, bar.show, executor, most):
            with bar.standing():
                yield p
    if any(p.missing for p in plans):
        say(f"computed in {duration(time.perf_counter() - started)}")


def _time(p: Plan) -> str:
    """What the missing parts will take, and how many of them nobody has measured."""
    from figures.parts.runner import duration

    if not p.missing:
        return "none"
    unknown = f"{len(p.unmeasured)} parts not measured yet" if p.unmeasured else ""
    if len(p.unmeasured) == len(p.missing):
        return unknown
    return f"about {duration(p.projected_seconds)}" + (f" and {unknown}" if unknown else "")


def _announce(plans: Sequence[Plan]) -> None:
    """The time, before it is spent."""
    from figures.parts.runner import duration

    for p in plans:
        if not p.missing:
            say(f"{p.name} {p.quality}: all {len(p.parts)} parts are there")
            continue
        say(f"{p.name} {p.quality}: {len(p.missing)} of {len(p.parts)} parts to compute, {_time(p)}")
        if p.unmeasured and p.quality == "paper":
            say(f"  `halfspace-sss figures compute {p.name} --quality draft` measures them first")
    if sum(bool(p.missing) for p in plans) > 1:
        unknown = sum(len(p.unmeasured) for p in plans)
        more = f" and {unknown} parts not measured yet" if unknown else ""
        each = {p.keys[name]: seconds or 0.0 for p in plans for name, seconds in p.seconds.items()}  # shared ones once
        say(f"together about {duration(sum(each.values()))}{more}")
