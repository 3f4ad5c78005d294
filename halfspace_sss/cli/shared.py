"""What several commands share: numbers and media, progress on stderr, tables on stdout, --quiet, and how commands end.

Errors become a line on stderr and an exit code: 0 done, 1 failed, 2 bad input, 130 interrupted (143 terminated).
"""

from __future__ import annotations

import functools
import inspect
import math
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer.core import TyperGroup

from halfspace_sss.backend import BackendError
from halfspace_sss.cli.interrupts import interrupts

if TYPE_CHECKING:
    from concurrent.futures import Executor

    from rich.console import Console

    from halfspace_sss.physics.medium import Medium


def _end(message: str, code: int) -> typer.Exit:
    """The exit that ends the command, after one line on stderr."""
    typer.echo(" ".join(message.split()), err=True)
    return typer.Exit(code)


def tell_interrupt(error: BaseException) -> typer.Exit:
    """The exit after an interrupt, whatever the libraries made of it."""
    interrupts.told = True
    detail = str(error) if isinstance(error, KeyboardInterrupt) else ""
    return _end(f"interrupted; {detail or 'files that were being written are whole or absent'}", interrupts.exit_code)


def _show_warning(message: Any, *_: Any) -> None:
    typer.echo(f"warning: {' '.join(str(message).split())}", err=True)


class Commands(TyperGroup):
    """The commands; what the library refuses, and interrupts, end them in a line."""

    def invoke(self, ctx: Any) -> Any:
        with interrupts, warnings.catch_warnings():
            warnings.showwarning = _show_warning
            try:
                return self._refuse_in_a_line(ctx)
            except BaseException as error:
                if interrupts.received is None or getattr(error, "exit_code", None) == interrupts.exit_code:
                    raise
                raise tell_interrupt(error) from None

    def _refuse_in_a_line(self, ctx: Any) -> Any:
        try:
            return super().invoke(ctx)
        except KeyboardInterrupt as error:
            raise tell_interrupt(error) from None
        except ValueError as error:
            interrupts.check()
            raise _end(f"error: {error}", 2) from error
        except BrokenPipeError:
            raise  # the reader, `head` for instance, has what it wanted: typer ends in silence
        except (BackendError, OSError) as error:
            interrupts.check()
            raise _end(f"error: {error}", 1) from error


TABLE_WIDTH = 132  # where the output is no terminal
LINE_EVERY = 30.0  # seconds
MEMORY = 3600.0  # seconds; steps may take minutes, and the time left is estimated from several of them
_quiet = False


def set_quiet(quiet: bool) -> None:
    """Whether progress and results are left out."""
    global _quiet
    _quiet = quiet


def console() -> Console:
    """A console that does not fold lines at 80 columns where the output is a file."""
    from rich.console import Console

    result = Console(quiet=_quiet)
    return result if result.is_terminal else Console(width=TABLE_WIDTH, quiet=_quiet)


def tell(sentence: str) -> None:
    """A sentence on stderr, before work starts."""
    if not _quiet:
        typer.echo(sentence, err=True)


class Bar:
    """Progress with the time left, on stderr; appears with the first step, so that refused input leaves no trace.

    A bar in a terminal, elsewhere a line now and then.
    """

    def __init__(self, title: str) -> None:
        self._title = title
        self._shown: _Moving | _Lines | None = None
        self._total = 0

    def __enter__(self) -> Bar:
        return self

    def show(self, done: int, total: int, text: str = "") -> None:
        """Move the bar; `text` says what was just done.

        Raises:
            KeyboardInterrupt: an interrupt came while nothing could hear it.
        """
        interrupts.check()
        if _quiet:
            return
        if self._shown is None:
            from rich.console import Console

            screen = Console(stderr=True)
            self._shown = _Moving(self._title, screen, done) if screen.is_terminal else _Lines(self._title)
        self._total = total
        self._shown.show(done, total, text)

    @contextmanager
    def standing(self) -> Iterator[None]:
        """Meanwhile lines may be printed, which come below the bar as it is; it goes on below them."""
        progress = getattr(self._shown, "progress", None)
        if progress:
            progress.stop()
        yield
        if progress:
            progress.start()

    def __exit__(self, kind: type | None, *_: object) -> None:
        if self._shown is not None:
            self._shown.stop(self._total if kind is None else None)


