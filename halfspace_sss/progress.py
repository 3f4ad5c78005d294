"""The callbacks of long work, which tell how far it is."""

from __future__ import annotations

from collections.abc import Callable

Progress = Callable[[int, int], None]  # steps done, steps in all
ProgressText = Callable[[int, int, str], None]  # steps done, steps in all, what was just done
NamedProgress = Callable[[str, int, int], None]  # what is done, steps done, steps in all
