"""What Mitsuba raises, brought down to its first cause: errors of plugins come wrapped, with tracebacks inside."""

from __future__ import annotations

import re

__all__ = ["first_cause"]

_PLACE = re.compile(r"(?:At|While loading) (.+? \(line \d+, col \d+\)|\S+): ")
_SOURCE = re.compile(r"^\[[\w.]+:\d+\] ")
_PLUGIN = re.compile(r'failed to instantiate \w+ plugin of type "[^"]*": ')
_RAISED = re.compile(r"^(?:[\w.]*\.)?(\w+): (.*)", re.MULTILINE | re.DOTALL)
_TRACEBACK = "Traceback (most recent call last):"


def first_cause(error: BaseException) -> str:
    """One line: where in the scene file, if that is told, and what was wrong there first."""
    while error.__cause__ is not None or error.__context__ is not None:
        error = error.__cause__ or error.__context__
    text = str(error)
    place = _PLACE.search(text)
    if _TRACEBACK in text:
        frames = text[text.rindex(_TRACEBACK) :].splitlines()[1:]
        said = next((k for k, line in enumerate(frames) if line[:1].strip()), len(frames))  # frames are indented
        raised = _RAISED.match("\n".join(frames[said:]).strip())
        text = raised[2] if raised else "\n".join(frames[said:])
    else:
        text = _PLUGIN.sub("", _PLACE.sub("", _SOURCE.sub("", text)))
        text = _SOURCE.sub("", text)
    line = " ".join(text.split()) or type(error).__name__
    return f"{place[1]}: {line}" if place else line
