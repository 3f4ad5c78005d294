"""Progress on stderr and results on stdout, as a terminal, a file or nobody wants them."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

import typer

from halfspace_sss.cli.interrupts import interrupts

if TYPE_CHECKING:
    from rich.console import Console

__all__ = ["Bar", "console", "set_quiet", "tell"]

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

    found = Console(quiet=_quiet)
    return found if found.is_terminal else Console(width=TABLE_WIDTH, quiet=_quiet)


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
        self._progress = Progress(*steps, *times, text, console=screen, expand=True, speed_estimate_period=MEMORY)
        self._progress.start()
        self._task = self._progress.add_task("", completed=done, text="")

    def show(self, done: int, total: int, text: str) -> None:
        self._progress.update(self._task, completed=done, total=total, text=text)

    def stop(self, total: int | None) -> None:
        if total is not None:
            self._progress.update(self._task, completed=total)
        self._progress.stop()


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