class _Moving:
    """A bar that moves."""

    def __init__(self, title: str, screen: Console, done: int) -> None:
        from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
        from rich.table import Column

        steps = (TextColumn(title), BarColumn(30), TextColumn("{task.percentage:.0f} %"))
        times = (TimeElapsedColumn(), TextColumn("left"), TimeRemainingColumn())
        text = TextColumn("{task.fields[text]}", markup=False, table_column=Column(ratio=1, no_wrap=True))
        self.progress = Progress(*steps, *times, text, console=screen, expand=True, speed_estimate_period=MEMORY)
        self.progress.start()
        self._task = self.progress.add_task("", completed=done, text="")

    def show(self, done: int, total: int, text: str) -> None:
        self.progress.update(self._task, completed=done, total=total, text=text)

    def stop(self, total: int | None) -> None:
        if total is not None:
            self.progress.update(self._task, completed=total)
        self.progress.stop()


class _Lines:
    """One line every half minute and one at the end."""

    def __init__(self, title: str) -> None:
        self._title = title
        self._started = self._last = time.monotonic()
        self._first: float | None = None

    def show(self, done: int, total: int, text: str) -> None:
        now, share = time.monotonic(), done / max(total, 1)
        self._first = share if self._first is None else self._first
        if now - self._last < LINE_EVERY:
            return
        self._last, passed = now, now - self._started
        rate = (share - self._first) / passed
        left = f", about {(1 - share) / rate:.0f} s left" if rate > 0 else ""
        typer.echo(f"{self._title} {100 * share:.0f} % after {passed:.0f} s{left}  {text}".rstrip(), err=True)

    def stop(self, total: int | None) -> None:
        if total is not None:
            typer.echo(f"{self._title} 100 % after {time.monotonic() - self._started:.0f} s", err=True)


def whole(text: str | int) -> int:
    """A whole number as people write it, 1e6 too; the parser of an option, which gets its default as well."""
    try:
        return int(text)
    except ValueError:
        pass
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not value.is_integer():
        raise typer.BadParameter(f"{text!r} is not a whole number.")
    return int(value)


SigmaT = Annotated[float | None, typer.Option(help="Extinction, 1/mm.", show_default="0.241")]
Albedo = Annotated[float | None, typer.Option(help="Single-scattering albedo.", show_default="0.75")]
MeanCosine = Annotated[float | None, typer.Option(help="Mean cosine of the phase function.", show_default="0")]
Eta = Annotated[float | None, typer.Option(help="Index inside over outside.", show_default="1.3")]
Materials = Annotated[list[str] | None, typer.Argument(help="Names of materials; see `halfspace-sss materials`.")]
Channels = Annotated[str | None, typer.Option(help="Only these, as R,B.", show_default="all")]
ObjectId = Annotated[str | None, typer.Option(help="Its id in the scene.", show_default="the only translucent one")]
SensorNumber = Annotated[int, typer.Option(help="Number of the sensor.", parser=whole)]
SampleSeed = Annotated[int, typer.Option(help="Seed of the samples.", parser=whole)]
OutFolder = Annotated[Path, typer.Option(help="Folder for the files; those of the same names are replaced.")]
Backend = Annotated[str, typer.Option(help="llvm or cuda.")]
SPECTRAL = ("llvm_ad_spectral", "cuda_ad_spectral")
Workers = Annotated[
    int | None,
    typer.Option(help="Processes that share the cores and the parts of the work.", parser=whole, show_default="none"),
]
Scheduler = Annotated[
    str | None,
    typer.Option(
        help="Address or file of a Dask scheduler, whose workers do the work; local starts one.", show_default="none"
    ),
]
Define = Annotated[
    list[str] | None,
    typer.Option("--define", "-D", help="Value of $NAME in the scene; repeat for more.", metavar="NAME=VALUE"),
]


