"""The command `halfspace-sss`: it listens to Ctrl-C before anything takes its time, then runs `figures.app`."""

from __future__ import annotations

import os
import signal
import sys
from typing import NoReturn


def main() -> None:
    """Run the command line; the entry point of `halfspace-sss`."""
    signal.signal(signal.SIGINT, _end)  # until `interrupts` watches
    for stream in (sys.stdout, sys.stderr):  # a terminal without ± shows ? there, and nothing is lost
        if hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="replace")
    from figures.app import app
    from halfspace_sss.interrupts import interrupts

    with interrupts:
        try:
            app()
        except BaseException as end:
            if interrupts.received is None:
                raise
            _leave(end)


def _end(*_: object) -> NoReturn:
    """End with a line while modules are imported; before, Python itself shows its traceback, for some 10 ms."""
    os.write(2, b"interrupted; files that were being written are whole or absent\n")
    os._exit(128 + signal.SIGINT)


def _leave(end: BaseException) -> NoReturn:
    """End at once: Mitsuba's and Dr.Jit's own ends are not made for the middle of work."""
    from halfspace_sss.cli.shared import tell_interrupt
    from halfspace_sss.interrupts import interrupts

    if not interrupts.told:
        tell_interrupt(end)
    for stream in (sys.stdout, sys.stderr):
        stream.flush()
    os._exit(interrupts.exit_code)


if __name__ == "__main__":
    main()
