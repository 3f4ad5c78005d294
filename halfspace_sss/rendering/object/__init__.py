"""Translucent objects: shape, surface and medium, points of the surface, and the transports laid onto it."""

from __future__ import annotations

from halfspace_sss.lazy import lazy_names

__getattr__, __dir__ = lazy_names(__name__, {"translucent": ""})
