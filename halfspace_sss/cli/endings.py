"""How commands end: the one place where errors become a line on stderr and an exit code.

0 done, 1 failed, 2 bad input, 130 interrupted (143 terminated).
"""

from __future__ import annotations

import shlex
import warnings
from typing import Any

import typer
from typer.core import TyperGroup

from halfspace_sss.backend import BackendError
from halfspace_sss.cli.interrupts import interrupts

__all__ = ["Commands", "tell_interrupt"]


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


STUDIES = ("ablation", "rivals", "shapes", "trade-check")  # which were commands of their own


class Commands(TyperGroup):
    """The commands; what the library refuses, and interrupts, end them in a line."""

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        if args[0] in STUDIES and self.get_command(ctx, args[0]) is None:
            raise ValueError(f"{args[0]} must be asked for as a study: `halfspace-sss study {shlex.join(args)}`")
        return super().resolve_command(ctx, args)

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
