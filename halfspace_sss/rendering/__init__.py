"""Mitsuba 3 plugins: the BSSRDF of the half-space on any shape, and a random walk inside it as the reference.

    import halfspace_sss.rendering as rendering
    mi.set_variant("llvm_ad_rgb")
    rendering.register()                    # also after every later mi.set_variant

Plugins: the surface `translucent` (which material, model and scattering orders an object has), the integrators
`bssrdf` and `translucent_walk`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from halfspace_sss.lazy import lazy_names

if TYPE_CHECKING:
    from halfspace_sss.rendering.plugins import register

__all__ = ["register"]

__getattr__, __dir__ = lazy_names(__name__, {"register": "plugins", "object": ""})
