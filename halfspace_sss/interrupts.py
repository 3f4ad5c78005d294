"""Ctrl-C while Mitsuba renders: it takes the signal, Dr.Jit wraps the error."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def interruptible() -> Iterator[None]:
    """An interrupt within it ends as a KeyboardInterrupt, and Python's handler is in place afterwards.

    Above it Dr.Jit makes a RuntimeError of that again, which `mitsuba.render` hands on as what it was, see `plugins`.
    """
    try:
        yield
    except BaseException as error:
        if not is_interrupt(error):
            raise
        raise KeyboardInterrupt from error
    finally:
        hear_again()


def is_interrupt(error: BaseException | None) -> bool:
    """Whether it is one, or was before a loop of Dr.Jit wrapped it."""
    while error is not None and not isinstance(error, KeyboardInterrupt):
        error = error.__cause__ or error.__context__
    return error is not None


def hear_again() -> None:
    """Put Python's handler back where Mitsuba left its own, which tells nobody of an interrupt."""
    if threading.current_thread() is threading.main_thread():
        handler = signal.getsignal(signal.SIGINT)
        if handler is not None:
            signal.signal(signal.SIGINT, handler)
