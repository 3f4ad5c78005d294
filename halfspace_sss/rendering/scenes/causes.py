"""What Mitsuba raises, brought down to its first cause: errors of plugins come wrapped, with tracebacks inside."""

from __future__ import annotations

import functools
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

from halfspace_sss.interrupts import is_interrupt

__all__ = ["SceneError", "first_cause", "plainly"]

_HERE = str(Path(__file__).parents[3])

_PLACE = re.compile(r"(?:At|While loading) (?:dictionary node )?(.+? \(line \d+, col \d+\)|\S+): ")
_SOURCE = re.compile(r"^\[[\w.]+:\d+\] ")
_PLUGIN = re.compile(r'failed to instantiate \w+ plugin of type "[^"]*": ')
_RAISED = re.compile(r"^(?:[\w.]*\.)?(\w+): (.*)", re.MULTILINE | re.DOTALL)
_EMPTY = re.compile(r'shape plugin of type "\w+": .*operands have incompatible sizes! \(sizes: 0,')
_TRACEBACK = "Traceback (most recent call last):"


def first_cause(error: BaseException) -> str:
    """One line: where in the scene file, if that is told, and what was wrong there first."""
    while error.__cause__ is not None or error.__context__ is not None:
        error = error.__cause__ or error.__context__
    text = str(error)
    place = _PLACE.search(text)
    if _EMPTY.search(text):
        text = "a mesh must have faces, got none"
    elif _TRACEBACK in text:
        frames = text[text.rindex(_TRACEBACK) :].splitlines()[1:]
        said = next((k for k, line in enumerate(frames) if line[:1].strip()), len(frames))  # frames are indented
        raised = _RAISED.match("\n".join(frames[said:]).strip())
        text = raised[2] if raised else "\n".join(frames[said:])
    else:
        text = _PLUGIN.sub("", _PLACE.sub("", _SOURCE.sub("", text)))
        text = _SOURCE.sub("", text)
    line = " ".join(text.split()) or type(error).__name__
    return f"{place[1]}: {line}" if place and place[1] != '"root"' else line


class SceneError(ValueError, RuntimeError):
    """What a plugin of this project refuses, in place of the RuntimeError by which Mitsuba hands that on."""


def plainly(function: Callable) -> Callable:
    """A function of Mitsuba whose errors say first what a plugin of this project refused, as a `SceneError`.

    An interrupt that Dr.Jit has wrapped is a KeyboardInterrupt again.
    """

    @functools.wraps(function)
    def found(*args: Any, **more: Any) -> Any:
        try:
            return function(*args, **more)
        except RuntimeError as error:
            if is_interrupt(error):
                end: BaseException = KeyboardInterrupt()
            elif _is_ours(error):
                end = SceneError(first_cause(error))
            else:
                raise
        raise end

    found.__wrapped__ = function
    return found


def _is_ours(error: BaseException) -> bool:
    """Whether a plugin of this project raised a ValueError: by the files of its traceback, or of that in the text.

    A mesh without faces counts too: what Mitsuba says of it says nothing.
    """
    while error.__cause__ is not None or error.__context__ is not None:
        error = error.__cause__ or error.__context__
    if isinstance(error, ValueError):
        files, place = [], error.__traceback__
        while place is not None:
            files.append(place.tb_frame.f_code.co_filename)
            place = place.tb_next
        return bool(files) and files[-1].startswith(_HERE)
    text = str(error)
    if _EMPTY.search(text):
        return True
    return _TRACEBACK in text and "ValueError: " in text and _HERE in text[text.rindex(_TRACEBACK) :]
