"""Ctrl-C while the command line is being imported, before it has work that could be put in order."""

from __future__ import annotations

import os
import signal
import threading

__all__ = ["end_in_a_line"]


def end_in_a_line() -> None:
    """From now on SIGINT ends the process with one line and 130, until `cli.interrupts` watches.

    Python itself starts in some 10 ms, in which it shows its own traceback.
    """
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGINT, _end)


def _end(*_: object) -> None:
    os.write(2, b"interrupted; files that were being written are whole or absent\n")
    os._exit(128 + signal.SIGINT)