@contextmanager
def executor_of(workers: int | None, scheduler: str | None) -> Iterator[Executor | None]:
    """Where parts run: None stands for this process."""
    from halfspace_sss import executors

    if workers is not None and scheduler is not None:
        raise ValueError(f"workers must be left out beside a scheduler, got {workers}")
    if scheduler is not None:
        with executors.scheduler(scheduler, console().print) as result:
            yield result
    elif workers is not None:
        with executors.workers(workers) as result:
            yield result
    else:
        yield None


def numbers(name: str, text: str) -> list[float]:
    """Comma-separated numbers; ValueError with the name of the option."""
    try:
        return [float(part) for part in text.split(",")]
    except ValueError:
        raise ValueError(f"{name} must be numbers separated by commas, got {text!r}") from None


def stated_medium(materials: list[str], given: dict[str, float | None]) -> Medium | None:
    """The medium of Fig. 10 with the coefficients that were given; None if none was.

    Raises:
        ValueError: coefficients were given beside the name of a material, or are out of range.
    """
    stated = {name: value for name, value in given.items() if value is not None}
    for name, value in stated.items():
        if materials:
            raise ValueError(f"{name} must be left out for a named material, got {value!r} with {materials[0]!r}")
    return fig10_medium(**stated) if stated else None


def fig10_medium(**stated: float) -> Medium:
    """The medium of Fig. 10 with other coefficients where they are stated."""
    from halfspace_sss.materials import load
    from halfspace_sss.physics.medium import Medium

    fig10 = load("fig10").medium
    known = {name: round(float(getattr(fig10, name)), 12) for name in ("sigma_t", "albedo", "g", "eta")}
    return Medium.from_albedo(**{**known, **stated})


def by_channel(names: list[str], channels: str) -> list[tuple[str, Medium]]:
    """A title and a scalar medium for each of the channels, as in "R,B", of each material."""
    from halfspace_sss.materials.registry import one_channel

    return [one_channel(name, channel.strip()) for name in names for channel in channels.split(",")]


def check_channel(channel: str | None, names: list[str]) -> None:
    """ValueError if channels are chosen and no material is."""
    if channel is not None and not names:
        raise ValueError(f"channel must be left out unless materials are named, got {channel!r}")


def defined(texts: list[str] | None) -> dict[str, str]:
    """Values of $NAME from texts NAME=VALUE."""
    pairs = [text.partition("=") for text in texts or ()]
    for text, (name, equals, _) in zip(texts or (), pairs):
        if not (name.isidentifier() and equals):
            raise ValueError(f"define must be NAME=VALUE, got {text!r}")
    return {name: value for name, _, value in pairs}


def check_left_out(names: dict[str, Any], beside: str) -> None:
    """ValueError if one of the options, by name, was given where `beside` says that it has no place."""
    for name, value in names.items():
        if value not in (None, False, []):
            raise ValueError(f"{name} must be left out {beside}, got {value!r}")


def with_quiet(command: Callable) -> Callable:
    """The command with a further option, --quiet."""

    @functools.wraps(command)
    def silenced(*arguments: Any, quiet: bool = False, **options: Any) -> Any:
        set_quiet(quiet)
        try:
            return command(*arguments, **options)
        finally:
            set_quiet(False)

    result = inspect.signature(command, eval_str=True)
    kind = Annotated[bool, typer.Option("--quiet", "-q", help="Print nothing but warnings and errors.")]
    option = inspect.Parameter("quiet", inspect.Parameter.KEYWORD_ONLY, default=False, annotation=kind)
    silenced.__signature__ = result.replace(parameters=[*result.parameters.values(), option])
    silenced.__annotations__ = {**{p.name: p.annotation for p in result.parameters.values()}, "quiet": kind}
    del silenced.__wrapped__  # of which the signature would be read
    return silenced
