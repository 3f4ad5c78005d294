"""Where networks are fitted: beside the walks that are their data."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import torch

__all__ = ["device_of_walks", "one_thread", "tensor"]


def device_of_walks() -> torch.device:
    """The GPU if Mitsuba's variant runs there and torch can, else the CPU."""
    import mitsuba as mi

    there = (mi.variant() or "").startswith("cuda") and torch.cuda.is_available()
    return torch.device("cuda" if there else "cpu")


def tensor(array: np.ndarray, device: torch.device) -> torch.Tensor:
    """An array where networks are fitted; on the CPU without a copy."""
    return torch.from_numpy(array).to(device)


@contextmanager
def one_thread() -> Iterator[None]:
    """Torch with one thread: layers this small gain little by being shared, and threads that wait spin."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)
