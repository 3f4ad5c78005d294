"""One number from several, for what takes one seed."""

from __future__ import annotations

import numpy as np

__all__ = ["seeded"]


def seeded(*numbers: int) -> int:
    """A seed of 32 bits; other numbers give independent ones."""
    return int(np.random.SeedSequence([int(n) for n in numbers]).generate_state(1)[0])
