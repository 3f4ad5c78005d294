"""Ctrl-C while Mitsuba renders: it takes the signal, and Dr.Jit makes another error of what Python raises."""

from __future__ import annotations

import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any

import mitsuba as mi

__all__ = ["hear_again", "interruptible"]


@contextmanager
def interruptible() -> Iterator[None]:
    """A KeyboardInterrupt within it is what `mitsuba.render` ends with, and Python's handler is in place afterwards."""
    try:
        yield
    except BaseException as error:
        if not _is_interrupt(error):
            raise
        _raise_past_mitsuba()
        raise KeyboardInterrupt from error
    finally:
        hear_again()


def _is_interrupt(error: BaseException | None) -> bool:
    """Whether it is one, or was before a loop of Dr.Jit wrapped it."""
    while error is not None and not isinstance(error, KeyboardInterrupt):
        error = error.__cause__ or error.__context__
    return error is not None


def _raise_past_mitsuba() -> None:
    """Let `mitsuba.render`, if it called, end with a KeyboardInterrupt, which Dr.Jit makes a RuntimeError below it."""
    frame, before = sys._getframe(), sys.getprofile()
    while frame is not None and frame.f_code is not mi.render.__code__:
        frame = frame.f_back
    if frame is None:
        return

    def end(ended: FrameType, event: str, _: Any) -> None:
        if ended is frame and event == "return":
            sys.setprofile(before)
            raise KeyboardInterrupt

    sys.setprofile(end)


def hear_again() -> None:
    """Put Python's handler back where Mitsuba left its own, which tells nobody of an interrupt."""
    if threading.current_thread() is threading.main_thread():
        handler = signal.getsignal(signal.SIGINT)
        if handler is not None:
            signal.signal(signal.SIGINT, handler)
