"""What several commands share: reading numbers and media, a bar of progress, and a console for tables."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from rich.console import Console

    from halfspace_sss.physics.medium import Medium

__all__ = [
    "FIG10", "Albedo", "Backend", "Bar", "Eta", "MeanCosine", "SigmaT", "console", "numbers", "stated_medium",
]  # fmt: skip

TABLE_WIDTH = 132  # where the output is no terminal
FIG10 = {"sigma_t": 0.241, "albedo": 0.75, "g": 0.0, "eta": 1.3}
MEMORY = 3600.0  # seconds; steps may take minutes, and the time left is estimated from several of them


SigmaT = Annotated[float | None, typer.Option(help="Extinction, 1/mm.", show_default="0.241")]
Albedo = Annotated[float | None, typer.Option(help="Single-scattering albedo.", show_default="0.75")]
MeanCosine = Annotated[float | None, typer.Option(help="Mean cosine of the phase function.", show_default="0")]
Eta = Annotated[float | None, typer.Option(help="Index inside over outside.", show_default="1.3")]
Backend = Annotated[str, typer.Option(help="llvm or cuda.")]


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
    from halfspace_sss.physics.medium import Medium

    stated = {name: value for name, value in given.items() if value is not None}
    for name, value in stated.items():
        if materials:
            raise ValueError(f"{name} must be left out for a named material, got {value!r} with {materials[0]!r}")
    return Medium.from_albedo(**{**FIG10, **stated}) if stated else None


class Bar:
    """Progress with the time left, on stderr; appears with the first step, so that refused input leaves no trace."""

    def __init__(self, title: str) -> None:
        self._title = title
        self._progress: Any = None

    def __enter__(self) -> Bar:
        return self

    def show(self, done: int, total: int, text: str = "") -> None:
        """Move the bar; `text` says what was just done."""
        if self._progress is None:
            self._start(done, total)
        self._progress.update(self._task, completed=done, total=total, text=text)

    def _start(self, done: int, total: int) -> None:
        from rich.console import Console
        from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
        from rich.table import Column

        steps = (TextColumn(self._title), BarColumn(30), TextColumn("{task.percentage:.0f} %"))
        times = (TimeElapsedColumn(), TextColumn("left"), TimeRemainingColumn())
        text = TextColumn("{task.fields[text]}", markup=False, table_column=Column(ratio=1, no_wrap=True))
        screen = Console(stderr=True)
        self._progress = Progress(*steps, *times, text, console=screen, expand=True, speed_estimate_period=MEMORY)
        self._progress.start()
        self._task = self._progress.add_task("", total=total, completed=done, text="")

    def __exit__(self, *_: object) -> None:
        if self._progress is not None:
            self._progress.stop()


def console() -> Console:
    """A console that does not fold lines at 80 columns where the output is a file."""
    from rich.console import Console

    found = Console()
    return found if found.is_terminal else Console(width=TABLE_WIDTH)
