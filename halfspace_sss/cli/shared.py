"""What commands share: their options, progress on stderr, tables on stdout, --quiet, and how they end.

Errors become a line on stderr and an exit code: 0 done, 1 failed, 2 bad input, 130 interrupted (143 terminated).
"""

from __future__ import annotations

import dataclasses
import inspect
import math
import time
import typing
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer
from typer.core import TyperGroup

from halfspace_sss.backend import BackendError
from halfspace_sss.interrupts import interrupts

if TYPE_CHECKING:
    from concurrent.futures import Executor

    import pandas
    from rich.console import Console
    from rich.table import Table

    from halfspace_sss.physics.medium import Medium

# ---------------------------------------------------------------------------------------------------------------------
# Groups and commands, and how they end


def _end(message: str, code: int) -> typer.Exit:
    """The exit that ends the command, after one line on stderr."""
    typer.echo(" ".join(message.split()), err=True)
    return typer.Exit(code)


def tell_interrupt(error: BaseException) -> typer.Exit:
    """The exit after an interrupt, whatever the libraries made of it."""
    interrupts.told = True
    detail = str(error) if isinstance(error, KeyboardInterrupt) else ""
    return _end(f"interrupted; {detail or 'files that were being written are whole or absent'}", interrupts.exit_code)


def _show_warnings() -> Callable[..., None]:
    """What shows each warning once: scenes that are loaded again warn again."""
    shown: set[str] = set()

    def show(message: Warning | str, *_: object) -> None:
        text = " ".join(str(message).split())
        if text not in shown:
            typer.echo(f"warning: {text}", err=True)
        shown.add(text)

    return show


NO_NUMBER = ("Input should be a valid number, unable to parse string as a number", "must be a number, such as 0.02")


class Commands(TyperGroup):
    """The commands; what they and the library refuse, and interrupts, end them in a line."""

    def invoke(self, ctx: typer.Context) -> object:
        with interrupts, warnings.catch_warnings():
            warnings.showwarning = _show_warnings()
            try:
                return self._refuse_in_a_line(ctx)
            except BaseException as error:
                if interrupts.received is None or getattr(error, "exit_code", None) == interrupts.exit_code:
                    raise
                raise tell_interrupt(error) from None

    def _refuse_in_a_line(self, ctx: typer.Context) -> object:
        try:
            return super().invoke(ctx)
        except KeyboardInterrupt as error:
            raise tell_interrupt(error) from None
        except ValueError as error:
            interrupts.check()
            raise _end(f"error: {error}", 2) from error
        except typer.TyperException as error:
            message = error.format_message().replace("Value error, ", "").replace(*NO_NUMBER)
            if not message:  # a group without a command has shown its help
                raise
            raise _end(f"error: {message}", error.exit_code) from None
        except BrokenPipeError:
            raise  # the reader, `head` for instance, has what it wanted: typer ends in silence
        except (BackendError, OSError) as error:
            interrupts.check()
            raise _end(f"error: {error}", 1) from error


def group(help: str, cls: type[TyperGroup] | None = None, completion: bool = False) -> typer.Typer:
    """A group of commands, to which `add` adds."""
    return typer.Typer(
        cls=cls, help=help, no_args_is_help=True, add_completion=completion, pretty_exceptions_enable=False,
        context_settings={"help_option_names": ["-h", "--help"]},
    )  # fmt: skip


