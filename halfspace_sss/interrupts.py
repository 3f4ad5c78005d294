"""Ctrl-C at any moment: it is remembered, for libraries wrap or swallow what Python raises inside their callbacks.

While Mitsuba renders it takes the signal itself, and Dr.Jit wraps the error.
"""

from __future__ import annotations

import os
import signal
import socket
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from types import FrameType

WAIT = 0.02  # seconds; until an interrupt during an import is heard again
_ENDS = (signal.SIGINT, signal.SIGTERM)
PATIENCE = 3.0  # seconds; until it is said that a kernel, in which Python hears nothing, has to end first


class Interrupts:
    """Watches for SIGINT and SIGTERM while a command runs; may be entered again inside."""

    def __init__(self) -> None:
        self.received: int | None = None
        self.told: bool = False
        self._depth = 0
        self._before: dict[int, Callable | int | None] = {}
        self._hook: Callable | None = None
        self._ear: socket.socket | None = None

    def __enter__(self) -> Interrupts:
        self._depth += 1
        if self._depth == 1:
            self.received, self.told = None, False
        if self._depth == 1 and threading.current_thread() is threading.main_thread():
            numbers = [*_ENDS, *([signal.SIGALRM] if hasattr(signal, "SIGALRM") else [])]
            self._before = {number: signal.signal(number, self._receive) for number in numbers}
            self._hook, sys.unraisablehook = sys.unraisablehook, self._unraisable
            self._listen()
        return self

    def __exit__(self, *_: object) -> None:
        self._depth -= 1
        if self._depth or not self._before:
            return
        for number, handler in self._before.items():
            signal.signal(number, handler)
        sys.unraisablehook, self._before = self._hook, {}
        signal.set_wakeup_fd(-1)
        self._ear.close()

    def _listen(self) -> None:
        """A thread that hears of signals at once: where a kernel runs on, a second one ends the program."""
        self._ear, mouth = socket.socketpair()
        self._ear.setblocking(False)
        signal.set_wakeup_fd(self._ear.fileno(), warn_on_full_buffer=False)
        threading.Thread(target=self._hear, args=(mouth,), daemon=True).start()

    def _hear(self, mouth: socket.socket) -> None:
        came, said = 0, False
        with mouth:
            while True:
                mouth.settimeout(PATIENCE if came and not said else None)
                try:
                    numbers = mouth.recv(64)
                except TimeoutError:
                    said = True
                    if not self.told:
                        os.write(2, b"interrupted; waits for a kernel that cannot be, the next one ends it\n")
                    continue
                if not numbers:
                    return
                came += sum(number in _ENDS for number in numbers)
                if said and came > 1:
                    os._exit(self.exit_code)

    def check(self) -> None:
        """Raise again what was swallowed."""
        if self.received is not None:
            raise KeyboardInterrupt

    @property
    def exit_code(self) -> int:
        """As a shell tells that a signal ended a program."""
        return 128 + (self.received or signal.SIGINT)

    def _receive(self, number: int, frame: FrameType | None) -> None:
        if number in _ENDS:
            if self.received is not None:
                return  # one is on its way, and must not be disturbed while it puts things in order
            self.received = number
        if self.received is None:
            return
        if _is_importing(frame) and hasattr(signal, "setitimer"):  # Mitsuba and Dr.Jit abort in the middle of one
            signal.setitimer(signal.ITIMER_REAL, WAIT)
        else:
            raise KeyboardInterrupt

    def _unraisable(self, result: sys.UnraisableHookArgs) -> None:
        if self.received is None:
            self._hook(result)


def _is_importing(frame: FrameType | None) -> bool:
    while frame is not None:
        if frame.f_code.co_filename == "<frozen importlib._bootstrap>":
            return True
        frame = frame.f_back
    return False


interrupts: Interrupts = Interrupts()


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


_cancelled: ContextVar[Callable[[], bool]] = ContextVar("cancelled", default=lambda: False)


@contextmanager
def cancellable(cancelled: Callable[[], bool]) -> Iterator[None]:
    """Work within it ends with a KeyboardInterrupt at its next `checkpoint` once `cancelled` says so."""
    token = _cancelled.set(cancelled)
    try:
        yield
    finally:
        _cancelled.reset(token)


def checkpoint() -> None:
    """End here if the work is cancelled; call it between parts of long work that leave all results whole."""
    if _cancelled.get()():
        raise KeyboardInterrupt


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
