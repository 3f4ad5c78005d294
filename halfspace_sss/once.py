"""A result that is computed once, whoever asks first and however many threads ask at the same time."""

from __future__ import annotations

import functools
import threading
from collections.abc import Callable
from typing import Any

__all__ = ["once"]


def once(f: Callable) -> Callable:
    """`functools.cache` under a lock: threads that ask while f runs wait for its result and do not run it again.

    Mitsuba makes the objects of a scene in parallel, each of which asks for materials and models.
    """
    cached, lock = functools.cache(f), threading.RLock()

    @functools.wraps(f)
    def answer(*args: Any) -> Any:
        with lock:
            return cached(*args)

    return answer