def add(app: typer.Typer, name: str, function: Callable) -> None:
    """Add a command to a group.

    A parameter of the function may be a record, a dataclass of values with typer annotations and defaults: each is
    an option. Every command has the option --quiet beside its own.
    """
    parameters, records = [], {}
    for parameter in inspect.signature(function, eval_str=True).parameters.values():
        if dataclasses.is_dataclass(parameter.annotation):
            records[parameter.name] = parameter.annotation
            kinds = typing.get_type_hints(parameter.annotation, include_extras=True)
            for field in dataclasses.fields(parameter.annotation):
                option = inspect.Parameter(field.name, inspect.Parameter.KEYWORD_ONLY, default=field.default)
                parameters.append(option.replace(annotation=kinds[field.name]))
        else:
            parameters.append(parameter.replace(kind=inspect.Parameter.KEYWORD_ONLY))

    def run(quiet: bool, **options: object) -> object:
        made = {
            key: record(**{field.name: options.pop(field.name) for field in dataclasses.fields(record)})
            for key, record in records.items()
        }
        set_quiet(quiet)
        try:
            return function(**options, **made)
        finally:
            set_quiet(False)

    kind = Annotated[bool, typer.Option("--quiet", "-q", help="Print nothing but warnings and errors.")]
    parameters.append(inspect.Parameter("quiet", inspect.Parameter.KEYWORD_ONLY, default=False, annotation=kind))
    run.__signature__ = inspect.Signature(parameters)
    run.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
    app.command(name, help=inspect.getdoc(function))(run)


# ---------------------------------------------------------------------------------------------------------------------
# What is printed

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


def say(*lines: object) -> None:
    """Results on stdout, as they are."""
    screen = console()
    for line in lines:
        screen.print(line, highlight=False, markup=False, soft_wrap=isinstance(line, str))


def say_files(paths: Iterable[Path | str]) -> None:
    """Paths that were written, a line each."""
    say(*(f"  {path}" for path in paths))


def tell(sentence: str) -> None:
    """A sentence on stderr, before work starts."""
    if not _quiet:
        typer.echo(sentence, err=True)


def table(
    headings: Sequence[str], rows: Iterable[Sequence[str]], *, title: str = "", caption: str = "", left: int = 1
) -> Table:
    """A table of texts: the first `left` columns are words, the others numbers."""
    from rich.box import SIMPLE_HEAD
    from rich.table import Table
    from rich.text import Text

    about = {"title": Text(title) if title else None, "caption": Text(caption) if caption else None}
    result = Table(**about, title_justify="left", caption_justify="left", box=SIMPLE_HEAD, pad_edge=False)
    for k, heading in enumerate(headings):
        result.add_column(Text(heading), justify="left" if k < left else "right", overflow="fold")
    for row in rows:
        result.add_row(*(Text(cell) for cell in row))
    return result


def csv_of(frame: pandas.DataFrame) -> str:
    """The text of a CSV file."""
    return frame.to_csv(index=False, lineterminator="\n")


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

    def told(self, what: str, done: int, total: int) -> None:
        """`show`, in the order in which libraries call a progress."""
        self.show(done, total, what)

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


# ---------------------------------------------------------------------------------------------------------------------
# Options


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


def _seed(text: str | int) -> int:
    value = whole(text)
    if value < 0:
        raise typer.BadParameter(f"seed must be a whole number >= 0, got {value}.")
    return value


def _complete_models() -> list[str]:
    from halfspace_sss import models

    return list(models())


def _complete_materials() -> list[str]:
    from halfspace_sss.materials import names

    return list(names())


MATERIALS_HELP = "Names of materials; see `halfspace-sss materials list`."
Materials = Annotated[list[str] | None, typer.Argument(help=MATERIALS_HELP, autocompletion=_complete_materials)]
OneMaterial = Annotated[str | None, typer.Argument(help="Name of a material.", autocompletion=_complete_materials)]
Channels = Annotated[str | None, typer.Option(help="Channels, as R,B.", show_default="all")]
Models = Annotated[
    list[str] | None,
    typer.Option(help="A model; repeat for more.", metavar="NAME", show_default="all", autocompletion=_complete_models),
]
ObjectId = Annotated[
    str | None, typer.Option(help="Id of the object in the scene.", show_default="the only translucent one")
]
SensorNumber = Annotated[int, typer.Option(help="Number of the sensor.", parser=whole)]
Seed = Annotated[int, typer.Option(help="Seed of random numbers.", parser=_seed)]
OutFolder = Annotated[Path, typer.Option(help="Folder for the files; those of the same names are replaced.")]
Backend = Annotated[Literal["llvm", "cuda"], typer.Option(help="Where the walks run.")]
AsJson = Annotated[bool, typer.Option("--json", help="As JSON, for programs.")]
Define = Annotated[
    list[str] | None,
    typer.Option("--define", "-D", help="Value of $NAME in the scene; repeat for more.", metavar="NAME=VALUE"),
]


