"""Where derivatives are followed, and where they are not."""

from __future__ import annotations

from contextlib import AbstractContextManager

import drjit as dr

__all__ = ["detached", "tracking"]


def tracking(when: bool) -> AbstractContextManager:
    """Where derivatives are followed, in a replay."""
    return dr.resume_grad(when=when)


def detached() -> AbstractContextManager:
    """Where they are not: for what decides where a path goes."""
    return dr.suspend_grad()
