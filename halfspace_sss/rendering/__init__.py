"""Mitsuba 3 plugins: the BSSRDF of the half-space on any shape, and a random walk inside it as the reference.

    import halfspace_sss.rendering as rendering
    mi.set_variant("llvm_ad_rgb")
    rendering.register()                    # also after every later mi.set_variant

Plugins: the surface `translucent` (which material, model and scattering orders an object has), the integrators
`bssrdf` and `translucent_walk`.
"""

from __future__ import annotations

import importlib
from typing import Any

__all__ = ["register"]

_HOME = {"register": "plugins"}


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{_HOME[name]}"), name)