@dataclasses.dataclass(frozen=True)
class MediumOptions:
    """A medium that is stated; what is left out is that of Fig. 10."""

    sigma_t: Annotated[float | None, typer.Option(help="Extinction, 1/mm.", show_default="0.241")] = None
    albedo: Annotated[float | None, typer.Option(help="Single-scattering albedo.", show_default="0.75")] = None
    g: Annotated[float | None, typer.Option(help="Mean cosine of the phase function.", show_default="0")] = None
    eta: Annotated[float | None, typer.Option(help="Index inside over outside.", show_default="1.3")] = None

    def stated(self, materials: Sequence[str]) -> Medium | None:
        """The medium; None if no coefficient was given.

        Raises:
            ValueError: coefficients were given beside the name of a material, or are out of range.
        """
        given = {name: value for name, value in vars(self).items() if value is not None}
        for name, value in given.items():
            if materials:
                raise ValueError(f"{name} must be left out for a named material, got {value!r} with {materials[0]!r}")
        return fig10_medium(**given) if given else None

    def media(self, materials: Sequence[str], channels: str | None) -> dict[str, Medium]:
        """Media by title: of materials, of their channels, as in "R,B", those stated, or that of Fig. 10."""
        from halfspace_sss.materials import load
        from halfspace_sss.materials.catalogue import one_channel

        stated = self.stated(materials)
        if channels is not None and not materials:
            raise ValueError(f"channel must be left out unless materials are named, got {channels!r}")
        if channels is not None:
            chosen = [one_channel(name, channel.strip()) for name in materials for channel in channels.split(",")]
        elif stated is None:
            chosen = [(each.name, each.medium) for each in map(load, materials or ["fig10"])]
        else:
            chosen = [("medium", stated)]
        if len(dict(chosen)) < len(chosen):
            raise ValueError(f"materials and channels must be different, got {', '.join(title for title, _ in chosen)}")
        return dict(chosen)


def fig10_medium(**stated: float) -> Medium:
    """The medium of Fig. 10 with other coefficients where they are stated."""
    from halfspace_sss.materials import load
    from halfspace_sss.physics.medium import Medium

    fig10 = load("fig10").medium
    known = {name: round(float(getattr(fig10, name)), 12) for name in ("sigma_t", "albedo", "g", "eta")}
    return Medium.from_albedo(**{**known, **stated})


@dataclasses.dataclass(frozen=True)
class Places:
    """Where the parts of the work run."""

    workers: Annotated[
        int | None,
        typer.Option(
            help="Processes that share the cores and the parts of the work.", parser=whole, show_default="none"
        ),
    ] = None
    scheduler: Annotated[
        str | None,
        typer.Option(
            help="Address or file of a Dask scheduler, whose workers do the work; local starts one.",
            show_default="none",
        ),
    ] = None

    def executor(self) -> AbstractContextManager[Executor | None]:
        """What runs the parts; None stands for this process."""
        from halfspace_sss import executors

        if self.workers is not None and self.scheduler is not None:
            raise ValueError(f"workers must be left out beside a scheduler, got {self.workers}")
        if self.scheduler is not None:
            return executors.scheduler(self.scheduler, console().print)
        return nullcontext() if self.workers is None else executors.workers(self.workers)


def numbers(name: str, text: str) -> list[float]:
    """Comma-separated numbers; ValueError with the name of the option."""
    try:
        return [float(part) for part in text.split(",")]
    except ValueError:
        raise ValueError(f"{name} must be numbers separated by commas, got {text!r}") from None


def defined(texts: Sequence[str] | None) -> dict[str, str]:
    """Values of $NAME from texts NAME=VALUE."""
    pairs = [text.partition("=") for text in texts or ()]
    for name, equals, value in pairs:
        if not (name.isidentifier() and equals):
            raise ValueError(f"define must be NAME=VALUE, got {name + equals + value!r}")
    return {name: value for name, _, value in pairs}
