"""What a scene says of a translucent object: its material and model, its shape."""

from __future__ import annotations

from halfspace_sss.lazy import lazy_names

__getattr__, __dir__ = lazy_names(__name__, {"translucent": ""})
