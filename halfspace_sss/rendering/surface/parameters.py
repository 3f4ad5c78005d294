"""The names of parameters that plugins take: one that none takes is refused."""

from __future__ import annotations

from collections.abc import Collection
from typing import Any

from halfspace_sss.checks import check_choice

__all__ = ["OF_MITSUBA", "check_parameters"]

OF_MITSUBA = ("block_size", "samples_per_pass", "timeout")  # read by its `SamplingIntegrator`


def check_parameters(plugin: str, props: Any, known: Collection[str]) -> None:
    """ValueError names the first parameter of a plugin that it does not know."""
    for key in props.keys():
        check_choice(f"parameter of {plugin}", key, known)
